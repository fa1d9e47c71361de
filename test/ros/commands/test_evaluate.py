"""``fus3dmaps evaluate``: what it refuses, and what it writes."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import ConfigError, Fus3dmapsError
from fus3dmaps_lab.evaluation import simulation_runs
from fus3dmaps_lab.evaluation.records import LAYERS
from fus3dmaps_lab.evaluation.simulation import Study
from fus3dmaps_ros.commands.evaluate import Destination, Evaluation, evaluate_target


@contextmanager
def no_bar(_: str) -> Iterator[object]:
    yield lambda done, total: None


def run(
    target: str,
    directory: Path | None = None,
    json_file: Path | None = None,
    report: Path | None = None,
    settings: dict[str, object] | None = None,
    **options: str,
) -> str:
    told = io.StringIO()
    console = Console(file=told, width=200)
    request = Evaluation(target, directory, 2, True, 2, options)
    evaluate_target(request, Config.from_flat(settings or {}), Destination(json_file, report, console), no_bar)
    return told.getvalue()


def test_a_simulation_is_tabled_and_written(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(simulation_runs, "QUICK", Study(rooms_per_storey=1, frames=16))
    told = run("simulation", json_file=tmp_path / "records.json", report=tmp_path / "report")
    assert "simulated building" in told
    assert "fused_instances" in told
    assert "±" in told
    records = json.loads((tmp_path / "records.json").read_text())
    assert set(records[0]) == {"scene", "seed", "layer", "mode", "metric", "value"}
    assert {record["seed"] for record in records} == {0, 1}
    assert {record["layer"] for record in records} == set(LAYERS)
    assert {record["mode"] for record in records} == {"full", "window", "window_no_evidence"}
    page = (tmp_path / "report" / "report.md").read_text()
    assert "fus3dmaps" in page
    assert "simulation" in page
    for name in ("records.csv",):
        assert (tmp_path / "report" / name).exists()


@pytest.mark.parametrize(
    ("target", "directory", "said"),
    [
        ("simulation", Path("/tmp"), "takes no directory"),
        ("replica", None, "directory is missing"),
        ("atlantis", Path("/tmp"), "atlantis"),
        ("sevenscenes", Path("/tmp"), "/tmp"),
        ("scannet", Path("/nowhere/at/all"), "/nowhere/at/all"),
    ],
)
def test_what_cannot_be_evaluated_is_refused_by_name(target, directory, said) -> None:
    with pytest.raises(Fus3dmapsError, match=said):
        run(target, directory)


def test_parameters_of_the_maps_reach_simulated_buildings(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(simulation_runs, "QUICK", Study(rooms_per_storey=1, frames=16))
    scores = {}
    for embeddings in ("crops", "patches"):
        file = tmp_path / f"{embeddings}.json"
        run("simulation", json_file=file, settings={"encoder.instance_embeddings": embeddings})
        scores[embeddings] = {
            (each["layer"], each["seed"]): each["value"]
            for each in json.loads(file.read_text())
            if (each["mode"], each["metric"]) == ("full", "accuracy")
        }
    for seed in (0, 1):
        assert scores["crops"]["dense", seed] == scores["patches"]["dense", seed]
        assert scores["crops"]["instances", seed] != scores["patches"]["instances", seed]


@pytest.mark.parametrize("key", ["encoder.name", "input.rgb_topic"])
def test_parameters_without_effect_on_simulated_buildings_are_refused_by_name(key) -> None:
    with pytest.raises(ConfigError, match=f"'{key}' has no effect"):
        run("simulation", settings={key: "something"})


def test_an_option_that_the_dataset_does_not_know_is_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="speed"):
        run("scannet", tmp_path, speed="9")


def test_plots_need_their_package(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr("fus3dmaps_ros.commands.evaluate.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"fus3dmaps_ros\[evaluation\]"):
        run("simulation", report=tmp_path)
