"""Cross-layer fusion, through the map: precision-weighted means, evidence, and what a window keeps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from reference.variants import BACKEND_IDS, BACKENDS

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

SIZE_M = 0.5
X, Y, Z = np.eye(3)
FAR = np.array([1e3, 0.0, 0.0])


@pytest.fixture(params=BACKENDS, ids=BACKEND_IDS)
def a_map(request) -> Callable[..., SemanticMap]:
    """Makes a map on each of the backends."""
    backend, device = request.param

    def make(
        variance_ratio: float = 1.0,
        window_radius_m: float = 0.0,
        max_hypotheses: int = 3,
        keep_most_evidence: bool = True,
    ) -> SemanticMap:
        config = MapConfig(voxel_size_m=SIZE_M, max_hypotheses=max_hypotheses, backend=backend, device=device)
        return SemanticMap(3, config, variance_ratio, window_radius_m, keep_most_evidence)

    return make


def points(numbers) -> np.ndarray:
    return np.array([[(number + 0.5) * SIZE_M, 0.1, 0.1] for number in numbers]).reshape(-1, 3)


def see(semantic_map: SemanticMap, numbers, embedding, weight: float = 1.0) -> None:
    """Dense points in voxels numbered along x."""
    count = len(numbers)
    semantic_map.integrate_dense(
        points(numbers), np.zeros(count, int), np.array([embedding]), np.array([weight]), np.zeros((count, 3), np.uint8)
    )


def propose(semantic_map: SemanticMap, numbers, embedding) -> int:
    return int(semantic_map.integrate_proposals(points(numbers), np.zeros(len(numbers), int), np.array([embedding]))[0])


def fused(semantic_map: SemanticMap, instance_id: int = 0) -> tuple[np.ndarray, float]:
    state = semantic_map.export_state()
    row = state["instance_id"].tolist().index(instance_id)
    return state["fused_embedding"][row], float(state["fused_evidence"][row])


def cosines(semantic_map: SemanticMap, layer: str) -> dict[int, np.ndarray]:
    """Per voxel the cosines with x, y and z: the direction of its embedding."""
    findings = [semantic_map.search(LayerQuery(layer, axis[None])) for axis in np.eye(3, dtype=np.float32)]
    numbers = np.floor(findings[0].points_m[:, 0] / SIZE_M).astype(int)
    return dict(zip(numbers.tolist(), np.stack([finding.similarity for finding in findings], axis=1), strict=True))


def direction(vector) -> np.ndarray:
    return np.asarray(vector, float) / np.linalg.norm(vector)


@pytest.mark.parametrize("ratio", [0.25, 1.0, 5.0])
def test_an_instance_is_the_mean_of_its_voxels_by_precision(a_map, ratio: float):
    semantic_map = a_map(ratio)
    see(semantic_map, [0, 0, 0], Y)
    see(semantic_map, [1], Z, weight=0.5)
    see(semantic_map, [7], X)  # Not part of the instance.
    propose(semantic_map, [0, 1, 1, 2], X)
    report = semantic_map.fuse()
    # Voxel 0: 3 dense of y, 1 count; voxel 1: 0.5 dense of z, 2 counts; voxel 2: no dense, 1 count.
    evidence = 3 + 0.5 + ratio * 4
    embedding, got_evidence = fused(semantic_map)
    np.testing.assert_allclose(embedding, (3 * Y + 0.5 * Z + ratio * 4 * X) / evidence, atol=1e-6)
    assert got_evidence == pytest.approx(evidence)
    assert (report.instances, report.updated, report.voxels) == (1, 1, 4)


def test_every_hypothesis_of_a_voxel_is_fused_with_its_own_count(a_map):
    semantic_map = a_map()
    see(semantic_map, [0, 0], Z)
    propose(semantic_map, [0, 0, 0], X)
    propose(semantic_map, [0, *range(10, 20)], Y)
    semantic_map.fuse()
    np.testing.assert_allclose(fused(semantic_map, 0)[0], (2 * Z + 3 * X) / 5, atol=1e-6)
    np.testing.assert_allclose(fused(semantic_map, 1)[0], (2 * Z + 11 * Y) / 13, atol=1e-6)


@pytest.mark.parametrize("ratio", [0.25, 1.0, 5.0])
def test_a_dense_voxel_is_fused_with_its_top_hypothesis_alone(a_map, ratio: float):
    semantic_map = a_map(ratio)
    see(semantic_map, [0, 0], Z)
    see(semantic_map, [3], Z)
    propose(semantic_map, [0, 0, 0], X)
    propose(semantic_map, [0, *range(10, 20)], Y)
    got = cosines(semantic_map, "fused_dense")
    np.testing.assert_allclose(got[0], direction(2 * Z + ratio * 3 * X), atol=1e-6)
    np.testing.assert_allclose(got[3], Z, atol=1e-6)  # Dense layer only.
    np.testing.assert_allclose(got[10], Y, atol=1e-6)  # Instance layer only.
    assert len(got) == 12


def test_without_dense_evidence_an_instance_keeps_its_own_embedding(a_map):
    semantic_map = a_map(5.0)
    propose(semantic_map, [0, 1], X + Y)
    semantic_map.fuse()
    embedding, evidence = fused(semantic_map)
    np.testing.assert_allclose(embedding, direction(X + Y), atol=1e-6)
    assert evidence == pytest.approx(10.0)


def test_without_a_window_a_query_sees_the_map_as_it_is_and_leaves_it_so(a_map):
    semantic_map = a_map()
    propose(semantic_map, [0], X)
    semantic_map.fuse()
    see(semantic_map, [0, 0, 0], Y)
    before = semantic_map.export_state()
    np.testing.assert_allclose(cosines(semantic_map, "fused_instances")[0], direction(X + 3 * Y), atol=1e-6)
    after = semantic_map.export_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    np.testing.assert_allclose(fused(semantic_map)[0], X, atol=1e-6)


def test_with_a_window_a_query_sees_what_fusion_stored(a_map):
    semantic_map = a_map(window_radius_m=2.0)
    propose(semantic_map, [0], X)
    see(semantic_map, [0, 0, 0], Y)
    np.testing.assert_allclose(cosines(semantic_map, "fused_instances")[0], X, atol=1e-6)  # Never fused.
    assert fused(semantic_map)[1] == 0
    semantic_map.fuse()
    np.testing.assert_allclose(cosines(semantic_map, "fused_instances")[0], direction(X + 3 * Y), atol=1e-6)
    propose(semantic_map, [0], Z)
    np.testing.assert_allclose(cosines(semantic_map, "fused_instances")[0], direction(X + 3 * Y), atol=1e-6)


def test_with_a_window_only_more_evidence_replaces(a_map):
    semantic_map = a_map(window_radius_m=2.0)
    see(semantic_map, [0, 0, 0], Y)
    propose(semantic_map, [0], X)
    assert semantic_map.fuse().updated == 1
    assert semantic_map.fuse().updated == 0  # Equal evidence is not more.
    assert semantic_map.prune_window(FAR) == 1
    assert semantic_map.fuse().updated == 0
    embedding, evidence = fused(semantic_map)
    np.testing.assert_allclose(embedding, (X + 3 * Y) / 4, atol=1e-6)
    assert evidence == 4

    # Seen again: evidence starts below, equals, then exceeds what is stored.
    see(semantic_map, [0, 0, 0], Z)
    assert semantic_map.fuse().updated == 0
    see(semantic_map, [0], Z, weight=0.25)
    report = semantic_map.fuse()
    assert (report.instances, report.updated) == (1, 1)
    embedding, evidence = fused(semantic_map)
    np.testing.assert_allclose(embedding, (X + 3.25 * Z) / 4.25, atol=1e-6)
    assert evidence == 4.25


def test_a_window_that_keeps_no_evidence_replaces_by_what_is_left(a_map):
    semantic_map = a_map(window_radius_m=2.0, keep_most_evidence=False)
    see(semantic_map, [0, 1], X, weight=3.0)
    assert propose(semantic_map, [0, 1], Y) == 0
    see(semantic_map, [50], X)
    assert propose(semantic_map, [50], X) == 1
    assert semantic_map.fuse().updated == 2
    np.testing.assert_allclose(fused(semantic_map)[0], (3 * X + Y) / 4, atol=1e-6)
    assert fused(semantic_map)[1] == 8.0
    assert semantic_map.prune_window(points([0, 51])[1]) == 2
    # Nothing of instance 0 is left in the window: it has its own embedding, in what is stored and in answers.
    report = semantic_map.fuse()
    assert (report.updated, report.recomputed) == (2, 1)
    np.testing.assert_allclose(fused(semantic_map)[0], Y, atol=1e-6)
    assert fused(semantic_map)[1] == 2.0
    np.testing.assert_allclose(cosines(semantic_map, "fused_instances")[0], Y, atol=1e-6)
    # It was seen again, but from where less of it is: what is stored follows.
    see(semantic_map, [0], Z)
    semantic_map.fuse()
    np.testing.assert_allclose(fused(semantic_map)[0], (Z + 2 * Y) / 3, atol=1e-6)


def test_without_a_window_less_evidence_replaces_too(a_map):
    semantic_map = a_map(max_hypotheses=1)
    see(semantic_map, [0, 0, 0, 1], Y)
    propose(semantic_map, [0, 1], X)
    semantic_map.fuse()
    assert fused(semantic_map)[1] == 6
    assert propose(semantic_map, [0, *range(10, 20)], Z) == 1  # Takes voxel 0 away from it.
    semantic_map.fuse()
    embedding, evidence = fused(semantic_map)
    assert evidence == 2
    np.testing.assert_allclose(embedding, (X + Y) / 2, atol=1e-6)


def test_an_instance_born_outside_the_window_is_fused_from_its_counts(a_map):
    semantic_map = a_map(2.0, window_radius_m=2.0)
    propose(semantic_map, [0, 1], X)
    semantic_map.prune_window(FAR)
    assert semantic_map.fuse().updated == 1
    assert fused(semantic_map)[1] == 4
