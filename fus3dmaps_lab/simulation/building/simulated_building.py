"""A robot's recording of a simulated building, with ground truth of every pixel and all surfaces."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_lab.simulation.building.box_renderer import BoxRenderer
from fus3dmaps_lab.simulation.building.box_surfaces import surface_points
from fus3dmaps_lab.simulation.building.box_world import BoxWorldBuilder
from fus3dmaps_lab.simulation.building.floor_plan import (
    BACKGROUND,
    build_shell,
    door_zone_m,
    plan_building,
    window_zone_m,
)
from fus3dmaps_lab.simulation.building.furnishing import KINDS, Space, furnish
from fus3dmaps_lab.simulation.building.route import route, route_zone_m
from fus3dmaps_lab.simulation.depth_noise import DepthSensor
from fus3dmaps_lab.simulation.drift import Drift
from fus3dmaps_lab.simulation.truth import LabelledFrame, SurfacePoints, Truth

CAMERA = Intrinsics(fx=262.0, fy=262.0, cx=159.5, cy=119.5, width=320, height=240)
ROOM_SIZE_M = (3.9, 5.0)
EPOCH_NS = 1_700_000_000_000_000_000
PERIOD_NS = 200_000_000


class SimulatedBuilding:
    """A furnished building and a route through all its rooms: an iterable of labelled frames.

    Attributes:
        world: All boxes of the building.
        plan: Plan of its rooms.
        intrinsics: Camera model of every frame.
        rooms: Kind of each room with the lower and upper corner of its inside, metres, in the order of the route.
    """

    def __init__(
        self,
        seed: int = 0,
        storeys: int = 1,
        rooms_per_storey: int = 4,
        frames: int | None = None,
        camera: Intrinsics = CAMERA,
        drift: Drift | None = None,
        room_size_m: tuple[float, float] = ROOM_SIZE_M,
    ) -> None:
        """Build and furnish the building, and plan the route.

        Args:
            seed: Seed of rooms, furniture and depth noise.
            storeys: Number of storeys.
            rooms_per_storey: Number of rooms on each storey.
            frames: Number of frames along the route; None takes one every 0.22 m or 0.3 rad.
            camera: Camera model.
            drift: Drift of the believed poses; None leaves them exact.
            room_size_m: Least and greatest edge of a room; a robot needs 3.6 m.

        Raises:
            ValueError: There are no storeys, rooms or frames, or rooms are too small.
        """
        if storeys < 1 or rooms_per_storey < 1 or (frames is not None and frames < 2):
            raise ValueError(
                f"a building needs a storey, a room and two frames, got {storeys}, {rooms_per_storey}, {frames}"
            )
        if not 3.6 <= room_size_m[0] <= room_size_m[1]:
            raise ValueError(f"room_size_m must be two ascending numbers from 3.6 m on, got {room_size_m}")
        rng = np.random.default_rng((seed, 0xB01D))
        self._seed = seed
        self.plan = plan_building(storeys, rooms_per_storey, room_size_m, rng)
        builder = BoxWorldBuilder(BACKGROUND)
        build_shell(builder, self.plan)
        self.rooms: tuple[tuple[str, NDArray[np.float64], NDArray[np.float64]], ...] = tuple(self._furnish(builder, rng))
        self.world = builder.build()
        self._renderer = BoxRenderer(self.world)
        self._sensor = DepthSensor()
        self._true_poses = _cut(route(self.plan), frames)
        self._poses = self._true_poses if drift is None else drift.believed(self._true_poses)
        self.intrinsics = camera

    @property
    def truth(self) -> Truth:
        """Parts, instances and classes."""
        return self.world.truth

    def __len__(self) -> int:
        """Count the frames."""
        return len(self._poses)

    def __iter__(self) -> Iterator[LabelledFrame]:
        """Yield the frames in order of time."""
        return (self.frame(index) for index in range(len(self)))

    def frame(self, index: int) -> LabelledFrame:
        """Make a frame. It does not depend on the frames made before."""
        view = self._renderer.render(self.intrinsics, self._true_poses[index])
        noisy_m = self._sensor.measure(view.depth_m, view.incidence_cos, np.random.default_rng((self._seed, index)))
        frame = PosedFrame(EPOCH_NS + index * PERIOD_NS, view.rgb, noisy_m, self.intrinsics, self._poses[index])
        return LabelledFrame(frame, self._true_poses[index], view.depth_m, view.parts)

    def surface(self, spacing_m: float = 0.025) -> SurfacePoints:
        """Sample all free surfaces that face the inside of the building, whether the robot sees them or not."""
        return surface_points(self.world, self.plan.insides_m(), spacing_m)

    def _furnish(
        self, builder: BoxWorldBuilder, rng: np.random.Generator
    ) -> Iterator[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
        kinds = rng.permutation(len(KINDS))
        for number, room in enumerate(self.plan.rooms):
            kind = KINDS[int(kinds[number % len(KINDS)])]
            reserved = np.concatenate([door_zone_m(room)[None], route_zone_m(room)])
            furnish(builder, kind, Space(room.low_m, room.high_m, reserved, window_zone_m(room)[None]), rng)
            yield kind.name, room.low_m, room.high_m


def _cut(poses: NDArray[np.float64], frames: int | None) -> NDArray[np.float64]:
    """Choose a number of poses evenly; some are repeated if there are fewer."""
    if frames is None:
        return poses
    chosen: NDArray[np.float64] = poses[np.linspace(0, len(poses) - 1, frames).round().astype(int)]
    return chosen
