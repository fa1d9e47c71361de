"""The presets of cameras: what the schema knows, over the defaults, and installed."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from fus3dmaps_core.config.schema import Config, fields

ROOT = Path(__file__).resolve().parents[2]
PRESETS = sorted((ROOT / "config" / "presets").glob("*.yaml"))
TOPICS = ("input.rgb_topic", "input.depth_topic", "input.camera_info_topic")


def values_of(path: Path) -> dict[str, object]:
    tree = yaml.safe_load(path.read_text())["/**"]["ros__parameters"]
    return {f"{section}.{name}": value for section, names in tree.items() for name, value in names.items()}


def test_there_is_a_preset_for_every_camera() -> None:
    assert {path.stem for path in PRESETS} == {"d435", "d455", "zed", "azure_kinect", "femto", "oak_d", "simulation"}


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.stem)
def test_a_preset_changes_only_what_it_says_over_the_defaults(path) -> None:
    values = values_of(path)
    assert values.keys() <= fields().keys()
    assert Config.from_yaml(path).flat() == {**Config().flat(), **values}


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.stem)
def test_a_preset_names_the_drivers_topics_and_its_release(path) -> None:
    values = values_of(path)
    # Names of a driver are absolute: they stay what they are in a namespace of the mapper's.
    assert all(str(values[topic]).startswith("/") for topic in TOPICS)
    assert len({values[topic] for topic in TOPICS}) == len(TOPICS)
    assert values["image.depth_min_m"] < values["image.depth_max_m"]
    comment = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert any(character.isdigit() for character in " ".join(comment))
    assert any("ros2 " in line for line in comment)


@pytest.mark.parametrize("path", PRESETS, ids=lambda path: path.stem)
def test_numbers_have_the_type_that_ros_parameters_are_declared_with(path) -> None:
    defaults = Config().flat()
    assert {name: type(value) for name, value in values_of(path).items()} == {
        name: type(defaults[name]) for name in values_of(path)
    }


def test_presets_are_installed_where_the_launch_file_looks(distribution) -> None:
    installed = dict(distribution.data_files)
    assert sorted(installed["share/fus3dmaps_ros/config/presets"]) == [f"config/presets/{path.name}" for path in PRESETS]
