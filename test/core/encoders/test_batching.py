"""Batches against one call, with an encoder whose memory has a known end."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.encoders.batching import Batches, naming_out_of_memory
from fus3dmaps_core.errors import EncoderError

IMAGES = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)


class SmallDevice:
    """Encodes rows of IMAGES, but never more than ``room`` of them together."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.tried: list[int] = []

    def __call__(self, images: slice) -> np.ndarray:
        size = len(IMAGES[images])
        self.tried.append(size)
        if size > self.room:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return 2 * IMAGES[images]


@given(st.integers(0, 40), st.integers(1, 50))
def test_the_result_is_that_of_one_call(count: int, room: int):
    result = Batches("crops").run(SmallDevice(room), count)
    assert result.dtype == np.float32
    assert result.shape == (count, 3)
    assert result.tobytes() == (2 * IMAGES[:count]).tobytes()


def test_one_call_does_where_memory_allows_it():
    device, batches = SmallDevice(40), Batches("crops")
    for count in (40, 3, 0, 1):
        batches.run(device, count)
    assert device.tried == [40, 3, 0, 1]
    assert batches.largest is None


def test_a_batch_is_halved_until_it_fits_and_the_size_is_remembered(caplog: pytest.LogCaptureFixture):
    device, batches = SmallDevice(12), Batches("crop encoder of 'siglip'")
    with caplog.at_level(logging.WARNING):
        batches.run(device, 40)
    assert device.tried == [40, 20, 10, 10, 10, 10]
    assert batches.largest == 10
    assert [record.args for record in caplog.records] == [
        ("crop encoder of 'siglip'", 40, 20),
        ("crop encoder of 'siglip'", 20, 10),
    ]
    device.tried.clear()
    batches.run(device, 25)
    assert device.tried == [10, 10, 5]


def test_memory_that_runs_out_later_halves_again_and_repeats_nothing():
    device = SmallDevice(12)
    seen: list[int] = []

    def encode(images: slice) -> np.ndarray:
        result = device(images)
        seen.extend(range(40)[images])
        device.room = 7  # Someone else took the rest.
        return result

    result = Batches("crops").run(encode, 40)
    assert seen == list(range(40))
    assert device.tried == [40, 20, 10, 10, *[5] * 6]
    assert result.tobytes() == (2 * IMAGES).tobytes()


def test_cached_memory_is_given_back_before_the_next_try(monkeypatch: pytest.MonkeyPatch):
    device, given_back = SmallDevice(2), []
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: given_back.append(len(device.tried)))
    Batches("crops").run(device, 8)
    assert device.tried == [8, 4, 2, 2, 2, 2]
    assert given_back == [1, 2]


def test_no_room_for_a_single_image_is_refused_by_name():
    device, batches = SmallDevice(0), Batches("crop encoder of 'siglip'")
    with pytest.raises(EncoderError, match=r"crop encoder of 'siglip'.*single image.*2\.00 GiB"):
        batches.run(device, 5)
    assert device.tried == [5, 2, 1]
    device.room = 5
    assert batches.run(device, 3).tobytes() == (2 * IMAGES[:3]).tobytes()


def test_other_errors_pass_as_they_are():
    def fail(images: slice) -> np.ndarray:
        raise RuntimeError("shapes differ")

    for count in (1, 9):
        with pytest.raises(RuntimeError, match="shapes differ"):
            Batches("crops").run(fail, count)


def test_want_of_memory_gets_a_name():
    with pytest.raises(EncoderError, match="segmenter 'fast'"), naming_out_of_memory("segmenter 'fast'"):
        SmallDevice(0)(slice(0, 1))
    with naming_out_of_memory("segmenter 'fast'"):
        SmallDevice(1)(slice(0, 1))
