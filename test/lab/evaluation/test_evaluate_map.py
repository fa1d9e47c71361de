"""A map against the truth: known answers, and all metrics of segmentation against a plain map and scikit-learn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.agreement import KnownTexts, apply_to_both, engine_of, reference_of
from reference.queries import layer_embeddings
from reference.steps import Setting, embeddings_of, random_steps
from reference.vectors import cosine
from scipy.special import softmax
from sklearn.metrics import accuracy_score, jaccard_score, recall_score

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.errors import MapError, QueryError
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_lab.evaluation.evaluate_map import INSTANCE_LAYERS, EvaluationProtocol, evaluate_map
from fus3dmaps_lab.evaluation.ground_truth import VoxelTruth, voxel_truth
from fus3dmaps_lab.evaluation.matching import mode_of_neighbours, nearest_voxels
from fus3dmaps_lab.evaluation.prediction import layer_cosines
from fus3dmaps_lab.evaluation.records import LAYERS
from fus3dmaps_lab.evaluation.retrieval import instance_scores

SIZE_M = 0.5
NAMES = ("", "wall", "chair", "mug", "lamp")
WALL, CHAIR, MUG, LAMP = 1, 2, 3, 4
TEXTS = np.eye(4, dtype=np.float32)
BACKGROUND = frozenset({WALL})


def block(x: int, side: int = 3) -> np.ndarray:
    """Return the centres of the voxels of a cube that begins at voxel x."""
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return (cells + [x, 0, 0] + 0.5) * SIZE_M


def see(semantic_map: SemanticMap, points_m: np.ndarray, dense: int, instance: int, times: int = 1) -> None:
    """Show one class to the dense layer and one to the instance layer, each with full certainty."""
    count = len(points_m)
    colors = np.zeros((count, 3), np.uint8)
    for _ in range(times):
        semantic_map.integrate_dense(points_m, np.zeros(count, int), TEXTS[[dense - 1]], np.ones(1), colors)
        semantic_map.integrate_proposals(points_m, np.zeros(count, int), TEXTS[[instance - 1]])


def truth_of(*things: tuple[np.ndarray, int]) -> VoxelTruth:
    """Make the truth of things with a class; each is an instance."""
    points_m = np.concatenate([points for points, _ in things])
    classes = np.concatenate([np.full(len(points), label) for points, label in things])
    instances = np.concatenate([np.full(len(points), number + 1) for number, (points, _) in enumerate(things)])
    return voxel_truth(points_m, classes, instances, SIZE_M)


def empty_map(window_radius_m: float = 0.0) -> SemanticMap:
    return SemanticMap(4, MapConfig(voxel_size_m=SIZE_M, iou_threshold=0.2), 1.0, window_radius_m)


def ending(metrics, text):
    return {
        name.replace("_with_background", ""): value
        for name, value in metrics.items()
        if ("_with_background" in name) == text
    }


def test_a_perfect_map_is_perfect_in_every_layer():
    semantic_map = empty_map()
    things = [(block(0), WALL), (block(10), CHAIR), (block(20), MUG)]
    for points_m, label in things:
        see(semantic_map, points_m, label, label)
    semantic_map.fuse()
    found = evaluate_map(semantic_map, TEXTS, truth_of(*things), NAMES, BACKGROUND)
    assert tuple(found) == LAYERS
    for layer, metrics in found.items():
        for with_background in (False, True):
            values = ending(metrics, with_background)
            assert math.isnan(values.pop("iou/lamp"))
            assert ("iou/wall" in values) == with_background
            assert values.pop("ECE") == pytest.approx(0, abs=1e-12)
            assert values.pop("localisation_error_m") == pytest.approx(0, abs=1e-5)
            # Of each class there is one instance, so that the others of the best three are wrong.
            assert values.pop("precision@3") == values.pop("precision@5") == pytest.approx(1 / 3)
            assert set(values.values()) == {1.0}
            assert ("AP25" in values) == (layer in INSTANCE_LAYERS)


def test_known_mistakes_are_counted():
    semantic_map = empty_map()
    chair, other_chair, mug, wall = block(0), block(10), block(20), block(30)
    see(semantic_map, chair, CHAIR, CHAIR)
    see(semantic_map, other_chair, MUG, CHAIR)  # The dense layer takes it for a mug.
    see(semantic_map, mug, MUG, MUG)
    see(semantic_map, wall, WALL, CHAIR)  # The instance layer takes it for a chair.
    truth = truth_of((chair, CHAIR), (other_chair, CHAIR), (mug, MUG), (wall, WALL))
    found = evaluate_map(semantic_map, TEXTS, truth, NAMES, BACKGROUND)
    dense = found["dense"]
    assert (dense["iou/chair"], dense["iou/mug"], dense["mIoU"]) == (0.5, 0.5, 0.5)
    assert dense["accuracy"] == pytest.approx(2 / 3)
    assert dense["mean_accuracy"] == pytest.approx((0.5 + 1) / 2)
    assert dense["iou_with_background/wall"] == 1.0
    assert dense["accuracy_with_background"] == pytest.approx(3 / 4)
    # One in three predictions of full certainty is wrong, and one in four.
    assert dense["ECE"] == pytest.approx(1 / 3)
    assert dense["ECE_with_background"] == pytest.approx(1 / 4)
    # The first mug is the lowest id, the chair that looks like one.
    assert dense["precision@1"] == 0.5
    assert dense["localisation_error_m"] == pytest.approx((0 + 10 * SIZE_M) / 2)
    assert dense["localised"] == 0.5
    instances = found["instances"]
    assert (instances["mIoU"], instances["accuracy"], instances["ECE"]) == (1.0, 1.0, 0.0)
    assert instances["iou_with_background/chair"] == pytest.approx(2 / 3)
    assert instances["iou_with_background/wall"] == 0.0
    assert instances["mIoU_with_background"] == pytest.approx((2 / 3 + 1 + 0) / 3)


def test_pieces_are_measured_by_top_hypotheses():
    semantic_map = empty_map()
    long = np.concatenate([block(0), block(3)])
    see(semantic_map, block(0), CHAIR, CHAIR, times=2)
    see(semantic_map, block(3), CHAIR, CHAIR)
    see(semantic_map, block(20), WALL, WALL)
    truth = truth_of((long, CHAIR), (block(20), WALL))
    found = evaluate_map(semantic_map, TEXTS, truth, NAMES, BACKGROUND)
    for layer in INSTANCE_LAYERS:
        metrics = found[layer]
        # Either half of the chair has an IoU of one half; the heavier is the first, and the other finds the chair taken.
        assert (metrics["AP25"], metrics["AP50"]) == (1.0, 1.0)
        assert (metrics["over_segmentation"], metrics["over_segmentation_with_background"]) == (2.0, 1.5)
        assert metrics["AP50_with_background"] == pytest.approx((1 + 2 / 3) / 2)
        # Neither half has more than half of the chair.
        assert math.isnan(metrics["under_segmentation"])
    assert "AP25" not in found["dense"]


def test_a_window_leaves_the_dense_layer_what_it_covers():
    semantic_map = empty_map(window_radius_m=4.0)
    near, far = block(0), block(40)
    see(semantic_map, far, MUG, MUG)
    semantic_map.fuse()
    see(semantic_map, near, CHAIR, CHAIR)
    semantic_map.prune_window(np.zeros(3))
    semantic_map.fuse()
    found = evaluate_map(semantic_map, TEXTS, truth_of((near, CHAIR), (far, MUG)), NAMES, BACKGROUND)
    dense = found["dense"]
    # Without a cap, what is left of the layer speaks for the far mug too.
    assert (dense["coverage"], dense["mIoU_covered"], dense["mIoU"]) == (0.5, 1.0, (0.5 + 0) / 2)
    for layer in LAYERS[1:]:
        assert (found[layer]["coverage"], found[layer]["mIoU"]) == (1.0, 1.0)
    strict = evaluate_map(semantic_map, TEXTS, truth_of((near, CHAIR), (far, MUG)), NAMES, BACKGROUND, ["dense"], k=0)
    assert (strict["dense"]["mIoU"], strict["dense"]["accuracy"]) == (0.5, 0.5)


def test_an_empty_map_finds_nothing():
    found = evaluate_map(empty_map(), TEXTS, truth_of((block(0), CHAIR)), NAMES, BACKGROUND)
    for layer, metrics in found.items():
        for name in ("mIoU", "accuracy", "coverage", "precision@1", "localised"):
            assert metrics[name] == 0.0, name
        assert math.isnan(metrics["ECE"])
        assert math.isnan(metrics["localisation_error_m"])
        if layer in INSTANCE_LAYERS:
            assert metrics["AP25"] == 0.0


def test_a_truth_of_its_own_without_background():
    semantic_map = empty_map()
    see(semantic_map, block(0), CHAIR, CHAIR)
    mostly_wall, lifted = truth_of((block(0), WALL)), truth_of((block(0), CHAIR))
    assert math.isnan(evaluate_map(semantic_map, TEXTS, mostly_wall, NAMES, BACKGROUND)["dense"]["mIoU"])
    found = evaluate_map(semantic_map, TEXTS, mostly_wall, NAMES, BACKGROUND, truth_without_background=lifted)
    assert found["dense"]["mIoU"] == 1.0
    assert found["dense"]["mIoU_with_background"] == 0.0


def test_a_text_encoder_is_as_good_as_its_vectors():
    semantic_map = empty_map()
    see(semantic_map, block(0), CHAIR, MUG)
    texts = KnownTexts(dict(zip(NAMES[1:], TEXTS, strict=True)))
    truth = truth_of((block(0), CHAIR))
    by_vectors = evaluate_map(semantic_map, 3 * TEXTS, truth, NAMES, BACKGROUND)
    np.testing.assert_equal(evaluate_map(semantic_map, texts, truth, NAMES, BACKGROUND), by_vectors)


def judged_plainly(reference, layer, truth, vectors, kept, logit_scale):
    """Score the kept classes with a plain map, scipy's softmax and scikit-learn; 0 stands for the other classes."""
    embeddings = layer_embeddings(reference, layer)
    keys = sorted(embeddings)
    cosines = [[cosine(embeddings[key], list(vectors[label - 1])) for label in kept] for key in keys]
    likely = softmax(logit_scale * np.array(cosines), axis=1)
    spoken = np.array(kept)[likely.argmax(axis=1)]
    judged = np.isin(truth.classes, kept)
    true = truth.classes[judged]
    predicted = mode_of_neighbours(nearest_voxels(truth.keys[judged], np.array(keys), 5), spoken)
    options = {"labels": sorted(set(true.tolist())), "zero_division": 0.0}
    nearest = nearest_voxels(truth.keys[judged], np.array(keys), 1).places[:, 0]
    confidence, right = likely.max(axis=1)[nearest], spoken[nearest] == true
    bins = np.clip(np.ceil(confidence * 15) - 1, 0, 14)
    return {
        "mIoU": jaccard_score(true, predicted, average="macro", **options),
        "f-mIoU": jaccard_score(true, predicted, average="weighted", **options),
        "accuracy": accuracy_score(true, predicted),
        "mean_accuracy": recall_score(true, predicted, average="macro", **options),
        "ECE": sum(abs((right - confidence)[bins == each].sum()) for each in range(15)) / len(true),
    }


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), layer=st.sampled_from(LAYERS), window=st.sampled_from([0.0, 1.0]))
def test_segmentation_and_calibration_agree_with_a_plain_map(seed, layer, window):
    setting = Setting(window_radius_m=window)
    engine, reference = engine_of(setting), reference_of(setting)
    for step in random_steps(setting, extent=2, count=10, seed=seed):
        apply_to_both(step, engine, reference)
    if not layer_embeddings(reference, layer):
        return
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-3, 4, (60, 3)), axis=0)
    classes = np.append([1, 2], rng.integers(0, 5, len(keys) - 2)).astype(np.int32)
    truth = VoxelTruth(keys, classes, classes, setting.voxel_size_m)
    vectors = embeddings_of(4, setting.dimension, rng)
    options = EvaluationProtocol(min_peak=0.0, min_probability=0.0)
    found = evaluate_map(engine, vectors, truth, NAMES, BACKGROUND, [layer], logit_scale=3.0, protocol=options)[layer]
    for with_background, kept in ((False, [2, 3, 4]), (True, [1, 2, 3, 4])):
        expected = judged_plainly(reference, layer, truth, vectors, kept, 3.0)
        values = ending(found, with_background)
        assert {name: values[name] for name in expected} == pytest.approx(expected, abs=1e-4)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), layer=st.sampled_from(LAYERS))
