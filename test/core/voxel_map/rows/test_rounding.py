"""Rounding to few bits: what is on the grid stays, the rest goes up as often as its fraction says."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.voxel_map.rows.rounding import dither, seeds_of, to_half, to_int8

WORD = 2**32
FIRST, SECOND = 0x7FEB352D, 0x846CA68B

_words = st.integers(0, WORD - 1)


def mix(bits: int) -> int:
    """The hash of 32-bit words in Python's integers."""
    bits ^= bits >> 16
    bits = bits * FIRST % WORD
    bits ^= bits >> 15
    bits = bits * SECOND % WORD
    return bits ^ bits >> 16


def seed_with_bits(bits: int) -> int:
    """The seed whose first column has these random bits: the hash backwards."""
    bits ^= bits >> 16
    bits = bits * pow(SECOND, -1, WORD) % WORD
    bits ^= bits >> 15 ^ bits >> 30
    bits = bits * pow(FIRST, -1, WORD) % WORD
    return bits ^ bits >> 16


EXTREME_SEEDS = torch.tensor([seed_with_bits(bits) for bits in (0, 1, 0x1FFF, 2**31, WORD - 0x2000, WORD - 1)])


@given(st.lists(_words, max_size=5), st.integers(0, 9))
def test_bits_are_a_hash_of_seed_and_column(seeds: list[int], width: int):
    got = dither(torch.tensor(seeds, dtype=torch.int64), width)
    assert got.tolist() == [[mix((seed + 0x9E3779B9 * column) % WORD) for column in range(width)] for seed in seeds]


def test_extreme_bits_come_up():
    assert dither(EXTREME_SEEDS, 1).squeeze(1).tolist() == [0, 1, 0x1FFF, 2**31, WORD - 0x2000, WORD - 1]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_seeds_differ_from_voxel_to_voxel_and_with_every_observation(axis: int):
    keys = torch.arange(500) * 2 ** (21 * axis)
    weights = torch.arange(1, 501, dtype=torch.float32) / 4
    for seeds in (seeds_of(keys, weights[:1].repeat(500)), seeds_of(keys[77:78].repeat(500), weights)):
        assert int(seeds.min()) >= 0
        assert int(seeds.max()) < WORD
        assert len(set(seeds.tolist())) == 500


def test_a_half_stays_what_it_is_under_any_seed():
    bits = np.arange(2**16, dtype=np.uint16).view(np.float16)
    halves = bits[np.abs(bits.astype(np.float32)) <= 1.0]  # NaN is not.
    for seeds in (EXTREME_SEEDS, torch.arange(20)):
        values = torch.tensor(halves.astype(np.float32)).repeat(len(seeds), 1)
        stored = to_half(values, seeds).numpy()
        np.testing.assert_array_equal(stored, np.tile(halves, (len(seeds), 1)))


def assert_unbiased(rounded: np.ndarray, value: np.ndarray, below: np.ndarray, step: np.ndarray) -> None:
    """How often each column goes up is binomial in its fraction: within 5 standard errors, and never anything else."""
    count = len(rounded)
    ups = (rounded - below) / step
    assert set(np.unique(ups)) <= {0.0, 1.0}
    fraction = (value - below) / step
    allowed = 5 * np.sqrt(fraction * (1 - fraction) * count) + 3
    assert (np.abs(ups.sum(axis=0) - fraction * count) <= allowed).all()


@settings(max_examples=10)
@given(st.integers(0, 2**31), st.sampled_from([1.0, 0.1, 1e-3]))
def test_halves_go_up_as_often_as_their_fraction_says(seed: int, size: float):
    rng = np.random.default_rng(seed)
    value = (rng.uniform(-1, 1, 50) * size).astype(np.float32)
    value = value[np.abs(value) > 2.0**-14]
    seeds = seeds_of(torch.arange(5000), torch.full((5000,), 3.0))
    rounded = to_half(torch.tensor(value).repeat(5000, 1), seeds).numpy().astype(np.float64)
    step = 2.0 ** (np.floor(np.log2(np.abs(value.astype(np.float64)))) - 10)
    # In size they go up or stay, whatever the sign.
    assert_unbiased(np.abs(rounded), np.abs(value), np.floor(np.abs(value) / step) * step, step)


def test_the_smallest_halves_are_rounded_to_the_nearest():
    values = np.linspace(-(2.0**-14), 2.0**-14, 999).astype(np.float32)
    for seeds in (EXTREME_SEEDS, torch.arange(20)):
        stored = to_half(torch.tensor(values).repeat(len(seeds), 1), seeds).numpy().astype(np.float64)
        assert np.abs(stored - values).max() <= 2.0**-24


@settings(max_examples=10)
@given(st.integers(0, 2**31))
def test_steps_go_up_as_often_as_their_fraction_says(seed: int):
    rng = np.random.default_rng(seed)
    value = np.append(rng.uniform(-0.8, 0.8, 49), 0.9).astype(np.float32)
    scale = np.float32(1 / 112)
    seeds = seeds_of(torch.arange(5000), torch.full((5000,), 3.0))
    steps, scales = to_int8(torch.tensor(value).repeat(5000, 1), torch.full((5000,), scale), seeds)
    assert (scales == scale).all()
    exact = value.astype(np.float64) / scale
    assert_unbiased(steps.numpy().astype(np.float64), exact, np.floor(exact), np.ones(50))


@pytest.mark.parametrize("scale", [1 / 112, 0.0123, 0.3 / 112, 2.0**-9, 7.7e-4])
def test_a_value_of_whole_steps_stays_what_it_is_under_any_seed(scale: float):
    steps = torch.arange(-127, 128, dtype=torch.int8)
    for seeds in (EXTREME_SEEDS, torch.arange(50)):
        for first in range(0, 255, 5):  # The seeds are extreme for the first.
            row = torch.cat([steps[first:], steps[:first]])
            values = (torch.tensor(scale, dtype=torch.float32) * row.to(torch.float32)).repeat(len(seeds), 1)
            stored, scales = to_int8(values, torch.full((len(seeds),), scale), seeds)
            assert (scales == torch.tensor(scale, dtype=torch.float32)).all()
            assert torch.equal(stored, row.repeat(len(seeds), 1))


@pytest.mark.parametrize(
    ("largest_steps", "kept"), [(39.9, False), (40.1, True), (112.0, True), (126.9, True), (127.1, False), (500.0, False)]
)
def test_a_scale_is_kept_while_it_fits_and_renewed_where_it_does_not(largest_steps: float, kept: bool):
    scale = 0.003
    values = torch.tensor([[-largest_steps * scale, 0.1 * scale, 0.0, 20.3 * scale]])
    stored, scales = to_int8(values, torch.tensor([scale]), torch.tensor([7]))
    expected = scale if kept else largest_steps * scale / 112
    assert float(scales) == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(stored.numpy() * scales.numpy(), values.numpy(), atol=1.001 * expected)


def test_a_new_row_gets_a_scale_and_zeros_are_zeros():
    values = torch.tensor([[0.25, -0.5, 0.0], [0.0, 0.0, 0.0]])
    stored, scales = to_int8(values, torch.zeros(2), torch.tensor([1, 2]))
    assert stored.tolist() == [[56, -112, 0], [0, 0, 0]]
    assert float(scales[0]) == pytest.approx(0.5 / 112)
    assert float(scales[1]) > 0
