"""Queries by image: the picture of a thing finds the thing, like a text that means it would."""

from __future__ import annotations

import numpy as np
import pytest
from stand_ins import COLORS, ColorEncoder, ColorSegmenter, color_trio, embed, wall_frame

from fus3dmaps_core.answers.query import IMAGE_PROMPT, TextQuery, answer_image_query, answer_query, embed_image
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    pipeline = Pipeline(Config(), color_trio(), ColorSegmenter())
    pipeline.process(wall_frame(1))
    return pipeline


def picture(name: str) -> np.ndarray:
    return np.full((20, 30, 3), COLORS[name], np.uint8)


def ask(pipeline: Pipeline, embedding: np.ndarray, **fields):
    query = TextQuery([IMAGE_PROMPT], **fields)
    return answer_image_query(pipeline.semantic_map, embedding, pipeline.trio.text, query, pipeline.trio.logit_scale)


def test_the_whole_image_is_the_mask():
    seen: list[Masks] = []

    class Spy(ColorEncoder):
        def encode_crops(self, rgb: np.ndarray, masks: Masks) -> np.ndarray:
            seen.append(masks)
            return super().encode_crops(rgb, masks)

    embedding = embed_image(Spy(), picture("red"))
    np.testing.assert_array_equal(embedding, embed(np.array([COLORS["red"]])))
    (masks,) = seen
    assert masks.masks.shape == (1, 20, 30)
    assert masks.masks.all()
    assert masks.boxes.tolist() == [[0, 0, 30, 20]]


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("negatives", [(), ("grey", "blue")])
def test_an_image_is_answered_like_the_text_of_the_same_embedding(pipeline, layer, negatives):
    # The stand-in encoders give a uniform picture and the name of its colour the same embedding.
    by_image = ask(pipeline, embed_image(pipeline.trio.crop, picture("red")), layer=layer, negative_prompts=negatives)
    query = TextQuery(["red"], negatives, layer)
    by_text = answer_query(pipeline.semantic_map, pipeline.trio.text, query, pipeline.trio.logit_scale)
    np.testing.assert_array_equal(by_image.points_m, by_text.points_m)
    np.testing.assert_array_equal(by_image.similarity, by_text.similarity)
    assert [(each.id, each.score) for each in by_image.instances] == [(each.id, each.score) for each in by_text.instances]
    assert {each.prompt for each in by_image.instances} == {IMAGE_PROMPT}


def test_the_thing_in_the_picture_is_found(pipeline):
    (best,) = ask(pipeline, embed_image(pipeline.trio.crop, picture("blue")), top_k=1).instances
    np.testing.assert_allclose(best.centroid_m, [0.5, 0.1, 2.0], atol=0.06)


@pytest.mark.parametrize("shape", [(0, 0, 3), (0, 40, 3), (7, 40, 3)])
def test_an_image_that_shows_nothing_is_refused(shape):
    with pytest.raises(QueryError, match=r"^image: "):
        embed_image(ColorEncoder(), np.zeros(shape, np.uint8))


def test_an_empty_map_and_malformed_fields_are_refused(pipeline):
    embedding = embed_image(pipeline.trio.crop, picture("red"))
    empty = SemanticMap(pipeline.trio.dimension, Config().map, 1.0)
    with pytest.raises(QueryError, match="map is empty"):
        answer_image_query(empty, embedding, pipeline.trio.text, TextQuery([IMAGE_PROMPT]), 1.0)
    with pytest.raises(QueryError, match=r"negative_prompts\[1\]"):
        ask(pipeline, embedding, negative_prompts=("grey", " "))
    with pytest.raises(QueryError, match="layer"):
        ask(pipeline, embedding, layer="sparse")
