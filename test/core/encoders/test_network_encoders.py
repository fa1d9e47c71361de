"""Frames and crops on their way to a network, against plain arithmetic, and another network in its place."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from fus3dmaps_core.encoders.network_encoders import NetworkCropEncoder, NetworkPatchEncoder
from fus3dmaps_core.encoders.network_graphs import GraphEncoder
from fus3dmaps_core.masks import Masks

MEAN, STD = (0.5, 0.4, 0.3), (0.2, 0.25, 0.5)
PATCH_PX = 8


class MeanColours(nn.Module):
    """The mean normalised colour of each patch, not of unit length, and whether its red is above the mean."""

    def __init__(self, saliency: bool) -> None:
        super().__init__()
        self.saliency, self.shapes = saliency, []

    def forward(self, images: torch.Tensor):
        self.shapes.append(tuple(images.shape))
        patches = nn.functional.avg_pool2d(images, PATCH_PX).permute(0, 2, 3, 1)
        return (patches, (patches[..., 0] > 0).float()) if self.saliency else patches


class WholeColours(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.batches = []

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.batches.append(len(images))
        return images.mean(dim=(2, 3))


def patch_encoder(saliency: bool = False) -> NetworkPatchEncoder:
    outputs = ("embeddings", "saliency") if saliency else ("embeddings",)
    return NetworkPatchEncoder(MeanColours(saliency), PATCH_PX, MEAN, STD, "cpu", outputs)


def crop_encoder() -> NetworkCropEncoder:
    return NetworkCropEncoder(WholeColours(), 3, 32, MEAN, STD, 0.0, "cpu")


def plain_patches(rgb: np.ndarray) -> np.ndarray:
    rows, columns = rgb.shape[0] // PATCH_PX, rgb.shape[1] // PATCH_PX
    normalised = (rgb / 255.0 - MEAN) / STD
    return normalised.reshape(rows, PATCH_PX, columns, PATCH_PX, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("saliency", [False, True])
def test_a_frame_is_normalised_once_and_weighted_by_what_the_network_says(rng, saliency):
    rgb = rng.integers(0, 256, (32, 48, 3)).astype(np.uint8)
    found = patch_encoder(saliency).encode_patches(rgb)
    expected = plain_patches(rgb)
    np.testing.assert_allclose(found.embeddings, expected, atol=1e-5)
    np.testing.assert_array_equal(found.weights, expected[..., 0] > 0 if saliency else np.ones((4, 6)))
    assert found.embeddings.dtype == found.weights.dtype == np.float32


@pytest.mark.parametrize(("size", "grid"), [((32, 48), (4, 6)), ((33, 41), (5, 6)), ((7, 100), (1, 13))])
def test_an_image_is_stretched_to_whole_patches(rng, size, grid):
    rgb = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    encoder = patch_encoder()
    assert encoder.grid(*size) == grid
    stretched = cv2.resize(rgb, (grid[1] * PATCH_PX, grid[0] * PATCH_PX), interpolation=cv2.INTER_LINEAR)
    np.testing.assert_allclose(encoder.encode_patches(rgb).embeddings, plain_patches(stretched), atol=1e-5)
    graph = encoder.graph(*size)
    assert graph.network is encoder.network
    assert encoder.network.shapes == [graph.shape] == [(1, 3, grid[0] * PATCH_PX, grid[1] * PATCH_PX)]


def test_an_image_that_is_not_contiguous_is_the_same_image(rng):
    rgb = rng.integers(0, 256, (32, 48, 3)).astype(np.uint8)
    found = patch_encoder().encode_patches(np.asfortranarray(rgb))
    np.testing.assert_array_equal(found.embeddings, patch_encoder().encode_patches(rgb).embeddings)


def test_crops_are_encoded_in_batches_and_in_order(rng):
    rgb = np.zeros((64, 400, 3), np.uint8)
    masks = np.zeros((37, 64, 400), bool)
    for number, mask in enumerate(masks):
        rgb[:, 10 * number : 10 * number + 10] = rng.integers(0, 256, 3)
        mask[20:30, 10 * number : 10 * number + 10] = True
    encoder = crop_encoder()
    found = encoder.encode_crops(rgb, Masks.from_masks(masks))
    expected = (rgb[25, 5 : 5 + 10 * len(masks) : 10] / 255.0 - MEAN) / STD
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert encoder.network.batches == [16, 16, 5]
    assert encoder.graph(64, 400).shape == (16, 3, 32, 32)


def test_no_crops_ask_nothing_of_the_network():
    encoder = crop_encoder()
    none = Masks.from_masks(np.zeros((0, 8, 8), bool))
    assert encoder.encode_crops(np.zeros((8, 8, 3), np.uint8), none).shape == (0, 3)
    assert encoder.network.batches == []


@pytest.mark.parametrize("as_tuple", [False, True])
def test_another_network_runs_in_its_place_and_the_graph_stays(rng, as_tuple):
    rgb = rng.integers(0, 256, (16, 16, 3)).astype(np.uint8)
    masks = Masks.from_masks(np.ones((2, 16, 16), bool))
    patches, crops = patch_encoder(), crop_encoder()
    assert isinstance(patches, GraphEncoder)
    assert isinstance(crops, GraphEncoder)
    own = patches.network, crops.network

    def twos(*shape: int):
        found = torch.full(shape, 2.0)
        return (found,) if as_tuple else found

    patches.run_with(lambda images: twos(1, 2, 2, 3))
    crops.run_with(lambda images: twos(len(images), 3))
    assert (patches.encode_patches(rgb).embeddings == 2).all()
    assert (patches.encode_patches(rgb).weights == 1).all()
    assert (crops.encode_crops(rgb, masks) == 2).all()
    assert (patches.graph(16, 16).network, crops.graph(16, 16).network) == own
