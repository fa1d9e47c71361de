"""Encoders and a segmenter of known behaviour, so that the pipeline's own work can be checked.

A patch or crop is described by its mean colour and a text by the colour it names; objects are regions of one colour.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fus3dmaps_core.encoders.protocols import EncoderTrio, PatchEmbeddings
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_core.masks import Masks

COLORS = {
    "red": (220, 30, 30),
    "green": (30, 200, 30),
    "blue": (30, 30, 220),
    "yellow": (220, 220, 30),
    "grey": (128, 128, 128),
}
DIMENSION = 8


def embed(colors: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 8) of colours (n, 3): gaussian responses to the named ones."""
    anchors = np.array(list(COLORS.values()), float)
    distance = np.linalg.norm(np.asarray(colors, float)[:, None] - anchors[None], axis=2)
    response = np.concatenate([np.exp(-((distance / 90) ** 2)) + 1e-3, np.zeros((len(distance), 3))], axis=1)
    return (response / np.linalg.norm(response, axis=1, keepdims=True)).astype(np.float32)


class ColorEncoder:
    """Patch, crop and text encoder in one."""

    space = "stand_in"

    def __init__(self) -> None:
        self.images = 0

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return height // 16, width // 16

    def encode_patches(self, rgb: np.ndarray) -> PatchEmbeddings:
        self.images += 1
        rows, columns = self.grid(*rgb.shape[:2])
        means = rgb[: rows * 16, : columns * 16].reshape(rows, 16, columns, 16, 3).mean(axis=(1, 3))
        return PatchEmbeddings(
            embed(means.reshape(-1, 3)).reshape(rows, columns, DIMENSION), np.ones((rows, columns), np.float32)
        )

    def encode_crops(self, rgb: np.ndarray, masks: Masks) -> np.ndarray:
        return embed(np.array([rgb[mask].mean(axis=0) for mask in masks.masks]))

    def encode_text(self, prompts: Sequence[str]) -> np.ndarray:
        return embed(np.array([COLORS.get(prompt, (0, 0, 0)) for prompt in prompts]))


class ColorSegmenter:
    """One mask for each named colour that is in the image."""

    def segment(self, rgb: np.ndarray, depth_m: np.ndarray) -> Masks:
        found = [np.all(np.abs(rgb.astype(int) - color) < 12, axis=2) for color in COLORS.values()]
        found = [mask for mask in found if mask.sum() > 30]
        return Masks.from_masks(np.array(found, bool).reshape(-1, *rgb.shape[:2]))


def color_trio() -> EncoderTrio:
    encoder = ColorEncoder()
    return EncoderTrio("stand_in", DIMENSION, 1.0, 20.0, encoder, encoder, encoder)


CAMERA = Intrinsics(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)


def wall_frame(stamp_ns: int, x_m: float = 0.0, patches: dict[str, tuple[float, float, float]] | None = None) -> PosedFrame:
    """A camera at (x, 0, 0) that looks along z at a grey wall 2 m away, with coloured squares painted on it.

    Args:
        stamp_ns: Time.
        x_m: Position of the camera.
        patches: Colour name to centre x, centre y and edge of its square on the wall, metres.
    """
    patches = {"red": (-0.4, 0.0, 0.4), "blue": (0.5, 0.1, 0.3)} if patches is None else patches
    rgb = np.full((480, 640, 3), COLORS["grey"], np.uint8)
    ys, xs = np.mgrid[0:480, 0:640]
    wall_x, wall_y = (xs - CAMERA.cx) * 2 / CAMERA.fx + x_m, (ys - CAMERA.cy) * 2 / CAMERA.fy
    for name, (cx, cy, edge) in patches.items():
        rgb[(np.abs(wall_x - cx) < edge / 2) & (np.abs(wall_y - cy) < edge / 2)] = COLORS[name]
    T = np.eye(4)
    T[0, 3] = x_m
    return PosedFrame(stamp_ns, rgb, np.full((480, 640), 2.0, np.float32), CAMERA, T)
