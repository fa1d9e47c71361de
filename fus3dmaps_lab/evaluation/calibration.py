"""Calibration of a map's probabilities: reliability curve and expected calibration error (Guo et al. 2017)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import MapError


@dataclass(frozen=True)
class Reliability:
    """A reliability curve: the share of right predictions in bins of probability.

    Attributes:
        edges: (b + 1,) float64 edges of the bins, from 0 to 1. A bin includes its upper edge, the first one both edges.
        counts: (b,) int64 predictions in each bin.
        confidence: (b,) float64 mean probability in each bin, NaN if it is empty.
        accuracy: (b,) float64 share of right predictions in each bin, NaN if it is empty.
    """

    edges: NDArray[np.float64]
    counts: NDArray[np.int64]
    confidence: NDArray[np.float64]
    accuracy: NDArray[np.float64]

    @property
    def expected_error(self) -> float:
        """Mean of abs(accuracy - confidence) over all predictions, bin by bin; NaN without any."""
        filled = self.counts > 0
        if not filled.any():
            return float("nan")
        gaps = np.abs(self.accuracy - self.confidence)[filled]
        return float(np.average(gaps, weights=self.counts[filled]))


def reliability(probabilities: NDArray[np.floating], right: NDArray[np.bool_], bins: int = 15) -> Reliability:
    """Compute the reliability curve of predictions.

    Args:
        probabilities: (n,) probabilities of the predicted classes, in [0, 1].
        right: (n,) whether the predicted class is the true one.
        bins: Number of bins, of equal width.

    Raises:
        MapError: The arrays differ in length, or a probability is outside of [0, 1].
    """
    if probabilities.shape != right.shape or probabilities.ndim != 1:
        raise MapError(f"probabilities, right: must be of one length, got {probabilities.shape} and {right.shape}")
    if not np.all((probabilities >= 0) & (probabilities <= 1)):
        raise MapError("probabilities: must be in [0, 1]")
    edges = np.linspace(0.0, 1.0, bins + 1)
    bin_of = np.searchsorted(edges[1:-1], probabilities)
    counts = np.bincount(bin_of, minlength=bins)
    sums = (np.bincount(bin_of, weights=each, minlength=bins) for each in (probabilities, right))
    with np.errstate(invalid="ignore"):
        confidence, accuracy = (each / counts for each in sums)
    return Reliability(edges, counts, confidence, accuracy)
