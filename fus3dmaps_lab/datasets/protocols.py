"""What a dataset is to the rest: a scene's posed frames, and where it has them, the true classes of its pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics, PosedFrame

TruePoints = tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]]
"""(n, 3) metres in the frame of the poses, (n,) class ids, (n,) instance ids; 0 where unlabelled or of no instance."""


@dataclass(frozen=True)
class Labels:
    """The classes that a scene's labels tell apart.

    Attributes:
        class_names: Index is the class id; 0 means unlabelled, and its name is empty.
        background: Ids of the classes that are left out where background does not count.
    """

    class_names: tuple[str, ...] = ("",)
    background: frozenset[int] = frozenset()

    @classmethod
    def of(cls, names: list[str], background: frozenset[str]) -> Labels:
        """Classes 1, 2, ... with these names, of which those in ``background`` are background."""
        return cls(("", *names), frozenset(i for i, name in enumerate(names, start=1) if name in background))


class Dataset(Protocol):
    """A scene of posed RGB-D frames; iterating twice gives the same frames twice."""

    @property
    def name(self) -> str:
        """Name of the layout, as the registry knows it."""
        ...

    @property
    def scene(self) -> str:
        """Name of the scene."""
        ...

    @property
    def intrinsics(self) -> Intrinsics:
        """Camera model of the colour images."""
        ...

    def __len__(self) -> int:
        """Number of frames that are yielded."""
        ...

    def __iter__(self) -> Iterator[PosedFrame]:
        """The frames in order of their stamps.

        Raises:
            RecordingError: A file cannot be read or holds something else than it should; the message names the file.
        """
        ...


class LabelledDataset(Dataset, Protocol):
    """A scene whose true classes are known, by pixel or by surface point."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """Index is the class id; 0 means unlabelled, and its name is empty."""
        ...

    @property
    def background(self) -> frozenset[int]:
        """Ids of wall, floor, ceiling and their like."""
        ...

    def label_image(self, index: int) -> NDArray[np.int32]:
        """(H, W) class ids, pixel by pixel those of the colour image of frame ``index``; 0 where unlabelled.

        Raises:
            RecordingError: The scene has no label images, or this one cannot be used; the message names the file.
        """
        ...

    def instance_image(self, index: int) -> NDArray[np.int32] | None:
        """(H, W) instance ids, 0 where there is none; None if the scene has no such images.

        Raises:
            RecordingError: The image cannot be used; the message names the file.
        """
        ...

    def ground_truth_points(self) -> TruePoints | None:
        """Labelled points of the surface; None where labels are to be had from the label images.

        Raises:
            RecordingError: The file of the surface cannot be used; the message names it.
        """
        ...
