"""What the map refuses, and that a refusal leaves no trace; what it accepts; and that it keeps no views of its input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from reference.agreement import ROUNDING, assert_same_bytes, dense_embeddings, engine_of
from reference.refusals import go_on, refused, undisturbed, used_map
from reference.steps import Setting
from reference.variants import BACKEND_IDS, BACKENDS, DTYPES

from fus3dmaps_core.errors import MapError, QueryError
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.rows import number_pool as numbers

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
    "points of integers": np.zeros((2, 3), int),
    "points as one number": np.array(1.0),
}
BAD_INDICES = {
    "an index beyond the rows": np.array([0, 2]),
    "a negative index": np.array([0, -1]),
    "indices of two axes": np.zeros((2, 1), int),
    "indices that are not integers": np.array([0.0, 1.0]),
    "too few indices": np.array([0]),
    "indices of truth values": np.array([False, True]),
    "an index beyond 64 bits": np.array([0, 2**63], np.uint64),
}
BAD_EMBEDDINGS = {
    "an embedding with NaN": changed(DENSE["embeddings"], (1, 3), np.nan),
    "an embedding with infinity": changed(DENSE["embeddings"], (0, 0), np.inf),
    "an embedding of length 0": changed(DENSE["embeddings"], 1, 0.0),
    "wider embeddings": np.ones((2, 6), np.float32),
    "narrower embeddings": np.ones((2, 4), np.float32),
    "one embedding as a vector": np.ones(5, np.float32),
    "embeddings of three axes": np.ones((2, 5, 1), np.float32),
    "embeddings of integers": np.ones((2, 5), int),
    "embeddings as one number": np.array(1.0),
}
BAD_WEIGHTS = {
    "a negative weight": np.array([1.0, -0.25]),
    "a weight of NaN": np.array([1.0, np.nan]),
    "an infinite weight": np.array([np.inf, 1.0]),
    "a weight that single precision cannot hold": np.array([1e300, 1.0]),
    "too few weights": np.array([1.0]),
    "too many weights": np.ones(3),
    "weights of two axes": np.ones((2, 1)),
    "a weight beyond a million": np.array([1.0, 1.1e6]),
    "weights of integers": np.ones(2, int),
}
BAD_COLORS = {
    "colours of floats": np.zeros((2, 3), np.float32),
    "colours with alpha": np.zeros((2, 4), np.uint8),
    "too few colours": np.zeros((1, 3), np.uint8),
}


def cases(**bad: dict[str, np.ndarray]):
    return [pytest.param(field, value, id=name) for field, values in bad.items() for name, value in values.items()]


@pytest.fixture(params=BACKENDS, ids=BACKEND_IDS)
def setting(request) -> Setting:
    """A map with a window, on each of the backends."""
    backend, device = request.param
    return Setting(window_radius_m=0.16, dtype="float16", backend=backend, device=device)


@pytest.mark.parametrize(
    ("field", "value"),
    cases(points_m=BAD_POINTS, patches=BAD_INDICES, embeddings=BAD_EMBEDDINGS, weights=BAD_WEIGHTS, colors=BAD_COLORS),
)
def test_bad_dense_input_is_refused_and_leaves_no_trace(setting: Setting, field: str, value: np.ndarray):
    engine = used_map(setting)
    with refused(engine, setting):
        engine.integrate_dense(**{**DENSE, field: value})


@pytest.mark.parametrize(("field", "value"), cases(points_m=BAD_POINTS, proposals=BAD_INDICES, embeddings=BAD_EMBEDDINGS))
def test_bad_proposals_are_refused_and_leave_no_trace(setting: Setting, field: str, value: np.ndarray):
    engine = used_map(setting)
    with refused(engine, setting):
        engine.integrate_proposals(**{**PROPOSALS, field: value})


def test_what_bad_input_was_made_from_is_good(setting: Setting):
    engine = used_map(setting)
    engine.integrate_dense(**DENSE)
    engine.integrate_proposals(**PROPOSALS)
    engine.remove_voxels(DENSE["points_m"])


@pytest.mark.parametrize("center", [np.array([0.0, np.nan, 0.0]), np.array([0.0, 0.0]), np.zeros((1, 3)), np.zeros(3, int)])
def test_a_bad_window_centre_is_refused_and_leaves_no_trace(setting: Setting, center: np.ndarray):
    engine = used_map(setting)
    with refused(engine, setting, match="center_m"):
        engine.prune_window(center)


@pytest.mark.parametrize(
    "points_m", [pytest.param(value, id=name) for name, value in BAD_POINTS.items() if name != "more points than patches"]
)
def test_removal_at_bad_points_is_refused_and_leaves_no_trace(setting: Setting, points_m: np.ndarray):
    engine = used_map(setting)
    with refused(engine, setting, match="points_m"):
        engine.remove_voxels(points_m)


@pytest.mark.parametrize("texts", [pytest.param(value, id=name) for name, value in BAD_EMBEDDINGS.items()])
@pytest.mark.parametrize("which", ["prompts", "negatives"])
def test_bad_texts_are_refused_and_leave_no_trace(setting: Setting, which: str, texts: np.ndarray):
    engine = used_map(setting)
    given = {"prompts": np.ones((1, setting.dimension)), which: texts}
    with refused(engine, setting, match=which):
        engine.search(LayerQuery("fused_instances", **given))


def test_no_prompt_is_refused_and_leaves_no_trace(setting: Setting):
    engine = used_map(setting)
    with refused(engine, setting, QueryError, "prompts"):
        engine.search(LayerQuery("dense", np.ones((0, setting.dimension))))


def test_an_unknown_layer_is_refused_and_leaves_no_trace(setting: Setting):
    engine = used_map(setting)
    with refused(engine, setting, QueryError, "panoptic"):
        engine.search(LayerQuery("panoptic", np.ones((1, setting.dimension))))


@pytest.mark.parametrize("what", ["voxels", "embeddings"])
def test_a_full_map_refuses_more_and_nothing_is_lost(setting: Setting, what: str, monkeypatch):
    engine = used_map(setting)
    count = engine.voxel_count if what == "voxels" else engine.instance_count
    far_m = np.array([[7.0, 7.0, 7.0], [8.0, 8.0, 8.0]])
    before = engine.export_state()
    with monkeypatch.context() as full:
        full.setattr(numbers, "_LIMIT", count + 1)
        with pytest.raises(MapError, match=f"{count} {what}"):
            engine.integrate_proposals(**{**PROPOSALS, "points_m": far_m})
        if what == "voxels":
            with pytest.raises(MapError, match=f"{count} voxels"):
                engine.integrate_dense(**{**DENSE, "points_m": far_m})
    assert_same_bytes(engine.export_state(), before)
    assert_same_bytes(go_on(engine, setting), undisturbed(setting))


def test_when_ids_are_used_up_proposals_are_refused_and_the_rest_goes_on(setting: Setting):
    engine = used_map(setting)
    last = 2**31 - 1
    engine.import_state({**engine.export_state(), "next_instance_id": np.array(last - 2)})
    far_m = np.array([[7.0, 7.0, 7.0], [8.0, 8.0, 8.0]])
    assert engine.integrate_proposals(**{**PROPOSALS, "points_m": far_m}).tolist() == [last - 2, last - 1]
    state = engine.export_state()
    assert state["hypothesis_id"].max() == last - 1
    with pytest.raises(MapError, match="instance ids"):
        engine.integrate_proposals(**{**PROPOSALS, "points_m": far_m + 3.0})
    assert_same_bytes(engine.export_state(), state)
    engine.integrate_dense(**DENSE)
    assert engine.fuse().instances == len(state["instance_id"])
    assert engine.voxels().top_instance.max() == last - 1
    assert engine.remove_voxels(far_m) == 2


def test_counts_stay_at_the_largest_that_can_be_held(setting: Setting):
    engine = engine_of(setting)
    point_m, twice = np.full((3, 3), 0.01), np.zeros(3, int)
    engine.integrate_proposals(point_m, twice, np.ones((1, 5)))
    largest = 2**31 - 1
    state = engine.export_state()
    engine.import_state({**state, "hypothesis_count": np.where(state["hypothesis_count"] > 0, largest - 2, 0)})
    for _ in range(3):
        assert engine.integrate_proposals(point_m, twice, np.ones((1, 5))).tolist() == [0]
        assert engine.export_state()["hypothesis_count"].max() == largest
        assert engine.voxels().top_count.tolist() == [largest]
    engine.fuse()
    assert engine.export_state()["fused_evidence"].tolist() == [largest * setting.variance_ratio]
    # Another instance of the voxel is below it, and the oldest of equal ones goes, as ever.
    assert (
        engine.integrate_proposals(np.array([[0.01] * 3, *np.eye(3), *-np.eye(3)]), np.zeros(7, int), -np.ones((1, 5))) == 1
    )
    assert engine.voxels().top_instance.max() == 1
    assert engine.instances().voxel_counts.tolist() == [1, 6]


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
def test_embeddings_may_have_any_length_but_zero(setting: Setting, length: float, dtype: type):
    embeddings = np.array([[0.6 * length, 0.8 * length, 0, 0, 0]], dtype)
    engine = engine_of(replace(setting, dtype="float32"))
    point, none = np.full((1, 3), 0.02), np.zeros(1, int)
    engine.integrate_dense(point, none, embeddings, np.ones(1), np.zeros((1, 3), np.uint8))
    engine.integrate_proposals(point, none, embeddings)
    state = engine.export_state()
    for name in ("dense_embedding", "instance_embedding"):
        np.testing.assert_allclose(state[name], [[0.6, 0.8, 0, 0, 0]], atol=1e-3 if dtype is np.float16 else 1e-6)


def first_held(state: dict[str, np.ndarray]) -> tuple[int, int]:
    """A voxel's place that holds a hypothesis, while another of the same voxel does not."""
    held = state["hypothesis_id"] >= 0
    voxel = int(np.flatnonzero(held.any(axis=1) & ~held.all(axis=1))[0])
    return voxel, int(np.flatnonzero(held[voxel])[0])


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
    "hypothesis_count": {
        "a negative count": lambda array: changed(array, (0, 0), -4),
        "no count for a hypothesis": lambda array: np.zeros_like(array),
        "a count beyond 31 bits": lambda array: np.where(array > 0, np.int64(2**31), 0),
    },
    "instance_id": {
        "an id twice": lambda array: changed(array, 0, array[1]),
        "an id that was never given": lambda array: changed(array, -1, 10**6),
    },
    "instance_embedding": {"NaN in an instance": lambda array: changed(array, (0, 0), np.nan)},
    "next_instance_id": {
        "a next id below 0": lambda array: np.array(-5),
        "a next id that was given": lambda array: np.array(0),
        "a next id beyond 31 bits": lambda array: np.array(2**31),
        "several next ids": lambda array: np.array([50, 51]),
    },
    "fused_embedding": {"NaN in a fused instance": lambda array: changed(array, (0, 0), np.nan)},
}


