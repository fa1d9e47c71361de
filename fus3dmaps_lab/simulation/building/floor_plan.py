"""Plan and shell of a building: storeys with rooms on both sides of a corridor, joined by stairs.

Each storey's corridor runs east along y = 0. Rooms lie north and south of it; each has a door to it and a window in its
outer wall. The stairs are beyond the corridor's eastern end. Walls, floors, ceilings, doors, windows and stairs are
instances like everything else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_lab.simulation.building.box_world import BoxWorldBuilder, Color, Piece

BACKGROUND = frozenset({"wall", "floor", "ceiling", "door", "window"})
"""Classes of the building itself, which published evaluations leave out."""

STOREY_M = 2.9
CEILING_M = 2.6
WALL_M = 0.12
HALF_CORRIDOR_M = 1.0
DOOR_WIDTH_M, DOOR_HEIGHT_M = 1.0, 2.05
STAIRS_FROM_M, STAIRS_TO_M = 0.6, 4.2
STAIRWELL_M = 5.4

_SLAB_M = 0.1
_STEPS = 14
_WALL: Color = (226, 220, 208)
_FLOOR: Color = (168, 140, 108)
_CEILING: Color = (238, 236, 230)
_DOOR: Color = (186, 150, 110)
_GLASS: Color = (170, 204, 226)
_STAIRS: Color = (140, 132, 124)
_WINDOW_SILL_M, _WINDOW_TOP_M, _WINDOW_WIDTH_M = 0.95, 2.1, 1.3

Hole = tuple[float, float, float, float]
"""A hole in a wall along x: least x, greatest x, lower edge, upper edge, metres."""


@dataclass(frozen=True)
class Room:
    """A room of the plan.

    Attributes:
        storey: Counted from 0.
        side: 1 north of the corridor, -1 south of it.
        low_m: (3,) lower corner of its inside, on the floor.
        high_m: (3,) upper corner, below the ceiling.
        door_x_m: Middle of its door, in the wall to the corridor.
    """

    storey: int
    side: int
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]
    door_x_m: float

    @property
    def walls_y_m(self) -> tuple[float, float]:
        """Inner y of its corridor wall and of its outer wall."""
        y0, y1 = float(self.low_m[1]), float(self.high_m[1])
        return (y0, y1) if self.side > 0 else (y1, y0)

    def door_hole_m(self) -> Hole:
        """Return the hole for the door in the corridor wall."""
        z, half = float(self.low_m[2]), 0.5 * DOOR_WIDTH_M
        return self.door_x_m - half, self.door_x_m + half, z, z + DOOR_HEIGHT_M

    def window_hole_m(self) -> Hole:
        """Return the hole for the window in the outer wall."""
        z, middle = float(self.low_m[2]), float(self.center_m[0])
        half = 0.5 * min(_WINDOW_WIDTH_M, float(self.high_m[0] - self.low_m[0]) - 0.8)
        return middle - half, middle + half, z + _WINDOW_SILL_M, z + _WINDOW_TOP_M

    @property
    def center_m(self) -> NDArray[np.float64]:
        """Middle of its floor, (2,)."""
        return 0.5 * (self.low_m + self.high_m)[:2]


@dataclass(frozen=True)
class FloorPlan:
    """The rooms and corridors of a building.

    Attributes:
        storeys: Number of storeys.
        length_m: Length of the corridors, which begin at x = 0.
        rooms: Rooms of all storeys, in the order of the robot's route.
    """

    storeys: int
    length_m: float
    rooms: tuple[Room, ...]

    def insides_m(self) -> NDArray[np.float64]:
        """Return (n, 2, 3) corners of all open spaces: rooms, doorways, window niches, corridors and stairs."""
        found = [np.stack([room.low_m, room.high_m]) for room in self.rooms]
        for room in self.rooms:
            inner, outer = room.walls_y_m
            doorway, niche = room.door_hole_m(), room.window_hole_m()
            for hole, y0, y1 in ((doorway, inner, inner - room.side * WALL_M), (niche, outer, outer + room.side * WALL_M)):
                left, right, below, above = hole
                found.append(np.sort(np.array([(left, y0, below), (right, y1, above)]), axis=0))
        for storey in range(self.storeys):
            z = storey * STOREY_M
            half = HALF_CORRIDOR_M
            found.append(np.array([(0, -half, z), (self.length_m + STAIRWELL_M, half, z + CEILING_M)]))
        stairs = (
            (self.length_m, -HALF_CORRIDOR_M, 0.0),
            (
                self.length_m + STAIRWELL_M,
                HALF_CORRIDOR_M,
                (self.storeys - 1) * STOREY_M + CEILING_M,
            ),
        )
        return np.array([*found, np.array(stairs)], np.float64)


def plan_building(
    storeys: int, rooms_per_storey: int, room_size_m: tuple[float, float], rng: np.random.Generator
) -> FloorPlan:
    """Lay out the rooms.

    Args:
        storeys: Number of storeys.
        rooms_per_storey: Number of rooms on each; they alternate between the two sides of the corridor.
        room_size_m: Least and greatest edge of a room.
        rng: Source of all random numbers.
    """
    rooms = []
    lengths = []
    for storey in range(storeys):
        ends = {1: 0.0, -1: 0.0}
        of_storey = []
        for number in range(rooms_per_storey):
            side = 1 if number % 2 == 0 else -1
            width, depth = rng.uniform(*room_size_m, 2)
            x, z = ends[side], storey * STOREY_M
            ends[side] = x + width + WALL_M
            near, far = HALF_CORRIDOR_M + WALL_M, HALF_CORRIDOR_M + WALL_M + depth
            low_y, high_y = (near, far) if side > 0 else (-far, -near)
            door = x + rng.uniform(0.5 * DOOR_WIDTH_M + 0.3, width - 0.5 * DOOR_WIDTH_M - 0.3)
            low, high = np.array([x, low_y, z]), np.array([x + width, high_y, z + CEILING_M])
            of_storey.append(Room(storey, side, low, high, float(door)))
        lengths.append(max(ends.values()))
        rooms += sorted(of_storey, key=lambda room: room.door_x_m, reverse=storey % 2 == 1)
    return FloorPlan(storeys, max(max(lengths), 2.0), tuple(rooms))


def build_shell(builder: BoxWorldBuilder, plan: FloorPlan) -> None:
    """Add walls, floors, ceilings, doors, windows and stairs."""
    for room in plan.rooms:
        _room(builder, room)
    for storey in range(plan.storeys):
        _corridor(builder, plan, storey)
        if storey + 1 < plan.storeys:
            _stairs(builder, plan, storey)


def door_zone_m(room: Room) -> NDArray[np.float64]:
    """Return the (2, 2) rectangle behind the door that stays free; the open door leaf is in it."""
    wall_y = room.walls_y_m[0]
    y0, y1 = sorted((wall_y, wall_y + room.side * 1.2))
    return np.array([(room.door_x_m - 0.75, y0), (room.door_x_m + 0.75, y1)])


def window_zone_m(room: Room) -> NDArray[np.float64]:
    """Return the (2, 2) rectangle along the window."""
    left, right, _, _ = room.window_hole_m()
    wall_y = room.walls_y_m[1]
    return np.array([(left, wall_y - 0.1), (right, wall_y + 0.1)])


def _box(part: str, low: tuple[float, float, float], high: tuple[float, float, float], color: Color) -> Piece:
    first, second = np.minimum(low, high).tolist(), np.maximum(low, high).tolist()
    return Piece(part, (first[0], first[1], first[2]), (second[0], second[1], second[2]), color)


def _with_hole(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float, hole: Hole) -> list[Piece]:
    """Make the pieces of a wall along x with a rectangular hole (x from, x to, z from, z to)."""
    left, right, below, above = hole
    boxes = [
        ((x0, y0, z0), (left, y1, z1)),
        ((right, y0, z0), (x1, y1, z1)),
        ((left, y0, above), (right, y1, z1)),
        ((left, y0, z0), (right, y1, below)),
    ]
    return [_box("wall", low, high, _WALL) for low, high in boxes if np.abs(np.subtract(high, low)).min() > 1e-6]


def _room(builder: BoxWorldBuilder, room: Room) -> None:
    x0, y0, z = room.low_m.tolist()
    x1, y1, top = room.high_m.tolist()
    inner, outer = room.walls_y_m
    hole, window = room.door_hole_m(), room.window_hole_m()
    left, right = hole[:2]
    threshold = _box("floor", (left, inner, z - _SLAB_M), (right, inner - room.side * WALL_M, z), _FLOOR)
    builder.add("floor", [_box("floor", (x0, y0, z - _SLAB_M), (x1, y1, z), _FLOOR), threshold])
    builder.add("ceiling", [_box("ceiling", (x0, y0, top), (x1, y1, top + _SLAB_M), _CEILING)])
    beyond = outer + room.side * WALL_M
    builder.add("wall", _with_hole(x0, x1, outer, beyond, z, top, window))
    pane_from, pane_to = outer + room.side * 0.04, outer + room.side * 0.07
    builder.add(
        "window",
        [
            _box(
                "pane",
                (window[0] + 0.05, pane_from, window[2] + 0.05),
                (window[1] - 0.05, pane_to, window[3] - 0.05),
                _GLASS,
            ),
            *_frame(window, outer + room.side * 0.02, outer + room.side * 0.09),
        ],
    )
    for edge, outside in ((x0, x0 - WALL_M), (x1, x1 + WALL_M)):
        middle_x = 0.5 * (edge + outside)  # Neighbouring rooms share a wall: each has half of it.
        builder.add("wall", [_box("wall", (edge, y0, z), (middle_x, y1, top), _WALL)])
    builder.add("wall", _with_hole(x0 - 0.5 * WALL_M, x1 + 0.5 * WALL_M, inner, inner - room.side * WALL_M, z, top, hole))
    # The leaf stands open on the side where the robot does not drive.
    hinge_x, beside_x = (left, left - 0.04) if room.door_x_m < room.center_m[0] else (right, right + 0.04)
    builder.add(
        "door",
        [
            _box("leaf", (hinge_x, inner, z + 0.01), (beside_x, inner + room.side * 0.95, z + 2.0), _DOOR),
            *_jambs(hole, inner - room.side * (WALL_M + 0.01), inner + room.side * 0.01),
        ],
    )


def _frame(hole: Hole, y0: float, y1: float) -> list[Piece]:
    left, right, below, above = hole
    edges = (
        ((left, y0, below), (left + 0.05, y1, above)),
        ((right - 0.05, y0, below), (right, y1, above)),
        ((left, y0, below), (right, y1, below + 0.05)),
        ((left, y0, above - 0.05), (right, y1, above)),
    )
    return [_box("frame", low, high, (240, 240, 238)) for low, high in edges]


def _jambs(hole: Hole, y0: float, y1: float) -> list[Piece]:
    left, right, below, above = hole
    edges = (
        ((left - 0.01, y0, below), (left + 0.03, y1, above)),
        ((right - 0.03, y0, below), (right + 0.01, y1, above)),
        ((left, y0, above - 0.03), (right, y1, above + 0.01)),
    )
    return [_box("frame", low, high, _DOOR) for low, high in edges]


def _corridor(builder: BoxWorldBuilder, plan: FloorPlan, storey: int) -> None:
    z, half, length = storey * STOREY_M, HALF_CORRIDOR_M, plan.length_m
    top, end = z + CEILING_M, length + STAIRWELL_M
    arrives, leaves = storey > 0, storey + 1 < plan.storeys
    hole = (length + STAIRS_FROM_M, length + STAIRS_TO_M)
    for class_name, z0, z1, open_, color in (
        ("floor", z - _SLAB_M, z, arrives, _FLOOR),
        ("ceiling", top, top + _SLAB_M, leaves, _CEILING),
    ):
        boxes = [((0.0, -half, z0), (length, half, z1))]
        builder.add(class_name, [_box(class_name, low, high, color) for low, high in boxes])
        if open_:
            boxes = [
                ((length, -half, z0), (end, 0.0, z1)),
                ((length, 0.0, z0), (hole[0], half, z1)),
                ((hole[1], 0.0, z0), (end, half, z1)),
            ]
        else:
            boxes = [((length, -half, z0), (end, half, z1))]
        builder.add(class_name, [_box(class_name, low, high, color) for low, high in boxes])
    for x, outside in ((0.0, -WALL_M), (end, end + WALL_M)):
        builder.add("wall", [_box("wall", (x, -half, z), (outside, half, top), _WALL)])
    for side in (1, -1):
        rooms = [room for room in plan.rooms if room.storey == storey and room.side == side]
        start = max((float(room.high_m[0]) for room in rooms), default=0.0) + (0.5 * WALL_M if rooms else 0.0)
        wall = _box("wall", (start, side * half, z), (end, side * (half + WALL_M), z + STOREY_M - _SLAB_M), _WALL)
        builder.add("wall", [wall])


def _stairs(builder: BoxWorldBuilder, plan: FloorPlan, storey: int) -> None:
    z, x = storey * STOREY_M, plan.length_m + STAIRS_FROM_M
    run, rise = (STAIRS_TO_M - STAIRS_FROM_M) / _STEPS, STOREY_M / _STEPS
    pieces = [
        _box(
            "steps",
            (x + step * run, 0.03, z + step * rise - (0.0 if step == 0 else 0.1)),
            (x + (step + 1) * run, HALF_CORRIDOR_M, z + (step + 1) * rise),
            _STAIRS,
        )
        for step in range(_STEPS)
    ]
    pieces += [
        _box(
            "rail",
            (x + step * run, 0.0, z + (step + 1) * rise + 0.8),
            (x + (step + 1) * run, 0.03, z + (step + 1) * rise + 0.9),
            (70, 70, 74),
        )
        for step in range(_STEPS)
    ]
    builder.add("stairs", pieces)
