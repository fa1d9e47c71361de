import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_lab.simulation.room.texture_atlas import MipAtlas, pack

SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9))


def plain_bilinear(image, u, v, repeat):
    """Compute one sample, texel by texel; outside texels wrap or repeat the edge."""
    height, width = image.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    total = np.zeros(image.shape[2:])
    for row in (y0, y0 + 1):
        for column in (x0, x0 + 1):
            share = (1 - abs(x - column)) * (1 - abs(y - row))
            if repeat:
                total = total + share * image[row % height, column % width]
            else:
                total = total + share * image[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
    return total


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(SIZES, st.booleans()), min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_samples_are_bilinear_in_their_own_image(images, seed):
    rng = np.random.default_rng(seed)
    pixels = [rng.random((*size, 3), np.float32) for size, _ in images]
    repeats = [repeat for _, repeat in images]
    tiles = pack(pixels, repeats)
    tile = rng.integers(len(pixels), size=600)
    u, v = rng.random((2, 600), np.float32)
    expected = [plain_bilinear(pixels[t], a, b, repeats[t]) for t, a, b in zip(tile, u, v, strict=True)]
    np.testing.assert_allclose(tiles.sample(tile, u, v), expected, atol=0.05)  # OpenCV interpolates in 1/32 texels.


def test_a_far_checkerboard_is_grey_and_a_near_one_is_not():
    board = np.indices((64, 64)).sum(axis=0) % 2 * np.uint8(255)
    atlas = MipAtlas([np.repeat(board[..., None], 3, axis=2).astype(np.uint8)], [False])
    u, v = np.random.default_rng(0).random((2, 500), np.float32)
    texture = np.zeros(500, int)
    far = atlas.sample(texture, u, v, np.full(500, 2, np.float32))
    near = atlas.sample(texture, u, v, np.full(500, -3, np.float32))
    assert np.ptp(far) <= 2
    assert far.mean() == pytest.approx(127.5, abs=1)
    assert np.ptp(near) > 150


def test_levels_blend_and_stop_at_the_smallest():
    ramp = np.zeros((8, 2, 3), np.uint8)
    ramp[:, 1] = 200
    atlas = MipAtlas([ramp], [False])
    at = np.zeros(3, int), np.full(3, 0.9, np.float32), np.full(3, 0.5, np.float32)
    full, half, beyond = atlas.sample(*at, np.array([0.0, 0.5, 9.0], np.float32))[:, 0]
    assert full == 200
    assert beyond == 100
    assert half == pytest.approx(150)
