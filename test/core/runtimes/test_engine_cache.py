"""Engines on disk, with a stand-in for TensorRT: built once, and again where another one is needed."""

from __future__ import annotations

from pathlib import Path

import pytest
from tensorrt_stand_in import TensorRT

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.engine_cache import Gpu, cached_engine, engine_path
from fus3dmaps_core.runtimes.tensorrt_engine import WORKSPACE_MIB

ORIN, DESKTOP = Gpu("Orin (nvgpu)", (8, 7)), Gpu("NVIDIA GeForce RTX 4090", (8, 9))
SHAPE = (2, 3, 4, 4)


@pytest.fixture
def graph(tmp_path) -> Path:
    path = tmp_path / "radseg_patch.onnx"
    path.write_bytes(b"a graph")
    return path


@pytest.fixture
def folder(tmp_path) -> Path:
    return tmp_path / "engines" / "deep"


def builds(tensorrt: TensorRT) -> int:
    return sum(entry[0] == "build" for entry in tensorrt.log)


def test_an_engine_is_built_once(graph, folder):
    tensorrt = TensorRT()
    first, path = cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)
    second, again = cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)
    assert builds(tensorrt) == 1
    assert path == again
    assert first.num_io_tensors == second.num_io_tensors
    for part in ("radseg-patch", "2x3x4x4", "fp16", "trt10.3.0", "orin-nvgpu", "sm87"):
        assert part in path.name
    assert sorted(file.suffix for file in folder.iterdir()) == [".cache", ".engine"]


def test_the_network_is_strongly_typed_and_built_from_the_file_within_the_limit(graph, folder):
    tensorrt = TensorRT()
    cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)
    assert ("build", 1 << tensorrt.NetworkDefinitionCreationFlag.STRONGLY_TYPED, graph) in tensorrt.log
    assert ("limit", "workspace", WORKSPACE_MIB << 20) in tensorrt.log
    assert ("clear", "tf32") in tensorrt.log


def test_whatever_makes_another_engine_necessary_makes_another_name(graph, folder, tmp_path):
    other = tmp_path / "other" / graph.name
    other.parent.mkdir()
    other.write_bytes(b"another graph")
    paths = {
        engine_path(folder, graph, SHAPE, "fp16", "10.3.0", ORIN),
        engine_path(folder, other, SHAPE, "fp16", "10.3.0", ORIN),
        engine_path(folder, graph, (1, 3, 4, 4), "fp16", "10.3.0", ORIN),
        engine_path(folder, graph, SHAPE, "bf16", "10.3.0", ORIN),
        engine_path(folder, graph, SHAPE, "fp16", "10.7.0", ORIN),
        engine_path(folder, graph, SHAPE, "fp16", "10.3.0", DESKTOP),
        engine_path(folder, graph, SHAPE, "fp16", "10.3.0", Gpu(ORIN.name, (8, 9))),
    }
    before = engine_path(folder, graph, SHAPE, "fp16", "10.3.0", ORIN)
    graph.with_name(graph.name + ".data").write_bytes(b"other weights beside it")
    assert len(paths | {engine_path(folder, graph, SHAPE, "fp16", "10.3.0", ORIN)}) == 8
    assert before in paths


def test_another_version_builds_its_own(graph, folder):
    old, new = TensorRT("10.3.0"), TensorRT("10.7.0")
    paths = {cached_engine(version, graph, SHAPE, "fp16", ORIN, folder)[1] for version in (old, new, old)}
    assert len(paths) == 2
    assert builds(old) == builds(new) == 1


@pytest.mark.parametrize("content", [b"", b"10.3.0|a gra", b"10.0.1|a graph|end"], ids=["empty", "cut short", "foreign"])
def test_a_file_that_tensorrt_refuses_is_replaced(graph, folder, content):
    tensorrt = TensorRT()
    path = cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)[1]
    whole = path.read_bytes()
    path.write_bytes(content)
    engine, again = cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)
    assert engine is not None
    assert again == path
    assert path.read_bytes() == whole
    assert builds(tensorrt) == 2


def test_timings_serve_the_next_build_and_damaged_ones_are_done_without(graph, folder):
    tensorrt = TensorRT()
    cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)
    cached_engine(tensorrt, graph, SHAPE, "bf16", ORIN, folder)
    (timings,) = folder.glob("*.cache")
    timings.write_bytes(b"damaged")
    cached_engine(tensorrt, graph, SHAPE, "fp32", ORIN, folder)
    used = [entry[1:3] for entry in tensorrt.log if entry[0] == "timings"]
    assert used == [(b"", True), (b"timings", True), (b"damaged", False), (b"", True)]
    assert timings.read_bytes() == b"timings"


def test_a_graph_that_cannot_be_read_or_built_is_refused_and_leaves_nothing(graph, folder):
    tensorrt = TensorRT()
    tensorrt.parses = False
    with pytest.raises(EncoderError, match=r"radseg_patch\.onnx.*TensorRT 10\.3\.0 cannot read it: In node 3"):
        cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)
    tensorrt.parses, tensorrt.builds = True, False
    with pytest.raises(EncoderError, match=r"radseg_patch\.onnx.*cannot build an engine of it: out of scratch memory"):
        cached_engine(tensorrt, graph, SHAPE, "fp16", ORIN, folder)
    assert not folder.exists() or not list(folder.glob("*.engine*"))


def test_a_directory_that_cannot_be_written_is_named(graph, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(EncoderError, match=r"encoder\.graph_directory.*file/engines"):
        cached_engine(TensorRT(), graph, SHAPE, "fp16", ORIN, tmp_path / "file" / "engines")
