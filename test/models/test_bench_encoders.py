"""The figures of vision models: what is counted and timed of known networks, and what the command writes and refuses."""

from __future__ import annotations

import io
import json
import os
import subprocess
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from benchmarks import encoders, random_weights
from benchmarks.encoder_tables import print_models, with_ratios
from benchmarks.flops import DETECTOR_INPUT, count_detector, count_flops, count_onnx
from benchmarks.model_figures import Job, Seconds, modules_in, parameters_of, resident_bytes, sample
from benchmarks.model_process import cpu_seconds, view
from benchmarks.segmenter_figures import measure_segmenter, sam2_flops
from benchmarks.trio_figures import figures_of
from graph_trios import CROP_PX, HEIGHT, WIDTH, narrow_clip_dinoiser
from onnx import TensorProto, helper, numpy_helper
from rich.console import Console
from torch import nn
from torch.nn import functional

from fus3dmaps_core.encoders.registry import names
from fus3dmaps_core.segmenters.sam2.network import build_sam2

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "bench"
JOB = Job("trio", "lite", "cpu", "torch", "fp16", 1, HEIGHT, WIDTH, 1, 60.0, "", True, "/nowhere")


class Attention(nn.Module):
    """Four heads over 10 tokens by torch's module, whose fused path no counter sees, and a fused attention of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(32, 4, batch_first=True)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        mixed = self.attention(tokens, tokens, tokens, need_weights=False)[0]
        return functional.scaled_dot_product_attention(mixed[:, None], mixed[:, None], mixed[:, None])


def test_operations_of_layers_are_those_of_their_formulas():
    conv = nn.Conv2d(3, 8, 3, stride=2, padding=1)
    depthwise = nn.Conv2d(8, 8, 5, padding=2, groups=8)
    assert count_flops(nn.Sequential(conv, depthwise), torch.zeros(2, 3, 32, 48)) == 2 * 2 * (16 * 24) * 8 * (27 + 25)
    assert count_flops(nn.Linear(20, 30), torch.zeros(4, 7, 20)) == 2 * 4 * 7 * 20 * 30


def test_fused_attention_is_counted_and_left_as_it_was():
    network = Attention().eval().requires_grad_(False)
    tokens, width = 10, 32
    projections, products = 2 * tokens * width * 4 * width, 2 * (2 * tokens * tokens * width)
    enabled = torch.backends.mha.get_fastpath_enabled()
    assert count_flops(network, torch.zeros(1, tokens, width)) == projections + 2 * products
    assert torch.backends.mha.get_fastpath_enabled() == enabled


def test_an_onnx_file_has_the_operations_of_its_layers(tmp_path):
    rng = np.random.default_rng(0)
    weights = {"conv": (8, 3, 3, 3), "up": (8, 4, 2, 2), "flat": (10,), "left": (5, 4)}
    nodes = [
        helper.make_node("Conv", ["image", "conv"], ["a"], pads=[1, 1, 1, 1], strides=[2, 2]),
        helper.make_node("ConvTranspose", ["a", "up"], ["b"], strides=[2, 2]),
        helper.make_node("MatMul", ["left", "b"], ["c"]),
    ]
    nodes[2].input[1] = "rows"
    nodes.insert(2, helper.make_node("Reshape", ["b", "shape"], ["rows"]))
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, (1, 3, 16, 16))],
        [helper.make_tensor_value_info("c", TensorProto.FLOAT, (5, 256))],
        [
            *(numpy_helper.from_array(rng.normal(size=shape).astype(np.float32), name) for name, shape in weights.items()),
            numpy_helper.from_array(np.array([4, 256]), "shape"),
        ],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), tmp_path / "small.onnx")
    parameters, flops = count_onnx(tmp_path / "small.onnx")
    assert parameters == 8 * 27 + 8 * 16 + 10 + 20
    assert flops == 2 * (8 * 8 * 8 * 27) + 2 * (8 * 8 * 8 * 4 * 4) + 2 * (5 * 4 * 256)


def test_the_detector_has_the_size_of_its_kind():
    parameters, flops = count_detector()
    assert DETECTOR_INPUT[2:] == (300, 300)
    assert 16.5e6 < parameters < 17.5e6  # SSD-MobileNet-v2 with 91 classes.
    assert 3e9 < flops < 4.5e9


def test_shared_weights_count_once():
    one, other = nn.Linear(3, 5), nn.Linear(5, 2)
    assert sum(parameters_of([one, nn.Sequential(one, other)]).values()) == 15 + 5 + 10 + 2

    class Holder:
        def __init__(self, held: object) -> None:
            self.held, self.name = held, "holder"

    assert modules_in(Holder(Holder(one))) == [one]


def test_samples_end_with_the_repeats_or_the_budget():
    calls: list[int] = []
    assert len(sample(calls.append, 0.0, replace(JOB, repeats=3))) == 3
    assert calls == [1, 2, 3]
    assert len(sample(calls.append, 1.0, replace(JOB, repeats=9, budget_s=4.5))) == 4
    assert sample(calls.append, 7.0, replace(JOB, budget_s=5.0)) == [7.0]
    assert Seconds.of([4.0, 1.0, 3.0], 0.5) == Seconds(0.5, 1.5, 3)


def test_busy_time_is_the_machines_and_holds_that_of_this_process():
    before = cpu_seconds()
    while cpu_seconds()[2] - before[2] < 0.3:
        pass
    all_s, busy_s, own_s = (now - then for now, then in zip(cpu_seconds(), before, strict=True))
    assert 0.3 <= own_s <= busy_s + 0.1  # Ticks of 10 ms.
    assert busy_s <= all_s + 1e-9  # Both are sums of the same ticks.


def test_resident_memory_is_what_a_process_holds():
    before = resident_bytes("VmRSS")
    held = np.ones(2**25)
    assert resident_bytes("VmRSS") - before > 0.9 * held.nbytes
    assert resident_bytes("VmHWM") >= resident_bytes("VmRSS")


@pytest.fixture(scope="module")
def measured():
    trio = narrow_clip_dinoiser()
    rgb = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    return trio, figures_of(replace(JOB, name="clip_dinoiser", budget_s=60.0), rgb, trio, 1.5, 0.0)


def test_a_trio_is_counted_as_it_is(measured):
    trio, figures = measured
    network = trio.patch.graph(HEIGHT, WIDTH).network
    clip = trio.text._clip
    visual = sum(weight.numel() for weight in clip.visual.parameters())
    heads = sum(weight.numel() for weight in network.heads.parameters())
    assert figures.image_parameters == visual + heads
    assert figures.text_parameters == sum(weight.numel() for weight in clip.parameters()) - visual
    assert figures.frame_input == (1, 3, 112, 160)
    assert figures.patch_grid == (7, 10)
    assert figures.crop_input[1:] == (3, CROP_PX, CROP_PX)
    assert (figures.dimension, figures.precision, figures.load_s) == (512, "float32", 1.5)
    assert figures.frame_gflop == count_flops(network, torch.zeros(figures.frame_input)) / 1e9
    # A transformer of 3 blocks of width 768 over 17 tokens, embedding of 16 patches and projection of one token included.
    tokens, width = CROP_PX**2 // 256 + 1, 768
    blocks = 3 * (2 * tokens * 12 * width**2 + 4 * tokens**2 * width)
    assert figures.crop_gflop == (blocks + 2 * (tokens - 1) * width**2 + 2 * width * 512) / 1e9


def test_a_trio_is_timed_in_all_its_parts(measured):
    _, figures = measured
    for times in (figures.frame, figures.crop, figures.prompt):
        assert 0 < times.best <= times.median
        assert times.samples == 1
    assert figures.prompt_sentences == figures.prompt_measured_sentences == 80
    assert 2 <= figures.crop_batch <= figures.crop_input[0]
    assert 0 < figures.loaded_resident_bytes <= figures.peak_resident_bytes
    assert figures.peak_device_bytes is figures.device_in_use_bytes is None


def test_a_prompt_beyond_the_budget_is_worked_out_from_a_few_sentences(measured):
    trio, _ = measured
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    figures = figures_of(replace(JOB, name="clip_dinoiser", budget_s=1e-3), rgb, trio, 0.0, 0.0)
    assert figures.prompt_sentences == 80
    assert figures.prompt_measured_sentences < 80
    assert figures.frame.samples == 1


def test_segmenters_are_measured_as_a_frame_alone():
    rgb, depth_m = view(HEIGHT, WIDTH)
    figures = measure_segmenter(replace(JOB, kind="segmenter"), rgb, depth_m)
    assert (figures.kind, figures.name, figures.frame_input) == ("segmenter", "lite", DETECTOR_INPUT)
    assert figures.image_parameters == count_detector()[0]
    assert figures.frame_gflop == count_detector()[1] / 1e9
    assert figures.crop is figures.prompt is figures.patch_grid is None
    assert 0 < figures.frame.best <= figures.frame.median


def test_the_decoder_of_sam2_is_counted_at_every_point():
    network = build_sam2(side=128)
    image, points = torch.zeros(1, 3, 128, 128), torch.full((6, 2), 64.0)
    once, twice = (sam2_flops(network, image, points[:count], 2) for count in (2, 4))
    encoder = count_flops(network.get_image_embeddings, image)
    assert once > encoder > 0
    assert twice - encoder == 2 * (once - encoder)


def test_tables_name_every_model_its_ratio_and_its_problem(measured):
    _, figures = measured
    other = asdict(replace(figures, name="lite", frame=Seconds(figures.frame.best / 8, 1.0, 1)))
    failed = {"kind": "segmenter", "name": "sam2", "problem": "out of [memory]"}
    models = with_ratios([asdict(figures) | {"busy_with_others": 0.3}, other, failed])
    assert [model.get("frame_over_lite") for model in models] == [pytest.approx(8.0), 1.0, None]
    written = io.StringIO()
    print_models(models, Console(file=written))
    text = written.getvalue()
    assert "clip_dinoiser" in text
    assert "112x160" in text
    assert "trio clip_dinoiser: meanwhile other processes took 30 % of the cores" in text
    assert "segmenter sam2: out of [memory]" in text
    assert with_ratios([asdict(figures)])[0]["frame_over_lite"] is None


def test_every_known_trio_has_random_weights():
    assert set(names()) == set(random_weights.TRIOS)
    with pytest.raises(ValueError, match="no random weights for encoder 'abacus'"):
        random_weights.write_trio("abacus", Path("/nowhere"))


def test_the_command_measures_models_in_processes_of_their_own(tmp_path):
    arguments = ["--trios", "lite", "--segmenters", "none", "--fastsam", "/nowhere/FastSAM-s.onnx", "--repeats", "1"]
    done = subprocess.run(
        [SCRIPT, "--encoders", *arguments, "--height", "96", "--width", "128", "--json", "figures.json"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": "/nowhere"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1, done.stderr
    trio, failed = json.loads((tmp_path / "figures.json").read_text())
    assert (trio["kind"], trio["name"], trio["frame_over_lite"]) == ("trio", "lite", 1.0)
    assert trio["frame_input"] == [1, 3, 96, 128]
    assert trio["patch_grid"] == [6, 8]
    assert trio["image_parameters"] > count_detector()[0]
    assert trio["frame_gflop"] > count_detector()[1] / 1e9
    assert trio["frame"]["samples"] == trio["crop"]["samples"] == trio["prompt"]["samples"] == 1
    assert 0.0 <= trio["busy_with_others"] <= 1.0
    assert trio["peak_resident_bytes"] >= trio["loaded_resident_bytes"] > 0
    assert "there is no file or directory '/nowhere/FastSAM-s.onnx'" in failed["problem"]
    assert failed["problem"] in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trios", "lite,abacus"], "--trios: unknown 'abacus', known are clip_dinoiser, lite, "),
        (["--segmenters", "fastsam"], "--segmenters: unknown 'fastsam', known are lite, sam2"),
        (["--runtime", "abacus"], "--runtime: unknown 'abacus', known are torch, "),
        (["--precision", "int4"], "--precision: unknown 'int4'"),
        (["--device", "abacus"], "torch cannot use 'abacus'"),
        (["--weights", "/nowhere"], "--weights /nowhere: is neither random, installed nor a directory"),
        (["--json", "/nowhere/figures.json"], "--json /nowhere/figures.json: there is no folder /nowhere"),
        (["--threads", "100000"], "--threads: must lie in [1, "),
        (["--repeats", "0"], "--repeats: must be at least 1, got 0"),
        (["--budget-s", "0"], "--budget-s: must be above 0"),
        (["--height", "8"], "--height: must be at least 32, got 8"),
        (["--fast"], "--fast"),
    ],
)
def test_bad_argument_is_refused_in_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as stopped:
        encoders.main(arguments)
    assert stopped.value.code == 2
    refusal = capsys.readouterr().err.strip()
    assert message in refusal
    assert "\n" not in refusal
