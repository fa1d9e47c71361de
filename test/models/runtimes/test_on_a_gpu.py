"""The same graphs on a CUDA device, where there is one: ONNX Runtime and TensorRT over torch's memory there."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import torch
from graph_trios import toy_trio

from fus3dmaps_core.runtimes.compiled_network import CompiledNetwork
from fus3dmaps_core.runtimes.exported_network import open_network
from fus3dmaps_core.runtimes.exporting import export_graph, graph_encoders
from fus3dmaps_core.runtimes.packages import import_onnxruntime
from fus3dmaps_core.runtimes.tensorrt_network import engine_of

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
needs_tensorrt = pytest.mark.skipif(find_spec("tensorrt") is None, reason="tensorrt is not installed")


def expected(kind: int, images: torch.Tensor) -> torch.Tensor:
    found = graph_encoders(toy_trio())[kind].encoder.graph(32, 48).network(images)
    return found if isinstance(found, torch.Tensor) else found[0]


def images_for(kind: int, count: int) -> torch.Tensor:
    return torch.rand(count, 3, *((32, 48), (16, 16))[kind], generator=torch.Generator().manual_seed(3))


def embeddings(network, images: torch.Tensor) -> torch.Tensor:
    found = network(images.cuda())
    first = found if isinstance(found, torch.Tensor) else found[0]
    assert first.is_cuda
    return first.cpu()


@pytest.mark.parametrize("kind", [0, 1])
def test_onnxruntime_reads_and_writes_there(tmp_path, kind):
    if "CUDAExecutionProvider" not in import_onnxruntime().get_available_providers():
        pytest.skip("this onnxruntime has no CUDA")
    file = export_graph(graph_encoders(toy_trio())[kind], "fp32", tmp_path, 32, 48).path
    network = open_network(file, "cuda", "onnxruntime", "fp32", tmp_path)
    for count in (1, 3, 9):
        images = images_for(kind, count)
        torch.testing.assert_close(embeddings(network, images), expected(kind, images), atol=2e-3, rtol=0)


@needs_tensorrt
@pytest.mark.parametrize(("precision", "atol"), [("fp32", 1e-4), ("fp16", 5e-3), ("bf16", 3e-2)])
@pytest.mark.parametrize("kind", [0, 1])
def test_tensorrt_builds_keeps_and_runs_an_engine(tmp_path, kind, precision, atol):
    file = export_graph(graph_encoders(toy_trio())[kind], precision, tmp_path, 32, 48).path
    network, engine = engine_of(file, "cuda", precision, tmp_path)
    for count in (1, 3, 9):
        images = images_for(kind, count)
        torch.testing.assert_close(embeddings(network, images), expected(kind, images), atol=atol, rtol=0)
    written = engine.stat().st_mtime_ns
    again, kept = engine_of(file, "cuda", precision, tmp_path)
    assert (kept, kept.stat().st_mtime_ns) == (engine, written)
    engine.write_bytes(engine.read_bytes()[:100])
    rebuilt, _ = engine_of(file, "cuda", precision, tmp_path)
    images = images_for(kind, 2)
    torch.testing.assert_close(embeddings(rebuilt, images), embeddings(again, images), atol=atol, rtol=0)


def test_a_compiled_network_says_the_same():
    encoder = graph_encoders(toy_trio())[0].encoder
    graph = encoder.graph(32, 48)
    graph.network.cuda()
    images = images_for(0, 3)
    network = CompiledNetwork(graph, "toy", "cuda")
    torch.testing.assert_close(embeddings(network, images), expected(0, images), atol=2e-3, rtol=0)
