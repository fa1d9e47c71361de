"""The public names of the core: what they are, that importing the package loads nothing, and how results read."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from stand_ins import ColorSegmenter, color_trio, wall_frame

import fus3dmaps_core
from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import QueryError, StorageError
from fus3dmaps_core.ledger import Ledger
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.saved_maps import storage
from fus3dmaps_core.saved_maps.storage import load_map, save_map


@pytest.fixture
def pipeline() -> Pipeline:
    made = Pipeline(Config(), color_trio(), ColorSegmenter())
    for stamp_ns, x_m in enumerate([0.0, 0.2, 0.4], start=1):
        made.process(wall_frame(stamp_ns, x_m=x_m))
    return made


def in_fresh_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_every_public_name_is_there_and_listed():
    for name in set(fus3dmaps_core.__all__) - {"__version__"}:
        assert getattr(fus3dmaps_core, name).__name__ == name
    assert set(fus3dmaps_core.__all__) <= set(dir(fus3dmaps_core))
    with pytest.raises(AttributeError, match="no attribute 'Teapot'"):
        fus3dmaps_core.Teapot  # noqa: B018


def test_importing_the_package_loads_no_library():
    heavy = "{'numpy', 'torch', 'pydantic', 'cv2', 'numba', 'scipy'}"
    assert in_fresh_python(f"import sys, fus3dmaps_core; print({heavy} & sys.modules.keys())") == "set()"
    light = in_fresh_python("import sys; from fus3dmaps_core import Config; print('torch' in sys.modules, Config.__name__)")
    assert light == "False Config"


def test_asking_a_pipeline_answers_the_query(pipeline: Pipeline):
    text, scale = pipeline.trio.text, pipeline.trio.logit_scale
    query = TextQuery(["red", "blue"], ["grey"], layer="instances", top_k=1)
    expected = answer_query(pipeline.semantic_map, text, query, scale)
    for answer in (
        pipeline.ask(query),
        pipeline.ask(["red", "blue"], negative_prompts=["grey"], layer="instances", top_k=1),
        pipeline.ask(TextQuery(["red", "blue"], ["grey"], layer="instances"), top_k=1),
    ):
        assert [(each.prompt, each.id, each.score) for each in answer.instances] == [
            (each.prompt, each.id, each.score) for each in expected.instances
        ]
        np.testing.assert_array_equal(answer.similarity, expected.similarity)
    assert pipeline.ask("red").instances[0].prompt == "red"
    with pytest.raises(TypeError, match="colour"):
        pipeline.ask("red", colour="red")
    with pytest.raises(QueryError, match="empty"):
        Pipeline(Config(), color_trio(), ColorSegmenter()).ask("red")


def test_an_answer_reads_as_a_list_of_places(pipeline: Pipeline):
    answer = pipeline.ask(["red", "blue"], top_k=1)
    head, *lines = repr(answer).splitlines()
    assert head == f"QueryAnswer: 2 instances by {len(answer.points_m):,} voxels of layer 'fused_instances'"
    for place, (line, found) in enumerate(zip(lines, answer.instances, strict=True), start=1):
        x, y, z = found.centroid_m
        assert line.startswith(f"  {place}. {found.prompt}: score {found.score:.3f} at ({x:.2f}, {y:.2f}, {z:.2f}) m, ")
        assert line.endswith(f" m, {found.voxels} voxels, id {found.id}")
        assert line.split(": ", 1)[1] in repr(found)


def test_a_map_and_a_pipeline_say_how_much_they_hold(pipeline: Pipeline):
    mapped = pipeline.semantic_map
    assert repr(mapped) == (
        f"SemanticMap({mapped.voxel_count:,} voxels of 0.05 m, {mapped.dense_voxel_count:,} of them dense, "
        f"{mapped.instance_count:,} instances, d = 8, encoder 'stand_in')"
    )
    assert repr(pipeline) == f"Pipeline(3 keyframes, {mapped!r})"


def test_a_pipeline_is_saved_whole_and_a_loaded_map_is_asked(pipeline: Pipeline, tmp_path, monkeypatch):
    loads = []
    monkeypatch.setattr(storage, "load_text_encoder", lambda *options: loads.append(options) or color_trio().text)
    storage._text_encoder.cache_clear()
    save_map(str(tmp_path / "wall"), pipeline)
    saved = load_map(str(tmp_path / "wall"))
    assert repr(saved) == f"SavedMap(3 keyframes in frame 'map', {pipeline.semantic_map!r})"
    assert (saved.info.stamp_ns, saved.info.config, saved.info.encoder) == (3, pipeline.config, "stand_in")
    np.testing.assert_array_equal(saved.info.camera_poses, pipeline.camera_poses())
    assert repr(saved.ask("red")) == repr(saved.ask("red")) == repr(pipeline.ask("red"))
    assert loads == [("stand_in", "cpu", "")]
    save_map(tmp_path / "again", saved)
    assert repr(load_map(tmp_path / "again").ask("blue")) == repr(pipeline.ask("blue"))
    storage._text_encoder.cache_clear()
    with pytest.raises(StorageError, match="nowhere"):
        load_map(str(tmp_path / "nowhere"))


def test_a_frame_and_a_ledger_say_what_they_are_without_their_arrays():
    assert repr(wall_frame(7, x_m=0.25)) == "PosedFrame(7 ns, colour 640x480, depth 640x480, camera at (0.25, 0.00, 0.00) m)"
    ledger = Ledger()
    ledger.add_frame()
    ledger.drops.add("no_pose", "pose: none", 2)
    assert repr(ledger) == (
        "Ledger(FrameCounts(frames=1, not_keyframes=0, dense_keyframes=0, instance_keyframes=0, proposals=0), "
        "drops={'no_pose': 2})"
    )


def test_a_query_that_does_not_say_takes_what_is_configured_and_a_text_is_one_text():
    made = Pipeline(Config.from_flat({"query.top_k": 1, "query.min_voxels": 10_000}), color_trio(), ColorSegmenter())
    made.process(wall_frame(1))
    assert made.ask("red").instances == []
    assert len(made.ask("red", min_voxels=1).instances) == 1
    for query in (TextQuery("red", "grey"), TextQuery.of("red", Config().query, negative_prompts="grey")):
        assert (query.prompts, query.negative_prompts) == (("red",), ("grey",))
