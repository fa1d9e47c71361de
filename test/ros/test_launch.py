"""The launch file, against stand-ins of the launch packages, and what RViz and Foxglove are told to show."""

from __future__ import annotations

import ast
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml

from fus3dmaps_core.config.schema import Config, fields
from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.mapper_node import NODE_NAME

ROOT = Path(__file__).resolve().parents[2]
CONFIG = "/share/fus3dmaps_ros/config"


class Recorded:
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


class DeclareLaunchArgument(Recorded): ...


class LaunchDescription(Recorded): ...


class Node(Recorded): ...


class OpaqueFunction(Recorded): ...


class ParameterValue(Recorded):
    def read(self) -> Any:
        assert self.kwargs == {"value_type": str}
        return self.args[0]


@pytest.fixture
def description(monkeypatch) -> LaunchDescription:
    modules = {
        "ament_index_python": {},
        "ament_index_python.packages": {"get_package_share_directory": lambda package: f"/share/{package}"},
        "launch": {"LaunchDescription": LaunchDescription},
        "launch.actions": {"DeclareLaunchArgument": DeclareLaunchArgument, "OpaqueFunction": OpaqueFunction},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Node},
        "launch_ros.parameter_descriptions": {"ParameterValue": ParameterValue},
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


def arguments_of(description: LaunchDescription) -> dict[str, dict[str, Any]]:
    return {entity.args[0]: entity.kwargs for entity in description.args[0] if isinstance(entity, DeclareLaunchArgument)}


class Reads(dict):
    """Remembers what was asked for."""

    def __init__(self, values: dict[str, str]) -> None:
        super().__init__(values)
        self.asked: set[str] = set()

    def __getitem__(self, key: str) -> str:
        self.asked.add(key)
        return super().__getitem__(key)


def launch(description: LaunchDescription, **given: str) -> dict[str, Node]:
    """The nodes that start where arguments are given, by package."""
    arguments = arguments_of(description)
    assert given.keys() <= arguments.keys()
    for name, value in given.items():
        assert value in arguments[name].get("choices", [value])
    values = Reads({name: options["default_value"] for name, options in arguments.items()} | given)
    (opaque,) = (entity for entity in description.args[0] if isinstance(entity, OpaqueFunction))
    nodes = opaque.kwargs["function"](SimpleNamespace(launch_configurations=values))
    if {"rviz", "foxglove"} <= given.keys():
        assert values.asked == set(arguments)
    return {node.kwargs["package"]: node for node in nodes}


def parameters(node: Node) -> tuple[list[str], dict[str, Any]]:
    """Files, in order, and values of a node."""
    *files, values = node.kwargs["parameters"]
    return files, {name: value.read() if isinstance(value, ParameterValue) else value for name, value in values.items()}


def test_the_mapper_alone_with_its_defaults(description) -> None:
    nodes = launch(description)
    assert list(nodes) == ["fus3dmaps_ros"]
    mapper = nodes["fus3dmaps_ros"].kwargs
    assert (mapper["executable"], mapper["name"], mapper["namespace"]) == ("mapper", NODE_NAME, "")
    assert "mapper = fus3dmaps_ros.mapper_node:main" in (ROOT / "setup.py").read_text()
    assert parameters(nodes["fus3dmaps_ros"]) == ([f"{CONFIG}/fus3dmaps.yaml"], {"use_sim_time": False})


def test_every_argument_is_described_has_a_default_and_is_used(description) -> None:
    arguments = arguments_of(description)
    assert all(options["description"] and isinstance(options["default_value"], str) for options in arguments.values())
    assert all(options["default_value"] in options["choices"] for options in arguments.values() if "choices" in options)
    assert {"camera", "encoder", "device", "window_radius_m", "use_sim_time", "namespace", "rviz", "foxglove"} <= set(
        arguments
    )
    launch(description, rviz="true", foxglove="true")


def test_there_is_a_camera_for_every_preset(description) -> None:
    presets = {path.stem for path in (ROOT / "config" / "presets").glob("*.yaml")}
    assert set(arguments_of(description)["camera"]["choices"]) == presets | {"none"}


