"""Every drop is counted; the log gets the first at once and the rest in batches."""

from __future__ import annotations

from fus3dmaps_core.ledger import Drops
from fus3dmaps_ros.node.drop_log import DropLog


def test_counts_are_complete_and_lines_are_few() -> None:
    lines: list[str] = []
    now_s = [0.0]
    drops = Drops(DropLog(lines.append, lambda: now_s[0]).report)
    for _ in range(10):
        drops.add("no_depth", "rgb/image: none near 1")
    drops.add("bad_pose", "pose: NaN", 3)
    assert lines == ["dropped 1 (no_depth): rgb/image: none near 1", "dropped 3 (bad_pose): pose: NaN"]
    now_s[0] = 6.0
    drops.add("no_depth", "rgb/image: none near 2")
    assert lines[2:] == ["dropped 10 (no_depth): rgb/image: none near 2"]
    assert drops.counts() == {"no_depth": 11, "bad_pose": 3}
