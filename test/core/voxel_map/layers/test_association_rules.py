"""Association by what is visible, and merging, through the map: cases whose answer is known."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from reference.variants import BACKEND_IDS, BACKENDS

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import MapError
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

SIZE_M = 0.5
X, Y, Z = np.eye(3)


@pytest.fixture(params=BACKENDS, ids=BACKEND_IDS)
def a_map(request) -> Callable[..., SemanticMap]:
    """Makes a map on each of the backends."""
    backend, device = request.param

    def make(window_radius_m: float = 0.0, **options) -> SemanticMap:
        config = MapConfig(voxel_size_m=SIZE_M, backend=backend, device=device, **options)
        return SemanticMap(3, config, 1.0, window_radius_m)

    return make


def points(numbers: Iterable[int]) -> np.ndarray:
    """A point in each of the voxels numbered along x."""
    return np.array([[(number + 0.5) * SIZE_M, 0.1, 0.1] for number in numbers]).reshape(-1, 3)


def propose(semantic_map: SemanticMap, *masks: Iterable[int], embeddings=None, visible=None) -> list[int]:
    """Proposals over voxels; a number that repeats is another point in that voxel."""
    numbers = [number for mask in masks for number in mask]
    proposals = [m for m, mask in enumerate(masks) for _ in mask]
    embeddings = np.tile(X, (len(masks), 1)) if embeddings is None else np.asarray(embeddings, float)
    seen = None if visible is None else points(visible)
    return semantic_map.integrate_proposals(points(numbers), np.array(proposals, int), embeddings, seen).tolist()


def hypotheses(semantic_map: SemanticMap) -> dict[int, dict[int, int]]:
    state = semantic_map.export_state()
    rows = zip(state["voxel_coordinates"], state["hypothesis_id"], state["hypothesis_count"], strict=True)
    return {
        int(coordinates[0]): {i: c for i, c in zip(ids.tolist(), counts.tolist(), strict=True) if i >= 0}
        for coordinates, ids, counts in rows
    }


def test_a_view_of_a_small_part_joins_a_large_object_only_by_what_is_visible(a_map):
    by_all, by_visible = a_map(), a_map(association="visible_iou")
    for semantic_map in (by_all, by_visible):
        assert propose(semantic_map, range(100)) == [0]
    assert propose(by_all, range(10), visible=range(12)) == [1]  # 10 of 100.
    assert propose(by_visible, range(10), visible=range(12)) == [0]  # 10 of 12.
    assert hypotheses(by_visible)[0] == {0: 2}


def test_what_is_visible_of_an_object_and_not_in_the_mask_speaks_against_it(a_map):
    semantic_map = a_map(association="visible_iou")
    assert propose(semantic_map, range(100)) == [0]
    assert propose(semantic_map, range(10), visible=range(50)) == [1]  # 10 of 50 is not above 0.2.
    semantic_map = a_map(association="visible_iou")
    assert propose(semantic_map, range(100)) == [0]
    assert propose(semantic_map, range(10), visible=range(49)) == [0]


def test_without_points_beside_the_proposals_theirs_alone_are_visible(a_map):
    semantic_map = a_map(association="visible_iou")
    assert propose(semantic_map, range(100)) == [0]
    assert propose(semantic_map, range(10)) == [0]


def test_the_voxels_of_the_other_proposals_are_visible_too(a_map):
    semantic_map = a_map(association="visible_iou")
    assert propose(semantic_map, range(100)) == [0]
    # The second sees 5 of the 55 voxels that are visible of the object.
    assert propose(semantic_map, range(50), range(50, 55)) == [0, 1]


def test_what_is_visible_makes_no_voxel(a_map):
    semantic_map = a_map(association="visible_iou")
    assert propose(semantic_map, [0, 1], visible=range(40, 60)) == [0]
    assert semantic_map.voxel_count == 2
    assert propose(semantic_map, visible=range(40, 60)) == []
    assert semantic_map.voxel_count == 2


def test_unusable_visible_points_are_refused_and_change_nothing(a_map):
    semantic_map = a_map(association="visible_iou")
    for bad in (np.zeros((2, 2)), np.full((1, 3), np.nan), np.zeros((2, 3), int)):
        with pytest.raises(MapError, match="visible_points_m"):
            semantic_map.integrate_proposals(points([0]), np.zeros(1, int), X[None], bad)
    assert semantic_map.voxel_count == semantic_map.instance_count == 0


def grow_together(semantic_map: SemanticMap, b=X) -> list[int]:
    """Instances 0 in voxels 0 .. 9 and 1 in 8 .. 11, then one proposal that gives 1 all but one of them to 0 as well."""
    assert propose(semantic_map, range(10)) == [0]
    assert propose(semantic_map, [8, 9, 10, 11, 11], embeddings=[b]) == [1]
    return propose(semantic_map, range(11))


def test_instances_that_have_grown_into_one_another_become_the_older_one(a_map):
    semantic_map = a_map(merge_overlap=0.75)
    assert grow_together(semantic_map) == [0]
    assert semantic_map.instances().ids.tolist() == [0]
    assert semantic_map.instances().weights.tolist() == [10 + 5 + 11]
    assert semantic_map.instances().hypothesis_voxels.tolist() == [12]
    expected = {number: {0: 2} for number in range(8)} | {8: {0: 3}, 9: {0: 3}, 10: {0: 2}, 11: {0: 2}}
    assert hypotheses(semantic_map) == expected
    assert propose(semantic_map, [90]) == [2]  # The id that is gone is not given again.


@pytest.mark.parametrize("options", [{}, {"merge_overlap": 0.76}, {"merge_overlap": 0.75, "merge_cosine": 0.9}])
def test_too_little_overlap_or_likeness_keeps_them_apart(a_map, options: dict[str, float]):
    semantic_map = a_map(**options)
    assert grow_together(semantic_map, b=[1.0, 1.0, 0.0]) == [0]
    assert semantic_map.instances().ids.tolist() == [0, 1]


def test_the_merged_embedding_is_the_mean_by_weight(a_map):
    semantic_map = a_map(merge_overlap=0.75, merge_cosine=0.0)
    assert grow_together(semantic_map, b=Y) == [0]
    np.testing.assert_allclose(semantic_map.export_state()["instance_embedding"], [(21 * X + 5 * Y) / 26], atol=1e-6)


def test_a_proposal_of_the_younger_one_is_told_the_id_that_took_it_in(a_map):
    semantic_map = a_map(merge_overlap=0.5)
    assert propose(semantic_map, range(4)) == [0]
    assert propose(semantic_map, range(20, 40)) == [1]
    assert propose(semantic_map, [1, 2, 3, *range(20, 40)]) == [0]
    assert semantic_map.instances().ids.tolist() == [0]


def test_an_instance_may_take_in_several_at_once(a_map):
    semantic_map = a_map(merge_overlap=1.0, iou_threshold=0.9)
    assert propose(semantic_map, range(4), range(3), range(2)) == [0, 0, 0]
    assert semantic_map.instances().ids.tolist() == [0]
    assert semantic_map.instances().weights.tolist() == [9]
    assert hypotheses(semantic_map) == {0: {0: 3}, 1: {0: 3}, 2: {0: 2}, 3: {0: 1}}
    assert propose(semantic_map, [9]) == [3]


@pytest.mark.parametrize(("b", "left"), [([1.0, 0.3, 0.0], [0]), ([1.0, 1.0, 0.0], [0, 2])])
def test_the_next_link_of_a_chain_is_judged_by_what_became_of_the_first(a_map, b: list[float], left: list[int]):
    # 0 and 1 share half of themselves, and so do 1 and 2. Alike are 0 and 1, and 1 and 2, but not 0 and 2.
    semantic_map = a_map(merge_overlap=0.5, merge_cosine=0.7, iou_threshold=0.9)
    c = [b[0], 4.0 * b[1], 0.0]
    propose(semantic_map, range(4), range(2, 6), range(4, 8), embeddings=[X, b, c])
    assert semantic_map.instances().ids.tolist() == left


def test_of_what_fusion_stored_that_of_more_evidence_stays_until_the_next_fusion(a_map):
    semantic_map = a_map(window_radius_m=5.0, merge_overlap=0.75, merge_cosine=0.0)
    assert propose(semantic_map, range(10)) == [0]
    assert propose(semantic_map, [8, 9, 10] + [11] * 20, embeddings=[Y]) == [1]
    semantic_map.fuse()
    assert semantic_map.export_state()["fused_evidence"].tolist() == [10.0, 23.0]
    assert propose(semantic_map, range(11)) == [0]
    state = semantic_map.export_state()
    assert (state["instance_id"].tolist(), state["fused_evidence"].tolist()) == ([0], [23.0])
    np.testing.assert_allclose(state["fused_embedding"], [Y], atol=1e-6)
    report = semantic_map.fuse()
    assert (report.instances, report.updated, report.recomputed) == (1, 1, 1)
    state = semantic_map.export_state()
    assert state["fused_evidence"].tolist() == [44.0]
    np.testing.assert_allclose(state["fused_embedding"], [(21 * X + 23 * Y) / 44], atol=1e-6)
