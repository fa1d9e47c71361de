"""Lack of memory in all the words in which libraries say it, and nothing else, is refused by the size of the images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.image_memory import naming_image_size

SIDE = 2_000_000


def failing(error: Exception):
    def fail() -> None:
        raise error

    return fail


def wrapped(said: str) -> None:
    """Raise lack of memory as the compiler's is told: in an error of our own, which hides what led to it."""
    try:
        torch.zeros(SIDE, SIDE)
    except RuntimeError:
        raise EncoderError(said) from None


@pytest.mark.parametrize(
    "work",
    [
        lambda: np.zeros((SIDE, SIDE, 3), np.int64),
        lambda: np.zeros((10 * SIDE, 10**12, 3), np.int64),
        lambda: torch.zeros(SIDE, SIDE),
        lambda: torch.zeros(10**13, 10**13),
        lambda: cv2.resize(np.zeros((3, 4, 3), np.uint8), (SIDE, SIDE)),
        lambda: wrapped("install a compiler"),
        failing(MemoryError()),
        failing(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 112 GiB.\nSee the documentation")),
        failing(RuntimeError("arena.cc:360 in Conv\nFailed to allocate memory for requested buffer of size 120000000000")),
        failing(RuntimeError("std::bad_alloc")),
    ],
)
def test_whoever_runs_out_of_memory_the_size_is_named(work):
    with (
        pytest.raises(
            EncoderError, match=r"^parameters 'image\.width', 'image\.height': encoder 'lite' .* 64 x 48 pixels"
        ) as told,
        naming_image_size("lite", 48, 64),
    ):
        work()
    message = str(told.value)
    assert "memory" in message
    assert "\n" not in message
    assert "()" not in message
    assert "compiler" not in message


@pytest.mark.parametrize("error", [EncoderError("weights are missing"), RuntimeError("shape"), KeyError("patch")])
def test_other_errors_pass_as_they_are(error):
    with pytest.raises(type(error)) as raised, naming_image_size("lite", 48, 64):
        raise error
    assert raised.value is error


def test_the_first_cause_is_told_from_where_it_says_so():
    with (
        pytest.raises(
            EncoderError, match=r"\(can't allocate memory: you tried to allocate \d+ bytes.*\); make them smaller$"
        ),
        naming_image_size("lite", 48, 64),
    ):
        wrapped("memory: can't allocate memory at all")


def test_what_goes_well_passes():
    with naming_image_size("lite", 48, 64):
        pass
