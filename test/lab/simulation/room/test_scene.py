import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_lab.simulation.room.scene import Material, Placement, SceneBuilder

WHITE = Material(np.full((4, 4, 3), 255, np.uint8))
ANGLES = st.floats(-np.pi, np.pi)
COORDINATES = st.floats(-5, 5)


@given(ANGLES, COORDINATES, COORDINATES)
def test_a_vertical_panel_reads_upright_for_who_faces_it(yaw, x, y):
    builder = SceneBuilder()
    builder.panel((0, 0, 1), (0, -1, 0), (2.0, 0.5), WHITE, Placement((x, y, 0), yaw))
    (panel,) = builder.build().panels
    facing = np.array([np.sin(yaw), -np.cos(yaw), 0])
    right = np.array([np.cos(yaw), np.sin(yaw), 0])  # At yaw 0 the viewer stands in the south and looks north.
    np.testing.assert_allclose(panel.normal, facing, atol=1e-12)
    np.testing.assert_allclose(panel.edge_u_m, 2.0 * right, atol=1e-12)
    np.testing.assert_allclose(panel.edge_v_m, (0, 0, -0.5), atol=1e-12)
    np.testing.assert_allclose(panel.point_m(0.5, 0.5), (x, y, 1), atol=1e-12)


@pytest.mark.parametrize("inward", [False, True])
def test_a_box_has_six_faces_that_close_it(inward):
    builder = SceneBuilder()
    low, high = np.array([0.0, 1.0, 2.0]), np.array([0.5, 3.0, 2.2])
    builder.box(low, high, WHITE, inward=inward)
    panels = builder.build().panels
    assert len(panels) == 6
    middle = 0.5 * (low + high)
    area = 0.0
    for panel in panels:
        outwards = (panel.point_m(0.5, 0.5) - middle) @ panel.normal
        assert (outwards < 0) == inward
        area += np.prod(panel.size_m)
        corners = panel.point_m([0, 1, 0, 1], [0, 0, 1, 1])
        assert np.all((np.isclose(corners, low)) | (np.isclose(corners, high)))
    width, depth, height = high - low
    assert area == pytest.approx(2 * (width * depth + width * height + depth * height))


@given(ANGLES)
def test_the_box_of_a_thing_bounds_its_corners(yaw):
    builder = SceneBuilder()
    builder.box((-9, -9, -9), (9, 9, 9), WHITE)
    with builder.thing("brick"):
        builder.box((-1, -0.5, 0), (1, 0.5, 0.3), WHITE, Placement((3, -2, 1), yaw))
    (brick,) = builder.build().objects
    extent = abs(np.cos(yaw)) * np.array([1, 0.5]) + abs(np.sin(yaw)) * np.array([0.5, 1])
    np.testing.assert_allclose(brick.box_min_m, (*(np.array([3, -2]) - extent), 1), atol=1e-9)
    np.testing.assert_allclose(brick.box_max_m, (*(np.array([3, -2]) + extent), 1.3), atol=1e-9)
    np.testing.assert_allclose(brick.center_m, (3, -2, 1.15), atol=1e-9)


def test_labels_count_things_from_one_and_leave_the_building_at_zero():
    builder = SceneBuilder()
    builder.panel((0, 0, 0), (0, 0, 1), (1, 1), WHITE)
    for name in ("a", "b"):
        with builder.thing(name):
            builder.panel((0, 0, 1), (0, 0, 1), (1, 1), WHITE)
    scene = builder.build()
    assert [panel.label for panel in scene.panels] == [0, 1, 2]
    assert scene.named("b") is scene.objects[1]
    with pytest.raises(KeyError):
        scene.named("c")


def test_things_have_their_own_names_and_surfaces():
    builder = SceneBuilder()
    with pytest.raises(ValueError, match="'inner' begins inside 'outer'"), builder.thing("outer"), builder.thing("inner"):
        pass
    with pytest.raises(ValueError, match="named 'outer' already"), builder.thing("outer"):
        pass
    with pytest.raises(ValueError, match="'outer' has no surface"):
        builder.build()
