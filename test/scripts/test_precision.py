"""Accuracy figures, on known cases and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.engine import Run
from benchmarks.precision import cosine_error, measure_precision, rank_correlation, top_overlap
from scipy.stats import spearmanr


def test_cosine_error_of_known_angles():
    exact = np.tile([[2.0, 0.0]], (4, 1))
    angles = np.array([0.0, 1e-6, np.pi / 2, np.pi])
    stored = np.stack([np.cos(angles), np.sin(angles)], axis=1) * 7
    assert cosine_error(stored, exact) == pytest.approx(1 - np.cos(angles), rel=1e-9, abs=1e-13)
    assert cosine_error(stored, exact)[1] == pytest.approx(0.5e-12, rel=1e-6)


def test_rank_correlation_is_spearmans():
    rng = np.random.default_rng(1)
    scores = rng.normal(size=200)
    assert rank_correlation(scores, 3 * scores + 1) == pytest.approx(1.0)
    assert rank_correlation(scores, -scores) == pytest.approx(-1.0)
    other = scores + rng.normal(size=200)
    assert rank_correlation(scores, other) == pytest.approx(spearmanr(scores, other).statistic)


def test_top_overlap_counts_shared_bests():
    scores = np.arange(20.0)
    assert top_overlap(scores, scores) == 1.0
    assert top_overlap(scores, -scores) == 0.0
    assert top_overlap(scores, np.roll(scores, 4), count=10) == 0.6


def test_float32_is_exact_and_float16_nearly(world):
    run = Run(world, "cpu", None, 1, 1, lambda text: None)
    figures = measure_precision(run, 16, ["float16"], updates=(1, 4))
    errors = {(f.params["dtype"], f.params["updates"]): f.value for f in figures if f.name == "precision_cosine_error"}
    assert set(errors) == {(dtype, updates) for dtype in ("float32", "float16") for updates in (1, 4)}
    assert max(errors["float32", 1], errors["float32", 4]) < 1e-12
    assert 1e-12 < errors["float16", 4] < 1e-5
    agreement = {f.params["measure"]: f.value for f in figures if f.name == "precision_rank_agreement"}
    assert agreement.keys() == {"spearman", "top_10"}
    assert all(value > 0.95 for value in agreement.values())
