"""The instance layer, through the map: association, hypotheses and what becomes of crowded-out instances."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.variants import BACKEND_IDS, BACKENDS

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

SIZE_M = 0.5
X, Y, Z = np.eye(3)


@pytest.fixture(scope="module", params=BACKENDS, ids=BACKEND_IDS)
def a_map(request) -> Callable[..., SemanticMap]:
    """Makes a map on each of the backends."""
    backend, device = request.param

    def make(max_hypotheses: int = 3, iou_threshold: float = 0.2) -> SemanticMap:
        config = MapConfig(
            voxel_size_m=SIZE_M,
            max_hypotheses=max_hypotheses,
            iou_threshold=iou_threshold,
            backend=backend,
            device=device,
        )
        return SemanticMap(3, config, 1.0)

    return make


def propose(semantic_map: SemanticMap, *masks: Iterable[int], embeddings=None) -> list[int]:
    """Proposals over voxels numbered along x; a number that repeats is another point in that voxel."""
    numbers = [number for mask in masks for number in mask]
    proposals = [m for m, mask in enumerate(masks) for _ in mask]
    points = np.array([[(number + 0.5) * SIZE_M, 0.1, 0.1] for number in numbers]).reshape(-1, 3)
    embeddings = np.tile(X, (len(masks), 1)) if embeddings is None else np.asarray(embeddings, float)
    return semantic_map.integrate_proposals(points, np.array(proposals, int), embeddings).tolist()


def hypotheses(semantic_map: SemanticMap) -> dict[int, dict[int, int]]:
    state = semantic_map.export_state()
    return {
        int(coordinates[0]): {i: c for i, c in zip(ids.tolist(), counts.tolist(), strict=True) if i >= 0}
        for coordinates, ids, counts in zip(
            state["voxel_coordinates"], state["hypothesis_id"], state["hypothesis_count"], strict=True
        )
    }


def embedding(semantic_map: SemanticMap, instance_id: int) -> np.ndarray:
    state = semantic_map.export_state()
    return state["instance_embedding"][state["instance_id"].tolist().index(instance_id)]


def alive(semantic_map: SemanticMap) -> list[int]:
    return semantic_map.instances().ids.tolist()


def test_a_proposal_that_meets_nothing_is_a_new_instance(a_map):
    semantic_map = a_map()
    assert propose(semantic_map, [0, 0, 1], [5], embeddings=[2 * X, 3 * Y]) == [0, 1]
    assert hypotheses(semantic_map) == {0: {0: 2}, 1: {0: 1}, 5: {1: 1}}
    assert semantic_map.instances().weights.tolist() == [3, 1]
    np.testing.assert_allclose(embedding(semantic_map, 0), X, atol=1e-7)


def test_a_match_adds_its_points_to_counts_weight_and_mean(a_map):
    semantic_map = a_map()
    propose(semantic_map, [0, 1, 2], embeddings=[X])
    assert propose(semantic_map, [1, 2, 2, 2, 3], embeddings=[7 * Y]) == [0]
    assert hypotheses(semantic_map) == {0: {0: 1}, 1: {0: 2}, 2: {0: 4}, 3: {0: 1}}
    assert semantic_map.instances().weights.tolist() == [8]
    assert semantic_map.instances().hypothesis_voxels.tolist() == [4]
    np.testing.assert_allclose(embedding(semantic_map, 0), [3 / 8, 5 / 8, 0], atol=1e-7)


@pytest.mark.parametrize(
    ("threshold", "old", "new", "matches"),
    [
        (0.2, 5, 1, False),  # 1/5 is not above 0.2.
        (0.2, 4, 1, True),
        (0.2, 25, 5, False),
        (0.2, 24, 5, True),
        (0.3, 10, 3, False),
        (0.6, 5, 3, False),
        (0.7, 10, 7, False),
        (0.1, 10, 1, False),
        (0.0, 400, 1, True),
    ],
)
def test_the_overlap_must_exceed_the_threshold(a_map, threshold: float, old: int, new: int, matches: bool):
    semantic_map = a_map(iou_threshold=threshold)
    propose(semantic_map, range(old))
    assert propose(semantic_map, range(new)) == [0 if matches else 1]


def test_with_no_threshold_a_proposal_must_still_meet_the_instance(a_map):
    semantic_map = a_map(iou_threshold=0.0)
    propose(semantic_map, [0])
    assert propose(semantic_map, [1]) == [1]


def test_the_union_counts_every_voxel_that_holds_the_instance_as_a_hypothesis(a_map):
    semantic_map = a_map()
    propose(semantic_map, range(3))
    # Another instance of more observations tops voxels 0..2, but they go on belonging to instance 0 as well.
    assert propose(semantic_map, [*range(30), *range(30)]) == [1]
    assert semantic_map.instances().voxel_counts.tolist() == [0, 30]
    assert semantic_map.instances().hypothesis_voxels.tolist() == [3, 30]
    assert propose(semantic_map, [0, 1, 2]) == [0]


def test_the_greatest_overlap_wins_and_of_equal_ones_the_lowest_id(a_map):
    semantic_map = a_map()
    propose(semantic_map, [0, 1], [4, 5, 6], [8, 9])
    assert propose(semantic_map, [1, 4, 5]) == [1]
    semantic_map = a_map()
    propose(semantic_map, [0, 1], [2, 3])
    assert propose(semantic_map, [1, 2]) == [0]
    # Twice as large and twice as shared is the same overlap.
    semantic_map = a_map()
    propose(semantic_map, [0, 1, 2, 3], [10])
    assert propose(semantic_map, [0, 1, 10]) == [0]


def test_proposals_of_a_frame_meet_the_map_as_the_one_before_left_it(a_map):
    semantic_map = a_map()
    assert propose(semantic_map, [0, 1, 2], [1, 2, 3], [3, 4], embeddings=[X, Y, Z]) == [0, 0, 1]
    assert hypotheses(semantic_map)[3] == {0: 1, 1: 1}


def test_points_of_a_proposal_need_not_be_together(a_map):
    semantic_map = a_map()
    points = np.array([[0.1, 0.1, 0.1], [5.1, 0.1, 0.1], [0.1, 0.1, 0.1], [5.1, 0.1, 0.1], [0.2, 0.1, 0.1]])
    ids = semantic_map.integrate_proposals(points, np.array([2, 0, 2, 0, 2]), np.stack([X, Y, Z]))
    assert ids.tolist() == [0, -1, 1]
    assert hypotheses(semantic_map) == {10: {0: 2}, 0: {1: 3}}


def test_a_proposal_without_points_gets_no_id_and_uses_none_up(a_map):
    semantic_map = a_map()
    assert propose(semantic_map, [], [0], [], [9]) == [-1, 0, -1, 1]


def crowd(semantic_map: SemanticMap, counts: list[int]) -> None:
    """Instances 0, 1, ... that all hold voxel 0, by so many points, and are too large for another to match them."""
    for number, count in enumerate(counts):
        own = range(100 * (number + 1), 100 * (number + 1) + 20)
        assert propose(semantic_map, [0] * count + list(own)) == [number]


def test_a_newcomer_takes_the_place_of_the_lowest_count(a_map):
    semantic_map = a_map()
    crowd(semantic_map, [4, 2, 3])
    assert propose(semantic_map, [0]) == [3]  # Its own count is the lowest of all: it is the others that compete.
    assert hypotheses(semantic_map)[0] == {0: 4, 2: 3, 3: 1}
    assert semantic_map.instances().hypothesis_voxels.tolist() == [21, 20, 21, 1]
    assert semantic_map.instances().weights.tolist() == [24, 22, 23, 1]


def test_of_equal_lowest_counts_the_oldest_goes(a_map):
    semantic_map = a_map()
    crowd(semantic_map, [5, 2, 2])
    propose(semantic_map, [0] * 9)
    assert hypotheses(semantic_map)[0] == {0: 5, 2: 2, 3: 9}


def test_a_match_that_already_holds_the_voxel_drops_nobody(a_map):
    semantic_map = a_map()
    crowd(semantic_map, [1, 2, 3])
    assert propose(semantic_map, [0, *range(100, 120)]) == [0]
    assert hypotheses(semantic_map)[0] == {0: 2, 1: 2, 2: 3}


def test_a_matched_instance_enters_a_full_voxel_of_others(a_map):
    semantic_map = a_map(max_hypotheses=2)
    crowd(semantic_map, [3, 2])
    assert propose(semantic_map, range(300, 320)) == [2]
    assert propose(semantic_map, [0, *range(300, 320)]) == [2]
    assert hypotheses(semantic_map)[0] == {0: 3, 2: 1}


def test_an_instance_without_voxels_is_deleted_and_its_id_stays_unused(a_map):
    semantic_map = a_map(max_hypotheses=1)
    assert propose(semantic_map, [0]) == [0]
    assert propose(semantic_map, range(10)) == [1]
    assert alive(semantic_map) == [1]
    assert semantic_map.instance_count == 1
    assert propose(semantic_map, [50]) == [2]
    assert alive(semantic_map) == [1, 2]
    assert all(0 not in held for held in hypotheses(semantic_map).values())


def test_a_later_proposal_may_displace_an_earlier_one_of_its_frame(a_map):
    semantic_map = a_map(max_hypotheses=1)
    assert propose(semantic_map, [0], range(10)) == [0, 1]
    assert alive(semantic_map) == [1]
    # The id is gone for good, also when it was the highest so far.
    assert propose(semantic_map, [70], [*range(70, 90)], [300]) == [2, 3, 4]
    assert alive(semantic_map) == [1, 3, 4]


@pytest.mark.parametrize("counts", [[2, 2, 1], [1, 3, 3]])
def test_of_equal_highest_counts_the_lowest_id_is_on_top(a_map, counts: list[int]):
    semantic_map = a_map()
    crowd(semantic_map, counts)
    voxels = semantic_map.voxels()
    slot = voxels.centers_m[:, 0].argmin()
    assert voxels.top_instance[slot] == counts.index(max(counts))
    assert voxels.top_count[slot] == max(counts)


def test_the_oldest_of_a_tie_goes_whatever_order_they_came_to_the_voxel(a_map):
    semantic_map = a_map(max_hypotheses=2)
    own = [range(100 * each, 100 * each + 20) for each in range(3)]
    assert propose(semantic_map, *own) == [0, 1, 2]
    # Instance 1 comes to voxel 900 before instance 0 does.
    assert propose(semantic_map, [900, *own[1]], [900, *own[0]]) == [1, 0]
    assert propose(semantic_map, [900, *own[2]]) == [2]
    assert hypotheses(semantic_map)[900] == {1: 1, 2: 1}


@settings(max_examples=15)
@given(
    st.lists(st.tuples(st.integers(0, 5), st.integers(2, 6)), min_size=1, max_size=6, unique_by=lambda pair: pair[0]),
    st.integers(1, 5),
)
def test_it_is_the_same_whether_a_proposal_arrives_in_one_frame_or_in_many(
    a_map, voxels: list[tuple[int, int]], frames: int
):
    """The points of one object, all its voxels hit by each share, as one proposal or as several of one embedding."""
    whole, parts = a_map(), a_map()
    share = [number for number, count in voxels for _ in range(count)]
    propose(whole, share * frames, embeddings=[[1, 2, 3]])
    for _ in range(frames):
        assert propose(parts, share, embeddings=[[1, 2, 3]]) == [0]
    assert hypotheses(whole) == hypotheses(parts)
    assert whole.instances().weights.tolist() == parts.instances().weights.tolist()
    np.testing.assert_allclose(embedding(whole, 0), embedding(parts, 0), atol=1e-6)
    whole.fuse()
    parts.fuse()
    np.testing.assert_allclose(whole.export_state()["fused_embedding"], parts.export_state()["fused_embedding"], atol=1e-6)
