"""SAM 2.1 Hiera tiny on its true architecture at full width, with random weights, on small images to be quick."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from transformers import Sam2ImageProcessor, Sam2VideoConfig, Sam2VideoModel

from fus3dmaps_core.config.schema import EncoderConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.segmenters.registry import load_segmenter
from fus3dmaps_core.segmenters.sam2.network import build_sam2, load_sam2
from fus3dmaps_core.segmenters.sam2.points import PointSettings, masks_at_points, point_grid
from fus3dmaps_core.segmenters.sam2.published import SAM2
from fus3dmaps_core.segmenters.sam2.segmenter import STD, Sam2Segmenter

SIDE = 256
ALL = PointSettings(per_side=3, min_iou=0.0, min_stability=-1.0)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(5)
    return build_sam2(SIDE)


@pytest.fixture(scope="module")
def published() -> dict[str, torch.Tensor]:
    """Make weights as they are published: the video model's."""
    torch.manual_seed(6)
    return Sam2VideoModel(Sam2VideoConfig()).state_dict()


@pytest.fixture(scope="module")
def directory(published, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    save_file(published, folder / "model.safetensors")
    return folder


def picture(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height + width).integers(0, 256, (height, width, 3)).astype(np.uint8)


def test_the_architecture_is_the_published_one(network, published):
    assert sum(value.numel() for value in published.values()) == 38_963_010
    assert sum(parameter.numel() for parameter in network.parameters()) == 31_440_721
    trained = build_sam2()
    assert {name: value.shape for name, value in trained.state_dict().items()} == {
        name: value.shape for name, value in network.state_dict().items()
    }
    assert (trained.config.prompt_encoder_config.image_size, trained.prompt_encoder.image_embedding_size) == (1024, (64, 64))


def test_the_weights_of_the_published_file_are_those_that_run(published, directory):
    loaded = load_sam2(str(directory), SIDE).state_dict()
    assert all(torch.equal(value, published[name]) for name, value in loaded.items())
    segmenter = load_segmenter("sam2", EncoderConfig(), str(directory / "model.safetensors"))
    assert isinstance(segmenter, Sam2Segmenter)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda state: state.pop("mask_decoder.conv_s0.weight"), "1 missing (mask_decoder.conv_s0.weight)"),
        (lambda state: state.update(detector=torch.ones(1)), "1 not expected (detector)"),
        (lambda state: state.update({"mask_decoder.iou_token.weight": torch.ones(1, 2)}), "1 of another shape"),
    ],
)
def test_weights_of_another_network_are_refused(published, tmp_path, change, complaint):
    state = dict(published)
    change(state)
    path = tmp_path / "model.safetensors"
    save_file(state, path)
    with pytest.raises(EncoderError) as refusal:
        load_sam2(str(path), SIDE)
    assert complaint in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert "/facebook/sam2.1-hiera-tiny/resolve/" in str(refusal.value)


def test_a_graph_in_place_of_weights_is_refused_by_parameter_with_what_to_get(tmp_path):
    path = tmp_path / "sam2.onnx"
    path.write_bytes(b"graph")
    with pytest.raises(EncoderError, match=r"sam2\.onnx': an ONNX graph.*download https://.*set 'segmenter\.weights'"):
        load_segmenter("sam2", EncoderConfig(), str(path))


def test_without_weights_it_says_what_to_download_and_where_to_put_it(tmp_path):
    with pytest.raises(EncoderError) as refusal:
        load_segmenter("sam2", EncoderConfig(), str(tmp_path))
    message = str(refusal.value)
    assert message.startswith("parameter 'segmenter.weights': SAM 2.1 Hiera tiny: ")
    assert f"https://huggingface.co/facebook/sam2.1-hiera-tiny/resolve/{SAM2.revision}/model.safetensors" in message
    assert "\n" not in message


def test_points_together_are_points_one_by_one(network):
    image = torch.randn((1, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        features = network.get_image_embeddings(image)
        points = point_grid(3, SIDE, torch.device("cpu"))
        together = masks_at_points(network, features, points, ALL)
        one_by_one = [
            masks_at_points(network, features, point[None], PointSettings(per_pass=1, min_iou=0.0, min_stability=-1.0))
            for point in points
        ]
    assert together.logits.shape == (27, SIDE // 4, SIDE // 4)
    assert torch.allclose(together.logits, torch.cat([part.logits for part in one_by_one]), atol=1e-4)
    assert torch.allclose(together.scores, torch.cat([part.scores for part in one_by_one]), atol=1e-5)
    moved = masks_at_points(network, features, points + 20.0, ALL)
    assert not torch.allclose(moved.logits, together.logits, atol=1e-3)


def test_the_numbers_are_those_of_the_whole_model(network):
    """What transformers gives for one image and one point, from its pixels on."""
    image = torch.randn((1, 3, SIDE, SIDE), generator=torch.Generator().manual_seed(2))
    point = torch.tensor([[50.0, 130.0]])
    with torch.inference_mode():
        whole = network(pixel_values=image, input_points=point[None, None])
        ours = masks_at_points(network, network.get_image_embeddings(image), point, ALL)
    assert torch.allclose(ours.logits, whole.pred_masks[0, 0], atol=1e-5)
    assert torch.allclose(ours.scores, whole.iou_scores[0, 0], atol=1e-6)


@pytest.mark.parametrize("size", [(480, 640), (97, 61), (SIDE, SIDE)])
def test_the_image_is_that_of_the_published_processor(network, size):
    rgb = picture(*size)
    expected = Sam2ImageProcessor(size={"height": SIDE, "width": SIDE})(images=rgb, return_tensors="pt")["pixel_values"]
    rounding = 1 / (255 * min(STD))  # It rounds to whole numbers after either axis.
    assert torch.allclose(Sam2Segmenter(network, "cpu")._input(rgb), expected, atol=rounding + 1e-4)


@pytest.mark.parametrize("size", [(480, 640), (97, 61), (200, 333)])
def test_masks_have_the_size_of_the_image_and_are_the_same_each_time(network, size):
    segmenter, rgb, depth = Sam2Segmenter(network, "cpu", ALL), picture(*size), np.zeros(size, np.float32)
    found = segmenter.segment(rgb, depth)
    assert len(found) > 0
    assert found.masks.shape == (len(found), *size)
    assert (found.masks.dtype, found.boxes.dtype) == (np.bool_, np.int32)
    for mask, (x0, y0, x1, y1) in zip(found.masks, found.boxes, strict=True):
        ys, xs = np.nonzero(mask)
        assert (x0, y0, x1, y1) == (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)
    again = segmenter.segment(np.asfortranarray(rgb), depth)
    assert np.array_equal(again.masks, found.masks)
    assert np.array_equal(again.boxes, found.boxes)


def test_nothing_taken_and_several_threads(network):
    rgb, depth = picture(120, 160), np.zeros((120, 160), np.float32)
    empty = Sam2Segmenter(network, "cpu", PointSettings(per_side=2, min_iou=1.0)).segment(rgb, depth)
    assert empty.masks.shape == (0, 120, 160)
    assert empty.boxes.shape == (0, 4)
    segmenter = Sam2Segmenter(network, "cpu", PointSettings(per_side=2, min_iou=0.0, min_stability=-1.0))
    images = [picture(120, 160), picture(121, 160)]
    once = [segmenter.segment(image, depth) for image in images]
    with ThreadPoolExecutor(2) as pool:
        for found, expected in zip(
            pool.map(lambda image: segmenter.segment(image, depth), images * 2), once * 2, strict=True
        ):
            assert np.array_equal(found.masks, expected.masks)
