"""``fus3dmaps encoders``: its table, its JSON, and what it takes from the configuration."""

from __future__ import annotations

import json
import sys

import pytest
import torch

from fus3dmaps_core.encoders import registry
from fus3dmaps_core.encoders.cards import EncoderCard
from fus3dmaps_ros.commands import cli
from fus3dmaps_ros.commands.terminal import OUT

KEYS = {
    "name",
    "summary",
    "dimension",
    "variance_ratio",
    "patch_px",
    "grid",
    "code_licence",
    "weights",
    "packages",
    "code",
    "installed",
    "missing",
}


@pytest.fixture(autouse=True)
def empty_caches(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "torch_hub"))


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs the command in this process: exit code, stdout, stderr."""

    def command(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["fus3dmaps", "encoders", *map(str, arguments)])
        monkeypatch.setattr(OUT, "_width", 300)
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return int(ended.value.code or 0), *capsys.readouterr()

    return command


def listed(run, *arguments: object) -> dict[str, dict]:
    code, out, _ = run("--json", *arguments)
    assert code == 0
    return {entry["name"]: entry for entry in json.loads(out)}


def test_json_has_every_trio_with_the_same_keys(run):
    entries = listed(run)
    assert list(entries) == registry.names()
    for entry in entries.values():
        assert set(entry) == KEYS
        assert entry["weights"]
        for part in (*entry["weights"], *([entry["code"]] if entry["code"] else [])):
            assert set(part) == {"title", "licence", "source", "path", "put_at"}
        for package in entry["packages"]:
            assert set(package) == {"name", "installed", "problem"}
            assert package["installed"] == (package["problem"] is None)
    assert (entries["clip_dinoiser"]["dimension"], entries["clip_dinoiser"]["variance_ratio"]) == (512, 5.0)
    assert entries["clip_dinoiser"]["grid"] == [30, 40]
    assert entries["lite"]["installed"]
    assert entries["lite"]["missing"] == []
    assert entries["naradio"]["code"]["path"] is None


def test_the_grid_is_that_of_the_configured_image(run, tmp_path):
    assert listed(run, "--set", "image.height=240", "--set", "image.width=330")["clip_dinoiser"]["grid"] == [15, 21]
    parameters = tmp_path / "parameters.yaml"
    parameters.write_text("image: {height: 96, width: 128}\n")
    assert listed(run, "--params-file", parameters)["lite"]["grid"] == [6, 8]


@pytest.mark.parametrize("by", ["--weights", "--set"])
def test_weights_are_looked_for_where_they_are_said_to_be(run, tmp_path, by):
    path = tmp_path / "weights" / "open_clip_model.safetensors"
    path.parent.mkdir()
    path.write_bytes(b"x")
    value = path.parent if by == "--weights" else f"encoder.weights={path.parent}"
    clip, heads = listed(run, by, value)["clip_dinoiser"]["weights"]
    assert clip["path"] == str(path)
    assert heads["path"] is None
    assert heads["source"].startswith("https://")
    assert heads["put_at"] == str(tmp_path / "cache/fus3dmaps/clip-dinoiser-heads/last.pt")


def test_no_weights_are_those_that_the_authors_published(run):
    assert listed(run, "--set", "encoder.weights=") == listed(run)


def test_the_table_says_what_is_missing_and_what_to_do(run):
    code, out, _ = run()
    assert code == 0
    table = [line for line in out.splitlines() if "30 x 40" in line]
    rows = dict(zip((line.split()[0] for line in table), table, strict=True))
    assert list(rows) == registry.names()
    assert rows["lite"].split()[-1] == "yes"
    assert rows["clip_dinoiser"].split()[1:3] == ["512", "5"]
    for name in ("clip_dinoiser", "naradio", "radseg"):
        assert "no, lacks" in rows[name]
    assert rows["naradio"].count("research and evaluation only") == 2
    assert "NVIDIA Open Model License; Apache-2.0" in rows["radseg"]
    assert rows["radseg"].rstrip().endswith("3 files, code")
    assert "RADIO's code: https://github.com/NVlabs/RADIO/archive/" in out
    assert "encoder.name=NAME" in out
    assert "now it is lite" in out


def test_a_broken_trio_is_a_row_of_its_own(run, monkeypatch):
    whole = registry.card

    def card(name: str) -> EncoderCard:
        if name == "radseg":
            raise SyntaxError("invalid [bold]syntax")
        return whole(name)

    monkeypatch.setattr(registry, "card", card)
    code, out, _ = run()
    assert code == 0
    assert "radseg: cannot be imported: SyntaxError: invalid [bold]syntax" in out
    entry = listed(run)["radseg"]
    assert set(entry) == KEYS
    assert entry["dimension"] is None
    assert not entry["installed"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--weights", "/no/such/place"), "no file or directory '/no/such/place'"),
        (("--set", "image.height=0"), "image.height"),
        (("--set", "encoder.name=foo"), f"unknown encoder 'foo', known are {', '.join(registry.names())}"),
        (("--json", "--set", "encoder.name="), "encoder.name': unknown encoder ''"),
        (("--set", "image.height"), "expected key=value"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(run, arguments, said):
    code, out, err = run(*arguments)
    assert code == 1
    assert out == ""
    assert said in err
    assert len(err.strip().splitlines()) == 1
