"""The node as a whole: refusals, status, parameters at run time."""

from __future__ import annotations

import pytest
from rclpy.parameter import Parameter
from robot import stand_in_pipeline
from stand_ins import wall_frame

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.mapper_node import main

START_NS = 1_700_000_000 * 10**9


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--ros-args", "-p", "map.voxel_size_m:=-1.0"], "map.voxel_size_m"),
        (["--ros-args", "-p", "map.voxel_size_m:=1"], "map.voxel_size_m"),
        (["--ros-args", "-p", "node.input_qos:=fast"], "node.input_qos"),
        (["--ros-args", "-r", "__ns:=/not a name"], "not a name"),
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


def test_topics_and_services_have_their_names(mapped_robot) -> None:
    own = f"{mapped_robot.namespace}/fus3dmaps"
    topics = {
        name for name, _ in mapped_robot.user.get_publisher_names_and_types_by_node("fus3dmaps", mapped_robot.namespace)
    }
    assert {f"{own}/{name}" for name in ("map", "instances", "similarity", "path")} <= topics
    services = {
        name for name, _ in mapped_robot.user.get_service_names_and_types_by_node("fus3dmaps", mapped_robot.namespace)
    }
    assert {f"{own}/{name}" for name in ("query_text", "fuse", "reset")} <= services
