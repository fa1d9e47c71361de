"""What SAM 2 is asked and what is taken of its answers, with a network of known answers in its place."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.segmenters.sam2.network import image_weights
from fus3dmaps_core.segmenters.sam2.points import PointSettings, masks_at_points, point_grid
from fus3dmaps_core.segmenters.sam2.segmenter import MEAN, STD, Sam2Segmenter

SIDE = 128


class KnownAnswers:
    """Says that bright pixels are an object when asked at one, and that the rest is one when asked elsewhere.

    Beside each good mask it gives a blurred one, which it thinks well of, and a good one, which it does not.
    """

    def __init__(self) -> None:
        self.config = SimpleNamespace(prompt_encoder_config=SimpleNamespace(image_size=SIDE))
        self.images: list[torch.Tensor] = []
        self.batches: list[int] = []

    def get_image_embeddings(self, image: torch.Tensor) -> list[torch.Tensor]:
        self.images.append(image)
        return [image]

    def __call__(self, image_embeddings, input_points, input_labels, multimask_output):
        assert multimask_output
        assert (input_labels == 1).all()
        self.batches.append(input_points.shape[1])
        bright = image_embeddings[0][0, 0] > 0
        masks, scores = [], []
        for x, y in input_points[0, :, 0]:
            asked = bright[int(y), int(x)]
            mask = torch.where(bright == asked, 1.0, -1.0)[::4, ::4]
            masks.append(torch.stack([10 * mask, 0.5 * mask, 10 * mask]))
            scores.append(torch.tensor([0.95 if asked else 0.9, 0.99, 0.5]))
        return SimpleNamespace(pred_masks=torch.stack(masks)[None], iou_scores=torch.stack(scores)[None])


def picture(height: int, width: int) -> np.ndarray:
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[height // 4 : height // 2, width // 2 : 3 * width // 4] = 255
    return rgb


def test_the_points_are_the_centres_of_equal_cells():
    assert point_grid(2, 100, torch.device("cpu")).tolist() == [[25, 25], [75, 25], [25, 75], [75, 75]]
    points = point_grid(16, 1024, torch.device("cpu"))
    assert points.shape == (256, 2)
    assert (points[0].tolist(), points[1].tolist(), points[-1].tolist()) == ([32, 32], [96, 32], [992, 992])


@pytest.mark.parametrize("size", [(128, 128), (256, 384), (480, 640)])
def test_each_object_is_proposed_once_and_the_best_first(size):
    height, width = size
    network = KnownAnswers()
    found = Sam2Segmenter(network, "cpu").segment(picture(height, width), np.zeros(size, np.float32))
    assert len(found) == 2
    assert found.masks.shape == (2, *size)
    assert (found.masks.dtype, found.boxes.dtype) == (np.bool_, np.int32)
    cell = 4 * np.array([width, height] * 2) / SIDE
    assert (np.abs(found.boxes[0] - [width // 2, height // 4, 3 * width // 4, height // 2]) <= cell).all()
    assert found.boxes[1].tolist() == [0, 0, width, height]
    assert not (found.masks[0] & found.masks[1]).any()
    assert network.batches == [16] * 16


class Rectangles(KnownAnswers):
    """Answers every point with three stable rectangles, some alike, of different merit."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        rng = np.random.default_rng(seed)
        self.masks = np.zeros((48, SIDE // 4, SIDE // 4), bool)
        for mask in self.masks:
            y, x, height, width = *rng.integers(0, 3, 2), *rng.integers(12, 20, 2)
            mask[y : y + height, x : x + width] = True
            mask[y : y + 12, x + 3 : x + rng.integers(3, 9)] = False  # So that equal boxes have unequal masks,
            if rng.random() < 0.5:
                mask[y, x:] = True  # and like masks unlike boxes.
        self.scores = rng.integers(80, 100, 48).astype(np.float32) / 100 + 0.005

    def __call__(self, image_embeddings, input_points, input_labels, multimask_output):
        start = 3 * sum(self.batches)
        self.batches.append(input_points.shape[1])
        rows = slice(start, start + 3 * input_points.shape[1])
        logits = torch.from_numpy(np.where(self.masks[rows], 10.0, -10.0).astype(np.float32))
        scores = torch.from_numpy(self.scores[rows])
        return SimpleNamespace(pred_masks=logits.unflatten(0, (-1, 3))[None], iou_scores=scores.unflatten(0, (-1, 3))[None])


def plain_choice(masks: np.ndarray, scores: np.ndarray) -> list[np.ndarray]:
    """Choose box by box, then mask by mask: whatever is too like a better one is dropped."""
    boxes = []
    for mask in masks:
        filled = np.zeros_like(mask)
        ys, xs = np.nonzero(mask)
        filled[ys.min() : ys.max() + 1, xs.min() : xs.max() + 1] = True
        boxes.append(filled)
    rows = sorted(range(len(masks)), key=lambda row: -scores[row])
    for shapes, limit in ((boxes, 0.7), (masks, 0.9)):
        kept: list[int] = []
        for row in rows:
            shares = [(shapes[row] & shapes[other]).sum() / (shapes[row] | shapes[other]).sum() for other in kept]
            if all(share <= limit for share in shares):
                kept.append(row)
        rows = kept
    return [masks[row] for row in rows]


@given(st.integers(0, 2**16))
def test_the_choice_is_that_of_plain_loops(seed):
    network = Rectangles(seed)
    side = SIDE // 4  # The decoder's own grid, so that the masks are not changed.
    found = Sam2Segmenter(network, "cpu", PointSettings(per_side=4, per_pass=5)).segment(
        picture(side, side), np.zeros((side, side), np.float32)
    )
    expected = plain_choice(network.masks, network.scores)
    assert np.array_equal(found.masks, np.array(expected))


def test_only_masks_that_are_expected_to_be_right_and_are_stable_are_taken():
    network, image = KnownAnswers(), torch.zeros((1, 3, SIDE, SIDE))
    points = point_grid(3, SIDE, torch.device("cpu"))
    taken = masks_at_points(network, [image], points, PointSettings(per_pass=4))
    assert network.batches == [4, 4, 1]
    assert taken.scores.tolist() == pytest.approx([0.9] * 9)
    assert (taken.logits == 10).all()
    unstable = masks_at_points(network, [image], points, PointSettings(min_stability=-1.0, min_iou=0.98))
    assert unstable.scores.tolist() == pytest.approx([0.99] * 9)
    everything = masks_at_points(network, [image], points, PointSettings(min_stability=-1.0, min_iou=0.0))
    assert everything.scores.tolist() == pytest.approx([0.9, 0.99, 0.5] * 9)


def test_an_image_with_nothing_to_take():
    segmenter = Sam2Segmenter(KnownAnswers(), "cpu", PointSettings(min_iou=1.0))
    found = segmenter.segment(picture(50, 70), np.zeros((50, 70), np.float32))
    assert found.masks.shape == (0, 50, 70)
    assert found.boxes.shape == (0, 4)


def test_the_image_is_stretched_to_the_square_and_normalised():
    network = KnownAnswers()
    rgb = np.full((60, 160, 3), (10, 130, 250), np.uint8)[:, ::2]  # Not contiguous.
    Sam2Segmenter(network, "cpu").segment(rgb, np.zeros((60, 80), np.float32))
    (image,) = network.images
    assert image.shape == (1, 3, SIDE, SIDE)
    expected = (np.array([10, 130, 250]) / 255 - MEAN) / STD
    assert np.allclose(image[0].numpy(), expected[:, None, None], atol=1e-5)


def test_parts_of_the_video_model_are_left_out_and_a_tensor_of_two_names_is_found_by_either():
    one, other = "shared_image_embedding.positional_embedding", "prompt_encoder.shared_embedding.positional_embedding"
    tensor = torch.ones(2, 3)
    state = {"no_memory_embedding": tensor, "memory_encoder.fuser.weight": tensor, "no_object_pointer": tensor}
    assert set(image_weights({**state, one: tensor})) == {"no_memory_embedding", one, other}
    assert set(image_weights({**state, other: tensor})) == {"no_memory_embedding", one, other}
    assert set(image_weights(state)) == {"no_memory_embedding"}
