"""Furniture and pictures for simulated rooms.

Every piece stands at a placement: x to its right, y to its back, z up, the origin on the floor in the middle of its back
edge. A piece placed on the line of a wall with the wall's yaw stands against that wall.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_lab.simulation.room import textures
from fus3dmaps_lab.simulation.room.scene import Material, Placement, SceneBuilder


@dataclass(frozen=True)
class Palette:
    """Materials shared by the furniture of a room."""

    light_wood: Material
    dark_wood: Material
    white: Material
    sofa: Material
    cushion: Material
    armchair: Material
    metal: Material
    shade: Material
    books: tuple[Material, ...]

    @classmethod
    def seeded(cls, rng: np.random.Generator) -> Palette:
        """Draw quiet Scandinavian colours."""
        books = ((116, 84, 76), (92, 104, 116), (150, 136, 112), (108, 118, 98), (134, 106, 92), (84, 86, 96))
        return cls(
            light_wood=Material(textures.wood((196, 168, 132), rng), 0.8),
            dark_wood=Material(textures.wood((112, 82, 60), rng), 0.8),
            white=Material(textures.plaster((222, 220, 214), rng), 0.8),
            sofa=Material(textures.fabric((112, 124, 138), rng), 0.5),
            cushion=Material(textures.fabric((186, 150, 96), rng), 0.4),
            armchair=Material(textures.fabric((104, 122, 106), rng), 0.5),
            metal=Material(textures.plain((70, 70, 72))),
            shade=Material(textures.plain((246, 236, 212)), lit=False),
            books=tuple(Material(textures.fabric(color, rng), 0.3) for color in books),
        )


def picture(
    builder: SceneBuilder,
    photograph: NDArray[np.uint8],
    width_m: float,
    frame: Material,
    placement: Placement,
    frame_m: float = 0.04,
    depth_m: float = 0.03,
) -> None:
    """Add a framed, undistorted photograph; its back is on the placement, its lower edge at the placement's height.

    Args:
        builder: Scene that gets it.
        photograph: (h, w, 3) uint8.
        width_m: Width of the photograph without its frame; the height follows.
        frame: Look of the frame.
        placement: Middle of the lower edge of the frame's back.
        frame_m: Width of the frame.
        depth_m: Thickness of the frame; the photograph lies 5 mm behind its front.
    """
    height_m = width_m * photograph.shape[0] / photograph.shape[1]
    half, top = 0.5 * width_m + frame_m, height_m + 2 * frame_m
    for low, high in (
        ((-half, -depth_m, 0), (half, 0, frame_m)),
        ((-half, -depth_m, top - frame_m), (half, 0, top)),
        ((-half, -depth_m, frame_m), (-half + frame_m, 0, top - frame_m)),
        ((half - frame_m, -depth_m, frame_m), (half, 0, top - frame_m)),
    ):
        builder.box(low, high, frame, placement)
    image = Material(photograph, lit=False)
    builder.panel((0, 0.005 - depth_m, 0.5 * top), (0, -1, 0), (width_m, height_m), image, placement)
    builder.panel((0, 0, 0.5 * top), (0, 1, 0), (width_m, height_m), frame, placement)


def sofa(builder: SceneBuilder, palette: Palette, placement: Placement, width_m: float = 1.9) -> None:
    """Add a sofa with two seats, two arms and two cushions."""
    half, fabric = 0.5 * width_m, palette.sofa
    builder.box((-half, -0.85, 0.08), (half, -0.05, 0.40), fabric, placement)
    builder.box((-half, -0.25, 0.40), (half, -0.05, 0.82), fabric, placement)
    for side in (-1, 1):
        low, high = sorted((side * half, side * (half - 0.18)))
        builder.box((low, -0.85, 0.40), (high, -0.25, 0.60), fabric, placement)
        low, high = sorted((side * 0.01, side * (half - 0.19)))
        builder.box((low, -0.83, 0.40), (high, -0.25, 0.50), fabric, placement)
        middle = side * 0.55 * half
        builder.box((middle - 0.22, -0.38, 0.50), (middle + 0.22, -0.25, 0.86), palette.cushion, placement)


def armchair(builder: SceneBuilder, palette: Palette, placement: Placement) -> None:
    """Add an armchair."""
    fabric = palette.armchair
    builder.box((-0.38, -0.78, 0.12), (0.38, -0.05, 0.42), fabric, placement)
    builder.box((-0.38, -0.22, 0.42), (0.38, -0.05, 0.86), fabric, placement)
    for low, high in ((-0.38, -0.24), (0.24, 0.38)):
        builder.box((low, -0.78, 0.42), (high, -0.22, 0.60), fabric, placement)
    for x in (-0.33, 0.29):
        for y in (-0.74, -0.12):
            builder.box((x, y, 0), (x + 0.04, y + 0.04, 0.12), palette.dark_wood, placement)


def table(
    builder: SceneBuilder,
    palette: Palette,
    placement: Placement,
    size_m: tuple[float, float, float] = (1.3, 0.65, 0.74),
) -> None:
    """Add a table with four legs; ``size_m`` is its width, depth and height."""
    width, depth, height = size_m
    half = 0.5 * width
    builder.box((-half, -depth, height - 0.04), (half, 0, height), palette.light_wood, placement)
    for x in (-half + 0.03, half - 0.09):
        for y in (-depth + 0.03, -0.09):
            builder.box((x, y, 0), (x + 0.06, y + 0.06, height - 0.04), palette.light_wood, placement)


def cabinet(
    builder: SceneBuilder,
    palette: Palette,
    placement: Placement,
    size_m: tuple[float, float, float] = (1.5, 0.42, 0.72),
    doors: int = 3,
) -> None:
    """Add a sideboard with doors and handles; ``size_m`` is its width, depth and height."""
    width, depth, height = size_m
    half, pitch = 0.5 * width, width / doors
    builder.box((-half, -depth + 0.02, 0.06), (half, 0, height), palette.white, placement)
    builder.box((-half - 0.01, -depth - 0.01, height), (half + 0.01, 0, height + 0.025), palette.light_wood, placement)
    for door in range(doors):
        left = -half + door * pitch
        builder.box(
            (left + 0.006, -depth, 0.08), (left + pitch - 0.006, -depth + 0.02, height - 0.015), palette.white, placement
        )
        builder.box(
            (left + pitch - 0.06, -depth - 0.02, 0.55 * height),
            (left + pitch - 0.045, -depth, 0.75 * height),
            palette.metal,
            placement,
        )


def bookshelf(
    builder: SceneBuilder,
    palette: Palette,
    placement: Placement,
    rng: np.random.Generator,
    size_m: tuple[float, float, float] = (1.1, 0.32, 0.95),
    shelves: int = 2,
) -> None:
    """Add an open shelf, each compartment partly filled with books; ``size_m`` is its width, depth and height."""
    width, depth, height = size_m
    half, board = 0.5 * width, 0.025
    pitch = (height - board) / shelves
    for side in (-half, half - board):
        builder.box((side, -depth, 0), (side + board, 0, height), palette.dark_wood, placement)
    for level in range(shelves + 1):
        z = level * pitch
        builder.box((-half + board, -depth, z), (half - board, 0, z + board), palette.dark_wood, placement)
    builder.panel((0, -0.005, 0.5 * height), (0, -1, 0), (width, height), palette.dark_wood, placement)
    for level in range(shelves):
        x, z = -half + board + 0.01, level * pitch + board
        end = x + (width - 2 * board) * rng.uniform(0.6, 0.85)
        while x < end:
            thick, tall = rng.uniform(0.025, 0.055), (pitch - board) * rng.uniform(0.62, 0.9)
            book = palette.books[int(rng.integers(len(palette.books)))]
            builder.box((x, -depth + rng.uniform(0.03, 0.06), z), (x + thick, -0.05, z + tall), book, placement)
            x += thick + 0.002


def floor_lamp(builder: SceneBuilder, palette: Palette, placement: Placement, height_m: float = 1.65) -> None:
    """Add a floor lamp with a square shade, its pole 0.2 m in front of the placement."""
    builder.box((-0.13, -0.33, 0), (0.13, -0.07, 0.025), palette.metal, placement)
    builder.box((-0.012, -0.212, 0.025), (0.012, -0.188, height_m - 0.3), palette.metal, placement)
    builder.box((-0.16, -0.36, height_m - 0.3), (0.16, -0.04, height_m), palette.shade, placement)


def door(builder: SceneBuilder, palette: Palette, placement: Placement) -> None:
    """Add a closed door with its frame and handle."""
    builder.box((-0.49, -0.03, 0), (0.49, 0, 2.09), palette.white, placement)
    builder.box((-0.42, -0.05, 0.005), (0.42, -0.03, 2.02), palette.light_wood, placement)
    builder.box((0.28, -0.10, 1.0), (0.38, -0.05, 1.03), palette.metal, placement)
