"""The simulated segmenter: its masks, the rate of each error, and equal results for equal frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lab.simulation.models.made_up_frames import labelled, painted, truth_of
from scipy import ndimage

from fus3dmaps_core.errors import ConfigError, EncoderError
from fus3dmaps_core.masks import Masks
from fus3dmaps_lab.simulation.models.oracle import Oracle
from fus3dmaps_lab.simulation.models.simulated_segmenter import SegmenterStatistics, SimulatedSegmenter
from fus3dmaps_lab.simulation.truth import LabelledFrame, Truth

EXACT = SegmenterStatistics(
    miss_probability=0.0,
    small_miss_probability=0.0,
    split_probability=0.0,
    merge_probability=0.0,
    keep_whole_probability=0.0,
    cut_probability=1.0,
    jitter_px=0.0,
    min_area_px=1.0,
)
DRAWS = 400


def segment(frame: LabelledFrame, truth: Truth, statistics: SegmenterStatistics) -> Masks:
    oracle = Oracle()
    oracle.look(frame)
    return SimulatedSegmenter(oracle, truth, statistics).segment(frame.frame.rgb, frame.frame.depth_m)


def holds(masks: Masks, mask: np.ndarray) -> bool:
    return any(np.array_equal(found, mask) for found in masks.masks)


def often(parts: np.ndarray, truth: Truth, statistics: SegmenterStatistics, mask: np.ndarray, depth_m=2.0) -> int:
    """Count the frames, of many, in which exactly this mask is returned."""
    oracle = Oracle()
    segmenter = SimulatedSegmenter(oracle, truth, statistics)
    count = 0
    for stamp in range(DRAWS):
        frame = labelled(parts, stamp, depth_m)
        oracle.look(frame)
        count += holds(segmenter.segment(frame.frame.rgb, frame.frame.depth_m), mask)
    return count


def assert_rate(count: int, probability: float) -> None:
    """Assert a rate within 4.5 standard deviations of a binomial count; rates of 0 and 1 must be exact."""
    assert abs(count - DRAWS * probability) <= 4.5 * (DRAWS * probability * (1 - probability)) ** 0.5 + 1e-9


def test_without_errors_every_connected_piece_has_its_mask():
    parts = painted(120, 160, [(2, 20, 20, 60, 60), (3, 30, 0, 40, 160), (0, 100, 100, 110, 110)])
    frame, truth = labelled(parts), truth_of([1, 2, 3])
    masks = segment(frame, truth, EXACT)
    expected = []
    for part in (1, 2, 3):
        pieces, count = ndimage.label(parts == part, structure=np.ones((3, 3)))
        expected += [pieces == number for number in range(1, count + 1)]
    assert len(expected) == 5  # The table is cut in two by what is before it, and so is the wall.
    assert len(masks) == 5
    assert all(holds(masks, mask) for mask in expected)
    for mask, box in zip(masks.masks, masks.boxes, strict=True):
        ys, xs = np.nonzero(mask)
        assert tuple(box) == (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)
    assert masks.boxes.dtype == np.int32


@pytest.mark.parametrize("edge", [4, 16, 60])
def test_small_things_are_missed_more_often(edge: int):
    parts = painted(90, 160, [(2, 10, 10, 10 + edge, 10 + edge)])
    statistics = replace(EXACT, miss_probability=0.1, small_miss_probability=0.7, small_area_px=2000.0)
    area_px = edge**2 * (640 / 160) ** 2
    missed = 0.1 + 0.6 * 2 ** (-area_px / 2000.0)
    assert_rate(often(parts, truth_of([1, 2]), statistics, parts == 2), 1 - missed)


@pytest.mark.parametrize(
    ("depth_m", "probability"), [(0.8, 0.6), (1.0, 0.6), (1.5, 0.45), (2.0, 0.3), (3.0, 0.0), (5.0, 0.0)]
)
def test_near_things_fall_into_parts(depth_m: float, probability: float):
    parts = painted(90, 160, [(2, 20, 20, 40, 40), (3, 40, 20, 60, 40)])
    truth = truth_of([1, 2], parts=[1, 2, 2])
    statistics = replace(EXACT, split_probability=0.6)
    whole = often(parts, truth, statistics, parts >= 2, depth_m)
    top = often(parts, truth, statistics, parts == 2, depth_m)
    assert whole + top == DRAWS
    assert top == often(parts, truth, statistics, parts == 3, depth_m)
    assert_rate(top, probability)


def test_what_shows_one_part_is_never_split():
    parts = painted(90, 160, [(2, 20, 20, 40, 40)])
    statistics = replace(EXACT, split_probability=1.0)
    assert often(parts, truth_of([1, 2], parts=[1, 2, 2]), statistics, parts == 2, 0.5) == DRAWS


def test_things_are_merged_with_what_they_stand_on():
    parts = painted(90, 160, [(2, 40, 20, 60, 100), (3, 25, 40, 40, 50)])
    truth, statistics = truth_of([1, 2, 3]), replace(EXACT, merge_probability=0.2)
    assert_rate(often(parts, truth, statistics, parts == 3), 0.8)
    assert_rate(often(parts, truth, statistics, parts >= 2), 1 - 0.8**2)  # Either of the two may ask the other.
    assert often(parts, truth, statistics, parts == 1) == DRAWS


def test_of_several_neighbours_it_is_that_with_the_longest_border():
    parts = painted(90, 160, [(2, 40, 20, 60, 100), (4, 25, 50, 40, 70), (3, 25, 40, 40, 50)])
    masks = segment(labelled(parts), truth_of([1, 2, 3, 3]), replace(EXACT, merge_probability=1.0))
    assert holds(masks, np.isin(parts, (3, 4)))
    assert holds(masks, np.isin(parts, (2, 4)))
    assert len(masks) == 3  # With the wall; the table and the broad cup choose each other.


def test_only_what_touches_in_space_is_merged_and_never_background():
    parts = painted(90, 160, [(2, 40, 20, 60, 100), (3, 25, 40, 40, 50)])
    truth, statistics = truth_of([1, 2, 3]), replace(EXACT, merge_probability=1.0)
    depth_m = np.where(parts == 3, 1.5, 2.0).astype(np.float32)
    apart = segment(labelled(parts, depth_m=depth_m), truth, statistics)
    assert [holds(apart, parts == part) for part in (1, 2, 3)] == [True] * 3
    on_wall = segment(labelled(np.where(parts == 2, 1, parts)), truth, statistics)
    assert len(on_wall) == 2


@pytest.mark.parametrize("kind", ["split", "merged"])
def test_a_whole_may_be_kept_beside_its_parts_or_its_group(kind: str):
    if kind == "split":
        parts = painted(90, 160, [(2, 20, 20, 40, 40), (3, 40, 20, 60, 40)])
        truth, statistics = truth_of([1, 2], parts=[1, 2, 2]), replace(EXACT, split_probability=1.0)
        own, other = parts >= 2, parts == 2
    else:
        parts = painted(90, 160, [(2, 40, 20, 60, 100), (3, 25, 40, 40, 50)])
        truth, statistics = truth_of([1, 2, 3]), replace(EXACT, merge_probability=1.0)
        own, other = parts == 3, parts >= 2
    statistics = replace(statistics, keep_whole_probability=0.3)
    assert_rate(often(parts, truth, statistics, own, 0.5), 0.3)
    assert often(parts, truth, statistics, other, 0.5) == DRAWS


def test_masks_in_pieces_are_cut_as_often_as_stated():
    parts = painted(90, 160, [(2, 20, 20, 40, 100), (3, 10, 50, 80, 60)])
    truth, statistics = truth_of([1, 2, 3]), replace(EXACT, cut_probability=0.7)
    assert_rate(often(parts, truth, statistics, parts == 2), 0.3)
    left = (parts == 2) & (np.arange(160) < 50)
    assert_rate(often(parts, truth, statistics, left), 0.7)


def test_borders_are_off_by_each_amount_alike():
    rng = np.random.default_rng(0)
    blob = ndimage.gaussian_filter(rng.standard_normal((90, 160)), 6) > 0
    blob, _ = ndimage.label(blob)
    parts = np.where(blob == np.bincount(blob[blob > 0]).argmax(), 2, 1).astype(np.int32)
    shown = parts == 2
    assert shown[0].any() or shown[-1].any() or shown[:, 0].any() or shown[:, -1].any()
    statistics = replace(EXACT, jitter_px=8.0)  # 2 pixels of an image 160 wide
    for by in range(-2, 3):
        if by < 0:
            expected = ndimage.binary_erosion(shown, iterations=-by, border_value=1)
        else:
            expected = ndimage.binary_dilation(shown, iterations=by) if by else shown
        assert_rate(often(parts, truth_of([1, 2]), statistics, expected), 0.2)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_masks_are_the_same_bits_for_the_same_frame_and_never_too_small(seed: int):
    rng = np.random.default_rng(seed)
    corners = rng.integers(0, 80, (12, 4))
    parts = painted(96, 128, [(2 + k, y, x, y + h // 2, x + w // 2) for k, (y, x, h, w) in enumerate(corners)])
    truth = truth_of([1, 2, 3, 4, 5, 4, 3], parts=[1, 2, 2, 3, 3, 4, 5, 5, 6, 6, 7, 7, 7])
    statistics = SegmenterStatistics(merge_probability=0.4, min_area_px=600.0, seed=seed)
    depth_m = rng.uniform(0.5, 3.0, parts.shape).astype(np.float32)
    frame = labelled(parts, int(rng.integers(2**62)), depth_m)
    masks = segment(frame, truth, statistics)
    again = segment(frame, truth, statistics)
    assert masks.masks.tobytes() == again.masks.tobytes()
    assert masks.masks.shape == (len(masks), 96, 128)
    assert all(mask.sum() >= 600.0 / 25 for mask in masks.masks)
    np.testing.assert_array_equal(Masks.from_masks(masks.masks).boxes, masks.boxes)


def test_seeds_and_stamps_draw_anew():
    parts = painted(96, 128, [(2 + k, 8 * k, 8 * k, 8 * k + 20, 8 * k + 30) for k in range(8)])
    truth, statistics = truth_of([1, *[2] * 8]), SegmenterStatistics(min_area_px=1.0)
    results = {
        segment(labelled(parts, stamp), truth, replace(statistics, seed=seed)).masks.tobytes()
        for stamp in (-1, 0, 1)
        for seed in (0, 1)
    }
    assert len(results) == 6


def test_an_image_of_nothing_has_no_masks():
    masks = segment(labelled(np.zeros((90, 160), np.int32), depth_m=0.0), truth_of([1]), SegmenterStatistics())
    assert masks.masks.shape == (0, 90, 160)
    assert masks.boxes.shape == (0, 4)


def test_another_image_than_the_oracles_is_refused():
    oracle = Oracle()
    segmenter = SimulatedSegmenter(oracle, truth_of([1, 2]), EXACT)
    frame = labelled(painted(48, 64, []))
    with pytest.raises(EncoderError, match="no frame"):
        segmenter.segment(frame.frame.rgb, frame.frame.depth_m)
    oracle.look(labelled(painted(48, 64, [(2, 0, 0, 9, 9)])))
    with pytest.raises(EncoderError, match="looks at"):
        segmenter.segment(frame.frame.rgb, frame.frame.depth_m)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("miss_probability", 1.1),
        ("cut_probability", -0.1),
        ("small_area_px", 0.0),
        ("split_near_m", 3.0),
        ("touch_m", float("nan")),
        ("jitter_px", float("inf")),
        ("seed", -1),
    ],
)
def test_what_is_out_of_range_is_refused_by_name(field: str, value: float):
    with pytest.raises(ConfigError, match=field):
        replace(SegmenterStatistics(), **{field: value})
