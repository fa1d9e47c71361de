"""Batches against one call, with an encoder whose memory has a known end."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.encoders.batching import RETRY_AFTER, Batches, naming_out_of_memory
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


def shrunk(room: int, first: int) -> tuple[SmallDevice, Batches]:
    """Make a device with that much room, and batches that ran out of it with so many images at first."""
    device, batches = SmallDevice(room), Batches("crops")
    batches.run(device, first)
    batches._fitted = 0  # What fitted meanwhile counts; the tests count from nothing.
    device.tried.clear()
    return device, batches


def test_memory_that_comes_back_is_used_again_step_by_step(caplog: pytest.LogCaptureFixture):
    device, batches = shrunk(room=12, first=40)
    device.room = 40
    caplog.clear()
    for _ in range(2 * RETRY_AFTER + 1):
        batches.run(device, 40)
    sizes = [10] * RETRY_AFTER + [20] * (RETRY_AFTER + 1)
    assert device.tried[: len(sizes)] == sizes
    assert device.tried[-3:] == [40, 40, 40]
    assert batches.largest is None
    assert not caplog.records


def test_a_try_that_fails_costs_no_image_and_is_not_repeated_at_once():
    device, batches = shrunk(room=12, first=40)
    for _ in range(RETRY_AFTER):
        result = batches.run(device, 15)
        assert result.tobytes() == (2 * IMAGES[:15]).tobytes()
    assert device.tried == [10, 5] * RETRY_AFTER
    device.tried.clear()
    assert batches.run(device, 15).tobytes() == (2 * IMAGES[:15]).tobytes()
    assert device.tried == [15, 10, 5]
    assert batches.largest == 10
    for _ in range(RETRY_AFTER - 1):
        device.tried.clear()
        batches.run(device, 15)
        assert device.tried == [10, 5]
    device.tried.clear()
    batches.run(device, 15)
    assert device.tried == [15, 10, 5]


def test_small_batches_say_nothing_about_large_ones():
    device, batches = shrunk(room=12, first=40)
    for _ in range(3 * RETRY_AFTER):
        batches.run(device, 4)
    device.tried.clear()
    batches.run(device, 40)
    assert device.tried == [10] * 4


def test_single_images_are_tried_by_twos_again():
    device, batches = shrunk(room=1, first=8)
    assert batches.largest == 1
    device.room = 40
    for _ in range(RETRY_AFTER):
        batches.run(device, 1)
    device.tried.clear()
    batches.run(device, 3)
    assert device.tried == [2, 1]


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(1, 50)), max_size=12), st.integers(1, 3))
def test_whatever_memory_does_the_results_are_those_of_one_call(calls: list[tuple[int, int]], retry_after: int):
    device, batches = SmallDevice(50), Batches("crops")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("fus3dmaps_core.encoders.batching.RETRY_AFTER", retry_after)
        for count, device.room in calls:
            assert batches.run(device, count).tobytes() == (2 * IMAGES[:count]).tobytes()


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


def test_the_page_on_faults_says_when_larger_batches_are_tried_again():
    page = Path(__file__).resolve().parents[3] / "docs" / "reliability.md"
    assert f"after {RETRY_AFTER} batches" in page.read_text()
