"""Images to try a graph with, as its encoder prepares them: noise, and shapes on a smooth background.

They go through the encoder's own resizing and normalisation; what would reach the network is recorded in its place.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fus3dmaps_core.encoders.network_graphs import Graph, GraphEncoder
from fus3dmaps_core.encoders.protocols import CropEncoder, PatchEncoder
from fus3dmaps_core.masks import Masks

_SEED = 6
_SHAPES = 40
_SMALLEST_CROP_PX = 24


class _RecordedError(Exception):
    """The end of an encoder's call where its network would have run."""


class GraphPatchEncoder(PatchEncoder, GraphEncoder, Protocol):
    """A patch encoder whose network can be run elsewhere."""


class GraphCropEncoder(CropEncoder, GraphEncoder, Protocol):
    """A crop encoder whose network can be run elsewhere."""


def pictures(height: int, width: int) -> list[NDArray[np.uint8]]:
    """Draw two (height, width, 3) uint8 images, noise and shapes, always the same."""
    rng = np.random.default_rng(_SEED)
    return [_noise(rng, height, width), _scene(rng, height, width)]


def patch_images(encoder: GraphPatchEncoder, height: int, width: int) -> torch.Tensor:
    """Record how two images of this size reach the network of a patch encoder: (2, 3, H', W') float32 on the CPU."""
    graph = encoder.graph(height, width)
    return torch.cat([_record(encoder, graph, partial(encoder.encode_patches, rgb)) for rgb in pictures(height, width)])


def crop_images(encoder: GraphCropEncoder, height: int, width: int) -> torch.Tensor:
    """Record how a batch of crops reaches the network of a crop encoder: (n, 3, side, side) float32 on the CPU.

    Args:
        encoder: Crop encoder.
        height: Height of the image that they are cut from, pixels.
        width: Its width, pixels.
    """
    rng = np.random.default_rng(_SEED)
    graph = encoder.graph(height, width)
    rgb = _scene(rng, height, width)
    rgb[:, width // 2 :] = _noise(rng, height, width)[:, width // 2 :]
    masks = np.zeros((graph.shape[0], height, width), bool)
    for mask in masks:
        rows, columns = (int(rng.integers(min(_SMALLEST_CROP_PX, side), side + 1)) for side in (height, width))
        y, x = int(rng.integers(height - rows + 1)), int(rng.integers(width - columns + 1))
        mask[y : y + rows, x : x + columns] = True
    return _record(encoder, graph, partial(encoder.encode_crops, rgb, Masks.from_masks(masks)))


def _record(encoder: GraphEncoder, graph: Graph, encode: Callable[[], object]) -> torch.Tensor:
    """Record what the encoder gives its network; afterwards the encoder runs in torch again."""
    seen: list[torch.Tensor] = []

    def note(images: torch.Tensor) -> torch.Tensor:
        seen.append(images.float().cpu().clone())
        raise _RecordedError

    encoder.run_with(note)
    try:
        with suppress(_RecordedError):
            encode()
    finally:
        encoder.run_with(graph.network)
    return seen[0]


def _noise(rng: np.random.Generator, height: int, width: int) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (height, width, 3)).astype(np.uint8)


def _scene(rng: np.random.Generator, height: int, width: int) -> NDArray[np.uint8]:
    ground = cv2.resize(rng.integers(60, 200, (3, 4, 3)).astype(np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(_SHAPES):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        axes = (int(rng.integers(4, max(5, width // 8))), int(rng.integers(4, max(5, height // 8))))
        colour = tuple(int(value) for value in rng.integers(0, 256, 3))
        if rng.random() < 0.5:
            cv2.ellipse(ground, centre, axes, float(rng.integers(180)), 0, 360, colour, -1, cv2.LINE_AA)
        else:
            corner = (centre[0] + axes[0], centre[1] + axes[1])
            cv2.rectangle(ground, centre, corner, colour, -1)
    return np.asarray(ground, np.uint8)
