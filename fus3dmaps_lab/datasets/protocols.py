"""The interface of all datasets: the posed frames of a scene and, if it has them, the true classes of its pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics, PosedFrame

TruePoints = tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]]
"""(n, 3) metres in the frame of the poses, (n,) class ids, (n,) instance ids; 0 is unlabelled or no instance."""


@dataclass(frozen=True)
class Labels:
    """The classes of a scene's labels.

    Attributes:
        class_names: Name by class id; 0 means unlabelled, and its name is empty.
        background: Ids of the classes that are left out if background does not count.
    """

    class_names: tuple[str, ...] = ("",)
    background: frozenset[int] = frozenset()

    @classmethod
    def of(cls, names: list[str], background: frozenset[str]) -> Labels:
        """Assign the numbers 1, 2, ... to classes with these names; those named in ``background`` are background."""
        return cls(("", *names), frozenset(i for i, name in enumerate(names, start=1) if name in background))


class Dataset(Protocol):
    """A scene of posed RGB-D frames; every iteration gives the same frames."""

    @property
    def name(self) -> str:
        """Name of the layout in the registry."""

    @property
    def scene(self) -> str:
        """Name of the scene."""

    @property
    def intrinsics(self) -> Intrinsics:
        """Camera model of the colour images."""

    def __len__(self) -> int:
        """Count the frames that an iteration yields."""

    def __iter__(self) -> Iterator[PosedFrame]:
        """Yield the frames in order of their stamps.

        Raises:
            RecordingError: A file cannot be read or has the wrong content; the message names the file.
        """


class LabelledDataset(Dataset, Protocol):
    """A scene whose true classes are known, for pixels or for surface points."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """Name by class id; 0 means unlabelled, and its name is empty."""

    @property
    def background(self) -> frozenset[int]:
        """Ids of wall, floor, ceiling and similar classes."""

    def label_image(self, index: int) -> NDArray[np.int32]:
        """Return the (H, W) class ids of the pixels of frame ``index``'s colour image; 0 is unlabelled.

        Raises:
            RecordingError: The scene has no label images, or this one cannot be used; the message names the file.
        """

    def instance_image(self, index: int) -> NDArray[np.int32] | None:
        """Return (H, W) instance ids, 0 for none; None if the scene has no such images.

        Raises:
            RecordingError: The image cannot be used; the message names the file.
        """

    def ground_truth_points(self) -> TruePoints | None:
        """Return labelled points of the surface; None if the labels are those of the label images.

        Raises:
            RecordingError: The file of the surface cannot be used; the message names it.
        """
