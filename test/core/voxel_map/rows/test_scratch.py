"""Scratch memory: lent, kept for the next, never lent twice at once, and bounded."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from fus3dmaps_core.voxel_map.rows.scratch import Scratch


@pytest.mark.parametrize(("shape", "dtype"), [((3, 5), np.float64), ((0,), np.int32), ((7,), np.int8), ((0, 4), np.int64)])
def test_an_array_of_the_asked_kind_is_lent(shape: tuple[int, ...], dtype):
    with Scratch().lend(shape, dtype) as array:
        assert (array.shape, array.dtype) == (shape, dtype)
        array[...] = 3
        assert (array == 3).all()


def test_memory_is_used_again():
    scratch = Scratch()
    with scratch.lend((1000,), np.float64) as array:
        first = array.ctypes.data
    with scratch.lend((900,), np.float64) as array:
        assert array.ctypes.data == first
    with scratch.lend((2, 450), np.int32) as array:
        assert array.ctypes.data != first  # Of another size.


def test_what_is_lent_is_lent_to_one_at_a_time():
    scratch = Scratch()
    wrong = []

    def use(value: int) -> None:
        for _ in range(300):
            with scratch.lend((64,), np.int64) as array:
                array.fill(value)
                wrong.extend(array[array != value].tolist())

    threads = [threading.Thread(target=use, args=(value,)) for value in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_it_comes_back_when_its_user_fails():
    scratch = Scratch()

    def fail() -> None:
        with scratch.lend((100,), np.int64) as array:
            places.append(array.ctypes.data)
            raise RuntimeError("no")

    places: list[int] = []
    with pytest.raises(RuntimeError):
        fail()
    with scratch.lend((100,), np.int64) as array:
        assert array.ctypes.data == places[0]


def test_no_more_than_asked_is_kept():
    scratch = Scratch(kept_bytes=10_000)
    for count in (100, 200, 400, 800, 1_000_000):
        with scratch.lend((count,), np.uint8):
            pass
        assert scratch.nbytes <= 10_000
    with scratch.lend((3000,), np.uint8), scratch.lend((3001,), np.uint8), scratch.lend((3002,), np.uint8):
        assert scratch.nbytes <= 10_000
    assert 4096 <= scratch.nbytes <= 10_000
