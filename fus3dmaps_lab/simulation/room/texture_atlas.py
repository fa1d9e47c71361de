"""An atlas: many textures with their half, quarter, ... sizes in one image, sampled at any positions in one call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_PADDING = 2  # Bilinear sampling reaches one texel beyond a texture; the second covers OpenCV's fixed-point coordinates.
_CHUNK = 512  # cv2.remap refuses maps longer than 32,767 in either direction, so flat lists are folded to this width.


@dataclass(frozen=True)
class Tiles:
    """Places of the packed images in an atlas.

    Attributes:
        image: The atlas, (h, w) or (h, w, channels).
        left: (n,) float32 column of the first texel of each image.
        top: (n,) float32 row of the first texel.
        width: (n,) float32 texels.
        height: (n,) float32 texels.
    """

    image: NDArray[Any]
    left: NDArray[np.float32]
    top: NDArray[np.float32]
    width: NDArray[np.float32]
    height: NDArray[np.float32]

    def sample(self, tile: NDArray[np.integer], u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[Any]:
        """Sample the images bilinearly.

        Args:
            tile: (n,) index of the image.
            u: (n,) in [0, 1], left edge to right edge.
            v: (n,) in [0, 1], top edge to bottom edge.

        Returns:
            (n,) or (n, channels) of the atlas's dtype.
        """
        n = len(tile)
        x = np.zeros((-(-n // _CHUNK), _CHUNK), np.float32)
        y = np.zeros_like(x)
        # Texel centres are integers in the atlas, and an image's left edge is half a texel before its first centre.
        np.subtract(u * self.width[tile] + self.left[tile], np.float32(0.5), out=x.reshape(-1)[:n])
        np.subtract(v * self.height[tile] + self.top[tile], np.float32(0.5), out=y.reshape(-1)[:n])
        sampled: NDArray[Any] = cv2.remap(self.image, x, y, cv2.INTER_LINEAR).reshape(-1, *self.image.shape[2:])
        return sampled[:n]


def pack(images: Sequence[NDArray[Any]], repeats: Sequence[bool]) -> Tiles:
    """Pack images of one dtype and channel count, tallest first, in rows.

    Args:
        images: (h, w) or (h, w, channels) each.
        repeats: Whether an image continues with its opposite side (a repeating texture) or with its own edge.
    """
    padded = [
        cv2.copyMakeBorder(image, *(4 * [_PADDING]), cv2.BORDER_WRAP if repeat else cv2.BORDER_REPLICATE)
        for image, repeat in zip(images, repeats, strict=True)
    ]
    area = sum(image.shape[0] * image.shape[1] for image in padded)
    atlas_width = max(int(np.sqrt(1.2 * area)), max(image.shape[1] for image in padded))
    left, top = np.zeros(len(padded), np.int64), np.zeros(len(padded), np.int64)
    x = y = row_height = 0
    for index in sorted(range(len(padded)), key=lambda i: (-padded[i].shape[0], i)):
        height, width = padded[index].shape[:2]
        if x + width > atlas_width:
            x, y, row_height = 0, y + row_height, 0
        left[index], top[index] = x, y
        x, row_height = x + width, max(row_height, height)
    atlas = np.zeros((y + row_height, atlas_width, *padded[0].shape[2:]), padded[0].dtype)
    for image, x0, y0 in zip(padded, left, top, strict=True):
        atlas[y0 : y0 + image.shape[0], x0 : x0 + image.shape[1]] = image
    return Tiles(
        atlas,
        (left + _PADDING).astype(np.float32),
        (top + _PADDING).astype(np.float32),
        np.array([image.shape[1] for image in images], np.float32),
        np.array([image.shape[0] for image in images], np.float32),
    )


class MipAtlas:
    """Textures that are sampled at the size of a pixel's footprint (trilinear mip-mapping), which avoids glitter."""

    def __init__(self, textures: Sequence[NDArray[np.uint8]], repeats: Sequence[bool]) -> None:
        """Pack every texture with all of its smaller sizes; ``repeats`` as in :func:`pack`."""
        images: list[NDArray[np.uint8]] = []
        wraps: list[bool] = []
        first, levels = [], []
        for texture, repeat in zip(textures, repeats, strict=True):
            pyramid = [texture]
            while min(pyramid[-1].shape[:2]) > 1:
                height, width = pyramid[-1].shape[:2]
                pyramid.append(cv2.resize(pyramid[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
            first.append(len(images))
            levels.append(len(pyramid) - 1)
            images += pyramid
            wraps += [repeat] * len(pyramid)
        self._tiles = pack(images, wraps)
        self._first = np.array(first, np.int32)
        self._last_level = np.array(levels, np.float32)

    def sample(
        self,
        texture: NDArray[np.integer],
        u: NDArray[np.float32],
        v: NDArray[np.float32],
        level: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Sample textures at a level of detail.

        Args:
            texture: (n,) index of the texture.
            u: (n,) in [0, 1].
            v: (n,) in [0, 1].
            level: (n,) log2 of texels per pixel at full size; clipped to the existing sizes.

        Returns:
            (n, 3) float32 in [0, 255].
        """
        last = self._last_level[texture]
        level = np.clip(level, 0, last)
        lower = np.floor(level)
        share = (level - lower)[:, None]
        fine = self._first[texture] + lower.astype(np.int32)
        coarse = fine + (lower < last)
        near = self._tiles.sample(fine, u, v).astype(np.float32)
        far = self._tiles.sample(coarse, u, v).astype(np.float32)
        far -= near
        far *= share
        far += near
        return far
