"""The base of all datasets: a sequence of frames, each with files of colour, depth and labels, a stamp and a pose."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import ConfigError, FrameError, RecordingError
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_lab.datasets.checked_files import read_ids, read_rgb
from fus3dmaps_lab.datasets.protocols import Labels, TruePoints


@dataclass(frozen=True)
class FrameFiles:
    """The files of a frame, with its stamp and pose.

    Attributes:
        stamp_ns: Time of the image, nanoseconds.
        rgb: Colour image.
        depth: Depth image.
        T_world_camera: (4, 4) float64 pose of the optical frame in the frame of the dataset's poses.
        labels: Image of the release's class ids, or None.
        instances: Image of instance ids, or None.
    """

    stamp_ns: int
    rgb: Path
    depth: Path
    T_world_camera: NDArray[np.float64]
    labels: Path | None = None
    instances: Path | None = None


class ImageSequence(ABC):
    """A scene made of files. Subclasses read depth and translate label values.

    Attributes:
        name: Name of the layout.
        lost_poses: Number of frames left out because they have no pose.
    """

    name: str

    def __init__(
        self,
        scene: str,
        intrinsics: Intrinsics,
        frames: Sequence[FrameFiles],
        labels: Labels | None = None,
        lost_poses: int = 0,
    ) -> None:
        """Store the list of frames.

        Raises:
            RecordingError: There are none.
        """
        if not frames:
            raise RecordingError(f"scene '{scene}' has no frame with a pose; {lost_poses} have none")
        self._scene = scene
        self._intrinsics = intrinsics
        self._frames = list(frames)
        self._labels = labels or Labels()
        self.lost_poses = lost_poses

    @property
    def scene(self) -> str:
        """Name of the scene."""
        return self._scene

    @property
    def intrinsics(self) -> Intrinsics:
        """Camera model of the colour images."""
        return self._intrinsics

    @property
    def class_names(self) -> tuple[str, ...]:
        """Name by class id; 0 means unlabelled, and its name is empty. Without labels it is the only one."""
        return self._labels.class_names

    @property
    def background(self) -> frozenset[int]:
        """Ids of the background classes."""
        return self._labels.background

    def __len__(self) -> int:
        """Count the frames."""
        return len(self._frames)

    def __iter__(self) -> Iterator[PosedFrame]:
        """Yield the frames in order.

        Raises:
            RecordingError: A file cannot be read or has the wrong content; the message names the file.
        """
        for files in self._frames:
            rgb, depth_m = self._read_rgb(files.rgb), self._read_depth(files.depth)
            try:
                yield PosedFrame(files.stamp_ns, rgb, depth_m, self._intrinsics, files.T_world_camera)
            except FrameError as error:
                raise RecordingError(f"'{files.rgb}': {error}") from None

    def label_image(self, index: int) -> NDArray[np.int32]:
        """Return the (H, W) class ids of the pixels of frame ``index``'s colour image; 0 is unlabelled.

        Raises:
            RecordingError: There is no label image, or it cannot be used; the message names the file.
        """
        files = self._frames[index]
        if files.labels is None:
            raise RecordingError(f"scene '{self._scene}' has no label image for '{files.rgb}'")
        raw = self._aligned(files.labels)
        try:
            return self._classes(raw, files.labels)
        except IndexError:
            raise RecordingError(f"'{files.labels}' holds the value {raw.max()}, which is no class") from None

    def instance_image(self, index: int) -> NDArray[np.int32] | None:
        """Return the (H, W) instance ids of frame ``index``, 0 for none; None if the scene has no such images.

        Raises:
            RecordingError: The image cannot be used; the message names the file.
        """
        path = self._frames[index].instances
        return None if path is None else self._aligned(path)

    def ground_truth_points(self) -> TruePoints | None:
        """Return None: without an override, a dataset has no labelled surface."""
        return None

    @abstractmethod
    def _read_depth(self, path: Path) -> NDArray[np.float32]:
        """Read depth as (h, w) float32 metres, 0 where there is no reading."""

    def _read_rgb(self, path: Path) -> NDArray[np.uint8]:
        return read_rgb(path)

    def _read_ids(self, path: Path) -> NDArray[np.int32]:
        """Read the (H, W) values of a label image as the release stores them."""
        return read_ids(path)

    def _classes(self, raw: NDArray[np.int32], path: Path) -> NDArray[np.int32]:
        """Translate the release's values to (H, W) class ids; raise IndexError for an unknown value. Here both are equal."""
        if raw.max(initial=0) >= len(self.class_names):
            raise IndexError
        return raw

    def _aligned(self, path: Path) -> NDArray[np.int32]:
        raw = self._read_ids(path)
        if raw.shape != (self._intrinsics.height, self._intrinsics.width):
            raise RecordingError(
                f"'{path}' is {raw.shape[1]}x{raw.shape[0]}, its colour image "
                f"{self._intrinsics.width}x{self._intrinsics.height}"
            )
        return raw


def every(count: int, stride: int) -> range:
    """Choose every ``stride``-th of ``count`` places, starting with the first.

    Raises:
        ConfigError: The stride is not positive.
    """
    if stride < 1:
        raise ConfigError(f"option 'stride' must be at least 1, got {stride}")
    return range(0, count, stride)


def lookup_table(class_of_value: dict[int, int]) -> NDArray[np.int32]:
    """Make a table, (n,), of class ids by value; -1 for unknown values in between, 0 stays 0."""
    table = np.full(max(class_of_value, default=0) + 1, -1, np.int32)
    for value, class_id in class_of_value.items():
        table[value] = class_id
    table[0] = 0
    return table


def look_up(table: NDArray[np.int32], raw: NDArray[np.int32]) -> NDArray[np.int32]:
    """Look up the classes of values in a :func:`lookup_table`; raise IndexError for an unknown value."""
    classes = table[raw]
    if classes.min(initial=0) < 0:
        raise IndexError
    return np.asarray(classes, np.int32)
