"""The graphs of every trio: near torch in each precision, and in its place without the encoders' results changing."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from graph_trios import HEIGHT, TRIOS, WIDTH, boxes

from fus3dmaps_core.encoders.network_graphs import GraphEncoder
from fus3dmaps_core.runtimes.exporting import ExportedGraph, export_graph, graph_encoders
from fus3dmaps_core.runtimes.onnx_network import OnnxNetwork
from fus3dmaps_core.runtimes.parity import BOUNDS

KINDS = ("patch", "crop")
PRODUCTS = ("MatMul", "Gemm", "Conv")
GRAPHS = [(name, kind) for name in TRIOS for kind in KINDS]


@pytest.fixture(scope="session")
def exported(trios, tmp_path_factory):
    """Export a graph once."""
    folder: Path = tmp_path_factory.mktemp("graphs")

    @cache
    def export(name: str, kind: str, precision: str) -> ExportedGraph:
        encoder = graph_encoders(trios[name])[KINDS.index(kind)]
        return export_graph(encoder, precision, folder, HEIGHT, WIDTH)

    return export


def errors(expected: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Compute 1 - cos along the last axis."""
    expected, found = expected.astype(np.float64), found.astype(np.float64)
    lengths = np.linalg.norm(expected, axis=-1) * np.linalg.norm(found, axis=-1)
    return 1 - (expected * found).sum(axis=-1) / lengths


@pytest.mark.parametrize("precision", ["fp32", "fp16"])
@pytest.mark.parametrize(("name", "kind"), GRAPHS)
def test_a_graph_says_what_torch_says(trios, exported, rng, name, kind, precision):
    found = exported(name, kind, precision)
    graph = getattr(trios[name], kind).graph(HEIGHT, WIDTH)
    values = rng.uniform(0, 255, graph.shape) if name == "lite" else rng.normal(size=graph.shape)
    images = values.astype(np.float32)
    session = onnxruntime.InferenceSession(found.path, providers=["CPUExecutionProvider"])
    outputs = session.run(list(graph.outputs), {"images": images})
    with torch.inference_mode():
        expected = graph.network(torch.from_numpy(images))
    expected = [expected] if isinstance(expected, torch.Tensor) else list(expected)
    error = errors(expected[0].numpy(), outputs[0])
    bound = BOUNDS[precision]
    assert error.max() < bound.largest
    assert error.mean() < bound.mean
    assert found.parity.largest < bound.largest
    if precision == "fp32":
        assert max(error.max(), found.parity.largest) < 1e-3
    for one, other in zip(expected[1:], outputs[1:], strict=True):
        assert np.abs(one.numpy() - other).max() < bound.further


@pytest.mark.parametrize(("name", "kind"), GRAPHS)
def test_half_precision_is_below_its_bound_and_rounds(exported, name, kind):
    parities = {precision: exported(name, kind, precision).parity for precision in ("fp32", "fp16", "bf16")}
    for precision in ("fp16", "bf16"):
        assert parities[precision].largest < BOUNDS[precision].largest
        assert parities[precision].mean < BOUNDS[precision].mean
        assert parities[precision].mean > 10 * abs(parities["fp32"].mean)


@pytest.mark.parametrize(("name", "kind"), GRAPHS)
def test_a_file_says_what_it_is_and_has_one_fixed_shape(trios, exported, name, kind):
    found = exported(name, kind, "fp32")
    model = onnx.load(found.path)
    onnx.checker.check_model(model)
    graph = getattr(trios[name], kind).graph(HEIGHT, WIDTH)
    assert [(opset.domain, opset.version) for opset in model.opset_import if opset.domain == ""] == [("", 18)]
    assert {prop.key: prop.value for prop in model.metadata_props}.items() >= {
        "model": name,
        "graph": kind,
        "shape": "x".join(map(str, graph.shape)),
        "precision": "fp32",
    }.items()
    (given,) = model.graph.input
    assert [dim.dim_value for dim in given.type.tensor_type.shape.dim] == list(graph.shape) == list(found.shape)
    assert tuple(value.name for value in model.graph.output) == graph.outputs
    assert all(dim.dim_value > 0 for value in model.graph.output for dim in value.type.tensor_type.shape.dim)
    assert found.parameters == sum(value.numel() for value in graph.network.parameters())


@pytest.mark.parametrize(("precision", "half"), [("fp16", onnx.TensorProto.FLOAT16), ("bf16", onnx.TensorProto.BFLOAT16)])
@pytest.mark.parametrize(("name", "kind"), GRAPHS)
def test_products_alone_are_half(exported, name, kind, precision, half):
    model = onnx.load(exported(name, kind, precision).path)
    types = {value.name: value.type.tensor_type.elem_type for value in [*model.graph.value_info, *model.graph.output]}
    types |= {weight.name: weight.data_type for weight in model.graph.initializer}
    products = [node for node in model.graph.node if node.op_type in PRODUCTS]
    of_half = [node for node in products if types[node.output[0]] == half]
    assert all(types[name] == half for node in of_half for name in node.input)
    others = {node.op_type for node in products if node not in of_half}
    assert others <= ({"Conv"} if precision == "bf16" else set())
    assert of_half
    for node in model.graph.node:
        if node.op_type not in (*PRODUCTS, "Cast"):
            assert all(types[name] != half for name in node.output), node.op_type
    for value in [*model.graph.input, *model.graph.output]:
        assert value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT


@pytest.mark.parametrize("name", TRIOS)
def test_encoders_give_the_same_through_the_graph(trios, exported, picture, name):
    trio = trios[name]
    patches, crops = trio.patch.encode_patches(picture), trio.crop.encode_crops(picture, boxes(18))
    try:
        for kind in KINDS:
            getattr(trio, kind).run_with(OnnxNetwork(exported(name, kind, "fp32").path, "cpu"))
        found = trio.patch.encode_patches(picture)
        assert found.embeddings.dtype == found.weights.dtype == np.float32
        np.testing.assert_allclose(found.embeddings, patches.embeddings, atol=1e-4)
        np.testing.assert_allclose(found.weights, patches.weights, atol=1e-5)
        for count in (1, 3, 18):  # Fewer than a batch, and more.
            some = trio.crop.encode_crops(picture, boxes(count))
            np.testing.assert_allclose(some, crops[:count], atol=1e-4)
        assert trio.crop.encode_crops(picture, boxes(0)).shape == (0, trio.dimension)
    finally:
        for kind in KINDS:
            encoder: GraphEncoder = getattr(trio, kind)
            encoder.run_with(encoder.graph(HEIGHT, WIDTH).network)
    np.testing.assert_array_equal(trio.patch.encode_patches(picture).embeddings, patches.embeddings)
