"""The client asks a live node, gets its map and path, and passes on its refusals."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.messages.fields import stamp_ns as stamp_of
from fus3dmaps_ros.commands.client import MapperClient, ranked_instances, similarity_points


@pytest.fixture(scope="module")
def client(mapped_robot) -> Iterator[MapperClient]:
    with MapperClient(f"{mapped_robot.namespace}/fus3dmaps") as client:
        client.wait_until_ready(30.0)
        yield client


def test_answers_arrive_as_they_were_sent(client: MapperClient, stamp_ns: int):
    reply = client.ask(["red", "blue"], top_k=1)
    red, blue = sorted(ranked_instances(reply), key=lambda found: found.centroid_m[0])
    assert (red.prompt, blue.prompt) == ("red", "blue")
    np.testing.assert_allclose(red.centroid_m, [-0.4, 0.0, 2.0], atol=0.06)
    np.testing.assert_allclose(blue.centroid_m, [0.5, 0.1, 2.0], atol=0.06)
    assert np.all(red.box_min_m < red.centroid_m)
    assert np.all(red.box_max_m > red.centroid_m)
    points_m, similarity = similarity_points(reply)
    assert points_m.shape == (len(similarity), 3)
    assert len(points_m) > 0
    assert stamp_of(reply.similarity) == stamp_ns


def test_map_and_path_of_a_stamp_arrive(client: MapperClient, stamp_ns: int):
    points_m, colors = client.map_cloud(stamp_ns)
    assert points_m.shape == colors.shape
    red = np.linalg.norm(points_m - (-0.4, 0.0, 2.025), axis=1) < 0.1
    assert red.any()
    np.testing.assert_array_equal(np.unique(colors[red], axis=0), [[220, 30, 30]])
    np.testing.assert_allclose(client.camera_poses(stamp_ns), [np.eye(4)])


def test_a_map_newer_than_any_is_not_waited_for_forever(client: MapperClient, stamp_ns: int):
    with pytest.raises(QueryError, match="fus3dmaps/map"):
        client.map_cloud(stamp_ns + 1, timeout_s=3.0)


@pytest.mark.parametrize(
    ("prompts", "options", "named"),
    [([], {}, "prompts"), (["red", " "], {}, r"prompts\[1\]"), (["red"], {"layer": "sparse"}, "sparse")],
)
def test_refusals_come_in_the_nodes_words(client: MapperClient, prompts, options, named):
    with pytest.raises(QueryError, match=named):
        client.ask(prompts, **options)


def test_a_node_that_is_not_there_is_named():
    with MapperClient("/elsewhere") as client, pytest.raises(QueryError, match="/elsewhere"):
        client.wait_until_ready(0.5)
