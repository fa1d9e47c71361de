"""Furniture and small things, made of boxes with parts.

A thing has its own frame: x to its right, y to its back, z up, the origin at the middle of its back edge on the floor. It
faces south.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fus3dmaps_lab.simulation.building.box_world import Color, Piece

Rng = np.random.Generator


@dataclass(frozen=True)
class Thing:
    """A thing that can be put into a room.

    Attributes:
        class_name: Name of its class.
        size_m: Width, depth and height.
        pieces: Its boxes.
        top_m: Height of the surface on which other things can stand; 0 for none.
    """

    class_name: str
    size_m: tuple[float, float, float]
    pieces: tuple[Piece, ...]
    top_m: float = 0.0


def _wood(rng: Rng) -> Color:
    return _near(((176, 138, 100), (120, 86, 60), (206, 178, 140), (96, 70, 52)), rng)


def _fabric(rng: Rng) -> Color:
    return _near(((112, 124, 138), (134, 92, 84), (96, 122, 104), (150, 136, 112), (88, 92, 120)), rng)


def _bright(rng: Rng) -> Color:
    return _near(((196, 70, 60), (60, 110, 190), (222, 180, 60), (70, 150, 90), (236, 232, 226)), rng)


def _near(colors: tuple[Color, ...], rng: Rng) -> Color:
    red, green, blue = np.clip(np.array(colors[int(rng.integers(len(colors)))]) + rng.integers(-12, 13, 3), 0, 255)
    return int(red), int(green), int(blue)


_METAL: Color = (96, 98, 102)
_BLACK: Color = (36, 38, 42)
_WHITE: Color = (228, 228, 224)


def _legs(width: float, depth: float, height: float, thick: float, color: Color, inset: float = 0.02) -> list[Piece]:
    half = 0.5 * width
    return [
        Piece("legs", (x, y, 0), (x + thick, y + thick, height), color)
        for x in (-half + inset, half - inset - thick)
        for y in (-depth + inset, -inset - thick)
    ]


def chair(rng: Rng) -> Thing:
    """Make a chair: seat, back and legs."""
    color, legs = _fabric(rng), _wood(rng)
    pieces = [
        Piece("seat", (-0.22, -0.46, 0.43), (0.22, 0, 0.48), color),
        Piece("back", (-0.22, -0.05, 0.48), (0.22, 0, 0.92), color),
        *_legs(0.44, 0.46, 0.43, 0.04, legs),
    ]
    return Thing("chair", (0.44, 0.46, 0.92), tuple(pieces))


def stool(rng: Rng) -> Thing:
    """Make a stool: seat and legs."""
    color = _wood(rng)
    pieces = [Piece("seat", (-0.17, -0.34, 0.6), (0.17, 0, 0.64), color), *_legs(0.34, 0.34, 0.6, 0.035, color)]
    return Thing("stool", (0.34, 0.34, 0.64), tuple(pieces))


def table(rng: Rng) -> Thing:
    """Make a table: top and legs."""
    width, depth, color = float(rng.uniform(1.0, 1.5)), float(rng.uniform(0.7, 0.85)), _wood(rng)
    half = 0.5 * width
    pieces = [Piece("top", (-half, -depth, 0.7), (half, 0, 0.74), color), *_legs(width, depth, 0.7, 0.06, color)]
    return Thing("table", (width, depth, 0.74), tuple(pieces), 0.74)


def desk(rng: Rng) -> Thing:
    """Make a desk: top, legs and drawers."""
    width, color = float(rng.uniform(1.2, 1.6)), _wood(rng)
    half = 0.5 * width
    pieces = [
        Piece("top", (-half, -0.7, 0.7), (half, 0, 0.74), color),
        *_legs(width, 0.7, 0.7, 0.05, _METAL),
        Piece("drawers", (half - 0.47, -0.6, 0.1), (half - 0.07, -0.05, 0.68), _WHITE),
    ]
    return Thing("desk", (width, 0.7, 0.74), tuple(pieces), 0.74)


def sofa(rng: Rng) -> Thing:
    """Make a sofa: seat, back and arms."""
    width, color = float(rng.uniform(1.6, 2.1)), _fabric(rng)
    half = 0.5 * width
    pieces = [
        Piece("seat", (-half + 0.16, -0.85, 0.05), (half - 0.16, -0.22, 0.45), color),
        Piece("back", (-half + 0.16, -0.22, 0.05), (half - 0.16, 0, 0.85), color),
        Piece("arms", (-half, -0.85, 0.05), (-half + 0.16, 0, 0.62), color),
        Piece("arms", (half - 0.16, -0.85, 0.05), (half, 0, 0.62), color),
    ]
    return Thing("sofa", (width, 0.85, 0.85), tuple(pieces))


def armchair(rng: Rng) -> Thing:
    """Make an armchair: seat, back and arms."""
    color = _fabric(rng)
    pieces = [
        Piece("seat", (-0.26, -0.78, 0.08), (0.26, -0.2, 0.42), color),
        Piece("back", (-0.26, -0.2, 0.08), (0.26, 0, 0.9), color),
        Piece("arms", (-0.4, -0.78, 0.08), (-0.26, 0, 0.6), color),
        Piece("arms", (0.26, -0.78, 0.08), (0.4, 0, 0.6), color),
    ]
    return Thing("armchair", (0.8, 0.78, 0.9), tuple(pieces))


def bed(rng: Rng) -> Thing:
    """Make a bed: frame, mattress and headboard. Its long side is at the wall, so that a robot can pass in a small room."""
    wood = _wood(rng)
    pieces = [
        Piece("frame", (-0.94, -0.95, 0.08), (1.0, 0, 0.32), wood),
        Piece("mattress", (-0.94, -0.92, 0.32), (0.97, -0.03, 0.5), _near(((226, 224, 232),), rng)),
        Piece("headboard", (-1.0, -0.95, 0.08), (-0.94, 0, 0.95), wood),
    ]
    return Thing("bed", (2.0, 0.95, 0.95), tuple(pieces))


def _doored(name: str, width: float, depth: float, height: float, doors: int, color: Color, surface: bool) -> Thing:
    half, pitch = 0.5 * width, width / doors
    pieces = [Piece("body", (-half, -depth + 0.025, 0.0), (half, 0, height), color)]
    for door in range(doors):
        left = -half + door * pitch
        pieces.append(
            Piece(f"door {door}", (left + 0.01, -depth, 0.05), (left + pitch - 0.01, -depth + 0.025, height - 0.02), color)
        )
    return Thing(name, (width, depth, height), tuple(pieces), height if surface else 0.0)


def cabinet(rng: Rng) -> Thing:
    """Make a cabinet: body and doors; things can stand on it."""
    return _doored("cabinet", float(rng.uniform(0.9, 1.5)), 0.45, float(rng.uniform(0.75, 0.9)), 3, _wood(rng), True)


def wardrobe(rng: Rng) -> Thing:
    """Make a wardrobe: body and two doors, as high as a person."""
    return _doored("wardrobe", float(rng.uniform(1.0, 1.4)), 0.6, 2.0, 2, _wood(rng), False)


def refrigerator(rng: Rng) -> Thing:
    """Make a refrigerator: body and door."""
    return _doored("refrigerator", 0.6, 0.62, 1.8, 1, _near(((214, 218, 222), (150, 154, 160)), rng), False)


def nightstand(rng: Rng) -> Thing:
    """Make a nightstand: body and a door; things can stand on it."""
    return _doored("nightstand", 0.45, 0.4, 0.5, 1, _wood(rng), True)


def washing_machine(rng: Rng) -> Thing:
    """Make a washing machine: body and porthole."""
    pieces = (
        Piece("body", (-0.3, -0.57, 0), (0.3, 0, 0.85), _WHITE),
        Piece("door 0", (-0.18, -0.6, 0.28), (0.18, -0.57, 0.64), _BLACK),
    )
    return Thing("washing machine", (0.6, 0.6, 0.85), pieces)


def counter(rng: Rng) -> Thing:
    """Make a kitchen counter: body and worktop; things can stand on it."""
    width, color = float(rng.uniform(1.2, 1.8)), _near(((232, 228, 218), (120, 140, 130)), rng)
    half = 0.5 * width
    pieces = (
        Piece("body", (-half, -0.58, 0), (half, 0, 0.86), color),
        Piece("worktop", (-half, -0.62, 0.86), (half, 0, 0.9), _wood(rng)),
    )
    return Thing("counter", (width, 0.62, 0.9), pieces, 0.9)


def oven(rng: Rng) -> Thing:
    """Make an oven: body, door and hob."""
    pieces = (
        Piece("body", (-0.3, -0.57, 0), (0.3, 0, 0.88), _METAL),
        Piece("door 0", (-0.26, -0.6, 0.2), (0.26, -0.57, 0.66), _BLACK),
        Piece("hob", (-0.28, -0.55, 0.88), (0.28, -0.03, 0.9), _BLACK),
    )
    return Thing("oven", (0.6, 0.6, 0.9), pieces)


def sink(rng: Rng) -> Thing:
    """Make a sink: basin, pedestal and tap."""
    pieces = (
        Piece("basin", (-0.28, -0.46, 0.72), (0.28, 0, 0.86), _WHITE),
        Piece("pedestal", (-0.1, -0.3, 0), (0.1, -0.05, 0.72), _WHITE),
        Piece("tap", (-0.03, -0.14, 0.86), (0.03, -0.04, 1.04), _METAL),
    )
    return Thing("sink", (0.56, 0.46, 1.04), pieces)


def toilet(rng: Rng) -> Thing:
    """Make a toilet: bowl and cistern."""
    pieces = (
        Piece("bowl", (-0.19, -0.66, 0), (0.19, -0.18, 0.42), _WHITE),
        Piece("cistern", (-0.2, -0.18, 0), (0.2, 0, 0.82), _WHITE),
    )
    return Thing("toilet", (0.4, 0.66, 0.82), pieces)


def bathtub(rng: Rng) -> Thing:
    """Make a bathtub: four walls around a floor."""
    pieces = (
        Piece("tub", (-0.8, -0.75, 0), (0.8, 0, 0.25), _WHITE),
        Piece("rim", (-0.8, -0.75, 0.25), (0.8, -0.68, 0.56), _WHITE),
        Piece("rim", (-0.8, -0.07, 0.25), (0.8, 0, 0.56), _WHITE),
        Piece("rim", (-0.8, -0.68, 0.25), (-0.72, -0.07, 0.56), _WHITE),
        Piece("rim", (0.72, -0.68, 0.25), (0.8, -0.07, 0.56), _WHITE),
    )
    return Thing("bathtub", (1.6, 0.75, 0.56), pieces)


def bookshelf(rng: Rng) -> Thing:
    """Make a bookshelf: boards and a back. Its books are instances of their own."""
    color = _wood(rng)
    pieces = [Piece("back", (-0.5, -0.02, 0), (0.5, 0, 1.8), color)]
    pieces += [Piece("sides", (x, -0.32, 0), (x + 0.03, -0.02, 1.8), color) for x in (-0.5, 0.47)]
    pieces += [Piece("boards", (-0.47, -0.32, z), (0.47, -0.02, z + 0.03), color) for z in SHELF_HEIGHTS_M]
    return Thing("bookshelf", (1.0, 0.32, 1.8), tuple(pieces))


SHELF_HEIGHTS_M = (0.05, 0.5, 0.95, 1.4)
"""Heights of the boards of a bookshelf, from below."""


def floor_lamp(rng: Rng) -> Thing:
    """Make a floor lamp: base, pole and shade."""
    pieces = (
        Piece("base", (-0.14, -0.34, 0), (0.14, -0.06, 0.03), _METAL),
        Piece("pole", (-0.02, -0.22, 0.03), (0.02, -0.18, 1.3), _METAL),
        Piece("shade", (-0.18, -0.38, 1.3), (0.18, -0.02, 1.62), _near(((246, 236, 212),), rng)),
    )
    return Thing("lamp", (0.36, 0.4, 1.62), pieces)


def plant(rng: Rng) -> Thing:
    """Make a plant: pot and leaves."""
    green = _near(((70, 120, 60), (90, 140, 80)), rng)
    pieces = (
        Piece("pot", (-0.15, -0.3, 0), (0.15, 0, 0.3), _near(((170, 96, 70),), rng)),
        Piece("leaves", (-0.2, -0.35, 0.3), (0.2, 0.0, 0.62), green),
        Piece("leaves", (-0.12, -0.27, 0.62), (0.12, -0.06, 0.95), green),
    )
    return Thing("plant", (0.4, 0.35, 0.95), pieces)


def trash_can(rng: Rng) -> Thing:
    """Make a trash can."""
    return Thing("trash can", (0.28, 0.28, 0.42), (Piece("bin", (-0.14, -0.28, 0), (0.14, 0, 0.42), _BLACK),))


def box(rng: Rng) -> Thing:
    """Make a cardboard box for the floor."""
    width, height = float(rng.uniform(0.35, 0.6)), float(rng.uniform(0.3, 0.5))
    color = _near(((176, 140, 96),), rng)
    return Thing("box", (width, 0.4, height), (Piece("box", (-0.5 * width, -0.4, 0), (0.5 * width, 0, height), color),))


def _block(name: str, size: tuple[float, float, float], color: Color) -> Thing:
    width, depth, height = size
    return Thing(name, size, (Piece(name, (-0.5 * width, -depth, 0), (0.5 * width, 0, height), color),))


def mug(rng: Rng) -> Thing:
    """Make a mug: body and handle."""
    color = _bright(rng)
    pieces = (
        Piece("body", (-0.05, -0.1, 0), (0.05, 0, 0.12), color),
        Piece("handle", (0.05, -0.06, 0.02), (0.08, -0.04, 0.1), color),
    )
    return Thing("mug", (0.16, 0.1, 0.12), pieces)


def bottle(rng: Rng) -> Thing:
    """Make a bottle: body and neck."""
    color = _near(((60, 110, 70), (120, 70, 50), (150, 180, 200)), rng)
    pieces = (
        Piece("body", (-0.05, -0.1, 0), (0.05, 0, 0.2), color),
        Piece("neck", (-0.02, -0.07, 0.2), (0.02, -0.03, 0.3), color),
    )
    return Thing("bottle", (0.1, 0.1, 0.3), pieces)


def vase(rng: Rng) -> Thing:
    """Make a vase."""
    return _block("vase", (0.14, 0.14, 0.28), _bright(rng))


def bowl(rng: Rng) -> Thing:
    """Make a bowl."""
    return _block("bowl", (0.24, 0.24, 0.09), _bright(rng))


def book(rng: Rng) -> Thing:
    """Make a lying book."""
    return _block("book", (0.2, 0.28, 0.05), _bright(rng))


def monitor(rng: Rng) -> Thing:
    """Make a monitor: screen and stand."""
    pieces = (
        Piece("stand", (-0.12, -0.2, 0), (0.12, -0.02, 0.02), _BLACK),
        Piece("stand", (-0.03, -0.13, 0.02), (0.03, -0.09, 0.14), _BLACK),
        Piece("screen", (-0.3, -0.15, 0.14), (0.3, -0.1, 0.5), _BLACK),
    )
    return Thing("monitor", (0.6, 0.2, 0.5), pieces)


def keyboard(rng: Rng) -> Thing:
    """Make a keyboard."""
    return _block("keyboard", (0.44, 0.15, 0.03), _near(((60, 62, 66), (210, 210, 206)), rng))


def table_lamp(rng: Rng) -> Thing:
    """Make a table lamp: base and shade."""
    pieces = (
        Piece("base", (-0.04, -0.16, 0), (0.04, -0.08, 0.22), _METAL),
        Piece("shade", (-0.12, -0.24, 0.22), (0.12, 0, 0.42), _near(((246, 236, 212),), rng)),
    )
    return Thing("lamp", (0.24, 0.24, 0.42), pieces)


def microwave(rng: Rng) -> Thing:
    """Make a microwave: body and door."""
    pieces = (
        Piece("body", (-0.24, -0.33, 0), (0.24, 0, 0.28), _METAL),
        Piece("door 0", (-0.22, -0.35, 0.03), (0.1, -0.33, 0.25), _BLACK),
    )
    return Thing("microwave", (0.48, 0.35, 0.28), pieces)


def kettle(rng: Rng) -> Thing:
    """Make a kettle."""
    return _block("kettle", (0.17, 0.17, 0.24), _near(((190, 192, 196), (40, 40, 44)), rng))


def television(rng: Rng) -> Thing:
    """Make a television: screen and foot."""
    pieces = (
        Piece("foot", (-0.25, -0.2, 0), (0.25, -0.04, 0.05), _BLACK),
        Piece("screen", (-0.5, -0.14, 0.05), (0.5, -0.08, 0.62), _BLACK),
    )
    return Thing("television", (1.0, 0.2, 0.62), pieces)


def pillow(rng: Rng) -> Thing:
    """Make a lying pillow."""
    return _block("pillow", (0.45, 0.32, 0.14), _bright(rng))


def towel(rng: Rng) -> Thing:
    """Make a folded towel."""
    return _block("towel", (0.36, 0.26, 0.1), _bright(rng))


def picture(rng: Rng) -> Thing:
    """Make a picture for a wall: frame and canvas."""
    width, height = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.4, 0.7))
    half = 0.5 * width
    pieces = (
        Piece("frame", (-half, -0.03, 0), (half, 0, height), _wood(rng)),
        Piece("canvas", (-half + 0.04, -0.05, 0.04), (half - 0.04, -0.03, height - 0.04), _bright(rng)),
    )
    return Thing("picture", (width, 0.05, height), pieces)


def rug(rng: Rng) -> Thing:
    """Make a thin carpet."""
    return _block("rug", (1.3, 1.3, 0.03), _fabric(rng))


Maker = Callable[[Rng], Thing]