def test_instances_are_ranked_as_a_query_ranks_them(seed, layer):
    setting = Setting()
    engine = engine_of(setting)
    for step in random_steps(setting, extent=2, count=15, seed=seed):
        step.apply(engine)
    vectors = embeddings_of(2, setting.dimension, np.random.default_rng(seed))
    centers_m, cosines = layer_cosines(engine, layer, vectors)
    voxels, ids = engine.voxels(), engine.instances().ids
    places = {key: place for place, key in enumerate(map(tuple, voxels.centers_m.tolist()))}
    top = (
        voxels.top_instance[[places[tuple(center)] for center in centers_m.tolist()]] if len(centers_m) else np.empty(0, int)
    )
    owner = np.where(top >= 0, np.searchsorted(ids, top), -1)
    scores = instance_scores(owner, cosines, len(ids))
    asked = engine.search(LayerQuery(layer, vectors, top_k=len(ids) + 1))
    for column, (best, means) in enumerate(asked.best):
        assert sorted(best.tolist()) == np.flatnonzero(np.isfinite(scores[:, column])).tolist()
        np.testing.assert_allclose(scores[best, column], means, rtol=0, atol=1e-6)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), k=st.sampled_from([0, 1, 5]))
def test_the_order_of_voxels_plays_no_role(seed, k):
    # With a window fused embeddings are stored; without, they would be summed anew in the new order.
    setting = Setting(window_radius_m=1.0)
    engine, shuffled = engine_of(setting), engine_of(setting)
    for step in random_steps(setting, extent=2, count=10, seed=seed):
        step.apply(engine)
    rng = np.random.default_rng(seed)
    state = engine.export_state()
    order = rng.permutation(len(state["voxel_coordinates"]))
    for name in ("voxel_coordinates", "voxel_colors", "hypothesis_id", "hypothesis_count"):
        state[name] = state[name][order]
    state["dense_slot"] = np.argsort(order)[state["dense_slot"]].astype(np.int32)
    shuffled.import_state(state)
    keys = np.unique(rng.integers(-3, 4, (60, 3)), axis=0)
    classes = rng.integers(0, 5, len(keys)).astype(np.int32)
    turned = VoxelTruth(keys, classes, classes, setting.voxel_size_m)
    truth = VoxelTruth(keys[::-1], classes[::-1], classes[::-1], setting.voxel_size_m)
    vectors = embeddings_of(4, setting.dimension, rng)
    one, other = (
        evaluate_map(each, vectors, labels, NAMES, BACKGROUND, logit_scale=5.0, k=k)
        for each, labels in ((engine, truth), (shuffled, turned))
    )
    assert one.keys() == other.keys()
    for layer in one:
        assert one[layer] == pytest.approx(other[layer], abs=1e-12, nan_ok=True), layer


