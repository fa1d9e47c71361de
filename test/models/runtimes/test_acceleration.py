"""Trios whose networks another runtime runs, by the configuration."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest
import torch
from graph_trios import boxes, toy_trio
from tensorrt_stand_in import Stream, TensorRT

from fus3dmaps_core.config.schema import EncoderConfig, ImageConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes import acceleration, engine_cache, exporting, tensorrt_network
from fus3dmaps_core.runtimes.acceleration import accelerate
from fus3dmaps_core.runtimes.graph_files import fingerprint, graph_directory, own_precision

IMAGE = ImageConfig(height=32, width=48)


@pytest.fixture
def rgb(rng) -> np.ndarray:
    return rng.integers(0, 256, (32, 48, 3)).astype(np.uint8)


def crops():
    masks = boxes(6)
    return replace(masks, boxes=np.array([[4 * i, i, 4 * i + 16, i + 16] for i in range(6)], np.int32))


def config(tmp_path, **values) -> EncoderConfig:
    return EncoderConfig(graph_directory=str(tmp_path / "graphs"), **values)


def assert_same(trio, rgb, atol=1e-5):
    reference = toy_trio()
    found, expected = trio.patch.encode_patches(rgb), reference.patch.encode_patches(rgb)
    np.testing.assert_allclose(found.embeddings, expected.embeddings, atol=atol)
    np.testing.assert_allclose(found.weights, expected.weights, atol=atol)
    np.testing.assert_allclose(trio.crop.encode_crops(rgb, crops()), reference.crop.encode_crops(rgb, crops()), atol=atol)


def test_torch_stays_as_it_is(toy, tmp_path):
    before = toy.patch.run
    assert accelerate(toy, config(tmp_path), IMAGE) is toy
    assert toy.patch.run is before
    assert not (tmp_path / "graphs").exists()


def test_onnxruntime_runs_what_it_finds_or_makes(toy, tmp_path, rgb, monkeypatch):
    settings = config(tmp_path, runtime="onnxruntime")
    trio = accelerate(toy, settings, IMAGE)
    assert trio.patch.run is not trio.patch._network
    assert_same(trio, rgb)
    files = sorted((tmp_path / "graphs").glob("*.onnx"))
    assert [file.name.rsplit("_", 1)[0] for file in files] == ["toy_crop_4x3x16x16_fp32", "toy_patch_1x3x32x48_fp32"]
    monkeypatch.setattr(exporting, "write_onnx", lambda *_: pytest.fail("exported again"))
    assert_same(accelerate(toy_trio(), settings, IMAGE), rgb)


def test_other_weights_or_sizes_never_get_a_stale_graph(toy, tmp_path, rgb):
    settings = config(tmp_path, runtime="onnxruntime")
    accelerate(toy_trio(seed=2), settings, IMAGE)
    accelerate(toy_trio(), settings, ImageConfig(height=32, width=64))
    assert_same(accelerate(toy, settings, IMAGE), rgb)
    assert len(list((tmp_path / "graphs").glob("toy_patch_*.onnx"))) == 3


def test_an_altered_file_is_made_anew(toy, tmp_path, rgb, caplog):
    settings = config(tmp_path, runtime="onnxruntime")
    accelerate(toy, settings, IMAGE)
    (file,) = (tmp_path / "graphs").glob("toy_patch_*.onnx")
    whole = file.read_bytes()
    file.write_bytes(whole[:-10])
    assert_same(accelerate(toy_trio(), settings, IMAGE), rgb)
    assert "not what its checksum says" in caplog.text
    assert len(file.read_bytes()) == len(whole)


def test_with_pooled_patches_the_crop_encoder_stays_in_torch(toy, tmp_path):
    accelerate(toy, config(tmp_path, runtime="onnxruntime", instance_embeddings="patches"), IMAGE)
    assert toy.crop.run is toy.crop._network
    assert toy.patch.run is not toy.patch._network
    assert not list((tmp_path / "graphs").glob("toy_crop*"))


def test_without_a_directory_graphs_are_kept_in_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert graph_directory("") == tmp_path / "fus3dmaps" / "graphs"


def test_the_name_follows_weights_but_not_how_they_were_loaded(toy):
    network = toy.patch._network
    before = fingerprint(network)
    assert own_precision(network) == "fp32"
    assert fingerprint(network.bfloat16()) == before
    assert own_precision(network) == "bf16"
    assert fingerprint(toy.crop._network) != before
    network.mix[3, 4] *= -1
    assert fingerprint(network) != before


def test_bfloat16_networks_are_exported_from_their_own_weights(toy, tmp_path, rgb):
    toy.patch._network.bfloat16()
    encoder = exporting.graph_encoders(toy)[0]
    found = exporting.export_graph(encoder, "fp32", tmp_path, 32, 48)
    assert found.parity.largest < 1e-6
    assert next(toy.patch._network.parameters()).dtype == torch.bfloat16


@pytest.mark.parametrize("runtime", ["onnxruntime", "tensorrt", "compile"])
@pytest.mark.parametrize("kind", ["patch", "crop"])
def test_an_encoder_without_a_graph_is_refused_by_name(toy, tmp_path, runtime, kind):
    class Plain:
        pass

    with pytest.raises(EncoderError, match=rf"encoder 'toy': its {kind} encoder, Plain, has no graph"):
        accelerate(replace(toy, **{kind: Plain()}), config(tmp_path, runtime=runtime), IMAGE)


def test_tensorrt_on_another_device_is_refused_before_anything_is_made(toy, tmp_path):
    with pytest.raises(EncoderError, match=r"tensorrt runs on CUDA devices alone, 'encoder.device' is 'cpu'"):
        accelerate(toy, config(tmp_path, runtime="tensorrt"), IMAGE)
    assert not (tmp_path / "graphs").exists()


def test_a_directory_that_cannot_be_written_leaves_the_trio_as_it_was(toy, tmp_path):
    (tmp_path / "graphs").write_bytes(b"")
    with pytest.raises(EncoderError, match=r"cannot write the graph 'patch'.*encoder\.graph_directory"):
        accelerate(toy, config(tmp_path, runtime="onnxruntime"), IMAGE)
    assert toy.patch.run is toy.patch._network


@pytest.mark.parametrize(("precision", "atol"), [("fp32", 1e-5), ("fp16", 5e-3)])
def test_the_whole_way_to_an_engine_and_back(toy, tmp_path, rgb, monkeypatch, precision, atol):
    """On the CPU: in place of TensorRT stands its double, whose engines run the file in ONNX Runtime."""
    module = TensorRT()
    sessions: list[onnxruntime.InferenceSession] = []

    def input_shape(path):
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        module.shape = tuple(session.get_inputs()[0].shape)
        module.outputs = {value.name: tuple(value.shape) for value in session.get_outputs()}
        sessions.append(session)
        return module.shape

    class Network(tensorrt_network.TensorRTNetwork):
        """Its engine is the one of the session that was opened last when it was made."""

        def __init__(self, *values):
            super().__init__(*values)
            session = sessions[-1]
            self._context._module = SimpleNamespace(
                log=module.log,
                runs=True,
                outputs=module.outputs,
                compute=lambda images: session.run(None, {"images": images}),
            )

    for place in (acceleration, tensorrt_network):
        monkeypatch.setattr(place, "check_cuda", lambda device: None)
        monkeypatch.setattr(place, "import_tensorrt", lambda: module)
    monkeypatch.setattr(tensorrt_network, "input_shape", input_shape)
    monkeypatch.setattr(tensorrt_network, "TensorRTNetwork", Network)
    monkeypatch.setattr(engine_cache.Gpu, "of", lambda device: engine_cache.Gpu("Orin", (8, 7)))
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: Stream(5))
    accelerate(toy, config(tmp_path, runtime="tensorrt", precision=precision), IMAGE)
    assert_same(toy, rgb, atol)
    assert len(list((tmp_path / "graphs").glob(f"*_{precision}_*_orin-sm87.engine"))) == 2
    assert sum(entry[0] == "run" for entry in module.log) == 1 + 2


def test_compiled_networks_say_the_same(toy, tmp_path, rgb):
    torch._dynamo.reset()
    # One network, for the compiler's time's sake; the other has nothing to tell them apart.
    settings = config(tmp_path, runtime="compile", instance_embeddings="patches")
    assert_same(accelerate(toy, settings, IMAGE), rgb)
    assert toy.patch.run is not toy.patch._network


@pytest.mark.parametrize("runtime", ["onnxruntime", "compile"])
def test_images_beyond_memory_are_refused_by_their_size(toy, tmp_path, runtime):
    with pytest.raises(EncoderError, match=r"^parameters 'image\.width', 'image\.height': encoder 'toy' .* memory") as told:
        accelerate(toy, config(tmp_path, runtime=runtime), ImageConfig(height=1_600_000, width=3_200_000))
    assert "3200000 x 1600000" in str(told.value)
    assert "compiler" not in str(told.value)
    assert "\n" not in str(told.value)
    assert toy.patch.run is toy.patch._network


def test_without_a_compiler_one_line_says_so(toy, tmp_path, monkeypatch):
    from torch._inductor import config as inductor

    torch._dynamo.reset()
    monkeypatch.setattr(inductor.cpp, "cxx", ("no-such-compiler",))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "inductor"))
    with pytest.raises(
        EncoderError, match=r"encoder\.runtime.*torch cannot compile the graph 'patch'.*C\+\+ compiler"
    ) as told:
        accelerate(toy, config(tmp_path, runtime="compile"), IMAGE)
    assert "\n" not in str(told.value)
    assert toy.patch.run is toy.patch._network
