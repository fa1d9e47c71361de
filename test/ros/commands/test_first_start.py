"""What set-up does of a first start."""

from __future__ import annotations

import sys
from typing import get_args

from fus3dmaps_core.config.schema import Config, MapConfig
from fus3dmaps_ros.commands import first_start


def test_the_default_models_are_loaded_and_maps_of_every_storage_type_rehearsed(monkeypatch):
    loaded, rehearsed = [], []
    monkeypatch.setattr(first_start.Pipeline, "from_config", loaded.append)
    monkeypatch.setattr(first_start, "warm_up", lambda dimension, config: rehearsed.append(config.dtype))
    first_start.prepare()
    assert loaded == [Config()]
    assert set(rehearsed) == set(get_args(MapConfig.model_fields["dtype"].annotation))


def test_what_the_node_and_the_demo_import_is_imported():
    names = {f"fus3dmaps_ros.{name}" for name in ("mapper_node", "player_node", "commands.demo")}
    assert names <= set(sys.modules)
