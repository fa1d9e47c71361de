"""The command: what it measures, writes and refuses."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest
from benchmarks.cli import main
from benchmarks.corridor import fitted_slope, measure_corridor
from benchmarks.engine import Run
from benchmarks.measurements import Measurement
from benchmarks.ratios import ratios
from benchmarks.timing import copy_bandwidth, spread

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "bench"
UNITS = {
    "copy_bandwidth": "GB/s",
    "dense_update": "ms",
    "instance_update": "ms",
    "full_fusion": "ms",
    "full_fusion_bandwidth": "GB/s",
    "incremental_fusion": "ms",
    "text_query": "ms",
    "text_query_bandwidth": "GB/s",
    "dense_bytes_per_voxel": "B",
    "instance_bytes": "B",
    "ratio": "1",
}


def test_run_writes_every_figure_with_its_unit(tmp_path):
    out = tmp_path / "figures.json"
    arguments = ["--sizes", "10k,12000", "--dimensions", "16", "--dtypes", "float16", "--repeats", "1", "--threads", "1"]
    done = subprocess.run(
        [SCRIPT, *arguments, "--json", out.name],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": "/nowhere"},
        capture_output=True,
    )
    assert done.returncode == 0, done.stderr.decode()
    figures = json.loads(out.read_text())
    assert {figure["name"]: figure["unit"] for figure in figures} == UNITS
    for figure in figures:
        assert figure["value"] > 0
        assert figure["name"] in done.stdout.decode()
        if figure["name"] not in ("copy_bandwidth", "ratio"):
            assert figure["params"]["d"] == 16
            assert figure["params"]["dtype"] == "float16"
            assert figure["params"]["map_voxels"] in (10_000, 12_000)
    layers = [figure["params"]["layer"] for figure in figures if figure["name"] == "text_query"]
    assert sorted(layers) == sorted(2 * ["dense", "fused_dense", "instances", "fused_instances"])
    assert {figure["params"]["points"] for figure in figures if figure["name"] == "dense_update"} == {6000, 8000}
    assert {figure["params"]["masks"] for figure in figures if figure["name"] == "instance_update"} == {40, 20}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sizes", "999"], "--sizes: '999' is no whole number of at least 10,000"),
        (["--sizes", "10k,many"], "--sizes: 'many' is no whole number"),
        (["--dimensions", "0"], "--dimensions: '0' is no whole number of at least 1"),
        (["--dtypes", "float16,bfloat8"], "--dtypes: unknown storage type 'bfloat8', known are "),
        (["--threads", "100000"], "--threads: must lie in [1, "),
        (["--repeats", "-1"], "--repeats: must not be negative, got -1"),
        (["--repeats", "few"], "--repeats"),
        (["--device", "abacus"], "--device abacus: "),
        (["--backend", "abacus"], "--backend abacus: "),
        (["--rayfronts", "/nowhere"], "--rayfronts /nowhere: is no checkout of RayFronts"),
        (["--json", "/nowhere/figures.json"], "--json /nowhere/figures.json: there is no folder /nowhere"),
        (["--corridor", "--keyframes", "10"], "--corridor: needs at least 500 keyframes"),
        (["--corridor", "--precision"], "--corridor and --precision"),
        (["--fast"], "--fast"),
    ],
)
def test_bad_argument_is_refused_in_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    output = capsys.readouterr()
    assert stopped.value.code == 2
    assert output.out == ""
    assert output.err.count("\n") == 1
    assert output.err.startswith("bench: ")
    assert message in output.err


def figure(name: str, value: float, **params: object) -> Measurement:
    return Measurement(name, {"d": 8, "dtype": "float16", **params}, value, "ms")


def test_ratios_compare_what_belongs_together():
    made = ratios(
        [
            Measurement("copy_bandwidth", {}, 20.0, "GB/s"),
            figure("dense_update", 6.0, map_voxels=2_000_000, points=8000, keyframes=12),
            figure("dense_update", 5.0, map_voxels=10_000, points=8000, keyframes=12),
            figure("dense_update", 4.0, map_voxels=200_000, points=8000, keyframes=12),
            figure("dense_update", 3.0, map_voxels=200_000, points=8000, keyframes=4),
            figure("dense_update", 9.0, map_voxels=10_000, points=6000, keyframes=12),
            figure("instance_update", 7.0, map_voxels=500_000, masks=40, instances=500),
            figure("instance_update", 14.0, map_voxels=500_000, masks=40, instances=5000),
            figure("text_query_bandwidth", 8.0, map_voxels=10_000, layer="dense"),
            figure("rayfronts_update", 400.0, map_voxels=200_000, points=8000, keyframes=12, windowed=False),
            figure("rayfronts_update", 100.0, map_voxels=200_000, points=8000, keyframes=12, windowed=True),
        ]
    )
    assert {entry.params["of"]: entry.value for entry in made} == {
        "dense_update: map_voxels 2,000,000 / 10,000 (d 8, dtype float16, points 8000, keyframes 12)": pytest.approx(1.2),
        "instance_update: instances 5,000 / 500 (d 8, dtype float16, map_voxels 500000, masks 40)": pytest.approx(2.0),
        "RayFronts full / ours (float16), 200,000 voxels, d 8": pytest.approx(100.0),
        "RayFronts windowed / ours (float16), 200,000 voxels, d 8": pytest.approx(25.0),
        "text_query_bandwidth dense / copy_bandwidth (10,000 voxels, d 8, float16)": pytest.approx(0.4),
    }


def test_spread_of_known_samples():
    assert spread([4.0, 1.0, 3.0, 2.0, 5.0]) == {"min": 1.0, "q1": 2.0, "q3": 4.0, "max": 5.0, "samples": 5}


def test_copy_counts_bytes_read_and_written():
    speed, samples = copy_bandwidth(1, size_bytes=2**20)
    assert samples["min"] <= speed <= samples["max"]


def test_slope_of_a_line():
    assert fitted_slope([100, 200, 300], [5.0, 7.0, 9.0]) == pytest.approx(0.02)


def test_corridor_keeps_the_dense_layer_bounded(world, monkeypatch):
    monkeypatch.setattr("benchmarks.corridor._SAMPLE_PERIOD", 10)
    run = Run(world, "cpu", None, 1, 1, lambda text: None)
    figures = {entry.name: entry for entry in measure_corridor(run, 8, "float16", 100, 40.0)}
    assert all(name.startswith("corridor_") for name in figures)
    assert figures["corridor_resident_end"].value > 0
    assert figures["corridor_unaccounted_slope"].unit == "B/keyframe"
    # 200 bytes for each of the 12,000 voxels that 1 m of corridor brings would be a hundred times this.
    assert figures["corridor_dense_slope"].value < 20_000