@pytest.mark.parametrize(
    ("field", "spoil"),
    [pytest.param(field, spoil, id=name) for field, spoils in BAD_STATES.items() for name, spoil in spoils.items()],
)
def test_a_state_that_is_no_map_is_refused_and_leaves_no_trace(
    setting: Setting, field: str, spoil: Callable[[np.ndarray], np.ndarray]
):
    engine = used_map(setting)
    state = engine.export_state()
    with refused(engine, setting):
        engine.import_state({**state, field: spoil(state[field])})


def test_a_state_whose_voxel_holds_an_instance_twice_is_refused(setting: Setting):
    engine = used_map(setting)
    state = engine.export_state()
    voxel, place = first_held(state)
    ids, counts = state["hypothesis_id"].copy(), state["hypothesis_count"].copy()
    ids[voxel], counts[voxel] = ids[voxel, place], counts[voxel, place]
    with refused(engine, setting):
        engine.import_state({**state, "hypothesis_id": ids, "hypothesis_count": counts})


def test_a_state_with_an_instance_that_no_voxel_holds_is_refused(setting: Setting):
    engine = used_map(setting)
    state = engine.export_state()
    lost = state["hypothesis_id"] == state["instance_id"][0]
    ids, counts = np.where(lost, -1, state["hypothesis_id"]), np.where(lost, 0, state["hypothesis_count"])
    with refused(engine, setting):
        engine.import_state({**state, "hypothesis_id": ids, "hypothesis_count": counts})


