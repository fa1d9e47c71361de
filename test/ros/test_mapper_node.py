"""The node as a whole: refusals, status, parameters at run time."""

from __future__ import annotations

import sys
from typing import Any

import pytest
from rclpy.parameter import Parameter
from robot import stand_in_pipeline, wait_until
from sensor_msgs.msg import PointCloud2
from stand_ins import wall_frame

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_msgs.msg import MapperStatus
from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.mapper_node import main

START_NS = 1_700_000_000 * 10**9


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--ros-args", "-p", "map.voxel_size_m:=-1.0"], "map.voxel_size_m"),
        (["--ros-args", "-p", "map.voxel_size_m:=1"], "map.voxel_size_m"),
        (["--ros-args", "-p", "input.rgb_qos:=fast"], "input.rgb_qos"),
        (["--ros-args", "-r", "__ns:=/not a name"], "not a name"),
        (["--ros-args", "-p", "input.rgb_topic:=not a topic"], "not a topic"),
        (["--ros-args", "--params-file", "/nowhere/at/all.yaml"], "/nowhere/at/all.yaml"),
        (["--ros-args", "--frobnicate"], "--frobnicate"),
        (["--frobnicate"], "--frobnicate"),
    ],
)
def test_a_refusal_is_one_line_and_exit_code_one(signals, capfd, arguments, named) -> None:
    assert main(arguments, stand_in_pipeline) == 1
    output = capfd.readouterr().err
    assert "Traceback" not in output
    (line,) = [line for line in output.splitlines() if line.startswith("fus3dmaps: ")]
    assert named in line


def test_a_model_that_cannot_be_loaded_is_a_refusal_too(signals, capfd) -> None:
    def fail(config):
        raise EncoderError("parameter 'encoder.name': unknown encoder 'huge'")

    assert main([], fail) == 1
    assert "fus3dmaps: parameter 'encoder.name': unknown encoder 'huge'" in capfd.readouterr().err


@pytest.mark.parametrize("source", ["pose_source", "extrinsic_source"])
def test_tf_without_its_package_is_refused_before_the_models_are_loaded(signals, capfd, monkeypatch, source) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)  # As if it were not installed.
    arguments = ["--ros-args", "-p", f"input.{source}:=tf", "-p", "input.body_frame:=base_link"]
    assert main(arguments, lambda config: pytest.fail("models were loaded")) == 1
    output = capfd.readouterr().err
    assert "Traceback" not in output
    (line,) = [line for line in output.splitlines() if line.startswith("fus3dmaps: ")]
    assert f"input.{source}" in line
    assert "apt install ros-jazzy-tf2-ros-py" in line


def test_a_signal_while_models_load_is_a_clean_end(signals, capfd) -> None:
    def interrupted(config):
        raise KeyboardInterrupt

    assert main([], interrupted) == 0
    assert "Traceback" not in capfd.readouterr().err


def test_the_status_line_tells_what_was_mapped(robot) -> None:
    assert "0 frames" in robot.mapper.status()
    robot.map(wall_frame(START_NS))
    robot.show(wall_frame(START_NS + 10**9))  # the same pose: no keyframe
    robot.map(wall_frame(START_NS + 2 * 10**9, x_m=0.5))
    semantic_map = robot.mapper.pipeline.semantic_map
    assert robot.mapper.status() == (
        "3 frames, 1 not keyframes, 2 dense and 2 instance keyframes, 0 waiting; dropped: none; "
        f"{semantic_map.voxel_count} voxels, {semantic_map.instance_count} instances"
    )


def test_top_k_changes_at_run_time(robot) -> None:
    robot.map(wall_frame(START_NS))
    assert len(robot.call(QueryText, "query_text", prompts=["red"]).instances) > 1
    assert robot.mapper.set_parameters([Parameter("query.top_k", value=1)])[0].successful
    assert len(robot.call(QueryText, "query_text", prompts=["red"]).instances) == 1


def test_a_memory_budget_changes_at_run_time(make_robot) -> None:
    # Few samples: a keyframe's worth of dense voxels, which a budget never goes below, is little.
    robot = make_robot(**{"sampling.dense_per_patch": 1, "sampling.instance_per_patch": 1})
    for index in range(5):
        robot.map(wall_frame(START_NS + index * 10**9, x_m=1.5 * index))
    semantic_map = robot.mapper.pipeline.semantic_map
    dense = semantic_map.dense_voxel_count
    assert robot.mapper.set_parameters([Parameter("map.memory_budget_mib", value=0.01)])[0].successful
    robot.map(wall_frame(START_NS + 5 * 10**9, x_m=7.5))
    assert semantic_map.dense_voxel_count < dense
    assert robot.mapper.status_message().memory_budget_bytes == round(0.01 * 2**20)


def test_periods_change_at_run_time(make_robot) -> None:
    robot = make_robot(**{"node.status_period_s": 3600.0, "node.publish_period_s": 3600.0})
    robot.map(wall_frame(START_NS))
    statuses, clouds = robot.listen(MapperStatus, "status"), robot.listen(PointCloud2, "map")
    for name in ("node.status_period_s", "node.publish_period_s"):
        assert robot.mapper.set_parameters([Parameter(name, value=0.05)])[0].successful
    wait_until(lambda: len(statuses) > 1 and clouds, "status and map published")


def test_a_parameter_that_is_set_while_the_models_load_takes_effect(make_robot) -> None:
    robots: list[Any] = []

    def interrupted(config: Any) -> Pipeline:
        mapper = robots[0].mapper
        assert mapper.set_parameters([Parameter("keyframes.dense_translation_m", value=3.0)])[0].successful
        assert not mapper.set_parameters([Parameter("map.voxel_size_m", value=0.2)])[0].successful
        return stand_in_pipeline(config)

    robots.append(make_robot(interrupted, **{"node.autostart": False}))
    robots[0].mapper.bring_up()
    robots[0].mapper.worker.between_frames(lambda: None).result(60)
    assert robots[0].mapper.pipeline.config.keyframes.dense_translation_m == 3.0
    assert robots[0].mapper.pipeline.config.map.voxel_size_m == 0.05


def test_topics_and_services_have_their_names(mapped_robot) -> None:
    own = f"{mapped_robot.namespace}/fus3dmaps"
    topics = {
        name for name, _ in mapped_robot.user.get_publisher_names_and_types_by_node("fus3dmaps", mapped_robot.namespace)
    }
    assert {f"{own}/{name}" for name in ("map", "instances", "similarity", "path", "answer", "labels", "status")} <= topics
    services = {
        name for name, _ in mapped_robot.user.get_service_names_and_types_by_node("fus3dmaps", mapped_robot.namespace)
    }
    assert {
        f"{own}/{name}"
        for name in (
            "query_text",
            "query_image",
            "label_map",
            "list_instances",
            "fuse",
            "reset",
            "save_map",
            "load_map",
        )
    } <= services
