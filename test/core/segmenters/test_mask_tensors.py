"""Masks as tensors: which of overlapping ones stay, and their full size, against plain loops and known answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fus3dmaps_core.segmenters import mask_tensors
from fus3dmaps_core.segmenters.mask_tensors import (
    best_first,
    box_overlaps,
    first_of_overlapping,
    mask_overlaps,
    masks_at,
    stability,
    tight_boxes,
)

NEAR_ZERO = 1e-4  # Logits that rounding may take to either side of the threshold.


def plain_first(overlaps: np.ndarray) -> list[int]:
    kept: list[int] = []
    for row in range(len(overlaps)):
        if not any(overlaps[row, other] for other in kept):
            kept.append(row)
    return kept


def plain_iou(a: np.ndarray, b: np.ndarray) -> float:
    width = max(0, min(a[2], b[2]) - max(a[0], b[0]))
    height = max(0, min(a[3], b[3]) - max(a[1], b[1]))
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
    return width * height / union if union else 0.0


def plain_weights(pixels: int, cells: int, first: float, last: float) -> np.ndarray:
    """Compute what each cell gives to each pixel's centre, within the cells that the region touches: (pixels, cells)."""
    weights = np.zeros((pixels, cells))
    lowest, highest = int(np.floor(first)), int(np.ceil(last)) - 1
    for pixel in range(pixels):
        place = first + (pixel + 0.5) * (last - first) / pixels - 0.5
        below = int(np.floor(place))
        for cell, share in ((below, 1 - (place - below)), (below + 1, place - below)):
            weights[pixel, min(max(cell, lowest), highest)] += share
    return weights


@given(arrays.arrays(bool, st.integers(0, 12).map(lambda n: (n, n))))
def test_of_overlapping_rows_the_first_remains_and_frees_what_it_does_not_touch(pairs):
    overlaps = pairs | pairs.T
    kept = first_of_overlapping(torch.from_numpy(overlaps))
    assert torch.nonzero(kept).flatten().tolist() == plain_first(overlaps)


def test_a_dropped_row_drops_nothing():
    # Each overlaps the next alone: every second one remains, and it takes many rounds to know of the last.
    n = 31
    overlaps = torch.zeros((n, n), dtype=torch.bool)
    for row in range(n - 1):
        overlaps[row, row + 1] = overlaps[row + 1, row] = True
    assert torch.nonzero(first_of_overlapping(overlaps)).flatten().tolist() == list(range(0, n, 2))


@given(
    st.lists(st.tuples(*[st.integers(0, 9)] * 4), max_size=10),
    st.sampled_from([0.0, 0.25, 0.5, 0.9]),
)
def test_overlaps_of_boxes(corners, limit):
    boxes = np.array([(min(a, c), min(b, d), max(a, c), max(b, d)) for a, b, c, d in corners], np.float32).reshape(-1, 4)
    expected = [[plain_iou(a, b) > limit for b in boxes] for a in boxes]
    assert box_overlaps(torch.from_numpy(boxes), limit).tolist() == expected


@given(arrays.arrays(bool, st.tuples(st.integers(0, 6), st.just(4), st.just(5))), st.sampled_from([0.0, 0.5, 0.9]))
def test_overlaps_of_masks(masks, limit):
    expected = [[bool((a | b).any()) and (a & b).sum() / (a | b).sum() > limit for b in masks] for a in masks]
    assert mask_overlaps(torch.from_numpy(masks), limit).tolist() == expected


def test_equal_scores_keep_their_order():
    scores = torch.tensor([0.5, 0.9, 0.5, 0.9, 0.7])
    assert best_first(scores, 5).tolist() == [1, 3, 4, 0, 2]
    assert best_first(scores, 2).tolist() == [1, 3]


@given(arrays.arrays(np.float32, (3, 4, 5), elements=st.sampled_from([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0])))
def test_stability_is_the_overlap_of_a_stricter_and_a_looser_mask(logits):
    expected = [(mask > 1).sum() / (mask > -1).sum() if (mask > -1).any() else 0.0 for mask in logits]
    assert stability(torch.from_numpy(logits), 1.0).tolist() == pytest.approx(expected)


@given(arrays.arrays(bool, st.tuples(st.integers(0, 5), st.integers(1, 6), st.integers(1, 7))))
def test_tight_boxes(masks):
    boxes = tight_boxes(torch.from_numpy(masks)).numpy()
    assert boxes.shape == (len(masks), 4)
    assert boxes.dtype == np.int32
    for mask, (x0, y0, x1, y1) in zip(masks, boxes, strict=True):
        if not mask.any():
            assert x1 <= x0
            continue
        ys, xs = np.nonzero(mask)
        assert (x0, y0, x1, y1) == (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)


@given(
    seed=st.integers(0, 2**16),
    cells=st.tuples(st.integers(2, 9), st.integers(2, 9)),
    size=st.tuples(st.integers(1, 30), st.integers(1, 30)),
    margins=st.tuples(*[st.sampled_from([0.0, 0.25, 0.5])] * 4),
)
def test_masks_at_the_size_of_the_image(seed, cells, size, margins):
    logits = np.random.default_rng(seed).normal(size=(3, *cells)).astype(np.float32)
    x0, y0, x1, y1 = margins[0], margins[1], cells[1] - margins[2], cells[0] - margins[3]
    values = plain_weights(size[0], cells[0], y0, y1) @ logits @ plain_weights(size[1], cells[1], x0, x1).T
    boxes = np.array([(0, 0, *size[::-1]), (1, 2, 20, 9), (0.5, 0.5, 3.5, 4.5)], np.float32)
    found = masks_at(torch.from_numpy(logits), *size, (x0, y0, x1, y1), torch.from_numpy(boxes))

    rows, columns = np.mgrid[: size[0], : size[1]]
    inside = np.array([(columns >= a) & (columns < c) & (rows >= b) & (rows < d) for a, b, c, d in boxes])
    expected = (values > 0) & inside
    sure = (np.abs(values) > NEAR_ZERO) | ~inside
    assume(sure.all())
    filled = expected.any(axis=(1, 2))
    assert found.masks.shape == (filled.sum(), *size)
    assert np.array_equal(found.masks, expected[filled])
    assert np.array_equal(found.boxes, tight_boxes(torch.from_numpy(expected[filled])).numpy())


def test_what_lies_beside_the_image_does_not_reach_into_it():
    logits = torch.full((1, 4, 6), -1000.0)
    logits[:, 1:3, :] = 1.0
    masks = masks_at(logits, 20, 60, (0.0, 1.0, 6.0, 3.0)).masks
    assert masks.all()


def test_many_masks_are_made_in_parts(monkeypatch):
    logits = torch.from_numpy(np.random.default_rng(0).normal(size=(9, 5, 6)).astype(np.float32))
    whole = masks_at(logits, 17, 23)
    monkeypatch.setattr(mask_tensors, "_CHUNK_PIXELS", 2 * 17 * 23)
    parts = masks_at(logits, 17, 23)
    assert np.array_equal(whole.masks, parts.masks)
    assert np.array_equal(whole.boxes, parts.boxes)


def test_no_masks():
    empty = masks_at(torch.zeros((0, 5, 6)), 17, 23)
    assert empty.masks.shape == (0, 17, 23)
    assert empty.boxes.shape == (0, 4)
    assert (empty.masks.dtype, empty.boxes.dtype) == (np.bool_, np.int32)
