import numpy as np
import pytest

from fus3dmaps_lab.simulation.room import furniture
from fus3dmaps_lab.simulation.room.scene import Material, Placement, SceneBuilder

PALETTE = furniture.Palette.seeded(np.random.default_rng(0))
PIECES = {
    "sofa": furniture.sofa,
    "armchair": furniture.armchair,
    "table": furniture.table,
    "cabinet": furniture.cabinet,
    "bookshelf": lambda builder, palette, placement: furniture.bookshelf(
        builder, palette, placement, np.random.default_rng(0)
    ),
    "lamp": furniture.floor_lamp,
    "door": furniture.door,
}


@pytest.mark.parametrize("name", PIECES)
def test_a_piece_stands_on_the_floor_with_its_back_to_the_wall(name):
    builder = SceneBuilder()
    with builder.thing(name):
        PIECES[name](builder, PALETTE, Placement((1.0, 2.0, 0.0), 0.0))
    (piece,) = builder.build().objects
    size = piece.box_max_m - piece.box_min_m
    assert 0 <= piece.box_min_m[2] < 0.1
    assert piece.box_max_m[1] <= 2.0 + 1e-9
    assert piece.center_m[0] == pytest.approx(1.0, abs=0.03)
    assert np.all(size > 0.05)
    assert np.all(size < 2.2)


def test_a_picture_shows_the_whole_photograph_undistorted_in_its_frame():
    builder = SceneBuilder()
    photo = np.zeros((30, 50, 3), np.uint8)
    frame = Material(np.zeros((4, 4, 3), np.uint8))
    with builder.thing("picture"):
        furniture.picture(builder, photo, 1.0, frame, Placement((0, 2, 0.5), 0.0), frame_m=0.05, depth_m=0.02)
    scene = builder.build()
    (image,) = (panel for panel in scene.panels if panel.material.texture is photo)
    assert image.size_m == pytest.approx((1.0, 0.6))
    assert image.material.tile_m is None
    np.testing.assert_allclose(image.normal, (0, -1, 0), atol=1e-12)
    np.testing.assert_allclose(image.point_m(0, 0), (-0.5, 1.985, 0.5 + 0.65))
    (picture,) = scene.objects
    np.testing.assert_allclose(picture.box_min_m, (-0.55, 1.98, 0.5))
    np.testing.assert_allclose(picture.box_max_m, (0.55, 2.0, 1.2))
