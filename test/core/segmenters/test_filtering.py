"""Which masks become proposals: area, contact of the contour with the border, and order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.config.schema import SegmenterConfig
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.filtering import border_contact, filter_masks


def rectangles(*bounds: tuple[int, int, int, int], size: tuple[int, int] = (40, 60)) -> Masks:
    masks = np.zeros((len(bounds), *size), bool)
    for mask, (x0, y0, x1, y1) in zip(masks, bounds, strict=True):
        mask[y0:y1, x0:x1] = True
    return Masks.from_masks(masks)


def config(**values) -> SegmenterConfig:
    return SegmenterConfig(**{"min_area_px": 1, "max_border_contact": 1.0, "max_masks": 64, **values})


def test_small_masks_go_and_the_rest_comes_largest_first():
    masks = rectangles((1, 1, 4, 4), (10, 10, 20, 20), (30, 5, 34, 15), (5, 20, 9, 30))
    kept = filter_masks(masks, config(min_area_px=40))
    # 100 px, then two of 40 px in the order in which they came.
    assert kept.boxes.tolist() == [[10, 10, 20, 20], [30, 5, 34, 15], [5, 20, 9, 30]]
    assert filter_masks(masks, config(min_area_px=40, max_masks=2)).boxes.tolist() == kept.boxes[:2].tolist()


@pytest.mark.parametrize(
    ("bounds", "contact"),
    [
        ((10, 10, 20, 20), 0.0),
        ((0, 10, 10, 20), 10 / 36),  # one side of a 10 px square, whose contour has 36 pixels
        ((0, 0, 10, 10), 19 / 36),
        ((50, 30, 60, 40), 19 / 36),
        ((0, 0, 60, 40), 1.0),
        ((5, 0, 6, 1), 1.0),
    ],
)
def test_border_contact_of_rectangles(bounds, contact):
    masks = rectangles(bounds)
    assert border_contact(masks.masks[0], masks.boxes[0]) == pytest.approx(contact)
    assert len(filter_masks(masks, config(max_border_contact=max(contact, 0.0)))) == 1
    if contact > 0:
        assert len(filter_masks(masks, config(max_border_contact=contact - 0.01))) == 0


def plain_contact(mask: np.ndarray) -> float:
    height, width = mask.shape
    contour = border = 0
    for y in range(height):
        for x in range(width):
            if not mask[y, x]:
                continue
            around = [(y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)]
            if any(not (0 <= v < height and 0 <= u < width) or not mask[v, u] for v, u in around):
                contour += 1
                border += y in (0, height - 1) or x in (0, width - 1)
    return border / contour


@given(st.integers(1, 9), st.integers(1, 9), st.data())
def test_border_contact_is_that_of_a_plain_loop(height, width, data):
    cells = data.draw(st.lists(st.booleans(), min_size=height * width, max_size=height * width).filter(any))
    masks = Masks.from_masks(np.array(cells).reshape(1, height, width))
    assert border_contact(masks.masks[0], masks.boxes[0]) == pytest.approx(plain_contact(masks.masks[0]))


def test_no_masks_stay_no_masks():
    assert len(filter_masks(Masks(np.zeros((0, 4, 5), bool), np.zeros((0, 4), np.int32)), config())) == 0