def test_the_users_own_file_wins_over_the_preset_and_arguments_over_both(description) -> None:
    nodes = launch(description, camera="d435", params_file="/home/me/mine.yaml", rgb_topic="7", window_radius_m="6")
    files, values = parameters(nodes["fus3dmaps_ros"])
    assert files == [f"{CONFIG}/fus3dmaps.yaml", f"{CONFIG}/presets/d435.yaml", "/home/me/mine.yaml"]
    assert values == {"input.rgb_topic": "7", "fusion.window_radius_m": 6.0, "use_sim_time": False}
    assert isinstance(values["fusion.window_radius_m"], float)


def test_every_argument_sets_parameters_that_exist(description) -> None:
    given = {
        "encoder": "lite",
        "device": "cuda:0",
        "rgb_topic": "/a",
        "depth_topic": "/b",
        "camera_info_topic": "/c",
        "pose_source": "odometry",
        "pose_topic": "/d",
        "pose_with_covariance_topic": "/e",
        "odometry_topic": "/f",
        "window_radius_m": "6.5",
        "use_sim_time": "True",
        "autostart": "False",
    }
    _, values = parameters(launch(description, **given)["fus3dmaps_ros"])
    assert values.pop("use_sim_time") is True
    assert values.keys() <= fields().keys()
    config = Config.from_flat(values)
    assert (config.encoder.name, config.encoder.device, config.map.device) == ("lite", "cuda:0", "cuda:0")
    assert (config.input.rgb_topic, config.input.depth_topic, config.input.camera_info_topic) == ("/a", "/b", "/c")
    assert (config.input.pose_topic, config.input.pose_with_covariance_topic, config.input.odometry_topic) == (
        "/d",
        "/e",
        "/f",
    )
    assert (config.input.pose_source, config.fusion.window_radius_m) == ("odometry", 6.5)
    assert config.node.autostart is False
    assert given.keys() == arguments_of(description).keys() - {
        "camera",
        "params_file",
        "namespace",
        "log_level",
        "rviz",
        "foxglove",
    }


@pytest.mark.parametrize(("given", "set_to"), [("true", True), ("True", True), ("false", False), ("", None)])
def test_autostart_is_what_the_files_say_unless_it_is_given(description, given, set_to) -> None:
    _, values = parameters(launch(description, autostart=given)["fus3dmaps_ros"])
    assert values.get("node.autostart") is set_to


def test_rviz_and_foxglove_start_where_asked(description) -> None:
    nodes = launch(description, rviz="true", foxglove="true", use_sim_time="true")
    assert list(nodes) == ["fus3dmaps_ros", "rviz2", "foxglove_bridge"]
    assert nodes["rviz2"].kwargs["arguments"] == ["-d", f"{CONFIG}/fus3dmaps.rviz"]
    assert nodes["rviz2"].kwargs["remappings"] == []
    assert nodes["rviz2"].kwargs["parameters"] == nodes["foxglove_bridge"].kwargs["parameters"] == [{"use_sim_time": True}]


@pytest.mark.parametrize("namespace", ["robot", "/robot", "/robot/"])
def test_rviz_finds_a_mapper_in_a_namespace(description, namespace) -> None:
    nodes = launch(description, rviz="true", namespace=namespace)
    assert nodes["fus3dmaps_ros"].kwargs["namespace"] == namespace
    remappings = dict(nodes["rviz2"].kwargs["remappings"])
    assert remappings == {topic: f"/robot{topic}" for topic in rviz_topics()}


def published() -> dict[str, str]:
    """Type by topic of everything that the sources of the node publish, at the node's name without a namespace."""
    found: dict[str, str] = {}
    for path in (ROOT / "fus3dmaps_ros").rglob("*.py"):
        if path.name == "player_node.py":
            continue
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "create_publisher":
                message, topic = call.args[:2]
                if isinstance(topic, ast.Constant):
                    found[topic.value.replace("~", f"/{NODE_NAME}")] = ast.unparse(message).rpartition(".")[2]
    return found


