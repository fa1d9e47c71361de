import numpy as np
import pytest

from fus3dmaps_lab.simulation.room import textures

COLOR = (180, 150, 120)
KINDS = {"plaster": textures.plaster, "fabric": textures.fabric, "wood": textures.wood, "planks": textures.planks}


@pytest.mark.parametrize("kind", KINDS)
def test_a_texture_is_quiet_near_its_colour_and_seeded(kind):
    texture = KINDS[kind](COLOR, np.random.default_rng(1))
    assert texture.dtype == np.uint8
    assert texture.shape[2] == 3
    np.testing.assert_allclose(texture.mean(axis=(0, 1)), COLOR, atol=6)
    assert 0 < texture.std(axis=(0, 1)).max() < 12
    assert np.array_equal(texture, KINDS[kind](COLOR, np.random.default_rng(1)))
    assert not np.array_equal(texture, KINDS[kind](COLOR, np.random.default_rng(2)))


@pytest.mark.parametrize("kind", ["plaster", "fabric", "wood"])
def test_a_texture_continues_across_its_sides(kind):
    texture = KINDS[kind](COLOR, np.random.default_rng(1)).astype(int)
    for axis in (0, 1):
        inside = np.abs(np.diff(texture, axis=axis)).mean()
        seam = np.abs(np.take(texture, 0, axis) - np.take(texture, -1, axis)).mean()
        assert seam < 2 * inside + 1


def test_a_rug_has_a_border():
    rug = textures.rug((200, 190, 180), (90, 80, 70), np.random.default_rng(0))
    assert rug[:5].mean() < 100
    assert rug[100:150, 100:150].mean() > 170


def test_plain_is_plain():
    assert np.all(textures.plain(COLOR) == COLOR)
