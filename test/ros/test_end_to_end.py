"""Node and player as processes of their own, over DDS, as a user starts them."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from node_process import RELIABLE_ARGUMENTS, STAND_IN, end, wait_for_line
from rclpy.node import Node
from robot import TIMEOUT_S, wait_until
from sensor_msgs.msg import PointCloud2
from stand_ins import wall_frame

from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_msgs.srv import QueryText
from fus3dmaps_ros.topics.conversions import from_cloud
from fus3dmaps_ros.topics.qos import LATCHED

START_NS = 1_700_000_000 * 10**9
STEP_NS = 100_000_000
FRAMES = 60


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "wall.mcap"
    with RecordingWriter(path) as writer:
        for index in range(FRAMES):
            writer.write(wall_frame(START_NS + index * STEP_NS, x_m=0.1 * index))
    return path


def ask(user: Node, client: Any, **fields: Any) -> Any:
    future = client.call_async(QueryText.Request(**fields))
    wait_until(future.done, "reply")
    return future.result()


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_queries_are_answered_while_a_recording_is_mapped(start, user, bag) -> None:
    node = start([*STAND_IN, *RELIABLE_ARGUMENTS, "-p", "use_sim_time:=true"], SLOW_S="0.1")
    client = user.create_client(QueryText, "/fus3dmaps/query_text")
    similarity: list[PointCloud2] = []
    maps: list[PointCloud2] = []
    user.create_subscription(PointCloud2, "/fus3dmaps/similarity", similarity.append, LATCHED)
    user.create_subscription(PointCloud2, "/fus3dmaps/map", maps.append, LATCHED)
    assert client.wait_for_service(TIMEOUT_S)
    assert not ask(user, client, prompts=["red"]).success

    player = start([sys.executable, "-m", "fus3dmaps_ros.player_node", str(bag)])
    during = wait_until(
        lambda: next((reply for reply in [ask(user, client, prompts=["red"])] if reply.success), None), "first answer"
    )
    last_ns = START_NS + (FRAMES - 1) * STEP_NS
    assert START_NS <= stamp_of(during.similarity) < last_ns

    output, _ = player.communicate(timeout=TIMEOUT_S)
    assert player.returncode == 0, output
    final = wait_until(
        lambda: next(
            (
                reply
                for reply in [ask(user, client, prompts=["red"], negative_prompts=["grey"], publish=True)]
                if reply.success and stamp_of(reply.similarity) == last_ns
            ),
            None,
        ),
        "the last frame mapped",
    )
    assert final.similarity.header.frame_id == "map"
    table = from_cloud(final.similarity)
    assert table.dtype.names == ("x", "y", "z", "similarity", "rgb")
    assert len(table) == final.similarity.width > 0
    # wall_frame paints the red square in the world, at x -0.4 m on a wall 2 m away.
    best = final.instances[0]
    assert best.prompt == "red"
    assert (best.header.frame_id, stamp_of(best)) == ("map", last_ns)
    np.testing.assert_allclose([best.centroid.x, best.centroid.y, best.centroid.z], [-0.4, 0.0, 2.0], atol=0.06)
    wait_until(lambda: similarity and similarity[-1].header.stamp == final.similarity.header.stamp, "answer published")
    wait_until(lambda: maps and stamp_of(maps[-1]) == last_ns, "map published")
    assert "ready" in end(node, signal.SIGINT)


def test_a_signal_in_the_middle_of_an_inference_ends_the_node_well(start, user, bag) -> None:
    node = start([*STAND_IN, *RELIABLE_ARGUMENTS], SLOW_S="3600")
    client = user.create_client(QueryText, "/fus3dmaps/query_text")
    assert client.wait_for_service(TIMEOUT_S)
    player = start([sys.executable, "-m", "fus3dmaps_ros.player_node", str(bag), "--rate", "10"])
    wait_for_line(node, "queue_full")
    assert "ending in the middle of a frame" in end(node, signal.SIGTERM)
    player.communicate(timeout=TIMEOUT_S)