@pytest.mark.parametrize("field", sorted(engine_of(Setting()).export_state()))
def test_a_state_with_text_for_numbers_is_refused_by_its_name(setting: Setting, field: str):
    engine = used_map(setting)
    state = engine.export_state()
    with refused(engine, setting, match=field):
        engine.import_state({**state, field: state[field].astype(str)})


@pytest.mark.parametrize("field", sorted(engine_of(Setting()).export_state()))
def test_a_state_that_lacks_an_array_is_refused_by_its_name(setting: Setting, field: str):
    engine = used_map(setting)
    state = engine.export_state()
    with refused(engine, setting, match=field):
        engine.import_state({name: array for name, array in state.items() if name != field})


@pytest.mark.parametrize(
    "spoil", [lambda scale: -scale, lambda scale: scale * np.nan, lambda scale: scale[1:], np.zeros_like]
)
def test_bad_scales_are_refused(setting: Setting, spoil: Callable[[np.ndarray], np.ndarray]):
    setting = replace(setting, dtype="int8")
    engine = used_map(setting)
    state = engine.export_state()
    with refused(engine, setting, match="dense_scale"):
        engine.import_state({**state, "dense_scale": spoil(state["dense_scale"])})
    with refused(used_map(setting), setting, match="dense_scale"):
        used_map(setting).import_state({name: array for name, array in state.items() if name != "dense_scale"})


@pytest.mark.parametrize("source", DTYPES)
@pytest.mark.parametrize("target", DTYPES)
def test_a_state_of_another_storage_type_is_taken_over(setting: Setting, source: str, target: str):
    state = used_map(replace(setting, dtype=source)).export_state()
    assert len(state["dense_slot"]) > 20
    engine = engine_of(replace(setting, dtype=target))
    engine.import_state(state)
    got = engine.export_state()
    assert got["dense_embedding"].dtype == target
    tolerance = 0.0 if source == target else 1e-7 + ROUNDING[target]
    np.testing.assert_allclose(dense_embeddings(got), dense_embeddings(state), atol=tolerance)


def test_what_is_handed_in_stays_as_it_was_and_what_is_handed_out_is_a_copy(setting: Setting):
    engine = used_map(setting)
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
