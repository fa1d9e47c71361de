"""A simulated encoder trio: embeddings made from the ground truth, with the errors of ``EncoderStatistics``.

Noise comes from a generator seeded by the statistics' seed, the frame's stamp and, for a crop, its mask. The same frame
gives the same embeddings bit for bit, in any order and in any batches. Statistics that differ only in a variance scale the
same random numbers.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import EncoderTrio, PatchEmbeddings
from fus3dmaps_core.masks import Masks
from fus3dmaps_lab.simulation.models.class_texts import ClassTexts, TextSimilarity
from fus3dmaps_lab.simulation.models.encoder_statistics import REFERENCE_WIDTH_PX, EncoderStatistics
from fus3dmaps_lab.simulation.models.oracle import Oracle
from fus3dmaps_lab.simulation.truth import Truth

NAME = "simulation"
LOGIT_SCALE = 100.0

_KIND_PATCH, _KIND_CROP, _KIND_APPEARANCE = 21, 22, 23


def simulated_trio(
    oracle: Oracle, truth: Truth, statistics: EncoderStatistics, similarity: TextSimilarity | None = None
) -> EncoderTrio:
    """Make the simulated trio of one world; its image encoders see the truth through the oracle.

    Args:
        oracle: Must look at a frame before it is encoded.
        truth: Parts, instances and classes of the world.
        statistics: Errors of the encoders.
        similarity: Similarity of class texts; None takes the defaults.

    Returns:
        A trio named ``simulation`` whose variance ratio is the statistics' own.
    """
    texts = ClassTexts(truth.class_names, statistics.dimension, statistics.seed, similarity)
    looks = instance_vectors(truth, texts, statistics)
    return EncoderTrio(
        NAME,
        statistics.dimension,
        statistics.variance_ratio,
        LOGIT_SCALE,
        SimulatedPatchEncoder(oracle, truth, looks, statistics),
        SimulatedCropEncoder(oracle, truth, looks, statistics),
        SimulatedTextEncoder(texts),
    )


def instance_vectors(truth: Truth, texts: ClassTexts, statistics: EncoderStatistics) -> NDArray[np.float32]:
    """Compute the look of each instance: normalise(its class text + an offset of its own).

    Returns:
        (instances + 1, d) float32, unit length; 0 is nothing, which has no offset.
    """
    vectors = texts.vectors[truth.class_of_instance]
    offsets = np.random.default_rng((statistics.seed, _KIND_APPEARANCE)).standard_normal(vectors.shape, np.float32)
    offsets[0] = 0.0
    return _unit(vectors + np.float32((statistics.appearance_variance / statistics.dimension) ** 0.5) * offsets)


class SimulatedPatchEncoder:
    """Simulated patch encoder: normalise(mean look in the receptive field + noise of variance R^D)."""

    def __init__(self, oracle: Oracle, truth: Truth, looks: NDArray[np.float32], statistics: EncoderStatistics) -> None:
        """Store the truth; ``looks`` are the (instances + 1, d) vectors of :func:`instance_vectors`."""
        self._oracle, self._truth, self._looks, self._statistics = oracle, truth, looks, statistics

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of patches: the columns are the same at any image size, the patches nearly square."""
        return _grid(height, width, self._statistics)

    def encode_patches(self, rgb: NDArray[np.uint8]) -> PatchEmbeddings:
        """Embed the patches of the frame that the oracle looks at; weights are 1.

        Raises:
            EncoderError: The oracle looks at another frame or at none.
        """
        statistics = self._statistics
        seen, labels = _instances(self._oracle, self._truth, rgb)
        rows, columns = self.grid(*labels.shape)
        shares = receptive_shares(labels, len(seen), rows, columns, statistics.receptive_field_patches)
        vectors = shares.reshape(rows * columns, -1) @ self._looks[seen]
        stamp = _seed_word(self._oracle.current.frame.stamp_ns)
        noise = np.random.default_rng((statistics.seed, _KIND_PATCH, stamp)).standard_normal(vectors.shape, np.float32)
        noise *= np.float32((statistics.patch_noise_variance / statistics.dimension) ** 0.5)
        embeddings = _unit(vectors + noise).reshape(rows, columns, statistics.dimension)
        return PatchEmbeddings(embeddings, np.ones((rows, columns), np.float32))


class SimulatedCropEncoder:
    """Simulated crop encoder: normalise(mean look in the padded box, weighted by the mask, + noise of variance R^I)."""

    def __init__(self, oracle: Oracle, truth: Truth, looks: NDArray[np.float32], statistics: EncoderStatistics) -> None:
        """Store the truth; ``looks`` are the (instances + 1, d) vectors of :func:`instance_vectors`."""
        self._oracle, self._truth, self._looks, self._statistics = oracle, truth, looks, statistics

    def encode_crops(self, rgb: NDArray[np.uint8], masks: Masks) -> NDArray[np.float32]:
        """Embed one crop per mask of the frame that the oracle looks at, as (n, d) float32 unit vectors.

        Raises:
            EncoderError: The oracle looks at another frame or at none.
        """
        statistics = self._statistics
        seen, labels = _instances(self._oracle, self._truth, rgb)
        stamp = _seed_word(self._oracle.current.frame.stamp_ns)
        vectors = np.empty((len(masks), statistics.dimension), np.float32)
        rows, columns = _grid(labels.shape[0], labels.shape[1], statistics)
        pixels_a_patch = labels.size / (rows * columns)
        for row, (mask, box) in enumerate(zip(masks.masks, masks.boxes, strict=True)):
            x0, y0, x1, y1 = (int(value) for value in box)
            window = padded_box(x0, y0, x1, y1, labels.shape, statistics.crop_padding)
            shares = crop_shares(labels[window], mask[window], len(seen), statistics.crop_mask_weight)
            # The seed uses the mask itself, not its row, which depends on filtering and on batches.
            name = zlib.crc32(np.packbits(mask[y0:y1, x0:x1]).tobytes())
            noise = np.random.default_rng((statistics.seed, _KIND_CROP, x0, y0, x1, y1, name, stamp))
            variance = statistics.crop_noise_variance(float(np.count_nonzero(mask) / pixels_a_patch))
            scale = np.float32((variance / statistics.dimension) ** 0.5)
            # One product per crop: a product of several rows may sum in another order.
            vectors[row] = shares @ self._looks[seen] + scale * noise.standard_normal(statistics.dimension, np.float32)
        return _unit(vectors)


