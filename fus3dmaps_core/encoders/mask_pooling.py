"""Embeddings of masks from the patch embeddings of their image, without a second encoder.

A crop costs a pass of a network, and shows the object without its surroundings at another scale than the network's patches.
The patches of the same frame have been embedded already, in context; a mask is embedded as their mean under the mask, in
which a pixel counts by its distance to the mask's edge: patches across an edge mix two things, and segmenters err there.
The idea is that of Igelbrink et al. 2026, "DISC"; pooling here is over the patch embeddings of any trio.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import PatchEmbeddings
from fus3dmaps_core.masks import Masks


def pool_masks(patches: PatchEmbeddings, masks: Masks) -> NDArray[np.float32]:
    """Embed every mask of an image by the patches under it.

    Args:
        patches: Embeddings (rows, columns, d) of the image, and weights, by which patches count as in the dense layer.
        masks: n masks of the image, each with at least one pixel.

    Returns:
        (n, d) float32, unit length.
    """
    rows, columns, dimension = patches.embeddings.shape
    shares = patch_shares(masks, rows, columns).reshape(len(masks), rows * columns)
    salient = shares * patches.weights.reshape(-1)
    # A mask without a salient patch is still a mask: its patches then count by the mask alone.
    shares = np.where(salient.any(axis=1, keepdims=True), salient, shares)
    flat = patches.embeddings.reshape(-1, dimension)
    sums = shares @ flat
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    # Embeddings that cancel have no mean direction; the innermost patch has one.
    cancelled = lengths[:, 0] <= 1e-6 * shares.sum(axis=1)
    sums[cancelled] = flat[shares[cancelled].argmax(axis=1)]
    lengths[cancelled] = 1.0
    return np.asarray(sums / lengths, np.float32)


def patch_shares(masks: Masks, rows: int, columns: int) -> NDArray[np.float32]:
    """Compute each patch's share of each mask: the mask's pixels in it, summed by their distance to the mask's edge.

    An object that the image cuts off goes on beyond it: the image's border is no edge. Patch (r, c) of an image of height H
    begins at row r H / rows; a pixel belongs to the patch in which its centre lies.

    Args:
        masks: n masks of one image.
        rows: Rows of the patch grid.
        columns: Columns of the patch grid.

    Returns:
        (n, rows, columns) float32, pixels.
    """
    height, width = masks.masks.shape[1:]
    row_of = (2 * np.arange(height) + 1) * rows // (2 * height)
    column_of = (2 * np.arange(width) + 1) * columns // (2 * width)
    shares = np.zeros((len(masks), rows, columns), np.float32)
    for share, mask, (x0, y0, x1, y1) in zip(shares, masks.masks, masks.boxes, strict=True):
        # A pixel around the box, where the image has one, is outside of the mask and makes its edge.
        ys, xs = slice(max(0, y0 - 1), y1 + 1), slice(max(0, x0 - 1), x1 + 1)
        inside = np.ascontiguousarray(mask[ys, xs]).view(np.uint8)
        # Without a pixel outside of it, a mask has no edge to be far from.
        distance = np.minimum(cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32(height + width))
        in_rows, first_rows = np.unique(row_of[ys], return_index=True)
        in_columns, first_columns = np.unique(column_of[xs], return_index=True)
        cells = np.add.reduceat(np.add.reduceat(distance, first_rows, axis=0), first_columns, axis=1)
        share[np.ix_(in_rows, in_columns)] = cells
    return shares
