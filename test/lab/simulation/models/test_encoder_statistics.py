"""Statistics of the encoders: ratios and ranges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fus3dmaps_core.errors import ConfigError
from fus3dmaps_lab.simulation.models.class_texts import ClassTexts
from fus3dmaps_lab.simulation.models.encoder_statistics import EncoderStatistics


def test_the_ratio_is_that_of_the_variances():
    assert EncoderStatistics(patch_variance=6.0, crop_variance=1.5).variance_ratio == 4.0
    assert EncoderStatistics(patch_variance=0.0, crop_variance=0.0).variance_ratio == 1.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("dimension", 3),
        ("patch_px", 0.5),
        ("patch_px", 641.0),
        ("patch_variance", -1.0),
        ("patch_variance", 0.0),
        ("crop_variance", float("nan")),
        ("crop_variance", float("inf")),
        ("receptive_field_patches", -0.1),
        ("crop_padding", -0.1),
        ("crop_mask_weight", 0.5),
        ("appearance_variance", -1.0),
        ("seed", -1),
    ],
)
def test_what_is_out_of_range_is_refused_by_name(field: str, value: float):
    with pytest.raises(ConfigError, match=field):
        replace(EncoderStatistics(), **{field: value})


def test_single_observations_are_as_often_right_as_the_defaults_say():
    words = (
        "wall floor ceiling door window chair armchair sofa stool table desk cabinet shelf bed lamp "
        "cup mug bottle bowl vase book monitor keyboard plant picture box bin sink toilet refrigerator"
    )
    names = words.split()
    stated = EncoderStatistics()
    for variance, right in ((stated.patch_variance, 0.4), (stated.crop_variance, 0.8)):
        rates = []
        for seed in range(10):
            texts, rng = ClassTexts(names, stated.dimension, seed).vectors, np.random.default_rng(seed)
            appearance = rng.normal(scale=(stated.appearance_variance / stated.dimension) ** 0.5, size=texts.shape)
            looks = (texts + appearance) / np.linalg.norm(texts + appearance, axis=1, keepdims=True)
            noise = rng.normal(scale=(variance / stated.dimension) ** 0.5, size=(200, *texts.shape))
            rates.append((((looks + noise) @ texts.T).argmax(axis=2) == np.arange(len(names))).mean())
        assert np.mean(rates) == pytest.approx(right, abs=0.05)
