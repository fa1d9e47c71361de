"""Maps of a wall with painted squares by the encoders of a trio: chosen by its name, or with pooled patches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stand_ins import ColorSegmenter, wall_frame

from fus3dmaps_core.answers.query import LAYERS, TextQuery, answer_query
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.pipeline import Pipeline

SETTINGS = {"image.width": 224, "image.height": 160, "segmenter.min_area_px": 30}


def map_by_name(name: str, weights: Path, dimension: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Map three frames with the trio of a name and the weights in a directory; every layer answers."""
    monkeypatch.setattr("fus3dmaps_core.pipeline.load_segmenter", lambda *options: ColorSegmenter())
    chosen = {"encoder.name": name, "encoder.weights": str(weights), "fusion.window_radius_m": 6.0}
    pipeline = Pipeline.from_config(Config.from_flat({**SETTINGS, **chosen}))
    reports = [pipeline.process(wall_frame(i, x_m=0.15 * i)) for i in range(3)]
    assert all(report.dense and report.instances and report.proposals for report in reports)
    assert pipeline.semantic_map.dimension == dimension
    for layer in LAYERS:
        request = TextQuery(["a red square"], layer=layer)
        answer = answer_query(pipeline.semantic_map, pipeline.trio.text, request, pipeline.trio.logit_scale)
        assert len(answer.points_m)
        assert np.isfinite(answer.similarity).all()


def map_with_pooled_patches(trio: EncoderTrio, monkeypatch: pytest.MonkeyPatch) -> None:
    """Map three frames; no crop may be embedded, and what reaches the map is of unit length and of the trio's space."""

    def refuse(*_: object) -> None:
        raise AssertionError("a crop was embedded")

    monkeypatch.setattr(trio.crop, "encode_crops", refuse)
    settings = {**SETTINGS, "encoder.instance_embeddings": "patches"}
    pipeline = Pipeline(Config.from_flat(settings), trio, ColorSegmenter())
    integrate, given = pipeline.semantic_map.integrate_proposals, []

    def watched(points_m, proposals, embeddings, visible_points_m=None):
        given.append(embeddings)
        return integrate(points_m, proposals, embeddings, visible_points_m)

    monkeypatch.setattr(pipeline.semantic_map, "integrate_proposals", watched)
    reports = [pipeline.process(wall_frame(i, x_m=0.2 * i - 0.2)) for i in range(3)]
    assert all(report.dense and report.instances and report.proposals for report in reports)
    embeddings = np.concatenate(given)
    assert len(embeddings) == sum(report.proposals for report in reports)
    assert embeddings.shape[1] == trio.dimension
    np.testing.assert_allclose(np.linalg.norm(embeddings, axis=1), 1, atol=1e-5)
    # A patch network averages nothing by itself: two objects of two colours have two embeddings.
    assert np.abs(embeddings[0] - embeddings[1]).max() > 1e-4
    answer = answer_query(pipeline.semantic_map, trio.text, TextQuery(["a red square"], layer="instances"), trio.logit_scale)
    assert answer.instances
    assert np.isfinite(answer.similarity).all()
