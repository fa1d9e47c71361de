"""Pooled rows against a dictionary: nothing is lost, nothing is shared, what is freed is used again."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.voxels.rows import BLOCK_ROWS, RowPool

CPU = torch.device("cpu")

_actions = st.lists(
    st.one_of(
        st.tuples(st.just("allocate"), st.integers(0, 9)),
        st.tuples(st.just("allocate"), st.sampled_from([BLOCK_ROWS - 1, BLOCK_ROWS, BLOCK_ROWS + 3])),
        st.tuples(st.just("free"), st.floats(0, 1)),
        st.tuples(st.just("overwrite"), st.floats(0, 1)),
    ),
    max_size=10,
)


def values_of(rng: np.random.Generator, count: int) -> torch.Tensor:
    """Values that half precision holds exactly."""
    return torch.tensor(rng.integers(-1000, 1000, (count, 2)) / 4.0, dtype=torch.float32)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_rows_hold_what_was_written_to_them(dtype: torch.dtype):
    @settings(max_examples=12)
    @given(_actions, st.integers(0, 2**32 - 1))
    def check(actions, seed):
        rng = np.random.default_rng(seed)
        pool = RowPool(2, dtype, CPU)
        plain: dict[int, list[float]] = {}
        most = 0
        for action, amount in actions:
            if action == "allocate":
                rows = pool.allocate(amount)
                assert rows.dtype == torch.int64
                assert rows.shape == (amount,)
                assert len(set(rows.tolist())) == amount
                assert not set(rows.tolist()) & plain.keys()
            else:
                chosen = [row for row in plain if rng.random() < amount]
                rows = torch.tensor(rng.permutation(np.array(chosen, np.int64)))
            if action == "free":
                pool.free(rows)
                for row in rows.tolist():
                    del plain[row]
            else:
                values = values_of(rng, len(rows))
                pool.write(rows, values)
                plain.update(zip(rows.tolist(), values.tolist(), strict=True))
            most = max(most, len(plain))
            everything = torch.tensor(list(plain), dtype=torch.int64)
            read = pool.read(everything)
            assert read.dtype == torch.float32
            assert read.tolist() == list(plain.values())
            # Freed rows were used before new ones, so rows never outnumber the most that were in use at once.
            assert pool.high_water == most
        seen = {}
        for first, block in pool.blocks():
            assert block.dtype == dtype
            seen.update(enumerate(block.float().tolist(), start=first))
        assert len(seen) == pool.high_water
        assert {row: seen[row] for row in plain} == plain

    check()


def test_half_precision_rounds_and_takes_half_the_room():
    full, half = RowPool(8, torch.float32, CPU), RowPool(8, torch.float16, CPU)
    values = torch.tensor(np.random.default_rng(0).normal(size=(5, 8)), dtype=torch.float32)
    for pool in (full, half):
        pool.write(pool.allocate(5), values)
    rows = torch.arange(5)
    assert torch.equal(full.read(rows), values)
    assert torch.equal(half.read(rows), values.half().float())
    assert half.nbytes < 0.75 * full.nbytes


def test_what_is_read_is_a_copy():
    pool = RowPool(3, torch.float32, CPU)
    rows = pool.allocate(2)
    pool.write(rows, torch.ones(2, 3))
    pool.read(rows).zero_()
    assert torch.equal(pool.read(rows), torch.ones(2, 3))


def test_storage_grows_with_use_and_not_with_churn():
    pool = RowPool(4, torch.float32, CPU)
    rows = pool.allocate(BLOCK_ROWS)
    before = {}
    for turn in range(5):
        pool.free(rows)
        rows = pool.allocate(BLOCK_ROWS)
        before[turn] = pool.nbytes
    assert len(set(before.values())) == 1
    assert pool.high_water == BLOCK_ROWS
