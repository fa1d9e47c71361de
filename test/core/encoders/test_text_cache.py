"""Prompts that were asked before are not embedded again, and nothing else changes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.encoders.text_cache import CachedTextEncoder


class Counting:
    """Embeds a prompt by its characters, and remembers what it was asked."""

    space = "characters"

    def __init__(self) -> None:
        self.asked: list[list[str]] = []

    def encode_text(self, prompts) -> np.ndarray:
        self.asked.append(list(prompts))
        return np.array([self.row(prompt) for prompt in prompts], np.float32).reshape(-1, 3)

    @staticmethod
    def row(prompt: str) -> list[float]:
        return [len(prompt), sum(map(ord, prompt)) % 97, ord(prompt[-1])]


@settings(max_examples=60, deadline=None)
@given(
    calls=st.lists(st.lists(st.sampled_from(["mug", "a chair", "sink", "bed", "Mug"]), max_size=6), max_size=8),
    capacity=st.integers(1, 6),
)
def test_answers_are_those_of_the_encoder_whatever_was_asked_before(calls, capacity):
    cached = CachedTextEncoder(Counting(), capacity)
    for prompts in calls:
        found = cached.encode_text(prompts)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, Counting().encode_text(prompts))


def test_a_prompt_is_embedded_once_and_new_ones_together():
    encoder = Counting()
    cached = CachedTextEncoder(encoder)
    assert cached.space == "characters"
    cached.encode_text(["mug", "sink", "mug"])
    cached.encode_text(["bed", "mug", "chair"])
    cached.encode_text(["chair", "sink"])
    assert encoder.asked == [["mug", "sink"], ["bed", "chair"]]


def test_the_prompt_not_asked_for_the_longest_time_is_forgotten_first():
    encoder = Counting()
    cached = CachedTextEncoder(encoder, capacity=2)
    for prompt in ("mug", "sink", "mug", "bed", "mug", "sink"):
        cached.encode_text([prompt])
    assert encoder.asked == [["mug"], ["sink"], ["bed"], ["sink"]]


def test_prompts_of_a_megabyte_are_answered_and_not_kept():
    encoder = Counting()
    cached = CachedTextEncoder(encoder)
    for _ in range(2):
        cached.encode_text(["x" * 1_000_000])
    assert len(encoder.asked) == 2


def test_what_a_caller_does_to_an_answer_stays_his():
    cached = CachedTextEncoder(Counting())
    for _ in range(2):
        found = cached.encode_text(["mug"])
        np.testing.assert_array_equal(found, [Counting.row("mug")])
        found[:] = 0


def test_a_refusal_is_passed_on_and_asked_again():
    encoder = Counting()
    cached = CachedTextEncoder(encoder)
    encode, encoder.encode_text = encoder.encode_text, None
    with pytest.raises(TypeError):
        cached.encode_text(["mug"])
    encoder.encode_text = encode
    np.testing.assert_array_equal(cached.encode_text(["mug"]), [Counting.row("mug")])


def test_threads_that_ask_at_once_are_all_answered():
    cached = CachedTextEncoder(Counting(), capacity=3)
    prompts = [f"thing {number % 7}" for number in range(200)]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda prompt: cached.encode_text([prompt])[0], prompts))
    np.testing.assert_array_equal(answers, [Counting.row(prompt) for prompt in prompts])
