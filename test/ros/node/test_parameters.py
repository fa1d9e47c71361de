"""The schema is what ROS sees."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from fus3dmaps_core.config.schema import Config, fields
from fus3dmaps_core.config.section import Changes, when_it_changes
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_ros.node.parameters import declare_parameters, follow_changes, unknown_overrides


@contextlib.contextmanager
def node_with(**overrides: object) -> Iterator[Node]:
    context = Context()
    rclpy.init(args=[], context=context)
    parameters = [Parameter(name, value=value) for name, value in overrides.items()]
    node = Node("declares", context=context, parameter_overrides=parameters)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_every_key_is_declared_with_default_and_description() -> None:
    with node_with() as node:
        assert declare_parameters(node) == Config()
        for key, field in fields().items():
            value = node.get_parameter(key).value
            assert (list(value) if isinstance(field.default, list) else value) == field.default
            descriptor = node.describe_parameter(key)
            assert descriptor.description == field.description
            changes = when_it_changes(field)
            assert descriptor.read_only == (changes == Changes.NEVER)
            told = "while the node is unconfigured" in descriptor.additional_constraints
            assert told == (changes == Changes.UNCONFIGURED)


def test_bounds_are_ranges() -> None:
    with node_with() as node:
        declare_parameters(node)
        share = node.describe_parameter("segmenter.max_border_contact").floating_point_range[0]
        assert (share.from_value, share.to_value) == (0.0, 1.0)
        hypotheses = node.describe_parameter("map.max_hypotheses").integer_range[0]
        assert (hypotheses.from_value, hypotheses.to_value) == (1, 16)
        assert node.describe_parameter("node.queue_size").integer_range[0].from_value == 1
        assert "> 0.0" in node.describe_parameter("map.voxel_size_m").additional_constraints
        assert "float16" in node.describe_parameter("map.dtype").additional_constraints


def test_overrides_reach_the_configuration() -> None:
    pose = [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]
    with node_with(
        **{"map.voxel_size_m": 0.1, "query.top_k": 9, "input.T_body_camera": pose, "map.dtype": "float16"}
    ) as node:
        config = declare_parameters(node)
    assert config == Config().with_values(
        {"map.voxel_size_m": 0.1, "query.top_k": 9, "input.T_body_camera": pose, "map.dtype": "float16"}
    )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("map.voxel_size_m", 0.0),  # ROS's closed range lets the open bound through, the schema does not
        ("map.voxel_size_m", -1.0),
        ("map.voxel_size_m", 11.0),
        ("map.voxel_size_m", float("nan")),
        ("keyframes.dense_translation_m", float("inf")),
        ("map.voxel_size_m", "large"),
        ("map.voxel_size_m", 1),
        ("map.max_hypotheses", 0),
        ("map.max_hypotheses", 2.5),
        ("map.dtype", "float8"),
        ("input.map_frame", ""),
        ("input.T_body_camera", [1.0]),
        ("input.rgb_qos", "fast"),
    ],
)
def test_a_wrong_value_is_refused_by_name(key, value) -> None:
    with node_with(**{key: value}) as node, pytest.raises(ConfigError, match=key.replace(".", r"\.")) as refusal:
        declare_parameters(node)
    assert "\n" not in str(refusal.value)


def test_a_misspelt_parameter_is_pointed_out() -> None:
    with node_with(**{"map.voxelsize_m": 0.1, "use_sim_time": True, "other_node.rate": 1}) as node:
        declare_parameters(node)
        (sentence,) = unknown_overrides(node)
    assert "map.voxelsize_m" in sentence
    assert "map.voxel_size_m" in sentence


def test_run_time_changes_are_checked_and_applied() -> None:
    with node_with() as node:
        state = [declare_parameters(node)]
        follow_changes(node, lambda: state[-1], state.append)
        assert node.set_parameters([Parameter("query.top_k", value=3)])[0].successful
        assert state[-1].query.top_k == 3
        for key, value in (("query.top_k", 0), ("map.voxel_size_m", 0.2), ("node.autostart", False)):
            result = node.set_parameters([Parameter(key, value=value)])[0]
            assert not result.successful
            assert key in result.reason
        assert not node.set_parameters([Parameter("query.top_k", value="many")])[0].successful
        assert state[-1] == Config().with_values({"query.top_k": 3})


def test_what_shapes_the_map_can_change_until_there_is_one() -> None:
    with node_with() as node:
        state, configured = [declare_parameters(node)], [False]
        follow_changes(node, lambda: state[-1], state.append, lambda: configured[0])
        pose = [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]
        for key, value in (("map.voxel_size_m", 0.2), ("encoder.name", "huge"), ("input.T_body_camera", pose)):
            assert node.set_parameters([Parameter(key, value=value)])[0].successful
            assert state[-1].flat()[key] == value
        configured[0] = True
        result = node.set_parameters([Parameter("map.voxel_size_m", value=0.3)])[0]
        assert not result.successful
        assert "while the node is unconfigured" in result.reason
        # Setting what is set already, as tools do that restore a whole file, is no change.
        assert node.set_parameters([Parameter("map.voxel_size_m", value=0.2)])[0].successful
        assert state[-1].map.voxel_size_m == 0.2


def test_a_refused_parameter_of_several_set_at_once_leaves_all_as_they_were() -> None:
    with node_with() as node:
        state = [declare_parameters(node)]
        follow_changes(node, lambda: state[-1], state.append)
        both = [Parameter("query.top_k", value=3), Parameter("map.voxel_size_m", value=0.2)]
        assert not node.set_parameters_atomically(both).successful
        assert state[-1] == Config()
