import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_lab.simulation.camera_path import look_at
from fus3dmaps_lab.simulation.room.rendering import SceneRenderer
from fus3dmaps_lab.simulation.room.scene import Material, SceneBuilder

CAMERA = Intrinsics(fx=110.0, fy=105.0, cx=62.0, cy=49.5, width=128, height=96)
QUADRANTS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
GREY = Material(np.full((4, 4, 3), 128, np.uint8), lit=False)


def quadrant_texture():
    return Material(QUADRANTS.repeat(32, axis=0).repeat(32, axis=1), lit=False)


def wall_with_print():
    """Build a grey wall at y = 2 with a 0.8 m x 0.8 m print at (0.3, 1.2) on it, 1 cm in front."""
    builder = SceneBuilder()
    builder.panel((0, 2, 1), (0, -1, 0), (60, 60), GREY)
    with builder.thing("print"):
        builder.panel((0.3, 1.99, 1.2), (0, -1, 0), (0.8, 0.8), quadrant_texture())
    return SceneRenderer(builder.build())


def pixel(pose, point_m):
    x, y, z = pose[:3, :3].T @ (np.asarray(point_m) - pose[:3, 3])
    return round(CAMERA.fx * x / z + CAMERA.cx), round(CAMERA.fy * y / z + CAMERA.cy)


def test_depth_of_a_wall_seen_head_on_is_its_distance_everywhere():
    builder = SceneBuilder()
    builder.panel((0, 2, 1), (0, -1, 0), (60, 60), GREY)
    view = SceneRenderer(builder.build()).render(CAMERA, look_at((0.4, -0.5, 1.1), (0.4, 2, 1.1)))
    np.testing.assert_allclose(view.depth_m, 2.5, atol=1e-5)
    assert np.all(view.rgb == 128)
    assert np.all(view.labels == 0)
    assert view.incidence_cos[49, 62] == pytest.approx(1, abs=1e-4)
    expected = 1 / np.sqrt(1 + (62 / 110) ** 2 + (49.5 / 105) ** 2)
    assert view.incidence_cos[0, 0] == pytest.approx(expected, abs=1e-5)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.8, 0.8), st.floats(-1.5, 0.5), st.floats(0.3, 2.0), st.floats(-0.4, 0.8), st.floats(0.8, 1.5))
def test_a_print_lands_on_its_pixels_upright_and_not_mirrored(x, y, z, target_x, target_z):
    pose = look_at((x, y, z), (target_x, 2.0, target_z))
    view = wall_with_print().render(CAMERA, pose)
    for row, height in enumerate((1.4, 1.0)):
        for column, side in enumerate((0.1, 0.5)):
            u, v = pixel(pose, (side, 1.99, height))
            if 1 <= u < 127 and 1 <= v < 95:
                assert view.rgb[v, u].tolist() == QUADRANTS[row, column].tolist()
                assert view.labels[v, u] == 1


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.8, 0.8), st.floats(-1.5, 0.5), st.floats(-1, 1), st.floats(0.5, 1.8))
def test_depth_unprojects_onto_the_plane(x, y, target_x, target_z):
    pose = look_at((x, y, 1.2), (target_x, 2.0, target_z))
    view = wall_with_print().render(CAMERA, pose)
    rows, columns = np.mgrid[:96, :128]
    points = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones((96, 128))], axis=-1)
    world = (points * view.depth_m[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(world[..., 1], np.where(view.labels == 1, 1.99, 2.0), atol=1e-3)


def test_the_border_of_a_surface_blends_both_colours():
    builder = SceneBuilder()
    builder.panel((0, 2, 0), (0, -1, 0), (60, 60), Material(np.zeros((4, 4, 3), np.uint8), lit=False))
    # Its left border runs a quarter of a pixel left of the centre of column 62, so two of four subpixels lie on it.
    left = -0.25 / CAMERA.fx
    builder.panel((left + 5, 1, 0), (0, -1, 0), (10, 10), Material(np.full((4, 4, 3), 200, np.uint8), lit=False))
    row = SceneRenderer(builder.build()).render(CAMERA, look_at((0, 0, 0), (0, 1, 0))).rgb[48, :, 0]
    assert row[60] == 0
    assert row[64] == 200
    assert row[62] == 150
    assert np.count_nonzero((row > 0) & (row < 200)) == 1


def test_rays_that_leave_the_scene_have_neither_colour_nor_depth():
    builder = SceneBuilder()
    with builder.thing("print"):
        builder.panel((0, 2, 0), (0, -1, 0), (0.5, 0.5), GREY)
    view = SceneRenderer(builder.build()).render(CAMERA, look_at((0, 0, 0), (0, 1, 0)))
    assert view.depth_m[48, 62] == pytest.approx(2)
    assert view.labels[48, 62] == 1
    for image in (view.rgb, view.depth_m, view.labels, view.incidence_cos):
        assert np.all(image[:5] == 0)


def test_light_darkens_lit_surfaces_and_spares_prints():
    builder = SceneBuilder()
    builder.box((-2, -2, 0), (2, 2, 2), Material(np.full((4, 4, 3), 100, np.uint8)), inward=True)
    builder.panel((0, 1.99, 1), (0, -1, 0), (0.8, 0.8), Material(np.full((4, 4, 3), 100, np.uint8), lit=False))
    view = SceneRenderer(builder.build()).render(CAMERA, look_at((0, 0, 1), (0, 2, 1)))
    assert np.all(view.rgb[48, 62] == 100)
    assert np.all(view.rgb[48, 5] < 100)
