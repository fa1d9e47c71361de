"""A report shows all results, names missing ones, and is written completely or not at all."""

from __future__ import annotations

import csv
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from lab.evaluation.made_up_results import (
    all_points,
    association_points,
    lambda_points,
    made_up_records,
    memory_points,
    window_points,
)

from fus3dmaps_core.errors import StorageError
from fus3dmaps_lab.evaluation import report
from fus3dmaps_lab.evaluation.paper_tables import SCANNET, SCENES
from fus3dmaps_lab.evaluation.records import CurvePoint
from fus3dmaps_lab.evaluation.report import write_report
from fus3dmaps_lab.evaluation.statistics import ComparisonError

NOTES = {"command": "fus3dmaps evaluate simulation --seeds 5", "machine": "2 cores", "lambda": "Wide, since noise is small."}


def section(page, heading, level=2):
    """Return the text under a heading, up to the next one of its level or above."""
    found = re.search(rf"^{'#' * level} {re.escape(heading)}\n(.*?)(?=^#{{1,{level}}} |\Z)", page, re.M | re.S)
    assert found, heading
    return found[1]


def verdict_lines(page):
    return [line for line in section(page, "What the data say").splitlines() if line.startswith("- ")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Write a report on everything; return its directory and page."""
    directory = tmp_path_factory.mktemp("report") / "of" / "today"
    path = write_report(directory, made_up_records(), all_points(), NOTES)
    assert path == directory / "report.md"
    return directory, path.read_text()


def test_every_file_that_the_page_names_is_there_and_no_other(whole):
    directory, page = whole
    named = set(re.findall(r"\]\(([^)]+)\)", page))
    assert {path.name for path in directory.iterdir()} == named | {"report.md"}
    assert all("/" not in name for name in named)
    pictures = {name for name in named if name.endswith(".png")}
    assert pictures >= {f"{name}.png" for name in ("lambda", "memory", "window_radius", "association")}
    assert {f"simulation_{name}_classes.png" for name in ("instances", "dense")} <= pictures
    for name in pictures:
        assert cv2.imread(str(directory / name)) is not None


def test_the_page_says_how_it_was_made(whole):
    _, page = whole
    assert "```sh\nfus3dmaps evaluate simulation --seeds 5\n```" in page
    assert "- machine: 2 cores\n" in page
    assert page.count("Wide, since noise is small.") == 1
    assert "Wide, since noise is small." in section(page, "Lambda (simulation)")


def test_simulations_are_called_so_in_every_heading_and_verdict(whole):
    _, page = whole
    headings = [line for line in page.splitlines() if line.startswith("## ")]
    assert headings == [
        "## What the data say",
        "## Simulation",
        "## Lambda (simulation)",
        "## Memory (simulation)",
        "## Radius of the sliding window (simulation)",
        "## Association of proposals with instances (simulation)",
        "## Left out",
    ]
    assert len(verdict_lines(page)) == 4 + 1 + 2 + 1
    assert all("simulation" in line.lower() for line in verdict_lines(page))
    assert "no result on any dataset" in section(page, "Simulation")


def test_csv_files_hold_every_number(whole):
    directory, _ = whole
    with (directory / "records.csv").open(newline="") as file:
        lines = list(csv.DictReader(file, quoting=csv.QUOTE_NONNUMERIC))
    read = sorted((r["scene"], r["seed"], r["layer"], r["mode"], r["metric"], r["value"]) for r in lines)
    assert read == sorted((r.scene, r.seed, r.layer, r.mode, r.metric, r.value) for r in made_up_records())
    with (directory / "points.csv").open(newline="") as file:
        assert len(list(csv.reader(file))) == 1 + len(all_points())


def test_the_same_data_make_the_same_files(whole, tmp_path):
    directory, _ = whole
    write_report(tmp_path, made_up_records(), all_points(), NOTES)
    for path in directory.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_verdicts_turn_when_the_data_do(tmp_path):
    good = verdict_lines(write_report(tmp_path, made_up_records(), all_points(), {}).read_text())
    assert all(", holds: " in line for line in good)
    records = made_up_records(
        instances__full=0.6, fused_dense__full=0.3, fused_instances__window=0.3, fused_instances__window_no_evidence=0.5
    )
    points = [*lambda_points({0.2: 5.0}), *memory_points(1.5, window_share=0.9), *association_points(mIoU=-0.2)]
    bad = verdict_lines(write_report(tmp_path, records, points, {}).read_text())
    assert len(bad) == len(good)
    assert all(", does not hold: " in line for line in bad)


def test_recorded_scenes_stand_beside_the_papers_scores(tmp_path):
    records = [r for scene in SCENES[SCANNET] for r in made_up_records(scene, seeds=(0,))]
    page = write_report(tmp_path, records, [], {"encoders": "lite"}).read_text()
    beside = section(page, "Beside the paper", 3)
    assert "| ours | ScanNet | lite | fused_instances | window |" in beside
    assert "| paper | ScanNet | RayFronts | dense | full | 0.4129 |" in beside
    assert "simulat" not in section(page, SCANNET).lower()
    assert "Simulation: no record is of a simulated scene." in section(page, "Left out")


def test_what_has_no_data_is_left_out_and_said_so(tmp_path):
    page = write_report(tmp_path, [], window_points(), {}).read_text()
    assert "## Radius of the sliding window" in page
    assert "## Lambda" not in page
    left_out = section(page, "Left out")
    assert "- Scores of maps: there are no records." in left_out
    for name in ("Lambda", "Memory", "Association of proposals with instances"):
        assert f"- {name}: there are no points of this experiment." in left_out
    assert "Nothing here decides any claim." in page
    only = [r for r in made_up_records() if r.layer in ("instances", "fused_instances") and r.mode == "full"]
    left_out = section(write_report(tmp_path, only, [], {}).read_text(), "Left out")
    assert "simulation, fused against unfused dense layer: not measured." in left_out


def test_a_refused_comparison_and_an_unknown_experiment_are_named(tmp_path):
    records = [r for r in made_up_records() if (r.layer, r.seed) != ("instances", 2)]
    page = write_report(tmp_path, records, [CurvePoint("drift", "a", 0, 1.0, "mIoU", 0.5)], {}).read_text()
    assert "mIoU of instances, full lacks simulated building seed 2" in section(page, "Left out")
    assert "undecided: fused instances beat" in page
    assert "- drift: no such experiment is known here" in page


def test_the_dense_layer_has_a_lambda_sweep_of_its_own(tmp_path):
    points = [replace(point, metric="fused_dense/mIoU") for point in lambda_points({5.0: 0.1})]
    page = write_report(tmp_path, [], [*lambda_points(), *points], {}).read_text()
    assert "](lambda_fused_dense_mIoU.png)" in section(page, "Lambda (simulation)")
    instances, dense = verdict_lines(page)
    assert ", holds: " in instances
    assert ", does not hold: " in dense
    assert "of the fused dense layer" in dense


def test_options_are_tested_in_pairs(tmp_path):
    page = write_report(tmp_path, [], association_points(), {}).read_text()
    assert "| visible IoU 0.2 | IoU 0.2 | mIoU |" in section(page, "Association of proposals with instances (simulation)")
    assert (tmp_path / "association_tests.csv").is_file()


def test_a_long_table_is_in_its_csv_alone(tmp_path):
    points = [CurvePoint("memory", "dense map", 0, float(x), "bytes", 1e6 * x) for x in range(1, 301)]
    page = write_report(tmp_path, [], points, {}).read_text()
    assert "300 rows in [memory.csv](memory.csv)." in page
    assert "| dense map | 150 |" not in page
    assert len((tmp_path / "memory.csv").read_text().splitlines()) == 301


def test_nothing_at_all_is_a_report_too(tmp_path):
    page = write_report(tmp_path, [], [], {}).read_text()
    assert "Left out" in page
    assert [path.name for path in tmp_path.iterdir()] == ["report.md"]


def test_a_record_given_twice_is_refused_and_nothing_written(tmp_path):
    records = made_up_records()
    with pytest.raises(ComparisonError, match="given twice"):
        write_report(tmp_path / "out", [*records, records[0]], [], {})
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "out").write_text("not a directory")
    with pytest.raises(StorageError, match=re.escape(str(tmp_path / "out"))):
        write_report(tmp_path / "out", made_up_records(), [], {})
    (tmp_path / "other" / "report.md").mkdir(parents=True)
    with pytest.raises(StorageError, match=r"other/report\.md"):
        write_report(tmp_path / "other", [], [], {})
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["report.md"]


def test_a_full_disk_is_named_and_leaves_the_last_report(tmp_path, monkeypatch):
    before = write_report(tmp_path, made_up_records(), [], {}).read_bytes()

    def full(descriptor):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(report.os, "fsync", full)
    with pytest.raises(StorageError, match=r"No space left on device") as refused:
        write_report(tmp_path, made_up_records(instances__full=0.1), [], {})
    assert str(tmp_path) in str(refused.value)
    assert (tmp_path / "report.md").read_bytes() == before
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_files_of_others_stay(tmp_path):
    other = Path(tmp_path / "results.json")
    other.write_text("[]")
    write_report(tmp_path, made_up_records(), [], {})
    assert other.read_text() == "[]"
