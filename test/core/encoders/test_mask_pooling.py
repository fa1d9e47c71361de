"""Embeddings pooled under masks, against sums over single pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fus3dmaps_core.encoders.mask_pooling import patch_shares, pool_masks
from fus3dmaps_core.encoders.protocols import PatchEmbeddings
from fus3dmaps_core.masks import Masks

# Far apart from each other, so that a pooled embedding tells which patches are in it.
AXES = np.eye(6, dtype=np.float32).reshape(2, 3, 6)


def embeddings(weights=None, values=AXES) -> PatchEmbeddings:
    weights = np.ones(values.shape[:2], np.float32) if weights is None else np.asarray(weights, np.float32)
    return PatchEmbeddings(values, weights)


def edge_distance(mask: np.ndarray, y: int, x: int) -> float:
    """Measure the distance of a pixel to the nearest one outside of the mask; without any, more than the image holds."""
    outside = np.argwhere(~mask)
    if not len(outside):
        return float(sum(mask.shape))
    return float(np.sqrt(((outside - (y, x)) ** 2).sum(axis=1)).min())


def plain_shares(mask: np.ndarray, rows: int, columns: int) -> np.ndarray:
    height, width = mask.shape
    shares = np.zeros((rows, columns))
    for y, x in np.argwhere(mask):
        shares[int((y + 0.5) * rows / height), int((x + 0.5) * columns / width)] += edge_distance(mask, y, x)
    return shares


@settings(max_examples=60, deadline=None)
@given(
    mask=st.tuples(st.integers(1, 14), st.integers(1, 17)).flatmap(lambda size: arrays(bool, size)).filter(np.any),
    rows=st.integers(1, 6),
    columns=st.integers(1, 6),
)
def test_shares_are_distances_to_the_edge_summed_pixel_by_pixel(mask, rows, columns):
    found = patch_shares(Masks.from_masks(mask[None]), rows, columns)
    assert (found.shape, found.dtype) == ((1, rows, columns), np.float32)
    np.testing.assert_allclose(found[0], plain_shares(mask, rows, columns), rtol=1e-5)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 5))
def test_pooling_is_the_weighted_mean_and_masks_do_not_depend_on_each_other(seed, n):
    random = np.random.default_rng(seed)
    values = random.standard_normal((4, 5, 16)).astype(np.float32)
    values /= np.linalg.norm(values, axis=2, keepdims=True)
    weights = random.uniform(0.1, 1.0, (4, 5)).astype(np.float32)
    images = random.random((n, 32, 40)) < random.uniform(0.2, 0.9)
    images[:, 3, 7] = True
    masks = Masks.from_masks(images)
    found = pool_masks(embeddings(weights, values), masks)
    for row, mask in enumerate(images):
        total = np.einsum("rc,rc,rcd->d", plain_shares(mask, 4, 5), weights.astype(float), values.astype(float))
        np.testing.assert_allclose(found[row], total / np.linalg.norm(total), atol=2e-6)
        alone = pool_masks(embeddings(weights, values), masks.take(np.array([row])))[0]
        np.testing.assert_allclose(found[row], alone, atol=1e-6)


def test_a_mask_inside_one_patch_is_that_patch():
    mask = np.zeros((32, 48), bool)
    mask[20:28, 34:46] = True  # Patch (1, 2).
    np.testing.assert_array_equal(pool_masks(embeddings(), Masks.from_masks(mask[None]))[0], AXES[1, 2])


def test_patches_across_the_edge_count_less_than_their_area():
    mask = np.zeros((32, 48), bool)
    mask[:, 8:48] = True  # Half of patch (0, 0), whole patches (0, 1) and (0, 2), which end where the image does.
    pooled = pool_masks(embeddings(), Masks.from_masks(mask[None]))[0].reshape(2, 3)
    assert pooled[0, 0] / pooled[0, 1] < 0.25
    # The image's border is no edge of the object: farther in is not nearer to an edge.
    assert pooled[0, 2] > pooled[0, 1]
    np.testing.assert_allclose(pooled[0], pooled[1], rtol=1e-6)


def test_a_mask_over_the_whole_image_weighs_all_patches_alike():
    pooled = pool_masks(embeddings(), Masks.from_masks(np.ones((1, 32, 48), bool)))[0]
    np.testing.assert_allclose(pooled, np.full(6, 6**-0.5), rtol=1e-6)


def test_saliency_weighs_patches_and_its_absence_leaves_the_mask():
    both = np.zeros((32, 48), bool)
    both[2:14, 2:46] = True
    masks = Masks.from_masks(both[None])
    pooled = pool_masks(embeddings([[0, 1, 0], [1, 1, 1]]), masks)[0]
    np.testing.assert_array_equal(pooled, AXES[0, 1])
    np.testing.assert_array_equal(pool_masks(embeddings(np.zeros((2, 3))), masks), pool_masks(embeddings(), masks))


def test_embeddings_that_cancel_give_the_innermost_patch():
    values = AXES.copy()
    values[0, 2] = -values[0, 0]
    mask = np.zeros((32, 48), bool)
    mask[4:12, 4:12] = mask[4:12, 36:44] = True
    found = pool_masks(embeddings(values=values), Masks.from_masks(mask[None]))[0]
    assert abs(found[0]) == pytest.approx(1.0)
    assert np.linalg.norm(found) == pytest.approx(1.0)


@pytest.mark.parametrize(("height", "width"), [(480, 640), (240, 321), (100, 90)])
def test_any_image_size_goes_with_any_grid(height, width):
    mask = np.zeros((3, height, width), bool)
    mask[0, 1:7, 2:9] = mask[1, -9:, -9:] = mask[2, :, 40:44] = True
    rows, columns = -(-height // 16), -(-width // 16)
    values = np.random.default_rng(0).standard_normal((rows, columns, 8)).astype(np.float32)
    found = pool_masks(embeddings(values=values), Masks.from_masks(mask))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(found[0], values[0, 0] / np.linalg.norm(values[0, 0]), atol=1e-6)


def test_no_masks_give_no_embeddings():
    assert pool_masks(embeddings(), Masks.from_masks(np.zeros((0, 32, 48), bool))).shape == (0, 6)
