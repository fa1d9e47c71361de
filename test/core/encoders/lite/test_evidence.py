"""What detections say about crops and patches, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.encoders.lite.detector import Detections
from fus3dmaps_core.encoders.lite.evidence import box_iou, crop_evidence, patch_evidence

CUP, TABLE = 47, 67
NOTHING = Detections(np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros((0, 4), np.float32))


def detections(*items: tuple[int, float, tuple[float, float, float, float]]) -> Detections:
    labels, scores, boxes = zip(*items, strict=True)
    return Detections(np.array(labels), np.array(scores, np.float32), np.array(boxes, np.float32))


sides = st.tuples(st.integers(0, 50), st.integers(0, 50), st.integers(1, 30), st.integers(1, 30))


@given(sides, sides)
def test_iou_counts_pixels(first, second):
    grids = []
    for x, y, width, height in (first, second):
        grid = np.zeros((80, 80), bool)
        grid[y : y + height, x : x + width] = True
        grids.append(grid)
    boxes = [np.array([[x, y, x + width, y + height]], np.float32) for x, y, width, height in (first, second)]
    expected = (grids[0] & grids[1]).sum() / (grids[0] | grids[1]).sum()
    assert box_iou(boxes[0], boxes[1]).item() == pytest.approx(expected, abs=1e-6)


def test_a_detection_speaks_of_crops_as_far_as_they_coincide():
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 20], [0, 0, 10, 60], [100, 100, 110, 110]], np.int32)
    evidence = crop_evidence(detections((CUP, 0.3, (0, 0, 10, 10)), (CUP, 0.2, (1, 0, 10, 10))), boxes)
    assert evidence.shape == (4, 91)
    assert evidence[0, CUP] == pytest.approx(0.6)  # twice the score of the better one
    assert evidence[1, CUP] == pytest.approx(0.6 * (0.5 - 0.2) / 0.5)  # an IoU of a half
    assert np.count_nonzero(evidence) == 2
    assert crop_evidence(detections((CUP, 0.9, (0, 0, 10, 10))), boxes)[0, CUP] == 1.0


def test_the_smaller_box_takes_precedence_over_another_category():
    evidence = patch_evidence(detections((TABLE, 0.9, (0, 0, 320, 320)), (CUP, 0.9, (120, 120, 200, 200))), 20, 20, 16)
    evidence = evidence.reshape(20, 20, 91)
    assert evidence[9, 9, CUP] == 1.0
    assert evidence[9, 9, TABLE] == 0.0
    assert evidence[5, 5, TABLE] == 1.0
    assert evidence[5, 5, CUP] == 0.0
    # 0.05 of the half side from the border: the first patch's centre is 8 pixels inside 160.
    assert evidence[9, 0, TABLE] == pytest.approx(8 / 160 / 0.3)


def test_nothing_detected_is_no_evidence():
    assert crop_evidence(NOTHING, np.array([[0, 0, 5, 5]], np.int32)).tolist() == [[0.0] * 91]
    assert crop_evidence(NOTHING, np.zeros((0, 4), np.int32)).shape == (0, 91)
    assert not patch_evidence(NOTHING, 3, 4, 16).any()


@given(
    st.lists(
        st.tuples(
            st.integers(1, 90), st.floats(0.125, 1.0, width=32), sides.map(lambda s: (s[0], s[1], s[0] + s[2], s[1] + s[3]))
        ),
        min_size=1,
        max_size=6,
    )
)
def test_evidence_is_a_share(items):
    evidence = patch_evidence(detections(*items), 5, 6, 16)
    assert evidence.shape == (30, 91)
    assert evidence.min() >= 0
    assert evidence.max() <= 1
