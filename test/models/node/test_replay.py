"""Every large trio maps a recording, offline and in a live node, and keeps to its own maps; one parameter switches them."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from node_process import RELIABLE_ARGUMENTS, end
from reference.agreement import assert_same_bytes
from robot import TIMEOUT_S, wait_until

from fus3dmaps_core.answers.query import LAYERS, TextQuery, answer_query
from fus3dmaps_core.encoders.registry import card, load_text_encoder, names
from fus3dmaps_core.errors import QueryError, StorageError
from fus3dmaps_core.offline import map_recording
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.saved_maps.storage import load_map, restore_map, save_map
from fus3dmaps_msgs.msg import MapperStatus
from fus3dmaps_msgs.srv import Fuse, LoadMap, QueryText, SaveMap
from fus3dmaps_ros.commands import cli
from fus3dmaps_ros.player_node import play
from fus3dmaps_ros.topics.conversions import from_cloud
from fus3dmaps_ros.topics.qos import LATCHED

NODE = Path(__file__).with_name("random_weights_node.py")
FRAMES = 2  # Of the recording, as conftest.py writes it.
PROMPT = "a red cup"
TRIOS = [name for name in names() if name != "lite"]


def another_than(name: str) -> str:
    return TRIOS[(TRIOS.index(name) + 1) % len(TRIOS)]


@pytest.fixture
def offline(cached, recording, maps, config) -> Any:
    """Map the recording in this process with the trio of a name, once, and save the map under ``offline_NAME``."""

    def mapped(name: str) -> Path:
        path = maps / f"offline_{name}"
        if not path.exists():
            pipeline = Pipeline.from_config(config(name))
            map_recording(recording, pipeline)
            save_map(path, pipeline)
        return path

    return mapped


def arguments(parameters: dict[str, object]) -> list[str]:
    return [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]


def call(user: Any, service_type: Any, service: str, **fields: Any) -> Any:
    client = user.create_client(service_type, f"/fus3dmaps/{service}")
    assert client.wait_for_service(TIMEOUT_S), service
    future = client.call_async(service_type.Request(**fields))
    wait_until(future.done, f"reply of {service}")
    user.destroy_client(client)
    return future.result()


@pytest.mark.parametrize("name", TRIOS)
def test_a_recording_gives_the_same_map_twice(cached, recording, config, offline, name):
    first, info = load_map(offline(name))
    pipeline = Pipeline.from_config(config(name))
    summary = map_recording(recording, pipeline)
    counts = summary.ledger.counts()
    assert counts.dense_keyframes == counts.instance_keyframes == counts.frames == FRAMES
    assert counts.proposals == FRAMES * config(name).segmenter.max_masks
    assert not summary.ledger.drops.counts()
    assert info.encoder == pipeline.trio.name == name
    assert first.dimension == pipeline.semantic_map.dimension == card(name).dimension
    assert_same_bytes(pipeline.semantic_map.export_state(), first.export_state())
    embedding = pipeline.trio.text.encode_text([PROMPT])
    assert embedding.shape == (1, card(name).dimension)
    np.testing.assert_allclose(np.linalg.norm(embedding), 1, atol=1e-5)
    text = SimpleNamespace(space=name, encode_text=lambda prompts: embedding)  # Eighty sentences, once.
    for layer in LAYERS:
        answer = answer_query(pipeline.semantic_map, text, TextQuery([PROMPT], layer=layer), pipeline.trio.logit_scale)
        assert len(answer.points_m)
        assert np.isfinite(answer.similarity).all()


def test_one_parameter_switches_trios(parameters):
    first, *others = (parameters(name) for name in TRIOS)
    for other in others:
        assert {name for name in first.keys() | other.keys() if first.get(name) != other.get(name)} == {"encoder.name"}


@pytest.mark.parametrize("name", TRIOS)
def test_a_node_maps_a_replay_and_keeps_to_its_own_maps(start, user, signals, cache, recording, parameters, offline, name):
    own, other = offline(name), offline(another_than(name))
    statuses: list[MapperStatus] = []
    user.create_subscription(MapperStatus, "/fus3dmaps/status", statuses.append, LATCHED)
    node = start(
        [sys.executable, str(NODE), *RELIABLE_ARGUMENTS, *arguments(parameters(name)), "-p", "node.queue_size:=100"],
        **cache.environment,
    )
    wait_until(lambda: statuses and statuses[-1].state == "active", "the node is active")
    assert play(recording, rate=10.0) == 0
    wait_until(lambda: statuses[-1].instance_keyframes == FRAMES, "the recording is mapped")
    assert statuses[-1].encoder == name
    assert statuses[-1].dense_keyframes == statuses[-1].frames == FRAMES
    assert not any(statuses[-1].drop_counts)

    assert call(user, Fuse, "fuse").success
    reply = call(user, QueryText, "query_text", prompts=[PROMPT])
    assert reply.success, reply.message
    assert reply.instances
    table = from_cloud(reply.similarity)
    assert len(table)
    assert np.isfinite(table["similarity"]).all()

    saved = call(user, SaveMap, "save_map", name=f"node_{name}")
    assert saved.success, saved.message
    live, info = load_map(Path(saved.path))
    assert info.encoder == name
    assert live.dimension == card(name).dimension
    assert_same_bytes(live.export_state(), load_map(own)[0].export_state())

    refused = call(user, LoadMap, "load_map", name=other.name)
    assert not refused.success
    assert f"its encoder is '{another_than(name)}', here '{name}'" in refused.message
    assert "\n" not in refused.message
    assert call(user, LoadMap, "load_map", name=own.name).success
    assert f"loading encoder '{name}'" in end(node, signal.SIGINT)


@pytest.mark.parametrize("name", TRIOS)
def test_a_saved_map_is_asked_in_the_words_of_its_own_trio(offline, config, monkeypatch, capsys, name):
    monkeypatch.setattr(sys, "argv", ["fus3dmaps", "query", str(offline(name)), PROMPT, "--json"])
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    assert len(json.loads(capsys.readouterr().out))


@pytest.mark.parametrize("name", TRIOS)
def test_a_saved_map_refuses_the_words_of_another_trio(cached, offline, name):
    other = another_than(name)
    semantic_map, info = load_map(offline(name))
    with pytest.raises(QueryError, match=rf"embedded by encoder '{other}', the map was built with '{name}'"):
        answer_query(semantic_map, load_text_encoder(other, "cpu"), TextQuery([PROMPT]), info.logit_scale)


@pytest.mark.parametrize("name", TRIOS)
def test_a_pipeline_refuses_the_map_of_another_trio(offline, config, name):
    other = another_than(name)
    fresh = SimpleNamespace(dimension=card(other).dimension)
    with pytest.raises(StorageError, match=rf"its encoder is '{name}', here '{other}'"):
        restore_map(offline(name), fresh, config(other), other)
