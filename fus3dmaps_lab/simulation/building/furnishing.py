"""Furnishing of rooms: furniture along the walls with small things on it, without overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_lab.simulation.building import things as t
from fus3dmaps_lab.simulation.building.box_world import BoxWorldBuilder, Piece, Pose
from fus3dmaps_lab.simulation.building.things import Maker, Rng, Thing

_GAP_M = 0.06
_ATTEMPTS = 40


@dataclass(frozen=True)
class RoomKind:
    """The furniture of a kind of room.

    Attributes:
        name: Name of the kind.
        along_walls: Furniture that stands against walls, the most important first.
        small: Things that stand on surfaces.
        on_soft: Things that lie on sofas and beds.
    """

    name: str
    along_walls: tuple[Maker, ...]
    small: tuple[Maker, ...]
    on_soft: tuple[Maker, ...] = ()


KINDS = (
    RoomKind(
        "living room",
        (t.sofa, t.cabinet, t.armchair, t.bookshelf, t.table, t.floor_lamp, t.plant, t.stool),
        (t.television, t.vase, t.book, t.mug, t.bowl, t.table_lamp),
        (t.pillow, t.pillow),
    ),
    RoomKind(
        "bedroom",
        (t.bed, t.wardrobe, t.nightstand, t.desk, t.chair, t.floor_lamp, t.plant),
        (t.table_lamp, t.book, t.mug, t.vase, t.monitor),
        (t.pillow, t.pillow),
    ),
    RoomKind(
        "kitchen",
        (t.counter, t.oven, t.refrigerator, t.counter, t.table, t.chair, t.chair, t.trash_can, t.sink),
        (t.microwave, t.kettle, t.bowl, t.bottle, t.mug, t.mug, t.vase),
    ),
    RoomKind(
        "office",
        (t.desk, t.chair, t.desk, t.chair, t.bookshelf, t.cabinet, t.plant, t.trash_can),
        (t.monitor, t.keyboard, t.mug, t.book, t.table_lamp, t.bottle),
    ),
    RoomKind(
        "bathroom",
        (t.bathtub, t.toilet, t.sink, t.washing_machine, t.cabinet, t.trash_can, t.stool),
        (t.towel, t.bottle, t.vase, t.towel),
    ),
    RoomKind(
        "storage",
        (t.bookshelf, t.wardrobe, t.box, t.box, t.table, t.box, t.stool, t.box),
        (t.bottle, t.book, t.bowl, t.towel),
    ),
)


@dataclass(frozen=True)
class Space:
    """The inside of a room.

    Attributes:
        low_m: Lower corner, on the floor.
        high_m: Upper corner, below the ceiling.
        reserved_m: (n, 2, 2) rectangles (low xy, high xy) that must stay free: doors and the robot's route.
        windows_m: (n, 2, 2) rectangles along the walls where nothing can hang.
    """

    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]
    reserved_m: NDArray[np.float64]
    windows_m: NDArray[np.float64]


def furnish(builder: BoxWorldBuilder, kind: RoomKind, space: Space, rng: Rng) -> None:
    """Put things into a room; leave out those that find no place."""
    taken = [*space.reserved_m]
    for maker in kind.along_walls:
        thing = maker(rng)
        pose = _place_at_wall(thing, space, taken, rng)
        if pose is None:
            continue
        builder.add(thing.class_name, thing.pieces, pose)
        if thing.top_m:
            _decorate(builder, thing, pose, kind.small, rng)
        if thing.class_name in ("sofa", "bed"):
            _cushion(builder, thing, pose, kind.on_soft, rng)
        if thing.class_name == "bookshelf":
            _fill_shelves(builder, pose, rng)
    taken += [*space.windows_m]
    for _ in range(2):
        _hang(builder, t.picture(rng), space, taken, rng)
    center = 0.5 * (space.low_m + space.high_m)
    rug = t.rug(rng)
    builder.add(rug.class_name, rug.pieces, Pose((float(center[0]), float(center[1]) + 0.65, float(space.low_m[2]))))


def _place_at_wall(thing: Thing, space: Space, taken: list[NDArray[np.float64]], rng: Rng) -> Pose | None:
    """Find a place along a wall and mark it as taken; return None if there is none."""
    width, depth, _ = thing.size_m
    for _ in range(_ATTEMPTS):
        turns = int(rng.integers(4))
        pose = _at_wall(space, turns, width, float(rng.uniform()), float(space.low_m[2]))
        if pose is None:
            continue
        low, high = pose.place((-0.5 * width, -depth, 0), (0.5 * width, 0, 1))
        rectangle = np.stack([low[:2] - _GAP_M, high[:2] + _GAP_M])
        if not _meets(rectangle, taken):
            taken.append(rectangle)
            return pose
    return None


def _at_wall(space: Space, turns: int, width: float, share: float, z: float) -> Pose | None:
    """Return a pose with its back to one of the four walls (0: the northern), at a share of the wall's length."""
    along = turns % 2  # The axis of the wall: x for the northern and the southern wall.
    room = float(space.high_m[along] - space.low_m[along]) - width - 2 * _GAP_M
    if room < 0:
        return None
    at = float(space.low_m[along]) + _GAP_M + 0.5 * width + share * room
    x0, y0, x1, y1 = *space.low_m[:2], *space.high_m[:2]
    places = ((at, y1), (x0, at), (at, y0), (x1, at))
    x, y = places[turns]
    return Pose((float(x), float(y), z), turns)


