"""Numbers against a set: none is in use twice, those given back come first, and none is larger than it must be."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.voxel_map.rows.number_pool import NumberPool

_actions = st.lists(st.one_of(st.integers(0, 60), st.floats(0.0, 1.0)), max_size=20)


@given(_actions, st.integers(0, 2**32 - 1))
def test_numbers_in_use_are_distinct_and_as_small_as_the_most_that_were(actions, seed: int):
    rng = np.random.default_rng(seed)
    numbers, used, most = NumberPool("things", torch.device("cpu")), set(), 0
    freed: list[int] = []
    for action in actions:
        if isinstance(action, int):
            taken = numbers.take(action).tolist()
            assert len(set(taken)) == action
            assert not set(taken) & used
            reused = min(action, len(freed))
            assert set(taken[:reused]) == set(freed[len(freed) - reused :])
            del freed[len(freed) - reused :]
            used |= set(taken)
        else:
            given_back = rng.permutation([number for number in sorted(used) if rng.random() < action]).astype(np.int64)
            numbers.give_back(torch.from_numpy(given_back))
            freed += given_back.tolist()
            used -= set(given_back.tolist())
        most = max(most, len(used))
        assert (len(numbers), numbers.high_water) == (len(used), most)
