"""Shared models run once for each image and give the same results as unshared ones."""

from __future__ import annotations

import numpy as np

from fus3dmaps_core.encoders.protocols import EncoderTrio, PatchEmbeddings
from fus3dmaps_core.masks import Masks
from fus3dmaps_lab.evaluation.shared_models import shared_segmenter, shared_trio


class Counting:
    """All models in one; their results depend on the image and the mask."""

    def __init__(self) -> None:
        self.patches = self.crops = self.segmented = 0

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return height // 2, width // 2

    def encode_patches(self, rgb: np.ndarray) -> PatchEmbeddings:
        self.patches += 1
        return PatchEmbeddings(np.full((2, 2, 3), rgb.mean(), np.float32), np.ones((2, 2), np.float32))

    def encode_crops(self, rgb: np.ndarray, masks: Masks) -> np.ndarray:
        self.crops += len(masks)
        rows = zip(masks.masks, masks.boxes, strict=True)
        return np.array([[rgb.mean(), mask.sum(), box[0]] for mask, box in rows], np.float32)

    def segment(self, rgb: np.ndarray, depth_m: np.ndarray) -> Masks:
        self.segmented += 1
        return Masks.from_masks(np.ones((1, *depth_m.shape), bool))

    def encode_text(self, prompts) -> np.ndarray:
        return np.ones((len(prompts), 3), np.float32)


def make() -> tuple[Counting, EncoderTrio]:
    models = Counting()
    return models, shared_trio(EncoderTrio("counting", 3, 1.0, 1.0, models, models, models))


def image(value: int) -> np.ndarray:
    return np.full((4, 4, 3), value, np.uint8)


def masks(*sizes: int) -> Masks:
    found = np.zeros((len(sizes), 4, 4), bool)
    for row, size in enumerate(sizes):
        found[row, :size, 1:] = True
    return Masks.from_masks(found)


def test_an_image_is_embedded_once_and_the_next_one_again() -> None:
    models, trio = make()
    first, second = image(10), image(10)
    for _ in range(3):
        assert trio.patch.encode_patches(first).embeddings[0, 0, 0] == 10
    assert models.patches == 1
    trio.patch.encode_patches(second)
    assert models.patches == 2
    assert trio.patch.grid(4, 6) == (2, 3)
    assert trio.patch.encode_patches(image(20)).embeddings[0, 0, 0] == 20


def test_crops_are_known_by_their_mask_in_whatever_order_and_company() -> None:
    models, trio = make()
    rgb = image(7)
    whole = trio.crop.encode_crops(rgb, masks(1, 2, 3))
    assert models.crops == 3
    np.testing.assert_array_equal(trio.crop.encode_crops(rgb, masks(3, 1)), whole[[2, 0]])
    assert models.crops == 3
    mixed = trio.crop.encode_crops(rgb, masks(4, 2))
    assert models.crops == 4
    np.testing.assert_array_equal(mixed, Counting().encode_crops(rgb, masks(4, 2)))
    np.testing.assert_array_equal(trio.crop.encode_crops(image(9), masks(2))[0, 0], 9)


def test_an_image_is_segmented_once() -> None:
    models = Counting()
    segmenter = shared_segmenter(models)
    depth_m = np.ones((4, 4), np.float32)
    rgb = image(1)
    assert segmenter.segment(rgb, depth_m) is segmenter.segment(rgb, depth_m)
    segmenter.segment(image(1), depth_m)
    assert models.segmented == 2
