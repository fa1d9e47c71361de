"""Procedural, seeded textures of low contrast that repeat on every side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Color = tuple[int, int, int]

_SIZE = 256


def plain(color: Color) -> NDArray[np.uint8]:
    """Make a texture of one colour, (4, 4, 3) uint8."""
    return np.full((4, 4, 3), color, np.uint8)


def plaster(color: Color, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Make a painted wall: soft blotches of a few grey values."""
    return _shaded(color, 0.7 * _noise(rng, 20.0, 20.0) + 0.7 * _noise(rng, 1.0, 1.0))


def fabric(color: Color, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Make woven cloth: fine threads both ways."""
    return _shaded(color, 2.5 * _noise(rng, 0.7, 5.0) + 2.5 * _noise(rng, 5.0, 0.7) + 1.5 * _noise(rng, 16.0, 16.0))


def wood(color: Color, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Make a board with its grain along the rows."""
    return _shaded(color, 4.0 * _noise(rng, 50.0, 1.5) + 1.5 * _noise(rng, 10.0, 0.7))


def planks(color: Color, rng: np.random.Generator, rows: int = 4) -> NDArray[np.uint8]:
    """Make a floor of boards along the rows, each a little lighter or darker, with faint joints."""
    height = _SIZE // rows
    shade = 4.0 * _noise(rng, 60.0, 1.5) + 1.5 * _noise(rng, 10.0, 0.7)
    for row in range(rows):
        band = shade[row * height : (row + 1) * height]
        end = int(rng.integers(_SIZE))
        band[:] = np.roll(band, end, axis=1) + rng.uniform(-4.0, 4.0)
        band[0] -= 14.0
        band[:, end] -= 14.0
    return _shaded(color, shade)


def rug(color: Color, border: Color, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Make a rug with a border, to be stretched over a rectangle."""
    texture = fabric(color, rng)
    edge = fabric(border, rng)
    inner = slice(_SIZE // 14, -_SIZE // 14)
    edge[inner, inner] = texture[inner, inner]
    return edge


def _noise(rng: np.random.Generator, sigma_x: float, sigma_y: float) -> NDArray[np.float32]:
    """Draw unit-variance Gaussian noise of a given grain that repeats on every side."""
    field = np.tile(rng.standard_normal((_SIZE, _SIZE), np.float32), (3, 3))
    smooth = cv2.GaussianBlur(field, (0, 0), sigmaX=sigma_x, sigmaY=sigma_y)[_SIZE : 2 * _SIZE, _SIZE : 2 * _SIZE]
    result: NDArray[np.float32] = smooth / smooth.std()
    return result


def _shaded(color: Color, shade: NDArray[np.float32]) -> NDArray[np.uint8]:
    values = np.asarray(color, np.float32) * (1.0 + shade[..., None] / 128.0)
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)
