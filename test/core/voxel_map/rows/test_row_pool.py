"""Pooled rows against a dictionary: nothing is lost, nothing is shared, what is freed is used again."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.variants import DEVICES, DTYPES

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.rows import number_pool as numbers
from fus3dmaps_core.voxel_map.rows.row_pool import RowPool

BLOCK_ROWS = RowPool(1, torch.float32, torch.device("cpu")).block_rows

_actions = st.lists(
    st.one_of(
        st.tuples(st.just("allocate"), st.integers(0, 9)),
        st.tuples(st.just("allocate"), st.sampled_from([BLOCK_ROWS - 1, BLOCK_ROWS, BLOCK_ROWS + 3])),
        st.tuples(st.just("free"), st.floats(0, 1)),
        st.tuples(st.just("overwrite"), st.floats(0, 1)),
    ),
    max_size=10,
)

in_every_dtype = pytest.mark.parametrize("dtype", [getattr(torch, name) for name in DTYPES], ids=DTYPES)
on_every_device = pytest.mark.parametrize("device", [torch.device(name) for name in DEVICES], ids=DEVICES)


def seeds_for(rows: torch.Tensor) -> torch.Tensor:
    return torch.arange(len(rows), device=rows.device)


def values_of(rng: np.random.Generator, count: int) -> torch.Tensor:
    """Values that every storage type holds exactly: steps of 1/64 with 112 of them in each row."""
    values = rng.integers(-112, 113, (count, 2))
    values[:, 1] = 112
    return torch.tensor(values / 64.0, dtype=torch.float32)


@on_every_device
@in_every_dtype
def test_rows_hold_what_was_written_to_them(dtype: torch.dtype, device: torch.device):
    @settings(max_examples=12)
    @given(_actions, st.integers(0, 2**32 - 1))
    def check(actions, seed):
        rng = np.random.default_rng(seed)
        pool = RowPool(2, dtype, device)
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
                rows = torch.tensor(rng.permutation(np.array(chosen, np.int64)), device=device)
            if action == "free":
                pool.free(rows)
                for row in rows.tolist():
                    del plain[row]
            else:
                values = values_of(rng, len(rows))
                pool.write(rows, values.to(device), seeds_for(rows))
                plain.update(zip(rows.tolist(), values.tolist(), strict=True))
            most = max(most, len(plain))
            assert len(pool) == len(plain)
            everything = torch.tensor(list(plain), dtype=torch.int64, device=device)
            read = pool.read(everything)
            assert read.dtype == torch.float32
            assert read.tolist() == list(plain.values())
            # Freed rows were used before new ones, so rows never outnumber the most that were in use at once.
            assert pool.high_water == most
        assert len(pool.blocks) == -(-most // pool.block_rows)
        for number, block in enumerate(pool.blocks):
            assert block.dtype == dtype
            assert block.shape == (pool.block_rows, 2)
            assert pool.addresses[number] == block.data_ptr()

    check()


@on_every_device
@in_every_dtype
def test_what_is_stored_can_be_read_and_written_as_it_is(dtype: torch.dtype, device: torch.device):
    first, second = RowPool(2, dtype, device), RowPool(2, dtype, device)
    rows = first.allocate(BLOCK_ROWS + 5)
    second.allocate(7)
    others = second.allocate(BLOCK_ROWS + 5).flip(0)
    first.write(rows, torch.rand(len(rows), 2, device=device), seeds_for(rows))
    stored, scales = first.read_stored(rows)
    assert stored.dtype == dtype
    assert len(scales) == (len(rows) if dtype == torch.int8 else 0)
    second.write_stored(others, stored, scales)
    assert torch.equal(second.read(others), first.read(rows))


def test_low_precision_takes_its_share_of_the_room():
    pools = [RowPool(64, getattr(torch, dtype), torch.device("cpu")) for dtype in DTYPES]
    for pool in pools:
        pool.allocate(5)
    full, half, steps = (pool.nbytes for pool in pools)
    assert half < 0.52 * full
    assert steps < 0.28 * full


def test_rows_of_low_precision_are_not_written_without_seeds():
    for dtype in (torch.float16, torch.int8):
        pool = RowPool(3, dtype, torch.device("cpu"))
        with pytest.raises(ValueError, match="seeds"):
            pool.write(pool.allocate(1), torch.ones(1, 3))


def test_what_is_read_is_a_copy():
    pool = RowPool(3, torch.float32, torch.device("cpu"))
    rows = pool.allocate(2)
    pool.write(rows, torch.ones(2, 3))
    pool.read(rows).zero_()
    pool.read_stored(rows)[0].zero_()
    assert torch.equal(pool.read(rows), torch.ones(2, 3))


@in_every_dtype
def test_storage_grows_with_use_and_not_with_churn(dtype: torch.dtype):
    pool = RowPool(4, dtype, torch.device("cpu"))
    rows = pool.allocate(BLOCK_ROWS)
    before = {}
    for turn in range(5):
        pool.free(rows)
        rows = pool.allocate(BLOCK_ROWS)
        before[turn] = pool.nbytes
    assert len(set(before.values())) == 1
    assert pool.high_water == BLOCK_ROWS


def test_growing_moves_no_row():
    pool = RowPool(4, torch.float32, torch.device("cpu"))
    pool.allocate(BLOCK_ROWS)
    address = pool.blocks[0].data_ptr()
    for _ in range(40):
        pool.allocate(BLOCK_ROWS)
    assert pool.blocks[0].data_ptr() == address == pool.addresses[0]
    assert [block.data_ptr() for block in pool.blocks] == pool.addresses[: len(pool.blocks)].tolist()


def test_more_rows_than_can_be_numbered_are_refused_before_anything_is_touched(monkeypatch):
    monkeypatch.setattr(numbers, "_LIMIT", 5)
    pool = RowPool(2, torch.float32, torch.device("cpu"))
    rows = pool.allocate(4)
    pool.check_room(1)
    for refused in (pool.check_room, pool.allocate):
        with pytest.raises(MapError, match="4 embeddings"):
            refused(2)
    assert (len(pool), pool.high_water) == (4, 4)
    pool.free(rows[1:2])
    assert sorted(pool.allocate(2).tolist()) == [1, 4]


@on_every_device
@in_every_dtype
def test_rows_moved_together_let_the_blocks_behind_them_go(dtype: torch.dtype, device: torch.device):
    rng = np.random.default_rng(1)
    pool = RowPool(2, dtype, device)
    count = 3 * pool.block_rows
    rows = pool.allocate(count)
    values = values_of(rng, count)
    pool.write(rows, values.to(device), seeds_for(rows))
    full_nbytes = pool.nbytes
    sources, targets = rows[-5:], rows[[3, 0, 7, 1, 5]]
    pool.move(sources, targets)
    pool.free(rows[8:])
    assert (pool.spare_blocks, pool.nbytes >= full_nbytes) == (2, True)
    pool.truncate(8)
    assert (len(pool), pool.high_water, len(pool.blocks), pool.spare_blocks) == (8, 8, 1, 0)
    assert pool.nbytes < 0.4 * full_nbytes
    expected = values[:8].clone()
    expected[[3, 0, 7, 1, 5]] = values[-5:]
    assert pool.read(rows[:8]).cpu().tolist() == expected.tolist()
    again = pool.allocate(2 * pool.block_rows)
    assert again.tolist() == list(range(8, 8 + 2 * pool.block_rows))
    pool.write(again, values[: len(again)].to(device), seeds_for(again))
    assert pool.read(again).cpu().tolist() == values[: len(again)].tolist()
    pool.truncate(0)
    assert (len(pool), pool.high_water, pool.blocks) == (0, 0, [])
