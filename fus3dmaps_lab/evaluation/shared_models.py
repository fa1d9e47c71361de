"""Models that are shared by several maps of the same frames: each image is segmented and embedded only once.

An image is recognised if it is the same array object. The pipeline passes on the same object if it has the working
resolution.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import CropEncoder, EncoderTrio, PatchEmbeddings, PatchEncoder
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.protocols import Segmenter


def shared_trio(trio: EncoderTrio) -> EncoderTrio:
    """Wrap a trio such that its image encoders remember the results of the newest image."""
    return replace(trio, patch=_PatchesOnce(trio.patch), crop=_CropsOnce(trio.crop))


def shared_segmenter(segmenter: Segmenter) -> Segmenter:
    """Wrap a segmenter such that it remembers the masks of the newest image."""
    return _MasksOnce(segmenter)


class _PatchesOnce:
    def __init__(self, encoder: PatchEncoder) -> None:
        self._encoder = encoder
        self._rgb: NDArray[np.uint8] | None = None
        self._patches: PatchEmbeddings | None = None

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return self._encoder.grid(height, width)

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        if self._patches is None or self._rgb is not rgb:
            self._rgb, self._patches = rgb, self._encoder.encode_patches(rgb)
        return self._patches


class _CropsOnce:
    """A crop encoder that remembers the newest image's embeddings by the boxes and pixels of the masks."""

    def __init__(self, encoder: CropEncoder) -> None:
        self._encoder = encoder
        self._rgb: NDArray[np.uint8] | None = None
        self._known: dict[bytes, NDArray[np.float32]] = {}

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        if self._rgb is not rgb:
            self._rgb, self._known = rgb, {}
        names = [_name(masks, row) for row in range(len(masks))]
        unknown = [row for row, name in enumerate(names) if name not in self._known]
        if unknown:
            self._known |= zip(
                (names[row] for row in unknown), self._encoder.encode_crops(rgb, masks.take(np.array(unknown))), strict=True
            )
        return np.stack([self._known[name] for name in names])


def _name(masks: Masks, row: int) -> bytes:
    x0, y0, x1, y1 = masks.boxes[row]
    return bytes(masks.boxes[row].tobytes() + np.packbits(masks.masks[row, y0:y1, x0:x1]).tobytes())


class _MasksOnce:
    def __init__(self, segmenter: Segmenter) -> None:
        self._segmenter = segmenter
        self._rgb: NDArray[np.uint8] | None = None
        self._masks: Masks | None = None

    def segment(self, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Masks:
        if self._masks is None or self._rgb is not rgb:
            self._rgb, self._masks = rgb, self._segmenter.segment(rgb, depth_m)
        return self._masks
