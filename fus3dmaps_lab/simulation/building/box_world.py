"""A world of axis-aligned boxes. Each box belongs to a part, the part to an instance, the instance to a class.

Frames: world x east, y north, z up, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_lab.simulation.truth import Truth

Color = tuple[int, int, int]


@dataclass(frozen=True)
class BoxWorld:
    """All boxes of a world with their labels.

    Attributes:
        low_m: (n, 3) float64 lower corners.
        high_m: (n, 3) float64 upper corners.
        part: (n,) int32 part of each box.
        color: (n, 3) uint8.
        truth: Instances and classes of the parts.
    """

    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]
    part: NDArray[np.int32]
    color: NDArray[np.uint8]
    truth: Truth


@dataclass(frozen=True)
class Piece:
    """A box of a part, in the frame of its instance.

    Attributes:
        part: Name of the part.
        low_m: Lower corner.
        high_m: Upper corner.
        color: Colour of its surface.
    """

    part: str
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    color: Color


@dataclass(frozen=True)
class Pose:
    """Place of an instance: quarter turns about z, then a translation.

    Attributes:
        position_m: Position of its origin.
        quarter_turns: Counter-clockwise, seen from above. With 0 it faces south, its back to the north.
    """

    position_m: tuple[float, float, float]
    quarter_turns: int = 0

    def place(self, low_m: Sequence[float], high_m: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Move a box from the instance's frame to the world and return its lower and upper corner."""
        corners = np.array([low_m, high_m], np.float64)
        for _ in range(self.quarter_turns % 4):
            corners[:, :2] = np.stack([-corners[:, 1], corners[:, 0]], axis=1)
        corners = np.sort(corners, axis=0) + self.position_m
        return corners[0], corners[1]


@dataclass
class BoxWorldBuilder:
    """Builds a world instance by instance.

    Attributes:
        background: Names of the classes of the building itself.
    """

    background: frozenset[str]
    _classes: list[str] = field(default_factory=lambda: [""])
    _class_of_instance: list[int] = field(default_factory=lambda: [0])
    _instance_of_part: list[int] = field(default_factory=lambda: [0])
    _boxes: list[tuple[NDArray[np.float64], NDArray[np.float64], int, Color]] = field(default_factory=list)

    def add(self, class_name: str, pieces: Sequence[Piece], pose: Pose | None = None) -> int:
        """Add an instance. Pieces with the same part name form one part.

        Returns:
            Its number.

        Raises:
            ValueError: It has no piece.
        """
        if not pieces:
            raise ValueError(f"'{class_name}' has no surface")
        if class_name not in self._classes:
            self._classes.append(class_name)
        instance = len(self._class_of_instance)
        self._class_of_instance.append(self._classes.index(class_name))
        parts: dict[str, int] = {}
        for piece in pieces:
            if piece.part not in parts:
                parts[piece.part] = len(self._instance_of_part)
                self._instance_of_part.append(instance)
            low_m, high_m = (pose or Pose((0.0, 0.0, 0.0))).place(piece.low_m, piece.high_m)
            self._boxes.append((low_m, high_m, parts[piece.part], piece.color))
        return instance

    def build(self) -> BoxWorld:
        """Return the world of all instances added so far."""
        truth = Truth(
            tuple(self._classes),
            frozenset(number for number, name in enumerate(self._classes) if name in self.background),
            np.array(self._class_of_instance, np.int32),
            np.array(self._instance_of_part, np.int32),
        )
        return BoxWorld(
            np.array([low for low, _, _, _ in self._boxes]).reshape(-1, 3),
            np.array([high for _, high, _, _ in self._boxes]).reshape(-1, 3),
            np.array([part for _, _, part, _ in self._boxes], np.int32),
            np.array([color for _, _, _, color in self._boxes], np.uint8).reshape(-1, 3),
            truth,
        )
