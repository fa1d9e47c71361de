"""A graph that others exported, with its products in half precision: near the original, made once, and refused beyond."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.foreign_graphs import in_precision
from fus3dmaps_core.runtimes.graph_files import is_whole

SHAPE = (1, 3, 16, 24)


def write_graph(path: Path, scale: float = 1.0, seed: int = 0) -> Path:
    """Write two convolutions with a sigmoid between, and types only at the ends, as other exporters leave them out."""
    rng = np.random.default_rng(seed)
    weights = {
        "first": scale * rng.normal(size=(8, 3, 3, 3)),
        "second": rng.normal(size=(5, 8, 1, 1)),
    }
    graph = helper.make_graph(
        [
            helper.make_node("Conv", ["images", "first"], ["features"], pads=[1, 1, 1, 1]),
            helper.make_node("Sigmoid", ["features"], ["gates"]),
            helper.make_node("Mul", ["features", "gates"], ["active"]),
            helper.make_node("Conv", ["active", "second"], ["masks"]),
            helper.make_node("ReduceMean", ["active"], ["scores"], axes=[2, 3], keepdims=1),
        ],
        "foreign",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, SHAPE)],
        [
            helper.make_tensor_value_info("masks", TensorProto.FLOAT, (1, 5, 16, 24)),
            helper.make_tensor_value_info("scores", TensorProto.FLOAT, (1, 8, 1, 1)),
        ],
        [numpy_helper.from_array(value.astype(np.float32), name) for name, value in weights.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


@pytest.fixture
def images(rng) -> torch.Tensor:
    return torch.from_numpy(rng.random((2, *SHAPE[1:]), np.float32))


def run(path: Path, images: torch.Tensor) -> list[np.ndarray]:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return session.run(None, {"images": images[:1].numpy()})


def test_float32_is_the_file_itself(tmp_path, images):
    path = write_graph(tmp_path / "net.onnx")
    assert in_precision(path, "fp32", tmp_path / "kept", images) == path
    assert not (tmp_path / "kept").exists()


def test_products_are_half_and_the_rest_float32(tmp_path, images):
    path = write_graph(tmp_path / "net.onnx")
    found = in_precision(path, "fp16", tmp_path / "kept", images)
    assert is_whole(found)
    assert [file.name for file in sorted((tmp_path / "kept").iterdir())] == [found.name, f"{found.name}.sha256"]
    model = onnx.shape_inference.infer_shapes(onnx.load(found))
    types = {value.name: value.type.tensor_type.elem_type for value in model.graph.value_info}
    types |= {weight.name: weight.data_type for weight in model.graph.initializer}
    types |= {value.name: value.type.tensor_type.elem_type for value in [*model.graph.input, *model.graph.output]}
    for node in model.graph.node:
        expected = TensorProto.FLOAT16 if node.op_type == "Conv" else TensorProto.FLOAT
        if node.op_type != "Cast":
            assert {types[name] for name in [*node.input, *node.output]} == {expected}
    for one, other in zip(run(path, images), run(found, images), strict=True):
        np.testing.assert_allclose(one, other, atol=5e-3 * np.abs(one).max())
        assert np.abs(one - other).max() > 0


def test_it_is_made_once_and_anew_where_it_is_damaged_or_of_another_graph(tmp_path, images):
    kept, path = tmp_path / "kept", write_graph(tmp_path / "net.onnx")
    found = in_precision(path, "fp16", kept, images)
    content, made = found.read_bytes(), found.stat().st_mtime_ns
    assert in_precision(path, "fp16", kept, images) == found
    assert found.stat().st_mtime_ns == made
    found.write_bytes(content[:-9])
    assert in_precision(path, "fp16", kept, images) == found
    assert found.read_bytes() == content
    assert in_precision(write_graph(path, seed=1), "fp16", kept, images) != found
    assert in_precision(path, "bf16", kept, images) not in (path, found)


def test_what_overflows_is_refused_and_leaves_nothing(tmp_path, images):
    path = write_graph(tmp_path / "net.onnx", scale=1e5)
    with pytest.raises(EncoderError, match=r"net.onnx' in fp16: .*nan.* take another 'encoder.precision', e.g. fp32"):
        in_precision(path, "fp16", tmp_path / "kept", images)
    assert not list((tmp_path / "kept").iterdir())


def test_a_place_that_cannot_be_written_is_named(tmp_path, images):
    (tmp_path / "kept").write_text("a file")
    with pytest.raises(EncoderError, match=r"'encoder.graph_directory': cannot write '.*kept"):
        in_precision(write_graph(tmp_path / "net.onnx"), "fp16", tmp_path / "kept", images)
