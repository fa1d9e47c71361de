"""The route of a robot through a building: along the corridors, twice around in every room, up the stairs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_lab.simulation.building.floor_plan import (
    HALF_CORRIDOR_M,
    STAIRS_FROM_M,
    STAIRS_TO_M,
    STOREY_M,
    WALL_M,
    FloorPlan,
    Room,
)
from fus3dmaps_lab.simulation.camera_path import look_at

EYE_M = 1.2
STEP_M = 0.22
STEP_RAD = 0.3
REACH_M = 0.6
"""Radius of the circle that the robot drives in a room."""

_PITCH_RAD = -0.12
_LANE_M = -0.5 * HALF_CORRIDOR_M


def route(plan: FloorPlan) -> NDArray[np.float64]:
    """Compute the poses of the route, at most STEP_M and about STEP_RAD apart.

    Args:
        plan: Plan of the building.

    Returns:
        (n, 4, 4) T_world_camera of the optical frame (REP-103).
    """
    stops = np.array(list(_stops(plan)), np.float64)
    dense = [stops[0]]
    for stop in stops[1:]:
        last = dense[-1]
        step = stop - last
        step[3] = (step[3] + np.pi) % (2 * np.pi) - np.pi
        pieces = max(1, int(np.ceil(max(np.linalg.norm(step[:3]) / STEP_M, np.abs(step[3:]).max() / STEP_RAD))))
        dense += [last + step * (piece / pieces) for piece in range(1, pieces + 1)]
    return np.stack([_pose(*each) for each in dense])


def _pose(x: float, y: float, z: float, yaw_rad: float, pitch_rad: float) -> NDArray[np.float64]:
    ahead = np.array([np.cos(yaw_rad) * np.cos(pitch_rad), np.sin(yaw_rad) * np.cos(pitch_rad), np.sin(pitch_rad)])
    position = np.array([x, y, z])
    return look_at(position, position + ahead)


def _stops(plan: FloorPlan) -> list[tuple[float, float, float, float, float]]:
    """List the stops (x, y, z, heading, pitch); between them the robot drives straight and turns evenly."""
    stops: list[tuple[float, float, float, float, float]] = []
    for storey in range(plan.storeys):
        z = storey * STOREY_M + EYE_M
        rooms = [room for room in plan.rooms if room.storey == storey]
        heading = 0.0 if storey % 2 == 0 else np.pi
        for room in rooms:
            stops.append((room.door_x_m, _LANE_M, z, heading, _PITCH_RAD))
            stops += _in_room(room, z)
            stops.append((room.door_x_m, _LANE_M, z, heading, _PITCH_RAD))
        if storey + 1 < plan.storeys:
            stops += _up(plan, z)
    return stops


def _in_room(room: Room, z: float) -> list[tuple[float, float, float, float, float]]:
    """List the stops in a room: in by the door, a circle looking outwards, a circle looking across it, and out."""
    inward = 0.5 * np.pi * room.side
    wall_y = room.side * HALF_CORRIDOR_M
    behind_wall = wall_y + room.side * (WALL_M + 0.7)
    x, y = room.center_m.tolist()
    entrance = (room.door_x_m, behind_wall, z, inward, _PITCH_RAD)
    angles = -inward + np.linspace(0, 2 * np.pi, 13)
    around = [(x + REACH_M * np.cos(a), y + REACH_M * np.sin(a), z) for a in angles]
    outward = [(*place, a, -0.25) for place, a in zip(around, angles, strict=True)]
    across = [(*place, a + np.pi, -0.3) for place, a in zip(around, angles, strict=True)]
    leaving = (room.door_x_m, behind_wall, z, -inward, _PITCH_RAD)
    return [entrance, *outward, *across, leaving]


def _up(plan: FloorPlan, z: float) -> list[tuple[float, float, float, float, float]]:
    """List the stops to the foot of the stairs, up, and back west to the next storey's corridor."""
    x0, x1, lane = plan.length_m + STAIRS_FROM_M, plan.length_m + STAIRS_TO_M, 0.5 * HALF_CORRIDOR_M
    top = z + STOREY_M
    return [
        (x0 - 0.5, _LANE_M, z, 0.0, _PITCH_RAD),
        (x0 - 0.4, lane, z, 0.0, 0.2),
        (x1 + 0.3, lane, top, 0.0, 0.0),
        (x1 + 0.6, lane, top, 0.5 * np.pi, _PITCH_RAD),
        (x1 + 0.6, _LANE_M, top, np.pi, _PITCH_RAD),
        (x0 - 0.5, _LANE_M, top, np.pi, _PITCH_RAD),
    ]


def route_zone_m(room: Room) -> NDArray[np.float64]:
    """Return (n, 2, 2) rectangles that cover the robot's route through a room, with clearance."""
    reach = REACH_M + 0.35
    x, y = room.center_m.tolist()
    rectangles = [((x - reach, y - reach), (x + reach, y + reach))]
    entrance = np.array([room.door_x_m, room.side * (HALF_CORRIDOR_M + WALL_M + 0.7)])
    # From behind the door the robot drives straight to the circle's nearest point; squares cover that line.
    goal = np.array([x, y - room.side * REACH_M])
    for share in np.linspace(0, 1, 12):
        at = entrance + share * (goal - entrance)
        rectangles.append(((at[0] - 0.35, at[1] - 0.35), (at[0] + 0.35, at[1] + 0.35)))
    return np.array(rectangles)
