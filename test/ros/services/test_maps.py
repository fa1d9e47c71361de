"""Saving, loading and resuming maps, and the time limits of services, over DDS."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from reference.agreement import assert_same_bytes
from robot import Robot, stand_in_pipeline, wait_until
from stand_ins import wall_frame
from std_srvs.srv import Trigger

from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.errors import StorageError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.saved_maps.directory import list_maps
from fus3dmaps_core.saved_maps.storage import load_map
from fus3dmaps_msgs.srv import Fuse, LoadMap, QueryText, SaveMap
from fus3dmaps_ros.node import map_store
from fus3dmaps_ros.node.autosave import NAMES

STAMP_NS = 1_700_000_000 * 10**9


@pytest.fixture
def maps(tmp_path) -> Path:
    return tmp_path / "maps"


@pytest.fixture
def robot(make_robot, maps) -> Robot:
    robot = make_robot(**{"node.map_directory": str(maps)})
    robot.map(wall_frame(STAMP_NS))
    return robot


def state_of(robot: Robot) -> dict[str, Any]:
    return robot.mapper.pipeline.semantic_map.export_state()


class Gate:
    """Holds a thread of the node until it is opened."""

    def __init__(self) -> None:
        self.entered, self._open = threading.Event(), threading.Event()

    def pass_through(self, *_: Any) -> None:
        self.entered.set()
        assert self._open.wait(60)

    def open(self) -> None:
        self._open.set()


@pytest.fixture
def gate() -> Iterator[Gate]:
    gate = Gate()
    yield gate
    gate.open()


def hold_worker(robot: Robot, gate: Gate) -> None:
    robot.mapper.worker.between_frames(gate.pass_through, changes=False)
    assert gate.entered.wait(60)


def limit(robot: Robot, seconds: float) -> None:
    assert robot.mapper.set_parameters([Parameter("node.service_timeout_s", value=seconds)])[0].successful


def test_a_saved_map_is_the_map(robot, maps) -> None:
    saved = robot.call(SaveMap, "save_map", name="kitchen")
    assert saved.success, saved.message
    assert saved.path == str(maps / "kitchen")
    assert saved.bytes == sum(path.stat().st_size for path in (maps / "kitchen").iterdir())
    semantic_map, info = load_map(maps / "kitchen")
    assert_same_bytes(semantic_map.export_state(), state_of(robot))
    assert (info.encoder, info.stamp_ns, info.map_frame) == ("stand_in", STAMP_NS, "map")
    np.testing.assert_array_equal(info.camera_poses, [np.eye(4)])


def test_a_loaded_map_takes_the_place_of_the_map_and_mapping_goes_on(robot) -> None:
    before = state_of(robot)
    assert robot.call(SaveMap, "save_map", name="kitchen").success
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    assert robot.call(QueryText, "query_text", prompts=["red"], publish=True).success
    loaded = robot.call(LoadMap, "load_map", name="kitchen")
    assert loaded.success, loaded.message
    assert_same_bytes(state_of(robot), before)
    assert (loaded.voxels, loaded.instances) == (len(before["voxel_coordinates"]), len(before["instance_id"]))
    answer = robot.call(QueryText, "query_text", prompts=["red"])
    assert answer.similarity.header.stamp.sec * 10**9 == STAMP_NS
    np.testing.assert_array_equal(robot.mapper.pipeline.camera_poses(), [np.eye(4)])

    # The pose that was mapped before is a keyframe again, and ids go on behind those of the saved map.
    robot.map(wall_frame(STAMP_NS + 2 * 10**9, x_m=0.5, patches={"yellow": (1.2, 0.0, 0.4)}))
    new = set(state_of(robot)["instance_id"].tolist()) - set(before["instance_id"].tolist())
    assert new
    assert min(new) >= before["next_instance_id"]


def test_without_a_name_the_newest_map_is_loaded(robot) -> None:
    assert robot.call(SaveMap, "save_map", name="older").success
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    assert robot.call(SaveMap, "save_map", name="a newer one").success
    saved = state_of(robot)
    assert robot.call(Trigger, "reset").success
    loaded = robot.call(LoadMap, "load_map")
    assert loaded.success
    assert "a newer one" in loaded.message
    assert_same_bytes(state_of(robot), saved)


@pytest.mark.parametrize("name", ["", "../elsewhere", "/etc", "a/b", ".hidden", "x" * 1000, "nul\x01"])
def test_names_that_lead_elsewhere_are_refused(robot, maps, name) -> None:
    saved = robot.call(SaveMap, "save_map", name=name)
    assert not saved.success
    assert "name" in saved.message
    assert not maps.exists() or not list(maps.iterdir())
    if name:
        loaded = robot.call(LoadMap, "load_map", name=name)
        assert not loaded.success
        assert "name" in loaded.message


def test_a_map_that_is_not_there_is_refused_by_name(robot) -> None:
    assert "nowhere" in robot.call(LoadMap, "load_map", name="nowhere").message
    assert "no map" in robot.call(LoadMap, "load_map").message


def test_a_map_of_another_voxel_size_is_refused_and_nothing_changes(make_robot, robot, maps) -> None:
    other = make_robot(**{"node.map_directory": str(maps), "map.voxel_size_m": 0.1})
    other.map(wall_frame(STAMP_NS))
    assert other.call(SaveMap, "save_map", name="coarse").success
    before = state_of(robot)
    loaded = robot.call(LoadMap, "load_map", name="coarse")
    assert not loaded.success
    assert "map.voxel_size_m" in loaded.message
    assert "coarse" in loaded.message
    assert_same_bytes(state_of(robot), before)


def test_a_map_of_another_encoder_is_refused(make_robot, robot, maps) -> None:
    def renamed(config: Any) -> Pipeline:
        pipeline = stand_in_pipeline(config)
        trio = pipeline.trio
        pipeline.trio = EncoderTrio("huge", trio.dimension, 1.0, 20.0, trio.patch, trio.crop, trio.text)
        return pipeline

    other = make_robot(renamed, **{"node.map_directory": str(maps)})
    other.map(wall_frame(STAMP_NS))
    assert other.call(SaveMap, "save_map", name="foreign").success
    loaded = robot.call(LoadMap, "load_map", name="foreign")
    assert not loaded.success
    assert "'huge'" in loaded.message


def test_a_damaged_map_is_refused_and_nothing_changes(robot, maps) -> None:
    assert robot.call(SaveMap, "save_map", name="kitchen").success
    flip_a_bit(maps / "kitchen")
    before = state_of(robot)
    loaded = robot.call(LoadMap, "load_map", name="kitchen")
    assert not loaded.success
    assert "kitchen" in loaded.message
    assert_same_bytes(state_of(robot), before)


def flip_a_bit(directory: Path) -> None:
    path = max(directory.glob("*.npy"), key=lambda each: each.stat().st_size)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_a_map_is_saved_and_mapping_and_queries_go_on_while_the_disk_is_slow(robot, maps, gate, monkeypatch) -> None:
    save = map_store.save_map

    def slow(*arguments: Any) -> int:
        gate.pass_through()
        return save(*arguments)

    monkeypatch.setattr(map_store, "save_map", slow)
    client = robot.user.create_client(SaveMap, "fus3dmaps/save_map")
    assert client.wait_for_service(60)
    saving = client.call_async(SaveMap.Request(name="slow"))
    assert gate.entered.wait(60)
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    assert robot.call(QueryText, "query_text", prompts=["red"]).success
    assert robot.call(Fuse, "fuse").success
    assert not saving.done()
    gate.open()
    wait_until(saving.done, "the slow save")
    assert saving.result().success
    assert list_maps(maps) == ["slow"]


def test_a_save_beyond_its_time_is_told_and_completes(robot, maps, gate, monkeypatch) -> None:
    save = map_store.save_map

    def slow(*arguments: Any) -> int:
        gate.pass_through()
        return save(*arguments)

    monkeypatch.setattr(map_store, "save_map", slow)
    limit(robot, 0.2)
    late = robot.call(SaveMap, "save_map", name="late")
    assert not late.success
    assert "0.2 s" in late.message
    assert "goes on" in late.message
    second = robot.call(SaveMap, "save_map", name="later")
    assert not second.success
    assert "earlier save_map" in second.message
    gate.open()
    wait_until(lambda: list_maps(maps) == ["late"], "the save completed")
    load_map(maps / "late")


@pytest.mark.parametrize(("service", "name", "fields"), [(Trigger, "reset", {}), (LoadMap, "load_map", {"name": "kitchen"})])
def test_a_change_that_could_not_begin_in_time_never_happens(robot, gate, service, name, fields) -> None:
    assert robot.call(SaveMap, "save_map", name="kitchen").success
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    before = state_of(robot)
    hold_worker(robot, gate)
    limit(robot, 0.3)
    late = robot.call(service, name, **fields)
    assert not late.success
    assert "0.3 s" in late.message
    assert "as it was" in late.message
    limit(robot, 60.0)
    assert robot.call(QueryText, "query_text", prompts=["red"]).success
    gate.open()
    robot.mapper.worker.between_frames(lambda: None).result(60)
    assert_same_bytes(state_of(robot), before)


def test_a_text_encoder_that_hangs_costs_its_callers_their_time_and_nobody_else(robot, gate, monkeypatch) -> None:
    monkeypatch.setattr(robot.mapper.pipeline.trio.text, "encode_text", gate.pass_through)
    limit(robot, 0.3)
    for _ in range(2):
        answer = robot.call(QueryText, "query_text", prompts=["red"])
        assert not answer.success
        assert "0.3 s" in answer.message
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    limit(robot, 30.0)
    assert robot.call(Fuse, "fuse").success
    monkeypatch.undo()
    gate.open()
    wait_until(lambda: robot.call(QueryText, "query_text", prompts=["red"]).success, "the encoder is back")


def test_a_full_disk_is_a_reply_and_the_last_map_stays(robot, maps, monkeypatch) -> None:
    assert robot.call(SaveMap, "save_map", name="kitchen").success

    def full(*_: Any) -> int:
        raise StorageError("cannot write map 'kitchen': No space left on device")

    monkeypatch.setattr(map_store, "save_map", full)
    saved = robot.call(SaveMap, "save_map", name="kitchen")
    assert not saved.success
    assert "No space left" in saved.message
    load_map(maps / "kitchen")
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))


def resumed(make_robot: Any, maps: Path) -> Robot:
    return make_robot(**{"node.map_directory": str(maps), "node.resume": True})


def test_a_node_resumes_the_newest_map(make_robot, robot, maps) -> None:
    assert robot.call(SaveMap, "save_map", name="older").success
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    assert robot.call(SaveMap, "save_map", name="newer").success
    again = resumed(make_robot, maps)
    assert_same_bytes(state_of(again), state_of(robot))
    answer = again.call(QueryText, "query_text", prompts=["red"])
    assert answer.similarity.header.stamp.sec * 10**9 == STAMP_NS + 10**9
    again.map(wall_frame(STAMP_NS + 2 * 10**9, x_m=1.0))
    assert len(again.mapper.pipeline.camera_poses()) == 3


def test_a_bad_map_is_named_and_the_next_older_one_resumed(make_robot, robot, maps, capfd) -> None:
    assert robot.call(SaveMap, "save_map", name="good").success
    saved = state_of(robot)
    for name in ("flipped", "no_manifest_to_speak_of"):
        robot.map(wall_frame(robot.mapper.worker.stamp_ns + 10**9, x_m=0.5 + len(name)))
        assert robot.call(SaveMap, "save_map", name=name).success
    flip_a_bit(maps / "flipped")
    (maps / "no_manifest_to_speak_of" / "manifest.json").write_text("{")
    again = resumed(make_robot, maps)
    assert_same_bytes(state_of(again), saved)
    log = capfd.readouterr().err
    assert "'flipped' is not resumed" in log
    assert "'no_manifest_to_speak_of' is not resumed" in log
    assert "resumed map 'good'" in log


def test_without_a_good_map_it_starts_empty(make_robot, maps) -> None:
    assert resumed(make_robot, maps).mapper.pipeline.semantic_map.voxel_count == 0
    maps.mkdir()
    (maps / "notes.txt").write_text("no map")
    assert resumed(make_robot, maps).mapper.pipeline.semantic_map.voxel_count == 0


def test_the_map_is_saved_by_period_in_turns_and_only_when_it_has_changed(make_robot, maps) -> None:
    robot = make_robot(**{"node.map_directory": str(maps), "node.autosave_period_s": 0.05})
    autosave = robot.mapper.autosave
    robot.map(wall_frame(STAMP_NS))
    wait_until(lambda: autosave.counts == (1, 0), "first save")
    assert list_maps(maps) == [NAMES[0]]
    robot.map(wall_frame(STAMP_NS + 10**9, x_m=0.5))
    wait_until(lambda: list_maps(maps) == [NAMES[1], NAMES[0]], "second save")
    robot.map(wall_frame(STAMP_NS + 2 * 10**9, x_m=1.0))
    wait_until(lambda: autosave.counts == (3, 0), "third save")
    assert list_maps(maps) == [NAMES[0], NAMES[1]]
    assert_same_bytes(load_map(maps / NAMES[0])[0].export_state(), state_of(robot))
    autosave.save_if_changed()
    assert autosave.counts == (3, 0)


def test_a_failing_autosave_is_counted_and_tried_again(make_robot, maps) -> None:
    maps.write_text("a file where the directory should be")
    robot = make_robot(**{"node.map_directory": str(maps), "node.autosave_period_s": 0.05})
    robot.map(wall_frame(STAMP_NS))
    wait_until(lambda: robot.mapper.autosave.counts[1] >= 2, "two failures")
    maps.unlink()
    wait_until(lambda: robot.mapper.autosave.counts[0] == 1, "saved at last")
    load_map(maps / NAMES[0])


def test_autosave_can_be_switched_on_while_the_node_runs_and_clean_up_saves_a_last_time(make_robot, maps) -> None:
    robot = make_robot(**{"node.map_directory": str(maps)})
    robot.map(wall_frame(STAMP_NS))
    assert robot.mapper.set_parameters([Parameter("node.autosave_period_s", value=3600.0)])[0].successful
    state = state_of(robot)
    robot.mapper.trigger_shutdown()
    assert_same_bytes(load_map(maps / NAMES[0])[0].export_state(), state)


def test_a_last_save_that_takes_too_long_is_left_to_itself_and_completes(make_robot, maps, gate, monkeypatch, capfd) -> None:
    save = map_store.save_map

    def slow(*arguments: Any) -> int:
        gate.pass_through()
        return save(*arguments)

    robot = make_robot(**{"node.map_directory": str(maps), "node.autosave_period_s": 3600.0})
    robot.map(wall_frame(STAMP_NS))
    state = state_of(robot)
    monkeypatch.setattr(map_store, "save_map", slow)
    limit(robot, 0.2)
    robot.mapper.trigger_shutdown()
    assert robot.mapper.session is None
    assert "the last save goes on" in capfd.readouterr().err
    assert list_maps(maps) == []
    gate.open()
    wait_until(lambda: list_maps(maps) == [NAMES[0]], "the save completed")
    assert_same_bytes(load_map(maps / NAMES[0])[0].export_state(), state)
