"""Ground truth of a simulated world: classes, instances and parts, per pixel and per surface point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import PosedFrame

NOTHING = 0
"""Part, instance and class of a pixel that shows nothing."""


@dataclass(frozen=True)
class Truth:
    """The parts, instances and classes of a world. Each is numbered from 1; 0 is nothing.

    A part belongs to an instance, and an instance to a class. A wall is an instance too, of a background class. A thing
    without parts has itself as its only part.

    Attributes:
        class_names: Name of each class; the first is empty and stands for nothing.
        background: Numbers of the classes of the building itself, such as wall and floor.
        class_of_instance: (instances + 1,) int32, 0 first.
        instance_of_part: (parts + 1,) int32, 0 first.
    """

    class_names: tuple[str, ...]
    background: frozenset[int]
    class_of_instance: NDArray[np.int32]
    instance_of_part: NDArray[np.int32]

    @property
    def class_of_part(self) -> NDArray[np.int32]:
        """Class of each part: (parts + 1,) int32, 0 first."""
        return self.class_of_instance[self.instance_of_part]


@dataclass(frozen=True)
class LabelledFrame:
    """A frame as the robot records it, and its ground truth.

    Attributes:
        frame: The frame with noisy depth and the pose that the robot believes.
        T_true_camera: (4, 4) true pose of the optical frame in the world.
        true_depth_m: (H, W) float32 metres along the optical axis, 0 where there is nothing.
        parts: (H, W) int32, part at each pixel of the colour image, 0 for none.
    """

    frame: PosedFrame
    T_true_camera: NDArray[np.float64]
    true_depth_m: NDArray[np.float32]
    parts: NDArray[np.int32]


@dataclass(frozen=True)
class SurfacePoints:
    """Sample points of all surfaces of a world.

    Attributes:
        points_m: (n, 3) float64, metres.
        parts: (n,) int32, part of each point.
    """

    points_m: NDArray[np.float64]
    parts: NDArray[np.int32]
