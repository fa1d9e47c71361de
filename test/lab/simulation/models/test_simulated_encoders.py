"""The simulated trio: mixing, amount of noise, and equal results for equal frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lab.simulation.models.made_up_frames import CLASSES, labelled, painted, truth_of

from fus3dmaps_core.answers.labels import label_voxels
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_lab.simulation.models.class_texts import ClassTexts
from fus3dmaps_lab.simulation.models.encoder_statistics import EncoderStatistics
from fus3dmaps_lab.simulation.models.oracle import Oracle
from fus3dmaps_lab.simulation.models.simulated_encoders import (
    crop_shares,
    instance_vectors,
    padded_box,
    receptive_shares,
    simulated_trio,
)
from fus3dmaps_lab.simulation.models.simulated_segmenter import SegmenterStatistics, SimulatedSegmenter
from fus3dmaps_lab.simulation.truth import LabelledFrame, Truth

EXACT = EncoderStatistics(
    patch_variance=0.0, crop_variance=0.0, appearance_variance=0.0, receptive_field_patches=0.0, crop_padding=0.0
)


def looking(frame: LabelledFrame, truth: Truth, statistics: EncoderStatistics) -> EncoderTrio:
    oracle = Oracle()
    oracle.look(frame)
    return simulated_trio(oracle, truth, statistics)


def masks_of(parts: np.ndarray, *numbers: int) -> Masks:
    return Masks.from_masks(np.array([parts == number for number in numbers]))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 6),
    st.integers(1, 7),
    st.integers(1, 5),
    st.sampled_from([0.0, 0.4, 0.75, 3.0]),
)
def test_receptive_shares_are_counted_pixels(seed: int, rows: int, columns: int, count: int, sigma: float):
    rng = np.random.default_rng(seed)
    height, width = rows + int(rng.integers(20)), columns + int(rng.integers(20))
    labels = rng.integers(0, count, (height, width))
    counted = np.zeros((rows, columns, count))
    for y in range(height):
        for x in range(width):
            counted[int(y * rows / height), int(x * columns / width), labels[y, x]] += 1
    counted /= counted.sum(axis=2, keepdims=True)
    expected = np.zeros_like(counted)
    for row in range(rows):
        for column in range(columns):
            total = 0.0
            for r in range(rows):
                for c in range(columns):
                    away = (r - row) ** 2 + (c - column) ** 2
                    weight = np.exp(-away / (2 * sigma**2)) if sigma else float(away == 0)
                    expected[row, column] += weight * counted[r, c]
                    total += weight
            expected[row, column] /= total
    np.testing.assert_allclose(receptive_shares(labels, count, rows, columns, sigma), expected, atol=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12), st.floats(1.0, 10.0))
def test_crop_shares_are_weighted_counts(seed: int, height: int, width: int, weight: float):
    rng = np.random.default_rng(seed)
    labels, mask = rng.integers(0, 4, (height, width)), rng.random((height, width)) < 0.5
    expected = np.zeros(4)
    for label, inside in zip(labels.ravel(), mask.ravel(), strict=True):
        expected[label] += weight if inside else 1.0
    np.testing.assert_allclose(crop_shares(labels, mask, 4, weight), expected / expected.sum(), atol=1e-6)


@pytest.mark.parametrize(
    ("size", "grid"), [((480, 640), (30, 40)), ((240, 320), (30, 40)), ((360, 640), (22, 40)), ((9, 12), (9, 12))]
)
def test_the_grid_is_a_share_of_the_image(size: tuple[int, int], grid: tuple[int, int]):
    trio = looking(labelled(painted(*size, [])), truth_of([1]), EXACT)
    assert trio.patch.grid(*size) == grid
    assert trio.patch.encode_patches(np.zeros((*size, 3), np.uint8) + 1).embeddings.shape == (*grid, 128)


def test_without_errors_a_patch_is_the_text_of_its_class():
    parts = painted(480, 640, [(2, 160, 160, 320, 320), (3, 320, 320, 480, 480)])
    trio = looking(labelled(parts), truth_of([1, 2, 3]), EXACT)
    rgb = labelled(parts).frame.rgb
    found = trio.patch.encode_patches(rgb)
    assert found.weights.dtype == found.embeddings.dtype == np.float32
    assert (found.weights == 1).all()
    texts = trio.text.encode_text(CLASSES)
    np.testing.assert_allclose(found.embeddings, texts[parts[8::16, 8::16]], atol=1e-5)
    np.testing.assert_allclose(trio.crop.encode_crops(rgb, masks_of(parts, 3, 2)), texts[[3, 2]], atol=1e-5)


def test_patches_over_a_boundary_mix_what_they_see():
    parts = painted(480, 640, [(2, 0, 324, 480, 640)])  # A quarter of each patch of column 20 is wall.
    trio = looking(labelled(parts), truth_of([1, 2]), EXACT)
    texts = trio.text.encode_text(CLASSES)
    found = trio.patch.encode_patches(labelled(parts).frame.rgb).embeddings
    np.testing.assert_allclose(found[7, 20], unit(0.25 * texts[1] + 0.75 * texts[2]), atol=1e-5)


def test_a_wider_receptive_field_bleeds_farther():
    parts = painted(480, 640, [(2, 0, 320, 480, 640)])
    away = []
    for sigma in (0.0, 0.75, 2.0):
        trio = looking(labelled(parts), truth_of([1, 2]), replace(EXACT, receptive_field_patches=sigma))
        found = trio.patch.encode_patches(labelled(parts).frame.rgb).embeddings
        np.testing.assert_allclose(found, np.broadcast_to(found[:1], found.shape), atol=1e-5)
        away.append(found[0, 19] @ trio.text.encode_text(["table"])[0])
    assert away == sorted(away)
    assert away[2] > away[0] + 0.1


@pytest.mark.parametrize("weight", [1.0, 4.0])
def test_crops_mix_object_and_background_by_share(weight: float):
    parts = painted(240, 320, [(2, 100, 100, 140, 200), (3, 90, 130, 110, 150)])
    statistics = replace(EXACT, crop_padding=0.1, crop_mask_weight=weight)
    trio = looking(labelled(parts), truth_of([1, 2, 3]), statistics)
    texts = trio.text.encode_text(CLASSES)
    found = trio.crop.encode_crops(labelled(parts).frame.rgb, masks_of(parts, 2))[0]
    signal = np.zeros(128)
    for y in range(96, 144):
        for x in range(90, 210):
            signal += (weight if parts[y, x] == 2 else 1.0) * texts[parts[y, x]]
    np.testing.assert_allclose(found, unit(signal), atol=1e-5)


def test_padding_stays_inside_the_image():
    assert padded_box(10, 20, 30, 60, (240, 320), 0.1) == np.s_[16:64, 8:32]
    assert padded_box(0, 200, 320, 240, (240, 320), 0.5) == np.s_[180:240, 0:320]


@pytest.mark.parametrize(("patch", "crop"), [(0.3, 4.0), (8.0, 0.05)])
def test_noise_has_the_stated_variance(patch: float, crop: float):
    # All of the image is one thing, so that noise is the only error. Unit embeddings hold the signal s with a length
    # of a = E cos(f, s), and f / a = s + noise of variance R across s: E |f - (f.s) s|^2 / E[f.s]^2 = R (d - 1) / d,
    # exact as d grows. With d = 1024 what is left is below 1 %.
    statistics = replace(EXACT, dimension=1024, patch_variance=patch, crop_variance=crop)
    parts = np.ones((240, 320), np.int32)
    oracle, truth = Oracle(), truth_of([4])
    trio = simulated_trio(oracle, truth, statistics)
    signal = trio.text.encode_text(["chair"])[0].astype(float)
    patches, crops = [], []
    rectangles = np.zeros((40, 240, 320), bool)
    for row in range(40):
        rectangles[row, row : row + 20, 5 * row : 5 * row + 30] = True
    masks = Masks.from_masks(rectangles)
    for stamp in range(4):
        frame = labelled(parts, stamp)
        oracle.look(frame)
        patches.append(trio.patch.encode_patches(frame.frame.rgb).embeddings.reshape(-1, 1024))
        crops.append(trio.crop.encode_crops(frame.frame.rgb, masks))
    for observed, variance in ((np.concatenate(patches), patch), (np.concatenate(crops), crop)):
        observed = observed.astype(float)
        along = observed @ signal
        across = observed - along[:, None] * signal
        assert (across**2).sum(axis=1).mean() / along.mean() ** 2 == pytest.approx(variance, rel=0.03)
        # Independent from embedding to embedding: their mean has none left of it but what chance leaves.
        assert (across.mean(axis=0) ** 2).sum() * len(observed) / along.mean() ** 2 == pytest.approx(variance, rel=0.25)


def test_the_trio_names_itself_and_its_ratio():
    trio = looking(labelled(painted(48, 64, [])), truth_of([1]), EncoderStatistics(patch_variance=10.0, crop_variance=2.0))
    assert (trio.name, trio.dimension, trio.variance_ratio, trio.logit_scale) == ("simulation", 128, 5.0, 100.0)


def test_a_frame_always_gives_the_same_bits():
    parts = painted(240, 320, [(2, 40, 40, 120, 120), (3, 100, 100, 200, 220)])
    frame, other = labelled(parts, stamp_ns=5), labelled(parts, stamp_ns=6)
    oracle = Oracle()
    truth, masks = truth_of([1, 2, 3]), masks_of(parts, 1, 2, 3)

    def encode(shown: LabelledFrame, seed: int = 0) -> tuple[bytes, bytes]:
        trio = simulated_trio(oracle, truth, EncoderStatistics(seed=seed))
        oracle.look(shown)
        rgb = shown.frame.rgb
        return trio.patch.encode_patches(rgb).embeddings.tobytes(), trio.crop.encode_crops(rgb, masks).tobytes()

    first = encode(frame)
    for changed in (encode(other), encode(frame, seed=1)):
        assert changed[0] != first[0]
        assert changed[1] != first[1]
    assert encode(frame) == first


def test_a_crop_does_not_depend_on_its_company():
    parts = painted(240, 320, [(2, 40, 40, 120, 120), (3, 100, 100, 200, 220)])
    trio = looking(labelled(parts), truth_of([1, 2, 3]), EncoderStatistics())
    rgb, masks = labelled(parts).frame.rgb, masks_of(parts, 1, 2, 3)
    together = trio.crop.encode_crops(rgb, masks)
    for row in range(3):
        assert trio.crop.encode_crops(rgb, masks.take(np.array([row])))[0].tobytes() == together[row].tobytes()
    assert trio.crop.encode_crops(rgb, masks.take(np.zeros(0, np.int64))).shape == (0, 128)


def test_everything_is_of_unit_length():
    parts = painted(240, 320, [(2, 40, 40, 120, 120), (0, 100, 100, 200, 220)])
    trio = looking(labelled(parts), truth_of([1, 2]), EncoderStatistics())
    rgb = labelled(parts).frame.rgb
    for found in (
        trio.patch.encode_patches(rgb).embeddings,
        trio.crop.encode_crops(rgb, masks_of(parts, 0, 1, 2)),
        trio.text.encode_text([*CLASSES, "a place to sit"]),
    ):
        np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1.0, atol=1e-5)


def test_instances_of_a_class_look_a_little_different():
    truth = truth_of([4] * 400)
    statistics = replace(EncoderStatistics(), dimension=512, appearance_variance=0.2)
    texts = ClassTexts(CLASSES, 512, 0)
    looks = instance_vectors(truth, texts, statistics)
    np.testing.assert_allclose(looks[0], texts.vectors[0], atol=1e-6)
    cosine = looks[1:] @ texts.vectors[4]
    assert cosine.std() > 0
    assert cosine.mean() == pytest.approx((1 + 0.2) ** -0.5, rel=0.01)
    same = instance_vectors(truth, texts, replace(statistics, appearance_variance=0.0))
    np.testing.assert_allclose(same[1:], np.tile(texts.vectors[4], (400, 1)), atol=1e-6)


def test_an_image_that_the_oracle_does_not_look_at_is_refused():
    trio = looking(labelled(painted(48, 64, [])), truth_of([1, 2]), EXACT)
    other = labelled(painted(48, 64, [(2, 0, 0, 9, 9)])).frame.rgb
    with pytest.raises(EncoderError, match="looks at"):
        trio.patch.encode_patches(other)
    with pytest.raises(EncoderError, match="looks at"):
        trio.crop.encode_crops(other, Masks(np.zeros((0, 48, 64), bool), np.zeros((0, 4), np.int32)))


@pytest.mark.parametrize("layer", ["dense", "fused_dense", "instances", "fused_instances"])
def test_without_errors_the_whole_pipeline_names_every_voxel_rightly(layer: str):
    """A wall 2 m away shows a table and a cup. Their borders lie on those of patches; voxels on a border are left out."""
    parts = painted(480, 640, [(2, 160, 160, 320, 320), (3, 160, 400, 240, 480)])
    truth, oracle = truth_of([1, 2, 3]), Oracle()
    errorless = SegmenterStatistics(
        miss_probability=0.0,
        small_miss_probability=0.0,
        split_probability=0.0,
        merge_probability=0.0,
        jitter_px=0.0,
    )
    config = Config.from_flat({"segmenter.max_border_contact": 1.0})
    trio = simulated_trio(oracle, truth, replace(EXACT, crop_mask_weight=100.0))
    pipeline = Pipeline(config, trio, SimulatedSegmenter(oracle, truth, errorless))
    frame = labelled(parts)
    oracle.look(frame)
    report = pipeline.process(frame.frame)
    assert report.proposals == 3
    pipeline.semantic_map.fuse(full=True)
    found = label_voxels(pipeline.semantic_map, trio.text, CLASSES[1:], layer)
    assert len(found.points_m) > 500
    camera = frame.frame.intrinsics
    x = found.points_m[:, 0] / 2.0 * camera.fx + camera.cx
    y = found.points_m[:, 1] / 2.0 * camera.fy + camera.cy
    half = 0.5 * config.map.voxel_size_m / 2.0 * camera.fx + 1.0
    sure = np.ones(len(x), bool)
    expected = np.ones(len(x), int)
    for part, y0, x0, y1, x1 in ((2, 160, 160, 320, 320), (3, 160, 400, 240, 480)):
        inside = (x > x0 + half) & (x < x1 - half) & (y > y0 + half) & (y < y1 - half)
        outside = (x < x0 - half) | (x > x1 + half) | (y < y0 - half) | (y > y1 + half)
        expected[inside] = part
        sure &= inside | outside
    assert (np.bincount(expected[sure], minlength=4)[1:] > 5).all()
    np.testing.assert_array_equal(found.labels[sure] + 1, expected[sure])


def test_noise_of_counted_observations_shrinks_with_how_often_an_embedding_is_counted():
    # What a mean over all counted points has left of the noise: R / points, whatever they were grouped in.
    statistics = replace(EXACT, dimension=1024, patch_variance=6.0, crop_variance=20.0, noise_per="observation")
    oracle, truth = Oracle(), truth_of([4])
    trio = simulated_trio(oracle, truth, statistics)
    signal = trio.text.encode_text(["chair"])[0].astype(float)
    areas = (8 * 8, 64 * 64)  # One patch of 8 x 8 pixels, and 64 of them.
    masks = np.zeros((60, 240, 320), bool)
    for row in range(30):
        masks[row, 5 * row : 5 * row + 8, 7 * row : 7 * row + 8] = True
        masks[30 + row, 5 * row : 5 * row + 64, 7 * row : 7 * row + 64] = True
    patches, crops = [], []
    for stamp in range(4):
        frame = labelled(np.ones((240, 320), np.int32), stamp)
        oracle.look(frame)
        patches.append(trio.patch.encode_patches(frame.frame.rgb).embeddings.reshape(-1, 1024))
        crops.append(trio.crop.encode_crops(frame.frame.rgb, Masks.from_masks(masks)).reshape(2, 30, 1024))
    small, large = np.concatenate(crops, axis=1)
    expected = ((np.concatenate(patches), 6.0 / 5), (small, 20.0 / 9), (large, 20.0 / (9 * areas[1] / areas[0])))
    for observed, variance in expected:
        along = observed.astype(float) @ signal
        across = observed - along[:, None] * signal
        assert (across**2).sum(axis=1).mean() / along.mean() ** 2 == pytest.approx(variance, rel=0.04)
