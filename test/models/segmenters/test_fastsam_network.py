"""FastSAM's segmenter over a real ONNX file of the same contract: what it finds, and which files it refuses."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from stand_ins import color_trio, wall_frame

from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import Config, EncoderConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.runtimes.onnx_network import OnnxNetwork
from fus3dmaps_core.segmenters import fastsam
from fus3dmaps_core.segmenters.registry import load_segmenter

HEIGHT, WIDTH = 64, 96
ANCHORS = 8 * 12 + 4 * 6 + 2 * 3
# Centre x, centre y, width, height, score: the whole input, its left half, the same again, and one without confidence.
DETECTIONS = [(48, 32, 96, 64, 0.9), (24, 32, 48, 64, 0.6), (24, 32, 47, 64, 0.5), (70, 20, 9, 9, 0.39)]


def write_network(
    path: Path,
    *,
    inputs: tuple[int | str, ...] = (1, 3, HEIGHT, WIDTH),
    kind: int = TensorProto.FLOAT,
    detections: tuple[int, ...] = (1, 37, ANCHORS),
    prototypes: tuple[int | str, ...] = (1, 32, HEIGHT // 4, WIDTH // 4),
    outputs: int = 2,
) -> Path:
    """Write a network with fixed detections whose mask is where the image's red is above 0.7, at a quarter of its sides."""
    values = np.zeros((37, ANCHORS), np.float32)
    for anchor, detection in enumerate(DETECTIONS):
        values[:5, 10 * anchor], values[5, 10 * anchor] = detection, 1.0
    constants = {
        "values": values.reshape(1, 37, ANCHORS),
        "rest": np.full((1, 31, HEIGHT // 4, WIDTH // 4), -1.0, np.float32),
        "threshold": np.array(0.7, np.float32),
        "first": np.array([0]),
        "second": np.array([1]),
        "channels": np.array([1]),
    }
    graph = helper.make_graph(
        [
            helper.make_node("Slice", ["images", "first", "second", "channels"], ["red"]),
            helper.make_node("AveragePool", ["red"], ["coarse"], kernel_shape=[4, 4], strides=[4, 4]),
            helper.make_node("Sub", ["coarse", "threshold"], ["mask"]),
            helper.make_node("Concat", ["mask", "rest"], ["output1"], axis=1),
            helper.make_node("Identity", ["values"], ["output0"]),
        ],
        "stand-in",
        [helper.make_tensor_value_info("images", kind, inputs)],
        [
            helper.make_tensor_value_info("output0", TensorProto.FLOAT, detections),
            helper.make_tensor_value_info("output1", TensorProto.FLOAT, prototypes),
        ][:outputs],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, path)
    return path


def two_rectangles(height: int, width: int) -> np.ndarray:
    """Draw bright rectangles left and right on a dark image, in whole cells of the network."""
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[height // 4 : height // 2, width // 6 : width // 3] = 255
    rgb[height // 2 : 3 * height // 4, 2 * width // 3 : 5 * width // 6] = 255
    return rgb


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (480, 720), (32, 48)])
def test_known_rectangles_are_found_end_to_end(size, tmp_path):
    height, width = size
    segmenter = load_segmenter("fastsam", EncoderConfig(), str(write_network(tmp_path / "mine.onnx")))
    found = segmenter.segment(two_rectangles(height, width), np.zeros(size, np.float32))
    assert found.masks.shape == (2, height, width)
    left, right = (
        [width // 6, height // 4, width // 3, height // 2],
        [2 * width // 3, height // 2, 5 * width // 6, 3 * height // 4],
    )
    cell = 4 * height / HEIGHT
    assert np.abs(found.boxes[0] - [left[0], left[1], right[2], right[3]]).max() <= cell
    assert np.abs(found.boxes[1] - left).max() <= cell
    assert np.array_equal(found.masks[1], found.masks[0] & (np.arange(width) < width / 2))


def test_480x640_is_letterboxed_and_the_masks_lie_where_the_objects_are(tmp_path):
    segmenter = load_segmenter("fastsam", EncoderConfig(), str(write_network(tmp_path / "mine.onnx")))
    rgb = np.zeros((480, 640, 3), np.uint8)
    rgb[120:240, 120:240] = 255
    found = segmenter.segment(rgb, np.zeros((480, 640), np.float32))
    assert len(found) == 1  # In both boxes whole.
    assert np.abs(found.boxes[0] - [120, 120, 240, 240]).max() <= 4 * 480 / HEIGHT
    expected = np.zeros((480, 640), bool)
    expected[120:240, 120:240] = True
    assert (found.masks[0] & expected).sum() / (found.masks[0] | expected).sum() > 0.7


def test_nothing_found_and_the_same_from_several_threads(tmp_path):
    segmenter = load_segmenter("fastsam", EncoderConfig(), str(write_network(tmp_path / "mine.onnx")))
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    empty = segmenter.segment(np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth)
    assert empty.masks.shape == (0, HEIGHT, WIDTH)
    rgb = np.asfortranarray(two_rectangles(HEIGHT, WIDTH))
    once = segmenter.segment(rgb, depth)
    with ThreadPoolExecutor(4) as pool:
        for again in pool.map(lambda _: segmenter.segment(rgb, depth), range(16)):
            assert np.array_equal(again.masks, once.masks)


def test_the_pipeline_maps_with_the_segmenter_that_one_parameter_names(tmp_path, monkeypatch):
    monkeypatch.setattr("fus3dmaps_core.pipeline.load_trio", lambda *options: color_trio())
    path = write_network(tmp_path / "mine.onnx")
    config = Config.from_flat({"segmenter.name": "fastsam", "segmenter.weights": str(path), "fusion.window_radius_m": 6.0})
    pipeline = Pipeline.from_config(config)
    reports = [pipeline.process(wall_frame(i, x_m=0.15 * i)) for i in range(3)]
    assert [report.proposals for report in reports if report.instances] == [1, 1, 1]
    request = TextQuery(["red"], layer="instances")
    answer = answer_query(pipeline.semantic_map, pipeline.trio.text, request, pipeline.trio.logit_scale)
    (instance,) = answer.instances
    assert np.allclose(instance.centroid_m, [-0.4, 0.0, 2.0], atol=0.1)


@pytest.mark.parametrize("name", ["FastSAM-s", "FastSAM-x"])
def test_it_is_found_in_a_directory_and_in_the_cache(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "fus3dmaps" / name.lower()
    folder.mkdir(parents=True)
    write_network(folder / f"{name}.onnx")
    for value in (str(folder), ""):
        segmenter = load_segmenter("fastsam", EncoderConfig(), value)
        assert len(segmenter.segment(two_rectangles(64, 96), np.zeros((64, 96), np.float32))) == 2


@pytest.mark.parametrize(("precision", "is_rounded"), [("fp32", False), ("fp16", True), ("bf16", True)])
def test_tensorrt_runs_it_in_the_precision_of_the_encoders(precision, is_rounded, tmp_path, monkeypatch):
    path, asked = write_network(tmp_path / "mine.onnx"), []

    def open_network(*options):
        asked.append(options)
        return OnnxNetwork(options[0], "cpu")

    monkeypatch.setattr(fastsam, "check_cuda", lambda device: None)
    monkeypatch.setattr(fastsam, "open_network", open_network)
    encoder = EncoderConfig(runtime="tensorrt", precision=precision, graph_directory=str(tmp_path / "graphs"))
    segmenter = load_segmenter("fastsam", encoder, str(path))
    ((run, device, runtime, said, directory),) = asked
    assert (device, runtime, said, directory) == ("cpu", "tensorrt", precision, tmp_path / "graphs")
    assert (run != path) == is_rounded
    assert run.parent == (directory if is_rounded else tmp_path)
    assert len(segmenter.segment(two_rectangles(64, 96), np.zeros((64, 96), np.float32))) == 2


def test_tensorrt_on_the_cpu_is_refused_by_name(tmp_path):
    path = write_network(tmp_path / "mine.onnx")
    with pytest.raises(EncoderError, match=r"tensorrt runs on CUDA devices alone, 'encoder.device' is 'cpu'"):
        load_segmenter("fastsam", EncoderConfig(runtime="tensorrt"), str(path))


@pytest.mark.parametrize(
    "other",
    [
        {"outputs": 1},
        {"detections": (1, 116, ANCHORS)},  # 80 classes and 32 weights: YOLOv8's own
        {"detections": (1, 300, 38)},  # exported with nms=True
        {"prototypes": (1, 32, "height", "width")},  # exported with dynamic=True
        {"inputs": ("batch", 3, "height", "width")},
        {"inputs": (1, 3, HEIGHT, 104)},
        {"kind": TensorProto.FLOAT16},  # exported with half=True
    ],
)
def test_another_network_is_refused_by_what_it_takes_and_gives(other, tmp_path):
    path = write_network(tmp_path / "other.onnx", **other)
    with pytest.raises(
        EncoderError, match=r"^parameter 'segmenter\.weights': FastSAM: .*other\.onnx' is another network"
    ) as found:
        load_segmenter("fastsam", EncoderConfig(), str(path))
    assert "\n" not in str(found.value)


def test_a_file_that_is_cut_short_is_refused(tmp_path):
    path = tmp_path / "FastSAM-s.onnx"
    path.write_bytes(write_network(tmp_path / "whole.onnx").read_bytes()[:-500])
    with pytest.raises(EncoderError, match=r"^parameter 'segmenter\.weights': FastSAM: .*cut short") as found:
        load_segmenter("fastsam", EncoderConfig(), str(path))
    assert "\n" not in str(found.value)
