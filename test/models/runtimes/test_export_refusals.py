"""What is not exported: files that are not what torch computes, numbers that do not fit; and where files cannot go."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
import torch
from graph_trios import toy_trio
from onnx import numpy_helper

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes import exporting, onnx_writer
from fus3dmaps_core.runtimes.cached_files import external_data
from fus3dmaps_core.runtimes.exporting import export_graph, graph_encoders
from fus3dmaps_core.runtimes.graph_files import is_whole
from fus3dmaps_core.runtimes.onnx_network import OnnxNetwork
from fus3dmaps_core.runtimes.parity import BOUNDS, Bound, compare

SIZE = (32, 48)


def perturbed(monkeypatch, amount: float) -> None:
    """Have the weights in written files differ from the network's."""
    write = exporting.write_onnx

    def write_another(graph, network, trio, precision, path):
        write(graph, network, trio, precision, path)
        model = onnx.load(path)
        for weight in model.graph.initializer:
            values = numpy_helper.to_array(weight)
            if values.dtype == np.float32 and values.size > 16:
                noise = np.random.default_rng(0).normal(size=values.shape) * values.std() * amount
                weight.CopyFrom(numpy_helper.from_array((values + noise).astype(np.float32), weight.name))
        onnx.save(model, path)

    monkeypatch.setattr(exporting, "write_onnx", write_another)


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize("amount", [0.1, 1.0])
def test_a_file_with_other_weights_is_refused_and_leaves_nothing(toy, tmp_path, monkeypatch, amount, kind):
    perturbed(monkeypatch, amount)
    name = ("patch", "crop")[kind]
    with pytest.raises(
        EncoderError, match=rf"graph '{name}' in fp32: largest cosine error \S+ is above the bound of 0\.001"
    ):
        export_graph(graph_encoders(toy)[kind], "fp32", tmp_path, *SIZE)
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_good_file_survives_a_bad_export(toy, tmp_path, monkeypatch):
    encoder = graph_encoders(toy)[0]
    good = export_graph(encoder, "fp32", tmp_path, *SIZE)
    before = good.path.read_bytes()
    perturbed(monkeypatch, 1.0)
    with pytest.raises(EncoderError, match="above the bound"):
        export_graph(encoder, "fp32", tmp_path, *SIZE)
    assert good.path.read_bytes() == before
    assert is_whole(good.path)


@pytest.mark.parametrize("scale", [1e7, 3e3], ids=["weights", "sums"])
def test_numbers_beyond_float16_are_refused_with_what_to_take(tmp_path, scale):
    """Too large are the weights themselves, or only what they give."""
    encoder = graph_encoders(toy_trio(scale=scale))[1]
    with pytest.raises(EncoderError, match=r"graph 'crop' in fp16: largest cosine error nan.*take another precision.*bf16"):
        export_graph(encoder, "fp16", tmp_path, *SIZE)
    assert list(tmp_path.iterdir()) == []
    assert export_graph(encoder, "bf16", tmp_path, *SIZE).parity.mean < BOUNDS["bf16"].mean


def test_a_directory_that_cannot_be_written_is_named(toy, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(EncoderError, match=r"cannot write the graph 'patch' of encoder 'toy' into '.*file/graphs'"):
        export_graph(graph_encoders(toy)[0], "fp32", tmp_path / "file" / "graphs", *SIZE)


def test_a_network_that_torch_cannot_export_is_named(toy, tmp_path):
    class Unruly(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.ones(1))

        def forward(self, images):
            return images * self.weight if images.sum().item() > 0 else images

    toy.patch._network = Unruly()
    with pytest.raises(
        EncoderError, match=r"encoder 'toy': torch cannot export the graph 'patch': .*data-dependent"
    ) as told:
        export_graph(graph_encoders(toy)[0], "fp32", tmp_path, *SIZE)
    assert "\n" not in str(told.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("precision", ["fp32", "fp16", "bf16"])
def test_weights_too_large_for_one_file_lie_beside_it(toy, tmp_path, monkeypatch, precision):
    monkeypatch.setattr(onnx_writer, "_LARGEST_INSIDE_BYTES", 0)
    found = export_graph(graph_encoders(toy)[0], precision, tmp_path, *SIZE)
    beside = external_data(found.path)
    assert beside.is_file()
    assert found.size_bytes == found.path.stat().st_size + beside.stat().st_size
    assert is_whole(found.path)
    if precision != "bf16":
        embeddings, _ = OnnxNetwork(found.path, "cpu")(torch.rand(1, 3, *SIZE))
        np.testing.assert_allclose(embeddings.norm(dim=3), 1, atol=1e-5)
    beside.write_bytes(beside.read_bytes()[:-4] + b"abcd")
    assert not is_whole(found.path)


def test_errors_are_those_of_the_angles():
    expected = torch.tensor([[1.0, 0.0], [0.0, 2.0], [1.0, 0.0]])
    found = torch.tensor([[3.0, 0.0], [1.0, 1.0], [-1.0, 0.0]])
    further = torch.tensor([0.5, 0.25]), torch.tensor([0.5, 0.75])
    parity = compare(("embeddings", "saliency"), (expected, further[0]), (found, further[1]), Bound(1e-3, 1e-4))
    assert parity.largest == pytest.approx(2.0)
    assert parity.mean == pytest.approx((0 + 1 - 0.5**0.5 + 2) / 3)
    assert parity.further == {"saliency": 0.5}
    assert Bound(0.02, 0.01).further == pytest.approx(np.linalg.norm([np.sin(np.arccos(0.98)), 1 - 0.98]))
