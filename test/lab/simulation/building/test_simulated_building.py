"""The simulated building: labels match the geometry, and a robot can drive through it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fus3dmaps_lab.simulation.building.box_world import BoxWorld
from fus3dmaps_lab.simulation.building.floor_plan import STOREY_M
from fus3dmaps_lab.simulation.building.route import STEP_M, STEP_RAD, route
from fus3dmaps_lab.simulation.building.simulated_building import SimulatedBuilding
from fus3dmaps_lab.simulation.drift import Drift

BODY_M = 0.15


def instance_boxes_m(world: BoxWorld) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper corners of every instance: two (instances + 1, 3), the first row without meaning."""
    instance = world.truth.instance_of_part[world.part]
    low, high = np.full((instance.max() + 1, 3), np.inf), np.full((instance.max() + 1, 3), -np.inf)
    np.minimum.at(low, instance, world.low_m)
    np.maximum.at(high, instance, world.high_m)
    return low, high


@pytest.fixture(scope="module")
def house() -> SimulatedBuilding:
    return SimulatedBuilding(seed=3, storeys=2, rooms_per_storey=4)


@pytest.fixture(scope="module", params=range(6))
def any_house(request) -> SimulatedBuilding:
    return SimulatedBuilding(seed=request.param, storeys=1 + request.param % 3, rooms_per_storey=2 + request.param)


def test_the_same_seed_gives_the_same_frames_in_whatever_order_and_another_seed_others(house) -> None:
    again = SimulatedBuilding(seed=3, storeys=2, rooms_per_storey=4)
    for index in (40, 7):
        first, second = house.frame(index), again.frame(index)
        np.testing.assert_array_equal(first.frame.rgb, second.frame.rgb)
        np.testing.assert_array_equal(first.frame.depth_m, second.frame.depth_m)
        np.testing.assert_array_equal(first.parts, second.parts)
    assert not np.array_equal(SimulatedBuilding(seed=4, storeys=2).frame(40).parts, house.frame(40).parts)


def test_parts_belong_to_instances_and_these_to_named_classes(house) -> None:
    truth = house.truth
    assert truth.instance_of_part[0] == truth.class_of_instance[0] == 0
    assert set(truth.instance_of_part[1:]) == set(range(1, len(truth.class_of_instance)))
    assert set(truth.class_of_instance[1:]) == set(range(1, len(truth.class_names)))
    assert len(set(truth.class_names)) == len(truth.class_names)
    assert {truth.class_names[number] for number in truth.background} == {"wall", "floor", "ceiling", "door", "window"}
    assert len(truth.class_names) - 1 - len(truth.background) >= 18


def test_rooms_hold_what_their_kind_is_known_by() -> None:
    known_by = {"bedroom": "bed", "living room": "sofa", "kitchen": "counter", "office": "desk", "bathroom": "toilet"}
    found = dict.fromkeys(known_by, 0)
    rooms = dict.fromkeys(known_by, 0)
    for seed in range(6):
        building = SimulatedBuilding(seed=seed, storeys=1, rooms_per_storey=6)
        low, high = instance_boxes_m(building.world)
        names = np.array(building.truth.class_names)[building.truth.class_of_instance]
        for kind, room_low, room_high in building.rooms:
            if kind in known_by:
                here = np.all((low > room_low - 0.01) & (high < room_high + 0.01), axis=1)
                rooms[kind] += 1
                found[kind] += known_by[kind] in names[here]
    assert min(rooms.values()) >= 5
    for kind, count in found.items():
        assert count >= rooms[kind] - 1, kind


def test_most_things_have_parts(house) -> None:
    parts = np.bincount(house.truth.instance_of_part[1:])
    for name in ("chair", "table", "sofa", "bed", "lamp", "cabinet"):
        number = house.truth.class_names.index(name)
        of_class = parts[np.flatnonzero(house.truth.class_of_instance == number)]
        assert len(of_class)
        assert of_class.min() >= 2, name


