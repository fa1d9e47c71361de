"""A map answers the queries of the encoders that built it, and refuses others' of the same width by name."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from stand_ins import ColorSegmenter, color_trio, wall_frame

from fus3dmaps_core.answers.labels import label_voxels
from fus3dmaps_core.answers.query import IMAGE_PROMPT, TextQuery, answer_image_query, answer_query
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.saved_maps.storage import MapInfo, SavedMap, load_map, save_map
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

OTHER = "'another'.*'stand_in'"


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    made = Pipeline(Config(), color_trio(), ColorSegmenter())
    for number in range(2):
        made.process(wall_frame(number, x_m=0.2 * number))
    return made


def saved_and_loaded(pipeline: Pipeline, directory: Path) -> SemanticMap:
    info = MapInfo(pipeline.trio.name, 20.0, "map", 1, pipeline.config, pipeline.camera_poses())
    save_map(directory, SavedMap(pipeline.semantic_map, info))
    return load_map(directory)[0]


@pytest.fixture(params=["live", "loaded"])
def semantic_map(request, pipeline, tmp_path) -> SemanticMap:
    return pipeline.semantic_map if request.param == "live" else saved_and_loaded(pipeline, tmp_path / "map")


def encoder(space: str) -> SimpleNamespace:
    return SimpleNamespace(space=space, encode_text=color_trio().text.encode_text)


@pytest.mark.parametrize("layer", ["dense", "fused_instances"])
def test_texts_of_another_trio_are_refused(semantic_map, layer):
    query = TextQuery(["red"], layer=layer)
    assert answer_query(semantic_map, encoder("stand_in"), query, 20.0).instances
    with pytest.raises(QueryError, match=OTHER):
        answer_query(semantic_map, encoder("another"), query, 20.0)


def test_images_with_texts_of_another_trio_are_refused(semantic_map):
    embedding = color_trio().text.encode_text(["red"])
    query = TextQuery([IMAGE_PROMPT], ["blue"])
    assert answer_image_query(semantic_map, embedding, encoder("stand_in"), query, 20.0).instances
    with pytest.raises(QueryError, match=OTHER):
        answer_image_query(semantic_map, embedding, encoder("another"), query, 20.0)


def test_labels_of_another_trio_are_refused(semantic_map):
    assert len(label_voxels(semantic_map, encoder("stand_in"), ["red", "blue"]).points_m)
    with pytest.raises(QueryError, match=OTHER):
        label_voxels(semantic_map, encoder("another"), ["red", "blue"])


def test_a_map_that_does_not_say_whose_it_is_answers_anybody(pipeline):
    nameless = SemanticMap(pipeline.trio.dimension, pipeline.config.map, 1.0)
    nameless.import_state(pipeline.semantic_map.export_state())
    expected = answer_query(pipeline.semantic_map, encoder("stand_in"), TextQuery(["red"]), 20.0)
    found = answer_query(nameless, encoder("another"), TextQuery(["red"]), 20.0)
    np.testing.assert_array_equal(found.similarity, expected.similarity)


def test_the_maps_that_a_pipeline_makes_bear_its_trios_name(pipeline):
    assert pipeline.semantic_map.space == pipeline.empty_map().space == "stand_in"
