"""Every drop is counted; the log gets the first at once and the rest in batches."""

from __future__ import annotations

from fus3dmaps_ros.node.drops import DropLog


def test_counts_are_complete_and_lines_are_few() -> None:
    lines: list[str] = []
    now_s = [0.0]
    drops = DropLog(lines.append, lambda: now_s[0])
    for _ in range(10):
        drops.count("no_depth", "rgb/image: none near 1")
    drops.count("bad_pose", "pose: NaN", 3)
    assert lines == ["dropped 1 (no_depth): rgb/image: none near 1", "dropped 3 (bad_pose): pose: NaN"]
    now_s[0] = 6.0
    drops.count("no_depth", "rgb/image: none near 2")
    assert lines[2:] == ["dropped 10 (no_depth): rgb/image: none near 2"]
    assert drops.counts() == {"no_depth": 11, "bad_pose": 3}