def test_depth_and_parts_of_a_frame_are_those_of_the_surface(house) -> None:
    surface = house.surface(0.02)
    tree = cKDTree(surface.points_m)
    camera = house.intrinsics
    xs, ys = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    for index in range(20, len(house), len(house) // 6):
        labelled = house.frame(index)
        z = labelled.true_depth_m
        seen = z > 0
        rays = np.stack([(xs - camera.cx) / camera.fx, (ys - camera.cy) / camera.fy, np.ones_like(xs)], axis=-1)
        points = (rays * z[..., None])[seen] @ labelled.T_true_camera[:3, :3].T + labelled.T_true_camera[:3, 3]
        distance, nearest = tree.query(points)
        assert distance.max() < 0.03
        # Where two parts meet, the nearest sample may be the neighbour's.
        agree = surface.parts[nearest] == labelled.parts[seen]
        assert agree.mean() > 0.97


def test_every_ray_meets_the_building(house) -> None:
    for index in range(0, len(house), len(house) // 12):
        labelled = house.frame(index)
        assert (labelled.parts > 0).mean() > 0.999
        assert ((labelled.parts > 0) == (labelled.true_depth_m > 0)).all()


def test_sensor_noise_is_that_of_the_sensor(house) -> None:
    labelled = house.frame(30)
    read = labelled.frame.depth_m > 0
    error = np.abs(labelled.frame.depth_m - labelled.true_depth_m)[read]
    assert 0 < np.median(error) < 0.03


def test_furniture_does_not_interpenetrate(any_house) -> None:
    low, high = instance_boxes_m(any_house.world)
    names = np.array(any_house.truth.class_names)[any_house.truth.class_of_instance]
    background = np.isin(any_house.truth.class_of_instance, list(any_house.truth.background))
    # Books are within the shelf's bounds, and a rug is under whatever stands on it.
    things = [n for n in range(1, len(names)) if not background[n] and names[n] not in ("books", "rug", "stairs")]
    for place, first in enumerate(things):
        for second in things[place + 1 :]:
            overlap = np.minimum(high[first], high[second]) - np.maximum(low[first], low[second])
            supported = "pillow" in (names[first], names[second])
            if not supported:
                assert (overlap < 1e-6).any(), (names[first], names[second])


def test_small_things_rest_on_something(any_house) -> None:
    low, high = instance_boxes_m(any_house.world)
    names = np.array(any_house.truth.class_names)[any_house.truth.class_of_instance]
    for number in np.flatnonzero(np.isin(names, ["mug", "vase", "book", "bottle", "bowl", "monitor", "keyboard", "pillow"])):
        below = np.all(any_house.world.low_m[:, :2] < high[number, :2], axis=1)
        below &= np.all(any_house.world.high_m[:, :2] > low[number, :2], axis=1)
        below &= any_house.truth.instance_of_part[any_house.world.part] != number
        assert np.abs(any_house.world.high_m[below, 2] - low[number, 2]).min() < 1e-6, names[number]


def test_the_way_is_smooth_free_and_goes_through_every_room(any_house) -> None:
    poses = route(any_house.plan)
    places = poses[:, :3, 3]
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() <= STEP_M + 1e-9
    turns = np.einsum("nij,nij->n", poses[:-1, :3, :3], poses[1:, :3, :3])
    assert np.arccos(np.clip((turns - 1) / 2, -1, 1)).max() <= 2**0.5 * STEP_RAD
    for _, low, high in any_house.rooms:
        assert np.all((places > low) & (places < high), axis=1).sum() >= 30
    for at in places:
        nearest = np.clip(at, any_house.world.low_m, any_house.world.high_m)
        assert np.linalg.norm(nearest - at, axis=1).min() > BODY_M, at
    storeys = any_house.plan.storeys
    assert (storeys - 1) * STOREY_M < places[:, 2].max() < storeys * STOREY_M


def test_frames_are_cut_as_asked() -> None:
    building = SimulatedBuilding(seed=0, rooms_per_storey=2, frames=25)
    assert len(building) == len(list(building)) == 25
    stamps = [labelled.frame.stamp_ns for labelled in building]
    assert all(np.diff(stamps) > 0)


def test_a_robot_that_drifts_believes_other_poses_and_sees_what_it_truly_sees() -> None:
    exact = SimulatedBuilding(seed=1, rooms_per_storey=2)
    drifting = SimulatedBuilding(seed=1, rooms_per_storey=2, drift=Drift(seed=5))
    first, second = exact.frame(60), drifting.frame(60)
    np.testing.assert_array_equal(first.parts, second.parts)
    np.testing.assert_array_equal(first.T_true_camera, second.T_true_camera)
    np.testing.assert_array_equal(first.frame.T_world_camera, first.T_true_camera)
    assert 0 < np.linalg.norm(second.frame.T_world_camera[:3, 3] - second.T_true_camera[:3, 3]) < 0.5


@pytest.mark.parametrize(
    "options",
    [{"storeys": 0}, {"rooms_per_storey": 0}, {"frames": 1}, {"room_size_m": (3.0, 4.0)}, {"room_size_m": (5.0, 4.0)}],
)
def test_what_cannot_be_built_is_refused(options) -> None:
    with pytest.raises(ValueError, match=r"building needs|room_size_m"):
        SimulatedBuilding(**options)
