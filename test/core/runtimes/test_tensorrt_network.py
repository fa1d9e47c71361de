"""Engines over torch's memory, with a stand-in that reads and writes the addresses it is given."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from tensorrt_stand_in import Stream, TensorRT

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.packages import import_tensorrt
from fus3dmaps_core.runtimes.tensorrt_network import TensorRTNetwork, check_cuda

STREAM = 77


@pytest.fixture(autouse=True)
def stream(monkeypatch) -> Stream:
    """Torch's current stream."""
    current = Stream(STREAM)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: current)
    return current


@pytest.fixture
def tensorrt() -> TensorRT:
    module = TensorRT()
    module.outputs = {"embeddings": (2, 5), "saliency": (2, 4, 4)}
    module.compute = lambda images: [2 * images.reshape(2, -1)[:, :5], images[:, 1]]
    return module


def network(tensorrt: TensorRT) -> TensorRTNetwork:
    engine = tensorrt.Runtime(tensorrt.ILogger()).deserialize_cuda_engine(f"{tensorrt.__version__}|end".encode())
    return TensorRTNetwork(tensorrt, engine, "cpu", "radseg_patch.onnx")


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_outputs_are_those_of_each_image(tensorrt, rng, count):
    images = torch.from_numpy(rng.normal(size=(count, 3, 4, 4)).astype(np.float32))
    embeddings, saliency = network(tensorrt)(images)
    assert torch.equal(embeddings, 2 * images.reshape(count, -1)[:, :5] if count else torch.zeros(0, 5))
    assert torch.equal(saliency, images[:, 1])


def test_the_memory_is_torchs_and_the_stream_its_current_one(tensorrt, rng):
    images = torch.from_numpy(rng.normal(size=(2, 3, 4, 4)).astype(np.float32))
    embeddings, saliency = network(tensorrt)(images)
    (run,) = [entry for entry in tensorrt.log if entry[0] == "run"]
    assert run[1] == STREAM
    assert run[2] == {
        "images": images.data_ptr(),
        "embeddings": embeddings.data_ptr(),
        "saliency": saliency.data_ptr(),
    }


def test_a_run_waits_for_the_one_before_in_another_stream(tensorrt, stream, monkeypatch):
    run, other = network(tensorrt), Stream(STREAM + 1)
    run(torch.ones(2, 3, 4, 4))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: other)
    run(torch.ones(2, 3, 4, 4))
    ((_, first),) = stream.log
    assert other.log[0] == ("wait", first)
    assert [entry[1] for entry in tensorrt.log if entry[0] == "run"] == [STREAM, STREAM + 1]


def test_results_outlive_the_next_run(tensorrt):
    run = network(tensorrt)
    first = run(torch.ones(2, 3, 4, 4))[0]
    run(torch.zeros(2, 3, 4, 4))
    assert (first == 2).all()


def test_images_in_another_layout_or_type_are_brought_to_the_engines(tensorrt, rng):
    images = torch.from_numpy(rng.normal(size=(2, 4, 4, 3))).permute(0, 3, 1, 2)
    assert torch.equal(network(tensorrt)(images)[1], images[:, 1].float())


def test_other_images_are_refused(tensorrt):
    with pytest.raises(EncoderError, match=r"radseg_patch\.onnx.*takes images of shape \(3, 4, 4\), got \(3, 4, 5\)"):
        network(tensorrt)(torch.zeros(2, 3, 4, 5))
    with pytest.raises(EncoderError, match=r"runs on 'cpu', got images on 'meta'"):
        network(tensorrt)(torch.zeros(2, 3, 4, 4, device="meta"))


def test_engines_that_cannot_be_used_are_refused(tensorrt):
    tensorrt.runs = False
    with pytest.raises(EncoderError, match=r"radseg_patch\.onnx': TensorRT cannot run it"):
        network(tensorrt)(torch.zeros(2, 3, 4, 4))
    tensorrt.has_memory = False
    with pytest.raises(EncoderError, match="finds no memory"):
        network(tensorrt)
    tensorrt.has_memory, tensorrt.shape = True, (-1, 3, 4, 4)
    with pytest.raises(EncoderError, match="shapes must be fixed"):
        network(tensorrt)
    tensorrt.dtype = tensorrt.DataType.HALF
    with pytest.raises(EncoderError, match="float32 tensors alone"):
        network(tensorrt)


def test_a_missing_tensorrt_is_said_with_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorrt", None)
    with pytest.raises(EncoderError, match=r"'tensorrt'.*JetPack.*apt install tensorrt python3-libnvinfer.*pip install"):
        import_tensorrt()


def test_an_old_tensorrt_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorrt", TensorRT("8.6.2"))
    with pytest.raises(EncoderError, match=r"tensorrt 8\.6\.2 is older than 10\.0"):
        import_tensorrt()
    monkeypatch.setitem(sys.modules, "tensorrt", TensorRT("11.4.0.106"))
    assert import_tensorrt().__version__ == "11.4.0.106"


@pytest.mark.parametrize("device", ["cpu", "xpu"])
def test_another_device_is_refused_by_name(device):
    with pytest.raises(EncoderError, match=rf"encoder\.runtime.*CUDA devices alone.*encoder\.device' is '{device}'"):
        check_cuda(device)
