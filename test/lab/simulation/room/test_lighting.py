import numpy as np
import open3d as o3d
import pytest

from fus3dmaps_lab.simulation.room.lighting import bake_light
from fus3dmaps_lab.simulation.room.scene import Material, SceneBuilder

GREY = np.full((4, 4, 3), 128, np.uint8)


def bake(builder):
    panels = builder.build().panels
    caster = o3d.t.geometry.RaycastingScene()
    for panel in panels:
        corners = panel.point_m([0, 1, 0, 1], [0, 0, 1, 1]).astype(np.float32)
        caster.add_triangles(o3d.core.Tensor(corners), o3d.core.Tensor(np.array([[0, 1, 2], [3, 2, 1]], np.uint32)))
    return bake_light(panels, caster)


def test_an_open_floor_is_evenly_lit_and_a_corner_is_darker():
    builder = SceneBuilder()
    builder.panel((0, 0, 0), (0, 0, 1), (4, 4), Material(GREY))
    (alone,) = bake(builder)
    assert np.ptp(alone) < 1e-6
    builder.panel((0, 2, 1), (0, -1, 0), (4, 2), Material(GREY))  # A wall along the first rows of the floor's texture.
    floor, _ = bake(builder)
    assert floor[0].mean() < 0.75 * alone.mean()
    assert floor[-1].mean() == pytest.approx(alone.mean(), rel=0.02)
    assert np.all(np.diff(floor.mean(axis=1)[:8]) > 0)


def test_a_lamp_casts_the_light_of_the_inverse_square_law_and_a_shadow():
    builder = SceneBuilder()
    builder.panel((0, 0, 0), (0, 0, 1), (4, 4), Material(GREY))
    (dark,) = bake(builder)
    emission, edge = 5.0, 0.1
    builder.panel((0, 0, 2), (0, 0, -1), (edge, edge), Material(GREY, lit=False, emission=emission))
    lamplight = bake(builder)[0] - dark
    n = len(lamplight)
    x = (np.arange(n) + 0.5) / n * 4 - 2
    square = x[:, None] ** 2 + x[None] ** 2 + 4.0
    # Irradiance of a small horizontal Lambertian lamp at height h: L A cos^2 / (pi r^2), cos = h / r.
    expected = emission * edge**2 / np.pi * 4.0 / square**2
    # The lamp also closes a little of the sky, which the comparison leaves to its tolerance.
    np.testing.assert_allclose(lamplight, expected, atol=0.1 * expected.max())
    builder.panel((0, 0, 1), (0, 0, 1), (1, 1), Material(GREY))
    builder.panel((0, 0, 1), (0, 0, -1), (1, 1), Material(GREY))
    shadowed = bake(builder)[0]
    assert shadowed[n // 2, n // 2] <= dark[n // 2, n // 2]
    assert shadowed[2, 2] > dark[2, 2]


def test_surfaces_that_are_not_lit_keep_their_brightness():
    builder = SceneBuilder()
    builder.box((0, 0, 0), (1, 1, 1), Material(GREY, lit=False), inward=True)
    assert all(np.all(grid == 1) for grid in bake(builder))
