"""The shipped parameter file is the schema's."""

from __future__ import annotations

from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.node import Node

from fus3dmaps_core.config.schema import Config, fields
from fus3dmaps_ros.commands.parameter_file import yaml_with_comments
from fus3dmaps_ros.node.parameters import declare_parameters

SHIPPED = Path(__file__).resolve().parents[3] / "config" / "fus3dmaps.yaml"


def test_the_shipped_file_is_up_to_date() -> None:
    assert SHIPPED.read_text() == yaml_with_comments(Config()), (
        "run: python -m fus3dmaps_ros.commands.parameter_file > config/fus3dmaps.yaml"
    )


def test_every_description_is_in_it() -> None:
    text = SHIPPED.read_text()
    assert all(str(field.description) in text for field in fields().values())


def test_the_command_line_reads_it_back(tmp_path) -> None:
    changed = Config().with_values({"map.voxel_size_m": 1.0, "input.map_frame": 'a "quoted" näme', "map.dtype": "float16"})
    path = tmp_path / "changed.yaml"
    path.write_text(yaml_with_comments(changed))
    assert Config.from_yaml(path) == changed
    assert Config.from_yaml(SHIPPED) == Config()


def test_ros_reads_it_back(tmp_path) -> None:
    changed = Config().with_values(
        {"map.voxel_size_m": 1.0, "query.top_k": 3, "input.T_body_camera": [0.0, 0, 0, 0, 0, 0, 1]}
    )
    path = tmp_path / "changed.yaml"
    path.write_text(yaml_with_comments(changed))
    context = Context()
    rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    node = Node("fus3dmaps", context=context)
    try:
        assert declare_parameters(node) == changed
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
