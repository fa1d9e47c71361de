"""Guided pooling and the heads, against loops over patches."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.encoders.clip_dinoiser.guided_pooling import THRESHOLD, guided_pooling
from fus3dmaps_core.encoders.clip_dinoiser.heads import WIDTH, DinoiserHeads


def pooled_in_loops(features: np.ndarray, correlations: np.ndarray, threshold: float) -> np.ndarray:
    """Pool (d, rows, columns) features by the (p, p) correlations of one image."""
    depth, rows, columns = features.shape
    result = np.zeros(features.shape)
    for patch in range(rows * columns):
        total, weight = np.zeros(depth), 0.0
        for other in range(rows * columns):
            if correlations[patch, other] >= threshold:
                total += correlations[patch, other] * features[:, other // columns, other % columns]
                weight += correlations[patch, other]
        result[:, patch // columns, patch % columns] = total / weight
    return result


@given(st.integers(1, 3), st.integers(1, 4), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_pooling_is_a_weighted_mean_over_patches_that_correlate(images, rows, columns, seed):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(images, 6, rows, columns)).astype(np.float32)
    unit = rng.normal(size=(images, rows * columns, 3))
    unit /= np.linalg.norm(unit, axis=2, keepdims=True)
    correlations = (unit @ unit.transpose(0, 2, 1)).astype(np.float32)
    found = guided_pooling(torch.from_numpy(features), torch.from_numpy(correlations)).numpy()
    for image in range(images):
        expected = pooled_in_loops(features[image], correlations[image], THRESHOLD)
        np.testing.assert_allclose(found[image], expected, atol=1e-4)


def test_a_patch_like_no_other_keeps_its_features():
    features = torch.arange(24.0).reshape(1, 4, 2, 3)
    np.testing.assert_allclose(guided_pooling(features, torch.eye(6)[None]).numpy(), features.numpy(), rtol=1e-5)


def test_what_is_below_the_threshold_has_no_say_and_what_is_on_it_has():
    features = torch.tensor([[[[1.0, 5.0]]]])
    correlations = torch.tensor([[[1.0, 0.2], [0.199, 1.0]]])
    found = guided_pooling(features, correlations, 0.2)[0, 0, 0]
    np.testing.assert_allclose(found.numpy(), [2.0 / 1.2, 5.0], rtol=1e-5)


def test_the_heads_are_a_convolution_and_a_weighted_sum(rng):
    torch.manual_seed(0)
    heads = DinoiserHeads().requires_grad_(False)
    rows, columns = 3, 4
    features = rng.normal(size=(WIDTH, rows, columns)).astype(np.float32)
    kernel, bias = heads.obj_proj.weight.numpy(), heads.obj_proj.bias.numpy()
    projected = np.zeros((rows * columns, len(bias)))
    logits = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            value = bias.astype(np.float64)
            for dy in (-1, 0, 1):
                for dx in (-1, 0, 1):  # Beyond the border stands the nearest patch.
                    neighbour = features[:, np.clip(row + dy, 0, rows - 1), np.clip(column + dx, 0, columns - 1)]
                    value = value + kernel[:, :, dy + 1, dx + 1] @ neighbour
            projected[row * columns + column] = value / np.linalg.norm(value)
            unit = features[:, row, column] / np.linalg.norm(features[:, row, column])
            logits[row, column] = heads.bkg_decoder.weight.numpy()[0, :, 0, 0] @ unit + heads.bkg_decoder.bias.numpy()[0]
    batch = torch.from_numpy(features)[None]
    np.testing.assert_allclose(heads.correlations(batch)[0].numpy(), projected @ projected.T, atol=1e-5)
    np.testing.assert_allclose(heads.saliency(batch)[0].numpy(), 1 / (1 + np.exp(-logits)), atol=1e-5)
