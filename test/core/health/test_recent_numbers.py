"""Recent numbers against a plain filter of everything that came."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.health.recent_numbers import RecentNumbers


@given(st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(-1e6, 1e6)), max_size=60), st.floats(0.1, 5.0))
def test_recent_numbers_are_those_that_a_filter_of_everything_keeps(steps, length_s) -> None:
    recent, now_s, everything = RecentNumbers(length_s), 0.0, []
    for step_s, number in steps:
        now_s += step_s
        recent.add(now_s, number)
        everything.append((now_s, number))
        assert recent.numbers(now_s) == [kept for at_s, kept in everything if at_s > now_s - length_s]
