"""The schema: dotted keys, refusals that name the parameter, and YAML in both shapes."""

from pathlib import Path

import pytest

from fus3dmaps_core.config.schema import Config, fields
from fus3dmaps_core.config.section import Changes, when_it_changes
from fus3dmaps_core.errors import ConfigError


def test_defaults_are_the_papers():
    flat = Config().flat()
    paper = {
        "map.voxel_size_m": 0.05,
        "map.max_hypotheses": 3,
        "map.iou_threshold": 0.2,
        "keyframes.dense_translation_m": 0.08,
        "keyframes.dense_rotation_rad": 0.06,
        "keyframes.instance_translation_m": 0.14,
        "keyframes.instance_rotation_rad": 0.11,
        "sampling.dense_per_patch": 5,
        "sampling.instance_per_patch": 9,
        "image.width": 640,
        "image.height": 480,
        "fusion.period_frames": 5,
        "fusion.keep_most_evidence": True,
        "map.association": "iou",
        "map.merge_overlap": 0.0,
    }
    assert {key: flat[key] for key in paper} == paper


def test_flat_keys_are_the_fields_and_round_trip():
    config = Config.from_flat({"map.voxel_size_m": 0.1, "encoder.device": "cuda:0"})
    assert list(config.flat()) == list(fields())
    assert Config.from_flat(config.flat()) == config
    assert config.with_values({"query.top_k": 9}).flat() == {**config.flat(), "query.top_k": 9}


def test_what_can_change_while_the_node_runs():
    def keys(changes: Changes) -> set[str]:
        return {key for key, field in fields().items() if when_it_changes(field) == changes}

    assert keys(Changes.ANY_TIME) == {
        *(f"segmenter.{name}" for name in ("min_area_px", "max_border_contact", "max_masks")),
        *(f"keyframes.{layer}_{motion}" for layer in ("dense", "instance") for motion in ("translation_m", "rotation_rad")),
        "map.memory_budget_mib",
        "fusion.period_frames",
        "query.top_k",
        "query.min_voxels",
        *(f"node.{name}_period_s" for name in ("publish", "status", "autosave")),
        "node.service_timeout_s",
        "node.map_directory",
    }
    assert keys(Changes.NEVER) == {"node.autostart"}


def test_every_field_is_described():
    assert [key for key, field in fields().items() if not field.description] == []


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"map.voxel_size": 0.1}, "map.voxel_size"),
        ({"map.voxel_size_m": -1.0}, "map.voxel_size_m"),
        ({"map.voxel_size_m": float("nan")}, "map.voxel_size_m"),
        ({"map.max_hypotheses": 0}, "map.max_hypotheses"),
        ({"map.dtype": "int3"}, "map.dtype"),
        ({"map.association": "visible"}, "map.association"),
        ({"map.merge_overlap": 1.01}, "map.merge_overlap"),
        ({"map.merge_cosine": -1.5}, "map.merge_cosine"),
        ({"fusion.keep_most_evidence": "perhaps"}, "fusion.keep_most_evidence"),
        ({"input.T_body_camera": [0.0, 1.0]}, "input.T_body_camera"),
        ({"map": 3}, "map"),
    ],
)
def test_refusals_name_the_parameter(values, named):
    with pytest.raises(ConfigError, match=named):
        Config.from_flat(values)


@pytest.mark.parametrize("wrap", [False, True])
def test_yaml_of_ros_and_plain(tmp_path: Path, wrap: bool):
    body = "map:\n  voxel_size_m: 0.2\nnode: {queue_size: 7}\n"
    if wrap:
        body = "/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in body.splitlines())
    path = tmp_path / "p.yaml"
    path.write_text(body)
    config = Config.from_yaml(path)
    assert (config.map.voxel_size_m, config.node.queue_size) == (0.2, 7)


@pytest.mark.parametrize("text", ["map: [", "- 1\n- 2\n", "map: {nothing: 1}\n"])
def test_unusable_yaml_names_the_file(tmp_path: Path, text: str):
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"broken\.yaml"):
        Config.from_yaml(path)


def test_missing_yaml_names_the_file(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"absent\.yaml"):
        Config.from_yaml(tmp_path / "absent.yaml")
