"""The transform buffer for recordings: chains, gaps, odd messages. Its agreement with tf2's rules is tested beside ROS."""

from __future__ import annotations

import numpy as np
import pytest
import ros_messages as ros

from fus3dmaps_core.sources.transforms import NoTransform, TransformGap, TransformTree

S = 1_000_000_000
HALF = float(np.sqrt(0.5))


def tree_of(*edges, max_gap_s: float = 2.0) -> TransformTree:
    """Build a tree of edges: parent, child, stamp (None: static), x, and a quaternion if it is turned."""
    tree = TransformTree(max_gap_s)
    for parent, child, stamp_ns, x, *turn in edges:
        message = ros.transforms((parent, child, stamp_ns or 0, (x, 0.0, 0.0), *turn))
        assert tree.add(message, "/tf", static=stamp_ns is None) == []
    return tree


def test_through_a_common_ancestor_both_ways():
    tree = tree_of(
        ("base", "neck", None, 1.0, (0.0, 0.0, HALF, HALF)), ("neck", "camera", None, 2.0), ("base", "wheel", None, -1.0)
    )
    # The neck is turned left: what is 2 m before it is 2 m to the left of the base.
    np.testing.assert_allclose(tree.lookup("wheel", "camera", 5)[:3, 3], [2, 2, 0], atol=1e-12)
    product = tree.lookup("wheel", "camera", 5) @ tree.lookup("camera", "wheel", 5)
    np.testing.assert_allclose(product, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(tree.lookup("nowhere", "/nowhere", 5), np.eye(4))


@pytest.mark.parametrize(
    ("target", "source", "stamp_ns", "gap", "named"),
    [
        ("map", "nose", S, TransformGap.UNKNOWN_FRAME, "nose"),
        ("map", "island", S, TransformGap.NOT_CONNECTED, "island"),
        ("map", "base", S - 1, TransformGap.BEFORE_FIRST, "base"),
        ("map", "base", 5 * S + 1, TransformGap.AFTER_LAST, "base"),
        ("base", "map", 3 * S, TransformGap.TOO_WIDE, "base"),
    ],
)
def test_why_there_is_none(target, source, stamp_ns, gap, named):
    tree = tree_of(
        ("map", "base", S, 1.0), ("map", "base", 2 * S, 2.0), ("map", "base", 5 * S, 2.0), ("sea", "island", None, 1.0)
    )
    answer = tree.lookup(target, source, stamp_ns)
    assert isinstance(answer, NoTransform)
    assert answer.gap == gap
    assert f"'{named}'" in answer.detail


def test_odd_transforms_are_refused_one_by_one():
    tree = tree_of(("map", "base", S, 1.0))
    message = ros.transforms(
        ("map", "base", 2 * S, (np.nan, 0.0, 0.0)),
        ("map", "base", 2 * S, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        ("base", "map", 2 * S, (0.0, 0.0, 0.0)),
        ("map", "", 2 * S, (0.0, 0.0, 0.0)),
        ("map", "map", 2 * S, (0.0, 0.0, 0.0)),
        ("map", "base", 2 * S, (3.0, 0.0, 0.0)),
    )
    refused = tree.add(message, "/tf", static=False)
    assert [error.reason for error in refused] == ["bad_transform"] * 5
    assert all(str(error).startswith("/tf: ") for error in refused)
    assert tree.lookup("map", "base", 2 * S)[0, 3] == 3.0


def test_a_repeated_transform_is_no_fault_and_a_restart_is_followed():
    tree = tree_of(("map", "base", 9 * S, 1.0), ("map", "base", 9 * S, 7.0), ("map", "base", 8 * S, 7.0))
    assert tree.lookup("map", "base", 9 * S)[0, 3] == 1.0
    tree.add(ros.transforms(("map", "base", S, (2.0, 0.0, 0.0))), "/tf", static=False)
    assert tree.lookup("map", "base", S)[0, 3] == 2.0


def test_another_parent_takes_over():
    tree = tree_of(("map", "base", S, 1.0), ("map", "dock", None, 5.0), ("dock", "base", 2 * S, 1.0))
    assert tree.lookup("map", "base", 2 * S)[0, 3] == 6.0


def test_memory_is_bounded():
    tree = tree_of(*(("map", "base", i * S // 10, 1.0) for i in range(1, 500)))
    assert len(tree._moving["base"]) <= 102
    assert isinstance(tree.lookup("map", "base", S), NoTransform)
    tree.clear()
    answer = tree.lookup("map", "base", 49 * S)
    assert isinstance(answer, NoTransform)
