"""Boxes: quarter turns, views against a known answer, and points of surfaces that can be seen."""

from __future__ import annotations

import numpy as np
import pytest

from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.simulation.building.box_renderer import BoxRenderer
from fus3dmaps_lab.simulation.building.box_surfaces import surface_points
from fus3dmaps_lab.simulation.building.box_world import BoxWorldBuilder, Piece, Pose
from fus3dmaps_lab.simulation.camera_path import look_at

RED, BLUE = (200, 0, 0), (0, 0, 200)
CAMERA = Intrinsics(50.0, 50.0, 24.5, 24.5, 50, 50)
ROOM = np.array([[(-5.0, -5.0, 0.0), (5.0, 5.0, 3.0)]])


def table_and_mug() -> BoxWorldBuilder:
    builder = BoxWorldBuilder(frozenset({"floor"}))
    builder.add("floor", [Piece("floor", (-5, -5, -0.1), (5, 5, 0), RED)])
    builder.add(
        "table", [Piece("top", (-0.5, -0.5, 0.7), (0.5, 0.5, 0.8), RED), Piece("leg", (-0.1, -0.1, 0), (0.1, 0.1, 0.7), RED)]
    )
    builder.add("mug", [Piece("mug", (-0.05, -0.05, 0.8), (0.05, 0.05, 0.9), BLUE)])
    return builder


@pytest.mark.parametrize(
    ("turns", "low", "high"),
    [
        (0, (9, 17, 0), (13, 20, 4)),
        (1, (10, 19, 0), (13, 23, 4)),
        (2, (7, 20, 0), (11, 23, 4)),
        (3, (7, 17, 0), (10, 21, 4)),
    ],
)
def test_quarter_turns(turns, low, high) -> None:
    # One to the left, three to the right, three to the front.
    first, second = Pose((10.0, 20.0, 0.0), turns).place((-1, -3, 0), (3, 0, 4))
    np.testing.assert_allclose(first, low)
    np.testing.assert_allclose(second, high)


def test_labels_are_counted_from_one_and_classes_are_shared() -> None:
    builder = table_and_mug()
    builder.add("mug", [Piece("mug", (2, 2, 0), (3, 3, 1), BLUE)])
    truth = builder.build().truth
    assert truth.class_names == ("", "floor", "table", "mug")
    assert truth.class_of_instance.tolist() == [0, 1, 2, 3, 3]
    assert truth.instance_of_part.tolist() == [0, 1, 2, 2, 3, 4]
    assert truth.background == {1}


def test_a_thing_without_a_box_is_refused() -> None:
    with pytest.raises(ValueError, match="no surface"):
        BoxWorldBuilder(frozenset()).add("ghost", [])


def test_a_view_from_above_sees_depths_parts_and_colours() -> None:
    world = table_and_mug().build()
    T = look_at((0.0, 0.01, 2.9), (0.0, 0.0, 0.9))
    T[:3, :3] = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]]).T
    T[:3, 3] = (0.0, 0.0, 2.9)
    view = BoxRenderer(world).render(CAMERA, T)
    assert view.parts[24, 24] == 4
    np.testing.assert_allclose(view.depth_m[24, 24], 2.0, atol=1e-5)
    assert view.rgb[24, 24, 2] > view.rgb[24, 24, 0]
    np.testing.assert_allclose(view.incidence_cos[24, 24], 1.0, atol=1e-3)
    assert view.parts[24, 24 + 10] == 2
    np.testing.assert_allclose(view.depth_m[24, 34], 2.1, atol=1e-5)
    assert view.parts[0, 0] == 1
    np.testing.assert_allclose(view.depth_m[0, 0], 2.9, atol=1e-5)


def test_a_ray_that_leaves_the_world_sees_nothing() -> None:
    world = table_and_mug().build()
    view = BoxRenderer(world).render(CAMERA, look_at((0, -3, 1.5), (0, -6, 3.5)))
    assert view.parts[0, 24] == 0
    assert view.depth_m[0, 24] == 0
    assert not view.rgb[0, 24].any()


def test_surfaces_that_touch_another_box_or_face_outwards_have_no_points() -> None:
    world = table_and_mug().build()
    surface = surface_points(world, ROOM, 0.02)
    of_floor, of_top, of_mug = (surface.points_m[surface.parts == part] for part in (1, 2, 4))
    np.testing.assert_array_equal(of_floor[:, 2], 0)
    assert not (np.abs(of_floor[:, :2]) < 0.1).all(axis=1).any()  # Under the leg.
    on_top = of_top[of_top[:, 2] == 0.8]
    assert not (np.abs(on_top[:, :2]) < 0.05).all(axis=1).any()  # Under the mug.
    assert of_mug[:, 2].min() > 0.8
    # Area times density: top 1 - 0.01, below 1 - 0.04, four edges of 0.1.
    np.testing.assert_allclose(len(of_top) * 0.02**2, 0.99 + 0.96 + 0.4, rtol=0.01)