def displayed() -> dict[str, str]:
    """Those of them that are something to look at: all but the report of how the node fares."""
    return {topic: kind for topic, kind in published().items() if kind not in ("MapperStatus", "DiagnosticArray")}


def rviz_displays() -> list[dict[str, Any]]:
    return yaml.safe_load((ROOT / "config" / "fus3dmaps.rviz").read_text())["Visualization Manager"]["Displays"]


def rviz_topics() -> set[str]:
    return {display["Topic"]["Value"] for display in rviz_displays() if "Topic" in display}


def test_rviz_shows_everything_to_look_at_as_what_it_is() -> None:
    shown = {
        display["Topic"]["Value"]: display["Class"].rpartition("/")[2] for display in rviz_displays() if "Topic" in display
    }
    assert {topic.rpartition("/")[2] for topic in shown} >= {"map", "labels", "similarity", "instances", "answer", "path"}
    assert shown == displayed()


def test_rviz_does_without_the_package_of_the_detections() -> None:
    """Of which ~/answer shows the same: a display whose plugin is missing says so in the list, no more."""
    plugins = {
        display["Name"]: (display["Class"].partition("/")[0], display["Enabled"])
        for display in rviz_displays()
        if not display["Class"].startswith("rviz_default_plugins/")
    }
    assert plugins == {"Detections": ("vision_msgs_rviz_plugins", False)}


def test_of_clouds_in_one_place_the_answer_is_outermost() -> None:
    """Boxes a little larger than those of the map: labels cover it, and the similarities of a question both."""
    sizes = {display["Name"]: display["Size (m)"] for display in rviz_displays() if "Size (m)" in display}
    assert sizes["Map"] == Config().map.voxel_size_m < sizes["Labels"] < sizes["Similarity"]


def test_rviz_asks_for_latched_topics_in_the_frame_of_the_map_and_shows_tf() -> None:
    topics = [display["Topic"] for display in rviz_displays() if "Topic" in display]
    assert {(topic["Reliability Policy"], topic["Durability Policy"]) for topic in topics} == {
        ("Reliable", "Transient Local")
    }
    assert "rviz_default_plugins/TF" in {display["Class"] for display in rviz_displays()}
    view = yaml.safe_load((ROOT / "config" / "fus3dmaps.rviz").read_text())
    assert view["Visualization Manager"]["Global Options"]["Fixed Frame"] == Config().input.map_frame


@pytest.fixture
def layout() -> dict[str, Any]:
    return json.loads((ROOT / "config" / "fus3dmaps_foxglove.json").read_text())


def panels_in(tree: Any) -> list[str]:
    return [tree] if isinstance(tree, str) else panels_in(tree["first"]) + panels_in(tree["second"])


def test_foxglove_lays_out_every_panel_once(layout) -> None:
    panels = panels_in(layout["layout"])
    assert sorted(panels) == sorted(layout["configById"])
    assert sorted(panel.partition("!")[0] for panel in panels) == ["3D", "CallService", "DiagnosticSummary", "Image"]


def test_foxglove_shows_what_the_node_publishes(layout) -> None:
    panels = layout["configById"]
    assert set(panels["3D!map"]["topics"]) == displayed().keys()
    assert panels["3D!map"]["followTf"] == Config().input.map_frame
    assert panels["DiagnosticSummary!health"]["topicToRender"] == "/diagnostics"
    inputs = Config().input
    image = panels["Image!rgb"]["imageMode"]
    assert (image["imageTopic"], image["calibrationTopic"]) == (f"/{inputs.rgb_topic}", f"/{inputs.camera_info_topic}")


def test_foxglove_asks_a_question_that_the_service_takes(layout) -> None:
    panel = layout["configById"]["CallService!query"]
    assert panel["serviceName"] == f"/{NODE_NAME}/query_text"
    payload = json.loads(panel["requestPayload"])
    assert payload.keys() <= QueryText.Request.get_fields_and_field_types().keys()
    request = QueryText.Request(**payload)
    assert request.prompts
    assert request.publish
