"""Both attentions of the last block against plain loops, and the Gaussian window on grids that are not square."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference.radio_attention import neighbourhood, recursive
from timm.layers import Attention

from fus3dmaps_core.encoders.radio.neighbourhood_attention import NeighbourhoodAttention, gaussian_window
from fus3dmaps_core.encoders.radio.recursive_attention import RecursiveAttention

WIDTH, HEADS = 24, 3
SIDES, SEEDS = st.integers(1, 5), st.integers(0, 9)


def attention(seed: int) -> Attention:
    """With norms of queries and keys, which RADIO's published networks do without, and not those of a new network."""
    torch.manual_seed(seed)
    module = Attention(WIDTH, num_heads=HEADS, qkv_bias=True, qk_norm=True, norm_layer=torch.nn.LayerNorm).double()
    for norm in (module.q_norm, module.k_norm):
        torch.nn.init.normal_(norm.weight, mean=1.0, std=0.3)
        torch.nn.init.normal_(norm.bias, std=0.3)
    return module.eval().requires_grad_(False)


def weights(module: Attention) -> dict[str, np.ndarray]:
    return {name: value.numpy() for name, value in module.state_dict().items()}


@given(rows=SIDES, columns=SIDES, prefix=st.integers(0, 3), sigma=st.floats(0.5, 9), seed=SEEDS)
def test_neighbourhood_attention_gives_the_numbers_of_plain_loops(rows, columns, prefix, sigma, seed):
    trained, tokens = attention(seed), torch.randn(2, prefix + rows * columns, WIDTH, dtype=torch.float64)
    found = NeighbourhoodAttention(trained, prefix, sigma)(tokens, rows, columns)
    for image, result in zip(tokens, found, strict=True):
        expected = neighbourhood(image.numpy(), weights(trained), HEADS, prefix, rows, columns, sigma)
        np.testing.assert_allclose(result, expected, atol=1e-6)


@given(count=st.integers(1, 16), scale=st.floats(0.5, 20), seed=SEEDS)
def test_recursive_attention_gives_the_numbers_of_plain_loops(count, scale, seed):
    trained, tokens = attention(seed), torch.randn(2, count, WIDTH, dtype=torch.float64)
    found = RecursiveAttention(trained, scale)(tokens, 1, count)
    for image, result in zip(tokens, found, strict=True):
        np.testing.assert_allclose(result, recursive(image.numpy(), weights(trained), HEADS, scale), atol=1e-9)


def test_the_window_of_a_wide_grid_joins_neighbours_and_no_others():
    prefix, rows, columns, sigma = 8, 3, 5, 7.0
    window = gaussian_window(rows, columns, prefix, sigma).numpy()
    assert window.shape == (prefix + rows * columns,) * 2
    assert not window[:prefix].any()
    assert not window[:, :prefix].any()
    patches = window[prefix:, prefix:].reshape(rows, columns, rows, columns)
    near, below, far = np.exp(-1 / 98), np.exp(-4 / 98), np.exp(-(4 + 16) / 98)
    assert patches[1, 2, 1, 2] == 1
    assert patches[1, 2, 1, 3] == pytest.approx(near)
    assert patches[0, 2, 2, 2] == pytest.approx(below)
    assert patches[0, 0, 2, 4] == pytest.approx(far)
    # The last patch of a row and the first of the next are four columns apart, though one follows the other.
    assert patches[0, 4, 1, 0] == pytest.approx(np.exp(-17 / 98))


def test_a_window_of_another_grid_with_as_many_patches_is_another_one():
    trained, tokens = attention(1), torch.randn(1, 12, WIDTH, dtype=torch.float64)
    module = NeighbourhoodAttention(trained, 0, 1.0)
    wide, high = module(tokens, 3, 4), module(tokens, 4, 3)
    assert not torch.allclose(wide, high, atol=1e-4)
    torch.testing.assert_close(module(tokens, 3, 4), wide)


def test_the_trained_attention_stays_as_it_was():
    trained, tokens = attention(2), torch.randn(1, 6, WIDTH, dtype=torch.float64)
    before = trained(tokens)
    NeighbourhoodAttention(trained, 0)(tokens, 2, 3)
    RecursiveAttention(trained)(tokens, 2, 3)
    assert torch.equal(trained(tokens), before)
