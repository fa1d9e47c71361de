"""Files in ONNX Runtime: what is run, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.exported_network import open_network
from fus3dmaps_core.runtimes.graph_input import input_shape
from fus3dmaps_core.runtimes.onnx_network import OnnxNetwork

SHAPE = (3, 3, 4, 6)


def write(path: Path, shape=SHAPE, kind=TensorProto.FLOAT, inputs=1, result=TensorProto.FLOAT) -> Path:
    """Write a graph that gives twice the images, and their means by channel."""
    given = [helper.make_tensor_value_info(f"images{place}", kind, shape) for place in range(inputs)]
    outputs = [helper.make_tensor_value_info(name, result, None) for name in ("double", "means")]
    nodes = [
        helper.make_node("Add", ["images0", "images0"], ["sum"]),
        helper.make_node("ReduceMean", ["images0"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Cast", ["sum"], ["double"], to=result),
        helper.make_node("Cast", ["mean"], ["means"], to=result),
    ]
    model = helper.make_model(helper.make_graph(nodes, "g", given, outputs), opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 10
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("count", [0, 1, 3, 7])
@pytest.mark.parametrize("runtime", ["torch", "compile", "onnxruntime"])
def test_any_number_of_images_is_run(tmp_path, rng, runtime, count):
    network = open_network(write(tmp_path / "a.onnx"), "cpu", runtime, "fp32", tmp_path)
    images = torch.from_numpy(rng.normal(size=(count, *SHAPE[1:])).astype(np.float32))
    double, means = network(images)
    assert torch.equal(double, 2 * images)
    torch.testing.assert_close(means, images.mean(dim=(2, 3)))


def test_results_are_the_same_each_time_and_outlive_the_next(tmp_path, rng):
    network = OnnxNetwork(write(tmp_path / "a.onnx"), "cpu")
    images = torch.from_numpy(rng.normal(size=SHAPE).astype(np.float32))
    first = network(images)
    network(torch.zeros(SHAPE))
    assert all(torch.equal(one, other) for one, other in zip(first, network(images), strict=True))


def test_other_images_are_refused(tmp_path):
    network = OnnxNetwork(write(tmp_path / "a.onnx"), "cpu")
    with pytest.raises(EncoderError, match=r"graph 'a\.onnx' takes images of shape \(3, 4, 6\), got \(3, 6, 4\)"):
        network(torch.zeros(1, 3, 6, 4))


def test_a_missing_or_damaged_file_is_named(tmp_path):
    with pytest.raises(EncoderError, match=r"graph '.*b\.onnx': there is no such file"):
        OnnxNetwork(tmp_path / "b.onnx", "cpu")
    damaged = write(tmp_path / "a.onnx")
    damaged.write_bytes(damaged.read_bytes()[:60])
    with pytest.raises(EncoderError, match=r"graph '.*a\.onnx': onnxruntime cannot load it"):
        OnnxNetwork(damaged, "cpu")
    with pytest.raises(EncoderError, match=r"graph '.*a\.onnx': it cannot be read"):
        input_shape(damaged)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"shape": ("n", 3, 4, 6)}, "fixed shape"),
        ({"shape": (3, 4, 6)}, "fixed shape|cannot load"),
        ({"inputs": 2}, "one float32 input"),
        ({"kind": TensorProto.FLOAT16}, "one float32 input"),
    ],
)
def test_other_inputs_are_refused(tmp_path, options, message):
    path = write(tmp_path / "a.onnx", **options)
    with pytest.raises(EncoderError, match=message):
        OnnxNetwork(path, "cpu")
    with pytest.raises(EncoderError, match=r"one float32 input of a fixed shape"):
        input_shape(path)


def test_other_outputs_are_refused(tmp_path):
    with pytest.raises(EncoderError, match="output 'double' is no float32 tensor"):
        OnnxNetwork(write(tmp_path / "a.onnx", result=TensorProto.FLOAT16), "cpu")


def test_devices_that_it_cannot_use_are_refused(tmp_path):
    path = write(tmp_path / "a.onnx")
    with pytest.raises(EncoderError, match=r"encoder\.runtime.*no CUDA.*onnxruntime-gpu"):
        OnnxNetwork(path, "cuda:0")
    with pytest.raises(EncoderError, match=r"encoder\.device.*not on 'xpu'"):
        OnnxNetwork(path, "xpu")
    with pytest.raises(EncoderError, match=r"encoder\.runtime.*CUDA devices alone"):
        open_network(path, "cpu", "tensorrt", "fp16", tmp_path)


def test_the_shape_is_read_from_the_file(tmp_path):
    assert input_shape(write(tmp_path / "a.onnx")) == SHAPE == OnnxNetwork(tmp_path / "a.onnx", "cpu").shape
