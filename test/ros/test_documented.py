"""The README lists what a live node offers, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

README = (Path(__file__).resolve().parents[2] / "README.md").read_text()
_COMMON = ("parameter", "parameters", "type_description", "change_state", "get_state", "available", "transition")


def listed(heading: str) -> set[str]:
    """Names under ~/ in the first column of a table."""
    table = README.split(f"| {heading} | type |")[1].split("\n\n")[0]
    return {name for row in table.splitlines() for name in re.findall(r"`~/(\w+)`", row.split(" | ")[0])}


def test_every_service_is_listed(robot) -> None:
    prefix = f"{robot.namespace}/fus3dmaps/"
    names, _ = zip(*robot.mapper.get_service_names_and_types_by_node("fus3dmaps", robot.namespace), strict=True)
    own = {name.removeprefix(prefix) for name in names if name.startswith(prefix)}
    assert {name for name in own if not any(word in name for word in _COMMON)} == listed("service")


def test_every_published_topic_is_listed(robot) -> None:
    prefix = f"{robot.namespace}/fus3dmaps/"
    topics = robot.mapper.get_publisher_names_and_types_by_node("fus3dmaps", robot.namespace)
    own = {name.removeprefix(prefix) for name, _ in topics if name.startswith(prefix)} - {"transition_event"}
    assert own | {"detections"} == listed("published")  # Detections need a package that may not be there.
