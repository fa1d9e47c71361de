"""Crops: what is cut out, that nothing of it is lost or stretched, and how it is normalised."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.encoders.crop_batches import CropBatcher

MEAN, STD = (0.5, 0.25, 0.75), (0.5, 0.25, 0.2)


def batcher(size_px: int = 32, padding: float = 0.0) -> CropBatcher:
    return CropBatcher(size_px, MEAN, STD, padding, "cpu")


def colors(batch: torch.Tensor) -> np.ndarray:
    """Undo the normalisation: (n, size, size, 3) in 0 .. 255."""
    images = batch.permute(0, 2, 3, 1).numpy().astype(np.float64)
    return 255.0 * (images * STD + MEAN)


def boxes(*values: tuple[int, int, int, int]) -> np.ndarray:
    return np.array(values, np.int32).reshape(-1, 4)


def test_a_box_of_the_networks_size_is_its_pixels(rng):
    rgb = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    batch = batcher().batch(rgb, boxes((7, 5, 39, 37)))
    assert batch.shape == (1, 3, 32, 32)
    assert batch.dtype == torch.float32
    np.testing.assert_allclose(colors(batch)[0], rgb[5:37, 7:39], atol=1e-3)


def test_a_long_box_keeps_its_shape_and_its_ends():
    rgb = np.zeros((60, 80, 3), np.uint8)
    rgb[10:20, 8:72] = 100  # 64 x 10 pixels, shrunk to 32 x 5
    rgb[10:20, 8:12], rgb[10:20, 68:72] = 200, 50
    crop = colors(batcher().batch(rgb, boxes((8, 10, 72, 20))))[0]
    np.testing.assert_allclose(crop[13:18, 0:2], 200, atol=1e-3)
    np.testing.assert_allclose(crop[13:18, 30:32], 50, atol=1e-3)
    np.testing.assert_allclose(crop[13:18, 3:29], 100, atol=1e-3)


def test_what_is_left_over_reads_as_zero(rng):
    rgb = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    batch = batcher().batch(rgb, boxes((8, 10, 72, 20), (30, 2, 34, 58)))
    # The mean in whole bytes: within half a byte.
    half_byte = 0.5 / 255 / min(STD)
    assert batch[0, :, :13].abs().max() <= half_byte
    assert batch[0, :, 18:].abs().max() <= half_byte
    assert batch[1, :, :, :15].abs().max() <= half_byte
    assert batch[1, :, :, 17:].abs().max() <= half_byte


def test_padding_is_a_share_of_the_box_and_ends_at_the_border():
    rgb = np.arange(64, dtype=np.uint8)[None, :, None].repeat(64, axis=0).repeat(3, axis=2)  # Columns have their number.
    padded = colors(batcher(24, 0.25).batch(rgb, boxes((20, 20, 36, 36), (0, 48, 16, 64))))
    np.testing.assert_allclose(padded[0, :, :, 0], np.arange(16, 40)[None].repeat(24, axis=0), atol=1e-3)
    # 4 pixels on the right and above, none on the left and below: 20 x 20.
    assert padded[1, :, 0, 0].max() < 1.0
    assert padded[1, :, -1, 0].min() > 18.0


@given(
    st.integers(0, 47),
    st.integers(0, 63),
    st.integers(1, 48),
    st.integers(1, 64),
    st.sampled_from([7, 16, 33]),
    st.floats(0, 1),
)
def test_a_flat_picture_fills_one_centred_rectangle_of_the_boxs_shape(y0, x0, height, width, size, padding):
    y1, x1 = min(48, y0 + height), min(64, x0 + width)
    rgb = np.full((48, 64, 3), 255, np.uint8)
    batch = CropBatcher(size, (0.0,) * 3, (1.0,) * 3, padding, "cpu").batch(rgb, boxes((x0, y0, x1, y1)))[0].numpy()
    filled = batch[0] > 0.5
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    assert filled[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all()
    assert filled.sum() == len(rows) * len(columns)
    assert max(len(rows), len(columns)) == size
    pad_y, pad_x = int(padding * (y1 - y0)), int(padding * (x1 - x0))
    box_rows = min(48, y1 + pad_y) - max(0, y0 - pad_y)
    box_columns = min(64, x1 + pad_x) - max(0, x0 - pad_x)
    shorter = size * min(box_rows, box_columns) / max(box_rows, box_columns)
    assert min(len(rows), len(columns)) == pytest.approx(max(1, shorter), abs=0.51)
    assert abs((rows[0] + rows[-1]) / 2 - (size - 1) / 2) <= 0.5
    assert abs((columns[0] + columns[-1]) / 2 - (size - 1) / 2) <= 0.5


def test_a_crop_does_not_depend_on_its_companions(rng):
    rgb = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    all_boxes = boxes((0, 0, 64, 48), (63, 47, 64, 48), (10, 0, 11, 48), (3, 4, 60, 20))
    together = batcher(16, 0.1).batch(rgb, all_boxes)
    for row in range(4):
        assert torch.equal(batcher(16, 0.1).batch(rgb, all_boxes[row : row + 1])[0], together[row])


def test_no_boxes_give_no_rows():
    assert batcher().batch(np.zeros((8, 8, 3), np.uint8), boxes()).shape == (0, 3, 32, 32)
