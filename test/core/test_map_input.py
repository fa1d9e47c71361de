"""What the map refuses, and that a refusal changes nothing; what it accepts; and that it keeps no views of its input."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from reference.agreement import assert_same_bytes, engine_of
from reference.steps import DenseStep, ProposalStep, Setting, random_steps

from fus3dmaps_core.errors import MapError
from fus3dmaps_core.semantic_map import SemanticMap

DENSE = {
    "points_m": np.array([[0.01, 0.02, 0.03], [9.0, 9.0, 9.0]]),
    "patches": np.array([0, 1]),
    "embeddings": np.ones((2, 5), np.float32),
    "weights": np.array([1.0, 0.5], np.float32),
    "colors": np.zeros((2, 3), np.uint8),
}
PROPOSALS = {name: DENSE[name] for name in ("points_m", "embeddings")} | {"proposals": np.array([0, 1])}


def changed(array: np.ndarray, index, value) -> np.ndarray:
    copy = array.copy()
    copy[index] = value
    return copy


BAD_POINTS = {
    "points of two coordinates": DENSE["points_m"][:, :2],
    "points without rows": DENSE["points_m"][0],
    "a point at NaN": changed(DENSE["points_m"], (1, 2), np.nan),
    "a point at infinity": changed(DENSE["points_m"], (1, 0), np.inf),
    "a point at minus infinity": changed(DENSE["points_m"], (0, 0), -np.inf),
    "a point beyond the grid": changed(DENSE["points_m"], (1, 1), 0.05 * 2**20),
    "a point below the grid": changed(DENSE["points_m"], (1, 1), -0.05 * 2**20 - 0.1),
    "a point at 1e300": changed(DENSE["points_m"], (1, 1), 1e300),
    "more points than patches": np.concatenate([DENSE["points_m"]] * 2),
    "points of text": np.array([["a", "b", "c"], ["d", "e", "f"]]),
}
BAD_INDICES = {
    "an index beyond the rows": np.array([0, 2]),
    "a negative index": np.array([0, -1]),
    "indices of two axes": np.zeros((2, 1), int),
    "indices that are not integers": np.array([0.0, 1.0]),
    "too few indices": np.array([0]),
}
BAD_EMBEDDINGS = {
    "an embedding with NaN": changed(DENSE["embeddings"], (1, 3), np.nan),
    "an embedding with infinity": changed(DENSE["embeddings"], (0, 0), np.inf),
    "an embedding of length 0": changed(DENSE["embeddings"], 1, 0.0),
    "wider embeddings": np.ones((2, 6), np.float32),
    "narrower embeddings": np.ones((2, 4), np.float32),
    "one embedding as a vector": np.ones(5, np.float32),
    "embeddings of three axes": np.ones((2, 5, 1), np.float32),
}
BAD_WEIGHTS = {
    "a negative weight": np.array([1.0, -0.25]),
    "a weight of NaN": np.array([1.0, np.nan]),
    "an infinite weight": np.array([np.inf, 1.0]),
    "a weight that single precision cannot hold": np.array([1e300, 1.0]),
    "too few weights": np.array([1.0]),
    "too many weights": np.ones(3),
    "weights of two axes": np.ones((2, 1)),
}
BAD_COLORS = {
    "colours of floats": np.zeros((2, 3), np.float32),
    "colours with alpha": np.zeros((2, 4), np.uint8),
    "too few colours": np.zeros((1, 3), np.uint8),
}


def cases(**bad: dict[str, np.ndarray]):
    return [pytest.param(field, value, id=name) for field, values in bad.items() for name, value in values.items()]


def used_map() -> SemanticMap:
    setting = Setting(window_radius_m=0.16)
    engine = engine_of(setting)
    for step in random_steps(setting, extent=2, count=12, seed=5):
        step.apply(engine)
    return engine


@pytest.mark.parametrize(
    ("field", "value"),
    cases(points_m=BAD_POINTS, patches=BAD_INDICES, embeddings=BAD_EMBEDDINGS, weights=BAD_WEIGHTS, colors=BAD_COLORS),
)
def test_bad_dense_input_is_refused_and_changes_nothing(field: str, value: np.ndarray):
    engine = used_map()
    before = engine.export_state()
    with pytest.raises(MapError):
        engine.integrate_dense(**{**DENSE, field: value})
    assert_same_bytes(engine.export_state(), before)
    DenseStep(**DENSE).apply(engine)


@pytest.mark.parametrize(("field", "value"), cases(points_m=BAD_POINTS, proposals=BAD_INDICES, embeddings=BAD_EMBEDDINGS))
def test_bad_proposals_are_refused_and_change_nothing(field: str, value: np.ndarray):
    engine = used_map()
    before = engine.export_state()
    with pytest.raises(MapError):
        engine.integrate_proposals(**{**PROPOSALS, field: value})
    assert_same_bytes(engine.export_state(), before)
    ProposalStep(**PROPOSALS).apply(engine)


@pytest.mark.parametrize(
    "center", [np.array([0.0, np.nan, 0.0]), np.array([0.0, 0.0]), np.zeros((1, 3)), np.array([np.inf, 0, 0])]
)
def test_a_bad_window_centre_is_refused_and_changes_nothing(center: np.ndarray):
    engine = used_map()
    before = engine.export_state()
    with pytest.raises(MapError):
        engine.prune_window(center)
    assert_same_bytes(engine.export_state(), before)


@pytest.mark.parametrize(
    ("length", "dtype"),
    [
        (1e30, np.float32),
        (1e-12, np.float32),
        (1e-20, np.float32),
        (1e-30, np.float32),
        (1e300, np.float64),
        (6e4, np.float16),
    ],
)
def test_embeddings_may_have_any_length_but_zero(length: float, dtype: type):
    embeddings = np.array([[0.6 * length, 0.8 * length, 0, 0, 0]], dtype)
    engine = engine_of(Setting())
    point, none = np.full((1, 3), 0.02), np.zeros(1, int)
    engine.integrate_dense(point, none, embeddings, np.ones(1), np.zeros((1, 3), np.uint8))
    engine.integrate_proposals(point, none, embeddings)
    state = engine.export_state()
    for name in ("dense_embedding", "instance_embedding"):
        np.testing.assert_allclose(state[name], [[0.6, 0.8, 0, 0, 0]], atol=1e-3 if dtype is np.float16 else 1e-6)


BAD_STATES = {
    "voxel_coordinates": {
        "a voxel beyond the grid": lambda array: changed(array, (0, 0), 2**30),
        "a voxel twice": lambda array: changed(array, 0, array[1]),
        "coordinates that are not integers": lambda array: array + 0.5,
    },
    "voxel_colors": {"fewer colours than voxels": lambda array: array[:-1]},
    "dense_slot": {
        "a slot beyond the voxels": lambda array: changed(array, 0, 10**6),
        "a negative slot": lambda array: changed(array, 0, -1),
        "a slot twice": lambda array: changed(array, 0, array[1]),
    },
    "dense_weight": {
        "a negative weight": lambda array: changed(array, 0, -1.0),
        "a weight of NaN": lambda array: changed(array, 0, np.nan),
    },
    "dense_embedding": {
        "NaN in a mean": lambda array: changed(array, (0, 0), np.nan),
        "means of another width": lambda array: array[:, :-1],
    },
    "hypothesis_id": {"an unknown instance": lambda array: changed(array, (0, 0), 10**6)},
    "hypothesis_count": {"a negative count": lambda array: changed(array, (0, 0), -4)},
    "instance_id": {
        "an id twice": lambda array: changed(array, 0, array[1]),
        "an id that was never given": lambda array: changed(array, -1, 10**6),
    },
    "instance_embedding": {"NaN in an instance": lambda array: changed(array, (0, 0), np.nan)},
    "fused_embedding": {"NaN in a fused instance": lambda array: changed(array, (0, 0), np.nan)},
}


@pytest.mark.parametrize(
    ("field", "spoil"),
    [pytest.param(field, spoil, id=name) for field, spoils in BAD_STATES.items() for name, spoil in spoils.items()],
)
def test_a_state_that_is_no_map_is_refused_and_changes_nothing(field: str, spoil: Callable[[np.ndarray], np.ndarray]):
    engine = used_map()
    before = engine.export_state()
    with pytest.raises(MapError):
        engine.import_state({**before, field: spoil(before[field])})
    assert_same_bytes(engine.export_state(), before)


@pytest.mark.parametrize("field", sorted(engine_of(Setting()).export_state()))
def test_a_state_that_lacks_an_array_is_refused_by_its_name(field: str):
    engine = used_map()
    before = engine.export_state()
    with pytest.raises(MapError, match=field):
        engine.import_state({name: array for name, array in before.items() if name != field})
    assert_same_bytes(engine.export_state(), before)


def test_what_is_handed_in_stays_as_it_was_and_what_is_handed_out_is_a_copy():
    engine = used_map()
    arguments = {name: array.copy() for name, array in DENSE.items()}
    engine.integrate_dense(**arguments)
    for name, array in arguments.items():
        np.testing.assert_array_equal(array, DENSE[name])
        if array.dtype != np.int64:
            array[...] = 77
    state = engine.export_state()
    for array in engine.export_state().values():
        array[...] = 0
    for snapshot in (engine.voxels(), engine.instances()):
        for array in vars(snapshot).values():
            array[...] = 0
    assert_same_bytes(engine.export_state(), state)
