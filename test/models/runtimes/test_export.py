"""``fus3dmaps export`` as a function: what it prints, writes and refuses."""

from __future__ import annotations

import json
import sys
from io import StringIO
from pathlib import Path

import pytest
from graph_trios import toy_trio
from rich.console import Console
from tensorrt_stand_in import TensorRT

from fus3dmaps_core.config.schema import Config, EncoderConfig, ImageConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes import exporting
from fus3dmaps_core.runtimes.acceleration import accelerate
from fus3dmaps_ros.commands.export import export_encoders


@pytest.fixture(autouse=True)
def _the_toy_is_registered(monkeypatch):
    def load_trio(name: str, device: str, crop_padding: float, weights: str):
        if name != "toy":
            raise EncoderError(f"parameter 'encoder.name': unknown encoder '{name}'")
        return toy_trio()

    monkeypatch.setattr("fus3dmaps_core.encoders.registry.load_trio", load_trio)
    monkeypatch.setitem(sys.modules, "tensorrt", None)


def export(
    folder: Path, precision: str = "fp32", name: str = "toy", as_json: bool = False, size: tuple[int, int] = (32, 48)
) -> str:
    stream = StringIO()
    values = {"encoder.name": name, "encoder.precision": precision, "image.height": size[0], "image.width": size[1]}
    export_encoders(Config.from_flat(values), folder, Console(file=stream, width=60), as_json=as_json)
    return stream.getvalue()


def test_both_graphs_are_written_and_described_a_line_each(tmp_path):
    patch, crop, engines = export(tmp_path / "graphs").splitlines()
    for line, kind, shape in ((patch, "patch", "1x3x32x48"), (crop, "crop", "4x3x16x16")):
        assert line.startswith(f"{kind}: {tmp_path}/graphs/toy_{kind}_{shape}_fp32_")
        for part in ("MiB", "opset 18", f"input {shape}", "M parameters", "cosine error max", "mean", "bound 1e-03"):
            assert part in line
    assert engines.startswith("no engines: ")
    assert "JetPack" in engines
    assert "pip install tensorrt-cu12" in engines
    assert len(list((tmp_path / "graphs").glob("*.onnx"))) == 2


def test_json_has_the_same(tmp_path):
    content = json.loads(export(tmp_path, "fp16", as_json=True))
    assert [graph["name"] for graph in content["graphs"]] == ["patch", "crop"]
    for graph in content["graphs"]:
        path = Path(graph["path"])
        assert graph["size_bytes"] == path.stat().st_size
        assert graph["precision"] == "fp16"
        assert graph["opset"] == 18
        assert 0 < graph["max_cosine_error"] < graph["max_cosine_error_bound"]
        assert 0 < graph["mean_cosine_error"] < graph["mean_cosine_error_bound"]
    assert content["engines"] == []
    assert "JetPack" in content["note"]


def test_a_pipeline_finds_what_was_exported(tmp_path, monkeypatch):
    export(tmp_path)
    monkeypatch.setattr(exporting, "write_onnx", lambda *_: pytest.fail("exported again"))
    settings = EncoderConfig(runtime="onnxruntime", graph_directory=str(tmp_path))
    accelerate(toy_trio(), settings, ImageConfig(height=32, width=48))


def test_without_a_gpu_the_graphs_are_the_product(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorrt", TensorRT())
    assert export(tmp_path).splitlines()[-1].startswith("no engines: they are built on the GPU that runs them")


def test_with_both_an_engine_is_built_of_each_graph(tmp_path, monkeypatch):
    built: list[tuple] = []

    def engine_of(path, device, precision, directory):
        built.append((path.name.split("_")[1], device, precision, directory))
        return None, path.with_suffix(".engine")

    monkeypatch.setitem(sys.modules, "tensorrt", TensorRT())
    monkeypatch.setattr("fus3dmaps_ros.commands.export._has_gpu", lambda: True)
    monkeypatch.setattr("fus3dmaps_core.runtimes.tensorrt_network.engine_of", engine_of)
    lines = export(tmp_path, "fp16").splitlines()
    assert built == [(kind, "cuda", "fp16", tmp_path) for kind in ("patch", "crop")]
    assert [line.startswith(f"engine: {tmp_path}/toy_") for line in lines] == [False, False, True, True]


def test_what_cannot_be_exported_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(EncoderError, match=r"cannot write the graph 'patch'.*--out"):
        export(tmp_path / "file" / "graphs")
    with pytest.raises(EncoderError, match="unknown encoder 'nobody'"):
        export(tmp_path, name="nobody")
    with pytest.raises(EncoderError, match=r"'image\.width', 'image\.height': encoder 'toy' .* 3200000 x 1600000 pixels"):
        export(tmp_path / "large", size=(1_600_000, 3_200_000))
    assert not (tmp_path / "large").exists()