class SimulatedTextEncoder:
    """Simulated text encoder.

    Attributes:
        space: Name of the trio.
    """

    space = NAME

    def __init__(self, texts: ClassTexts) -> None:
        """Take the embeddings from ``texts``."""
        self._texts = texts

    def encode_text(self, prompts: Sequence[str]) -> NDArray[np.float32]:
        """Embed n prompts as (n, d) float32 unit vectors."""
        return self._texts.encode(prompts)


def _grid(height: int, width: int, statistics: EncoderStatistics) -> tuple[int, int]:
    columns = min(width, max(1, round(REFERENCE_WIDTH_PX / statistics.patch_px)))
    return min(height, max(1, round(columns * height / width))), columns


def receptive_shares(
    labels: NDArray[np.integer], count: int, rows: int, columns: int, sigma_patches: float
) -> NDArray[np.float32]:
    """Compute the share of each label in the receptive field of each patch.

    The shares of the pixels of each patch are averaged over all patches, with Gaussian weights around each one that sum to 1
    inside the image.

    Args:
        labels: (H, W), each in 0 .. ``count`` - 1.
        count: Number of labels.
        rows: Rows of the patch grid, at most H.
        columns: Columns of the patch grid, at most W.
        sigma_patches: Sigma of the Gaussian, in patches; 0 keeps each patch to itself.

    Returns:
        (rows, columns, count) float32; the labels of each patch sum to 1.
    """
    height, width = labels.shape
    cells = _cells(height, width, rows, columns)
    pixels = np.bincount((cells * count + labels).reshape(-1), minlength=rows * columns * count)
    shares = pixels.reshape(rows, columns, count).astype(np.float32)
    shares /= shares.sum(axis=2, keepdims=True)
    down, across = _gaussian_weights(rows, sigma_patches), _gaussian_weights(columns, sigma_patches)
    mixed = (down @ shares.reshape(rows, -1)).reshape(rows, columns, count)
    return np.asarray(across @ mixed, np.float32)


def crop_shares(labels: NDArray[np.integer], mask: NDArray[np.bool_], count: int, mask_weight: float) -> NDArray[np.float32]:
    """Compute the share of each label among the pixels of a crop; a pixel of the mask counts ``mask_weight`` times.

    Args:
        labels: (h, w), each in 0 .. ``count`` - 1.
        mask: (h, w) pixels of the object.
        count: Number of labels.
        mask_weight: At least 1.

    Returns:
        (count,) float32, sum 1.
    """
    pixels = np.bincount(labels.reshape(-1), minlength=count)
    pixels = pixels + (mask_weight - 1.0) * np.bincount(labels[mask], minlength=count)
    return np.asarray(pixels / pixels.sum(), np.float32)


def padded_box(x0: int, y0: int, x1: int, y1: int, shape: tuple[int, ...], padding: float) -> tuple[slice, slice]:
    """Return rows and columns of a box, padded on each side by a share of its size, within an (H, W) image."""
    pad_x, pad_y = int(padding * (x1 - x0)), int(padding * (y1 - y0))
    return np.s_[max(0, y0 - pad_y) : min(shape[0], y1 + pad_y), max(0, x0 - pad_x) : min(shape[1], x1 + pad_x)]


def _instances(oracle: Oracle, truth: Truth, rgb: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the instances in the image, ascending, and for each pixel its place among them, (H, W)."""
    instances = truth.instance_of_part[oracle.parts_of(rgb)]
    present = np.bincount(instances.reshape(-1)) > 0
    number = np.cumsum(present) - 1
    return np.flatnonzero(present), number[instances]


@lru_cache(maxsize=8)
def _cells(height: int, width: int, rows: int, columns: int) -> NDArray[np.int64]:
    """Return the row-major patch number of each pixel, (H, W), as in the pipeline's pixel samples."""
    down = np.arange(height) * rows // height
    across = np.arange(width) * columns // width
    cells: NDArray[np.int64] = down[:, None] * columns + across
    cells.flags.writeable = False  # The array is shared through the cache.
    return cells


@lru_cache(maxsize=8)
def _gaussian_weights(count: int, sigma: float) -> NDArray[np.float32]:
    """Return (count, count) Gaussian weights of all places of a line around each place; rows sum to 1."""
    if sigma == 0:
        return np.eye(count, dtype=np.float32)
    distance = np.arange(count)[:, None] - np.arange(count)
    weights = np.exp(-0.5 * (distance / sigma) ** 2)
    weights /= weights.sum(axis=1, keepdims=True)
    shared = weights.astype(np.float32)
    shared.flags.writeable = False  # The array is shared through the cache.
    return shared


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    length = np.sqrt(np.einsum("nd,nd->n", vectors, vectors))
    return np.asarray(vectors / length[:, None], np.float32)


def _seed_word(stamp_ns: int) -> int:
    """Turn a stamp into a seed, which must not be negative."""
    return stamp_ns % 2**64
