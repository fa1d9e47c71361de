"""The launch file, against stand-ins of the launch packages, which are no part of a pip environment."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from fus3dmaps_core.config import Config
from fus3dmaps_ros.mapper_node import NODE_NAME

ROOT = Path(__file__).resolve().parents[2]


class Recorded:
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


class DeclareLaunchArgument(Recorded): ...


class IfCondition(Recorded): ...


class LaunchConfiguration(Recorded): ...


class LaunchDescription(Recorded): ...


class Node(Recorded): ...


@pytest.fixture
def description(monkeypatch) -> LaunchDescription:
    modules = {
        "ament_index_python": {},
        "ament_index_python.packages": {"get_package_share_directory": lambda package: f"/share/{package}"},
        "launch": {"LaunchDescription": LaunchDescription},
        "launch.actions": {"DeclareLaunchArgument": DeclareLaunchArgument},
        "launch.conditions": {"IfCondition": IfCondition},
        "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node},
    }
    for name, contents in modules.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("fus3dmaps_launch", ROOT / "launch" / "fus3dmaps.launch.py")
    assert spec is not None
    assert spec.loader is not None
    launch_file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(launch_file)
    return launch_file.generate_launch_description()


def of_kind(description: LaunchDescription, kind: type) -> list[Any]:
    return [entity for entity in description.args[0] if isinstance(entity, kind)]


def test_the_mapper_is_declared(description) -> None:
    mapper = next(node for node in of_kind(description, Node) if node.kwargs["package"] == "fus3dmaps_ros")
    assert (mapper.kwargs["executable"], mapper.kwargs["name"]) == ("mapper", NODE_NAME)
    setup = (ROOT / "setup.py").read_text()
    assert "mapper = fus3dmaps_ros.mapper_node:main" in setup


def test_every_configuration_used_is_an_argument_with_a_default(description) -> None:
    arguments = {argument.args[0]: argument.kwargs for argument in of_kind(description, DeclareLaunchArgument)}
    assert all(options["description"] for options in arguments.values())
    assert {
        "params_file",
        "namespace",
        "use_sim_time",
        "rgb_topic",
        "depth_topic",
        "camera_info_topic",
        "pose_topic",
    } <= set(arguments)
    used: set[str] = set()

    def collect(value: Any) -> None:
        if isinstance(value, LaunchConfiguration):
            used.add(value.args[0])
        elif isinstance(value, Recorded):
            collect([value.args, value.kwargs])
        elif isinstance(value, dict):
            collect(list(value.values()))
        elif isinstance(value, list | tuple):
            for item in value:
                collect(item)

    collect(of_kind(description, Node))
    assert used == set(arguments)
    assert arguments["params_file"]["default_value"] == "/share/fus3dmaps_ros/config/fus3dmaps.yaml"


def test_remaps_are_the_nodes_own_topics(description) -> None:
    mapper = of_kind(description, Node)[0]
    inputs = Config().input
    names = [inputs.rgb_topic, inputs.depth_topic, inputs.camera_info_topic, inputs.pose_topic, inputs.odometry_topic]
    assert [topic for topic, _ in mapper.kwargs["remappings"]] == names


def test_rviz_shows_what_the_node_publishes() -> None:
    view = yaml.safe_load((ROOT / "config" / "fus3dmaps.rviz").read_text())
    displays = view["Visualization Manager"]["Displays"]
    topics = {display["Topic"]["Value"]: display["Topic"] for display in displays if "Topic" in display}
    assert set(topics) == {f"/{NODE_NAME}/{name}" for name in ("map", "similarity", "instances", "path")}
    assert all(
        (topic["Reliability Policy"], topic["Durability Policy"]) == ("Reliable", "Transient Local")
        for topic in topics.values()
    )
    assert view["Visualization Manager"]["Global Options"]["Fixed Frame"] == Config().input.map_frame