def test_what_does_not_fit_is_refused():
    semantic_map = empty_map()
    see(semantic_map, block(0), CHAIR, CHAIR)
    truth = truth_of((block(0), CHAIR))
    other_size = VoxelTruth(truth.keys, truth.classes, truth.instances, 0.05)
    with pytest.raises(MapError, match=r"truth: its voxels have 0\.05 m, the map's 0\.5 m"):
        evaluate_map(semantic_map, TEXTS, other_size, NAMES, BACKGROUND)
    with pytest.raises(MapError, match=r"truth: its voxels have 0\.05 m"):
        evaluate_map(semantic_map, TEXTS, truth, NAMES, BACKGROUND, truth_without_background=other_size)
    with pytest.raises(MapError, match="texts: 3 embeddings do not go with 4 classes"):
        evaluate_map(semantic_map, TEXTS[:3], truth, NAMES, BACKGROUND)
    with pytest.raises(MapError, match="truth: class 2 has no name"):
        evaluate_map(semantic_map, TEXTS[:1], truth, NAMES[:2], frozenset())
    with pytest.raises(MapError, match="background"):
        evaluate_map(semantic_map, TEXTS, truth, NAMES, frozenset({9}))
    with pytest.raises(QueryError, match="unknown layer 'sparse'"):
        evaluate_map(semantic_map, TEXTS, truth, NAMES, BACKGROUND, ["sparse"])
