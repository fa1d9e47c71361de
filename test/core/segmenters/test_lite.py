"""The default segmenter on drawn scenes, a photograph and images without content."""

from __future__ import annotations

import numpy as np
import pytest
import skimage.data

from fus3dmaps_core.config.schema import EncoderConfig
from fus3dmaps_core.encoders.lite.evidence import box_iou
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.segmenters.lite import LiteSegmenter
from fus3dmaps_core.segmenters.registry import load_segmenter


@pytest.fixture(scope="module")
def segmenter() -> LiteSegmenter:
    return load_segmenter("lite", EncoderConfig())


def best_iou(found: Masks, mask: np.ndarray) -> float:
    return max(float((other & mask).sum() / (other | mask).sum()) for other in found.masks)


def check_contract(found: Masks, shape: tuple[int, int]) -> None:
    assert found.masks.shape == (len(found), *shape)
    assert found.masks.dtype == bool
    assert found.boxes.dtype == np.int32
    assert np.array_equal(found.boxes, Masks.from_masks(found.masks).boxes)


def test_drawn_things_come_out_whole(segmenter):
    rgb = np.full((480, 640, 3), (150, 140, 130), np.uint8)
    mug, box = np.zeros((2, 480, 640), bool)
    mug[100:180, 100:170] = True
    box[250:400, 350:600] = True
    rgb[mug], rgb[box] = (240, 240, 240), (40, 60, 160)
    found = segmenter.segment(rgb, np.zeros((480, 640), np.float32))
    check_contract(found, (480, 640))
    # A blurred rim of two pixels goes to the background.
    assert best_iou(found, mug) > 0.75
    assert best_iou(found, box) > 0.75


def test_depth_makes_a_striped_plane_whole(segmenter):
    stripes = (np.arange(640) // 64) % 2 == 0
    rgb = np.where(stripes[None, :, None], np.uint8(60), np.uint8(200)) * np.ones((480, 1, 3), np.uint8)
    floor = np.zeros((480, 640), bool)
    floor[240:] = True
    rgb[:240] = (170, 60, 60)
    depth = np.full((480, 640), 3.0, np.float32)
    depth[240:] = (3.0 / (1 + np.arange(240) / 120))[:, None]
    assert best_iou(segmenter.segment(rgb, depth), floor) > 0.9
    assert best_iou(segmenter.segment(rgb, np.zeros_like(depth)), floor) < 0.5


def test_a_detected_thing_is_proposed(segmenter):
    rgb = np.full((480, 640, 3), 180, np.uint8)
    rgb[90:390, 95:546] = skimage.data.chelsea()
    found = segmenter.segment(rgb, np.full((480, 640), 2.0, np.float32))
    check_contract(found, (480, 640))
    (cat,) = (box for box, label in zip(*_detected(segmenter, rgb), strict=True) if label == 17)
    assert box_iou(found.boxes.astype(np.float32), cat[None]).max() > 0.6


def _detected(segmenter: LiteSegmenter, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    detections = segmenter._detector.detect(rgb)
    return detections.boxes[:1], detections.labels[:1]


@pytest.mark.parametrize("shape", [(480, 640), (101, 67), (3, 2), (1, 1), (1080, 1920)])
def test_images_of_any_size_and_depth_without_meaning(segmenter, shape, rng):
    rgb = np.full((*shape, 3), 90, np.uint8)
    depth = rng.choice(np.array([0, np.nan, np.inf, -1, 2], np.float32), shape)
    check_contract(segmenter.segment(rgb, depth), shape)


def test_the_same_image_gives_the_same_masks(segmenter):
    rgb = skimage.data.coffee()
    depth = np.full(rgb.shape[:2], 1.5, np.float32)
    first, second = segmenter.segment(rgb, depth), segmenter.segment(rgb.copy(), depth)
    check_contract(first, rgb.shape[:2])
    assert np.array_equal(first.masks, second.masks)
