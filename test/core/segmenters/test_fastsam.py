"""FastSAM's work before and after its network, against a plain reference and known rectangles; and its refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fus3dmaps_core.config.schema import EncoderConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.segmenters.fastsam.decoding import MAX_PROPOSALS, masks_of, select
from fus3dmaps_core.segmenters.fastsam.letterbox import Letterbox
from fus3dmaps_core.segmenters.fastsam.segmenter import FastSamSegmenter
from fus3dmaps_core.segmenters.registry import load_segmenter

SHAPE = (64, 96)  # Of the network's input.
NEAR_ZERO = 1e-4  # Logits that rounding may take to either side of the threshold.


def anchors(shape=SHAPE) -> int:
    return sum((shape[0] // stride) * (shape[1] // stride) for stride in (8, 16, 32))


def some_outputs(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Make detections with equal scores, equal boxes and few confident ones, and prototypes."""
    rng = np.random.default_rng(seed)
    n = anchors()
    predictions = np.zeros((37, n), np.float32)
    predictions[:2] = rng.integers(0, 13, (2, n)) * 8
    predictions[2:4] = rng.integers(1, 8, (2, n)) * 8
    predictions[4] = rng.integers(0, 6, n) / 10
    predictions[5:] = rng.integers(-2, 3, (32, n))
    same = rng.integers(0, n, (2, n // 4))
    predictions[:, same[0]] = predictions[:, same[1]]  # The same detection twice.
    prototypes = rng.normal(size=(32, SHAPE[0] // 4, SHAPE[1] // 4)).astype(np.float32)
    return predictions, prototypes


def iou(a: np.ndarray, b: np.ndarray) -> float:
    width = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
    height = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    return width * height / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height)


def plain_select(predictions: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return boxes and coefficients of what remains, highest score first."""
    rows = [row for row in range(predictions.shape[1]) if predictions[4, row] > 0.4]
    rows.sort(key=lambda row: -predictions[4, row])
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    for row in rows:
        x, y, width, height = predictions[:4, row].astype(float)
        box = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
        if all(iou(box, other) <= 0.9 for other, _ in kept):
            kept.append((box, predictions[5:, row]))
    return kept


def plain_masks(kept, prototypes: np.ndarray, height: int, width: int) -> tuple[list[np.ndarray], bool]:
    """Make masks at the size of the image, and tell whether rounding could change any of them."""
    gain = min(SHAPE[0] / height, SHAPE[1] / width)
    inner_height, inner_width = round(height * gain), round(width * gain)
    top, left = (SHAPE[0] - inner_height) // 2, (SHAPE[1] - inner_width) // 2
    y = top + (np.arange(height) + 0.5) * inner_height / height
    x = left + (np.arange(width) + 0.5) * inner_width / width
    sure, coarse_kept, masks = True, [], []
    for box, coefficients in kept:
        logits = sum(
            float(weight) * prototype.astype(float) for weight, prototype in zip(coefficients, prototypes, strict=True)
        )
        coarse = np.zeros(logits.shape, bool)
        for row in range(logits.shape[0]):
            for column in range(logits.shape[1]):
                middle_x, middle_y = 4 * column + 2, 4 * row + 2
                inside = box[0] <= middle_x < box[2] and box[1] <= middle_y < box[3]
                coarse[row, column] = inside and logits[row, column] > 0
                sure &= not inside or abs(logits[row, column]) > NEAR_ZERO
        shares = [(coarse & other).sum() / (coarse | other).sum() for other in coarse_kept if (coarse | other).any()]
        if any(share > 0.9 for share in shares):
            continue
        coarse_kept.append(coarse)
        values = np.array([[bilinear(logits, px / 4, py / 4, top, left, inner_height, inner_width) for px in x] for py in y])
        columns, rows = (x - left) * width / inner_width - 0.5, (y - top) * height / inner_height - 0.5
        edges = (box - [left, top, left, top]) * np.array([width / inner_width, height / inner_height] * 2)
        columns, rows = np.round(columns), np.round(rows)
        inside = ((rows >= edges[1]) & (rows < edges[3]))[:, None] & ((columns >= edges[0]) & (columns < edges[2]))[None]
        sure &= bool((np.abs(values[inside]) > NEAR_ZERO).all())
        if (inside & (values > 0)).any():
            masks.append(inside & (values > 0))
    return masks, bool(sure)


def bilinear(logits, x, y, top, left, inner_height, inner_width) -> float:
    """Interpolate at a place in cells, whose centres are at halves; outside the image's cells the nearest counts."""
    first_row, last_row = top // 4, -(-(top + inner_height) // 4) - 1
    first_column, last_column = left // 4, -(-(left + inner_width) // 4) - 1
    row, column = int(np.floor(y - 0.5)), int(np.floor(x - 0.5))
    down, across = y - 0.5 - row, x - 0.5 - column
    value = 0.0
    for i, share_i in ((row, 1 - down), (row + 1, down)):
        for j, share_j in ((column, 1 - across), (column + 1, across)):
            cell = min(max(i, first_row), last_row), min(max(j, first_column), last_column)
            value += share_i * share_j * logits[cell]
    return value


@given(seed=st.integers(0, 2**16))
@settings(max_examples=40)
def test_selection_is_that_of_plain_loops(seed):
    predictions, _ = some_outputs(seed)
    found = select(torch.from_numpy(predictions))
    expected = plain_select(predictions)
    assert len(found.boxes) == len(expected)
    for box, coefficients, (plain_box, plain_coefficients) in zip(found.boxes, found.coefficients, expected, strict=True):
        assert np.allclose(box.numpy(), plain_box, atol=1e-4)
        assert np.array_equal(coefficients.numpy(), plain_coefficients)


@given(seed=st.integers(0, 2**16), size=st.sampled_from([SHAPE, (20, 40), (40, 20), (37, 51)]))
@settings(max_examples=8)
def test_masks_are_those_of_plain_loops(seed, size):
    predictions, prototypes = some_outputs(seed)
    chosen = select(torch.from_numpy(predictions))
    few = type(chosen)(chosen.boxes[:6], chosen.coefficients[:6])
    found = masks_of(few, torch.from_numpy(prototypes), Letterbox.of(size, SHAPE), *size)
    expected, sure = plain_masks(plain_select(predictions)[:6], prototypes, *size)
    assume(sure)
    assert len(found) == len(expected)
    assert all(np.array_equal(a, b) for a, b in zip(found.masks, expected, strict=True))


def test_at_most_so_many_proposals_and_those_of_the_highest_scores():
    n = 2 * MAX_PROPOSALS
    predictions = torch.zeros((37, n))
    predictions[0], predictions[2:4] = 10.0 * torch.arange(n), 5.0
    predictions[4] = torch.linspace(0.5, 0.9, n)
    found = select(predictions)
    assert len(found.boxes) == MAX_PROPOSALS
    assert found.boxes[:, 0].tolist() == [10.0 * row - 2.5 for row in range(n - 1, MAX_PROPOSALS - 1, -1)]


def test_of_boxes_that_all_but_coincide_the_better_remains():
    predictions = torch.zeros((37, 3))
    for anchor, (x1, y1, score) in enumerate(((93, 10, 0.6), (100, 10, 0.9), (100, 8.75, 0.7))):
        predictions[:5, anchor] = torch.tensor([x1 / 2, y1 / 2, x1, y1, score])  # From the upper left corner.
    assert select(predictions).boxes.tolist() == [[0, 0, 100, 10], [0, 0, 100, 8.75]]


def test_of_masks_that_coincide_the_better_remains_whatever_its_box():
    predictions = torch.zeros((37, 3))
    for anchor, (x1, y1, score) in enumerate(((52, 40, 0.6), (80, 64, 0.9), (48, 64, 0.7))):
        box = torch.tensor([x1 / 2, y1 / 2, x1, y1])  # From the upper left corner.
        predictions[:4, anchor], predictions[4, anchor], predictions[5, anchor] = box, score, 1.0
    prototypes = torch.full((32, SHAPE[0] // 4, SHAPE[1] // 4), -1.0)
    prototypes[0, 4:8, 2:14] = 1.0  # Columns 8 to 56, of which the first box has 11 cells of 12 and the last 10.
    found = masks_of(select(predictions), prototypes, Letterbox.of(SHAPE, SHAPE), *SHAPE)
    assert len(found) == 2
    assert found.boxes[0].tolist() == [8, 16, 56, 32]
    assert found.boxes[1].tolist() == [8, 16, 48, 32]


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        ((64, 96), (64, 96, 0, 0)),
        ((32, 48), (64, 96, 0, 0)),
        ((32, 96), (32, 96, 16, 0)),
        ((128, 128), (64, 64, 0, 16)),
        ((31, 96), (31, 96, 16, 0)),  # the odd row of grey is below
        ((1, 5000), (1, 96, 31, 0)),
    ],
)
def test_where_an_image_lies_in_the_input(image, expected):
    box = Letterbox.of(image, SHAPE)
    assert (box.height, box.width, box.top, box.left) == expected
    rgb = np.random.default_rng(0).integers(0, 256, (*image, 3)).astype(np.uint8)
    fitted = box.fit(rgb)
    assert fitted.shape == (*SHAPE, 3)
    inner = fitted[box.top : box.top + box.height, box.left : box.left + box.width]
    assert np.array_equal(inner, cv2.resize(rgb, (box.width, box.height), interpolation=cv2.INTER_LINEAR))
    outside = np.ones(SHAPE, bool)
    outside[box.top : box.top + box.height, box.left : box.left + box.width] = False
    assert (fitted[outside] == 114).all()


class Rectangles:
    """A network that says of bright pixels, wherever they are, that they are one object."""

    def __init__(self) -> None:
        self.images: list[torch.Tensor] = []

    def __call__(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        self.images.append(images)
        bright = images[0, 0] > 0.9
        predictions, prototypes = torch.zeros((1, 37, anchors())), torch.full((1, 32, SHAPE[0] // 4, SHAPE[1] // 4), -1.0)
        prototypes[0, 0] = 20 * images[0, 0].unfold(0, 4, 4).unfold(1, 4, 4).mean(dim=(2, 3)) - 14
        if bright.any():
            ys, xs = torch.nonzero(bright).T
            x0, y0, x1, y1 = xs.min(), ys.min(), xs.max() + 1, ys.max() + 1
            box = torch.stack([(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0])
            for anchor, score in ((7, 0.9), (3, 0.9), (5, 0.3)):
                predictions[0, :4, anchor], predictions[0, 4, anchor], predictions[0, 5, anchor] = box, score, 1.0
        return predictions, prototypes


@pytest.mark.parametrize("size", [SHAPE, (128, 192), (64, 64), (480, 640)])
def test_a_rectangle_is_found_where_it_is(size):
    height, width = size
    x0, y0, x1, y1 = width // 4, height // 4, width // 2, 3 * height // 4
    rgb = np.full((height, width, 3), 40, np.uint8)
    rgb[y0:y1, x0:x1] = 255
    found = FastSamSegmenter(Rectangles(), SHAPE, "cpu").segment(rgb, np.zeros(size, np.float32))
    assert len(found) == 1  # Twice detected, and once without confidence.
    expected = np.zeros(size, bool)
    expected[y0:y1, x0:x1] = True
    cell = 4 * max(1.0, height / SHAPE[0], width / SHAPE[1])
    assert np.abs(found.boxes[0] - [x0, y0, x1, y1]).max() <= cell
    assert (found.masks[0] & expected).sum() / (found.masks[0] | expected).sum() > 0.8
    assert found.masks.shape == (1, *size)


def test_what_the_network_is_given():
    network = Rectangles()
    wide = np.random.default_rng(1).integers(0, 256, (SHAPE[0], 2 * SHAPE[1], 3)).astype(np.uint8)
    rgb = wide[:, ::2]  # Not contiguous.
    FastSamSegmenter(network, SHAPE, "cpu").segment(rgb, np.zeros(SHAPE, np.float32))
    (image,) = network.images
    assert image.dtype == torch.float32
    assert np.allclose(image[0].numpy(), rgb.transpose(2, 0, 1) / 255.0)


def test_an_image_with_nothing_in_it():
    found = FastSamSegmenter(Rectangles(), SHAPE, "cpu").segment(
        np.zeros((50, 70, 3), np.uint8), np.zeros((50, 70), np.float32)
    )
    assert len(found) == 0
    assert found.masks.shape == (0, 50, 70)
    assert found.boxes.shape == (0, 4)
    assert (found.masks.dtype, found.boxes.dtype) == (np.bool_, np.int32)


@pytest.mark.parametrize("value", ["", "nowhere.onnx", "folder", "FastSAM-s.pt"])
def test_without_its_file_it_says_how_to_make_it_and_the_licence(value, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "FastSAM-s.pt").write_bytes(b"PK")
    with pytest.raises(EncoderError) as refusal:
        load_segmenter("fastsam", EncoderConfig(), value)
    message = str(refusal.value)
    assert "\n" not in message
    assert message.startswith("parameter 'segmenter.weights': FastSAM: ")
    assert "yolo export model=FastSAM-s.pt format=onnx imgsz=480,640" in message
    assert "AGPL-3.0" in message
    assert str(tmp_path / "cache" / "fus3dmaps" / "fastsam-s" / "FastSAM-s.onnx") in message
    assert value in message
