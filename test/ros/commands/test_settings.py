"""What the command line says about parameters: texts as they stand, all else as YAML, and no empty directory."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_ros.commands import cli
from fus3dmaps_ros.commands.settings import configuration, directory, pairs

TEXTS = ["", "a b", "12", "1e3", "2026-11-24", "yes", "null", "~", "[", "@x", "a: b", "/data/my #1/w.pt", "{}", "a=b"]


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("key", ["encoder.weights", "segmenter.weights", "encoder.graph_directory"])
def test_a_text_is_taken_as_it_stands(key, text):
    assert configuration(None, [f"{key}={text}"]).flat()[key] == text


@given(st.text(st.characters(blacklist_categories=("Cs",))).filter(lambda text: not text.strip().startswith(("'", '"'))))
def test_any_text_is_taken_but_for_the_space_around_it(text):
    assert configuration(None, [f"encoder.weights={text}"]).encoder.weights == text.strip()


@pytest.mark.parametrize(("text", "value"), [("' a '", " a "), ('"a\\tb"', "a\tb"), ("''", ""), (" lite ", "lite")])
def test_a_text_may_be_in_quotes(text, value):
    assert configuration(None, [f"encoder.name={text}"]).encoder.name == value


def test_all_else_is_yaml():
    config = configuration(
        None,
        [
            "map.voxel_size_m=0.1",
            "node.resume=yes",
            "image.width=64",
            "map.dtype=int8",
            "input.T_body_camera=[0, 0, 1, 0, 0, 0, 1]",
        ],
    )
    assert (config.map.voxel_size_m, config.node.resume, config.image.width, config.map.dtype) == (0.1, True, 64, "int8")
    assert config.input.T_body_camera == [0, 0, 1, 0, 0, 0, 1]


@pytest.mark.parametrize(
    "setting",
    [
        "map.voxel_size_m=",
        "map.voxel_size_m=[",
        "node.resume=",
        "map.dtype=",
        "map.size=1",
        "input.rgb_topic=",
        "encoder.name='a",
    ],
)
def test_what_is_no_value_is_refused_in_one_line_by_its_name(setting):
    with pytest.raises(ConfigError) as refusal:
        configuration(None, [setting])
    assert setting.partition("=")[0] in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_settings_go_before_those_of_the_file(tmp_path):
    (tmp_path / "p.yaml").write_text("encoder: {weights: /a, name: siglip2}")
    config = configuration(tmp_path / "p.yaml", ["encoder.weights="])
    assert config == Config().with_values({"encoder.name": "siglip2"})


def test_pairs_have_an_equals_sign():
    assert pairs("--option", [" a = 1", "b==", "a=2"]) == {"a": "2", "b": "="}
    assert pairs("--option", None) == {}
    with pytest.raises(ConfigError, match="--option stride: expected key=value"):
        pairs("--option", ["stride"])


@pytest.mark.parametrize("command", [("export",), ("map", "recording.mcap"), ("demo",)])
def test_every_command_refuses_a_directory_without_a_name(command, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["fus3dmaps", *command, "--out", ""])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    out, err = capsys.readouterr()
    assert (ended.value.code, out) == (1, "")
    assert err.startswith("fus3dmaps: --out: ")
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["", "  "])
def test_a_directory_without_a_name_is_refused(text):
    with pytest.raises(ConfigError, match="--out: the name of a directory is missing"):
        directory(text)


def test_any_other_directory_is_taken():
    assert directory(".") == Path()
    assert directory("a b/c") == Path("a b/c")