def _meets(rectangle: NDArray[np.float64], others: Sequence[NDArray[np.float64]]) -> bool:
    low, high = rectangle
    return any(bool(np.all(low < other[1]) and np.all(other[0] < high)) for other in others)


def _decorate(builder: BoxWorldBuilder, thing: Thing, pose: Pose, makers: Sequence[Maker], rng: Rng) -> None:
    """Put two to four small things side by side on a surface."""
    width, depth, _ = thing.size_m
    chosen = [makers[int(index)](rng) for index in rng.permutation(len(makers))[: int(rng.integers(2, 5))]]
    x = -0.5 * width + 0.04
    for small in chosen:
        if x + small.size_m[0] > 0.5 * width - 0.04 or small.size_m[1] > depth - 0.04:
            continue
        back = -float(rng.uniform(0.02, depth - 0.02 - small.size_m[1]))
        _put(builder, small, pose, (x + 0.5 * small.size_m[0], back, thing.top_m))
        x += small.size_m[0] + float(rng.uniform(0.05, 0.15))


def _cushion(builder: BoxWorldBuilder, thing: Thing, pose: Pose, makers: Sequence[Maker], rng: Rng) -> None:
    """Add pillows: side by side on a sofa, behind one another at the head of a bed."""
    things = [maker(rng) for maker in makers]
    for place, small in enumerate(things):
        if thing.class_name == "sofa":
            room = thing.size_m[0] - 0.34
            at = (-0.5 * room + (place + 0.5) * room / len(things), -0.24, 0.45)
        else:
            at = (-0.68, -0.08 - place * 0.44, 0.5)
        _put(builder, small, pose, at)


def _fill_shelves(builder: BoxWorldBuilder, pose: Pose, rng: Rng) -> None:
    """Put a row of books on every board. Each row is one instance; its books are the parts."""
    for z in t.SHELF_HEIGHTS_M:
        pieces: list[Piece] = []
        x, end = -0.45, float(rng.uniform(-0.1, 0.42))
        while x < end:
            thick, tall = float(rng.uniform(0.03, 0.06)), float(rng.uniform(0.22, 0.36))
            low, high = (x, -0.26, z + 0.03), (x + thick, -0.04, z + 0.03 + tall)
            pieces.append(Piece(f"book {len(pieces)}", low, high, t.book(rng).pieces[0].color))
            x += thick + 0.002
        builder.add("books", pieces, pose)


def _hang(builder: BoxWorldBuilder, thing: Thing, space: Space, taken: list[NDArray[np.float64]], rng: Rng) -> None:
    """Hang a thing on a piece of wall without furniture, door or window."""
    for _ in range(_ATTEMPTS):
        pose = _at_wall(space, int(rng.integers(4)), thing.size_m[0], float(rng.uniform()), float(space.low_m[2]) + 1.5)
        if pose is None:
            continue
        low, high = pose.place((-0.5 * thing.size_m[0], -0.05, 0), (0.5 * thing.size_m[0], 0, 1))
        rectangle = np.stack([low[:2], high[:2]])
        if not _meets(rectangle, taken):
            taken.append(rectangle)
            builder.add(thing.class_name, thing.pieces, pose)
            return


def _put(builder: BoxWorldBuilder, small: Thing, base: Pose, at: tuple[float, float, float]) -> None:
    low, high = base.place(at, at)
    x, y, z = (float(value) for value in 0.5 * (low + high))
    builder.add(small.class_name, small.pieces, Pose((x, y, z), base.quarter_turns))
