"""Arrays survive the way into messages and back."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from visualization_msgs.msg import Marker

from fus3dmaps_core.answers.query import QueryAnswer, RankedInstance
from fus3dmaps_core.voxel_map.snapshots import InstanceSnapshot, VoxelSnapshot
from fus3dmaps_ros.topics import conversions

HEADER = conversions.to_header(1_700_000_000_123_456_789, "map")
FINITE = st.floats(-1e3, 1e3, width=32)


def axes(table: np.ndarray) -> np.ndarray:
    return np.stack([table[axis] for axis in "xyz"], axis=1)


def test_a_header_keeps_every_nanosecond() -> None:
    assert (HEADER.stamp.sec, HEADER.stamp.nanosec, HEADER.frame_id) == (1_700_000_000, 123_456_789, "map")


@pytest.mark.parametrize(("seconds", "expected"), [(0.0, (0, 0)), (1.25, (1, 250_000_000)), (0.9999999999, (1, 0))])
def test_a_duration_carries_over_whole_seconds(seconds, expected) -> None:
    message = conversions.to_duration(seconds)
    assert (message.sec, message.nanosec) == expected


@settings(max_examples=30)
@given(
    st.integers(0, 40).flatmap(
        lambda n: st.tuples(
            hnp.arrays(np.float32, (n, 3), elements=FINITE),
            *[hnp.arrays(dtype, n) for dtype in (np.int32, np.uint8, np.uint16)],
        )
    )
)
def test_a_cloud_round_trips_over_the_wire(drawn) -> None:
    points, *columns = drawn
    named = dict(zip(("id", "level", "count"), columns, strict=True))
    message = conversions.to_cloud(HEADER, points, named)
    assert message.width * message.height == len(points)
    assert message.row_step == message.point_step * message.width == len(message.data)
    received = deserialize_message(serialize_message(message), PointCloud2)
    assert received.header == HEADER
    table = conversions.from_cloud(received)
    assert table.dtype.names == ("x", "y", "z", *named)
    np.testing.assert_array_equal(axes(table), points)
    for name, column in named.items():
        np.testing.assert_array_equal(table[name], column)


def test_a_cloud_is_laid_out_as_its_fields_say() -> None:
    """Against struct, field by field, as a reader in another language would."""
    message = conversions.to_cloud(
        HEADER, np.array([[1, 2, 3], [4, 5, 6]], np.float32), {"instance": np.array([-1, 7], np.int32)}
    )
    formats = {PointField.FLOAT32: "<f", PointField.INT32: "<i"}
    rows = [
        [
            struct.unpack_from(formats[field.datatype], bytes(message.data), row * message.point_step + field.offset)[0]
            for field in message.fields
        ]
        for row in range(2)
    ]
    assert [field.name for field in message.fields] == ["x", "y", "z", "instance"]
    assert rows == [[1, 2, 3, -1], [4, 5, 6, 7]]


def test_a_cloud_with_padding_is_read() -> None:
    data = struct.pack("<fxxxxfxxxx", 1.5, 2.5)
    message = PointCloud2(height=1, width=2, point_step=8, row_step=16, is_dense=True)
    message.fields = [PointField(name="x", offset=0, datatype=PointField.FLOAT32, count=1)]
    message.data = data
    np.testing.assert_array_equal(conversions.from_cloud(message)["x"], [1.5, 2.5])


@given(hnp.arrays(np.uint8, st.tuples(st.integers(0, 30), st.just(3))))
def test_packed_colours_round_trip(colors) -> None:
    packed = conversions.pack_rgb(colors)
    assert packed.dtype == np.float32
    np.testing.assert_array_equal(conversions.unpack_rgb(packed), colors)


def test_packed_colour_has_red_in_the_third_byte() -> None:
    (packed,) = (conversions.pack_rgb(np.array([[1, 2, 3]], np.uint8)).tobytes(),)
    assert packed == bytes([3, 2, 1, 0])


def test_the_similarity_cloud_has_its_fields_even_when_empty() -> None:
    answer = QueryAnswer("dense", np.array([[1, 2, 3]], np.float32), np.array([0.5], np.float32), [])
    names = [field.name for field in conversions.to_similarity_cloud(HEADER, answer).fields]
    empty = conversions.empty_similarity_cloud(HEADER)
    assert names == ["x", "y", "z", "similarity", "rgb"] == [field.name for field in empty.fields]
    assert empty.width == 0
    assert len(conversions.from_cloud(empty)) == 0


def test_the_map_cloud_bears_colour_and_top_instance() -> None:
    voxels = VoxelSnapshot(
        np.array([[0, 0, 0], [1, 1, 1]], np.float32),
        np.array([[1, 2, 3], [4, 5, 6]], np.uint8),
        np.array([-1, 12], np.int64),
        np.array([0, 5], np.int64),
        np.ones(2, np.float32),
    )
    table = conversions.from_cloud(conversions.to_map_cloud(HEADER, voxels))
    np.testing.assert_array_equal(conversions.unpack_rgb(table["rgb"]), voxels.colors)
    np.testing.assert_array_equal(table["instance"], [-1, 12])


def test_an_instance_message_has_every_field() -> None:
    found = RankedInstance(
        7, "mug", 0.25, 42.0, *(np.array(values, np.float32) for values in ([1, 2, 3], [0, 1, 2], [2, 3, 4])), 9
    )
    message = conversions.to_instance(HEADER, found)
    assert message.header == HEADER
    assert (message.id, message.prompt, message.score, message.weight, message.voxels) == (7, "mug", 0.25, 42.0, 9)
    assert [(p.x, p.y, p.z) for p in (message.centroid, message.box_min, message.box_max)] == [
        (1, 2, 3),
        (0, 1, 2),
        (2, 3, 4),
    ]


def snapshot(counts: list[int]) -> InstanceSnapshot:
    n = len(counts)
    low = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    low[np.array(counts) == 0] = np.nan
    return InstanceSnapshot(
        np.arange(10, 10 + n), np.ones(n), np.array(counts), np.array(counts), low + 0.5, low, low + np.array([1, 2, 3])
    )


def test_markers_are_a_box_and_a_label_for_every_instance_large_enough() -> None:
    message = conversions.to_markers(HEADER, snapshot([5, 3, 4, 0]), min_voxels=4)
    first, *rest = message.markers
    assert first.action == Marker.DELETEALL
    assert [(marker.ns, marker.id) for marker in rest] == [("boxes", 10), ("labels", 10), ("boxes", 12), ("labels", 12)]
    box, label = rest[2:]
    assert (box.type, label.type, label.text) == (Marker.CUBE, Marker.TEXT_VIEW_FACING, "12")
    assert (box.scale.x, box.scale.y, box.scale.z) == (1, 2, 3)
    assert (box.pose.position.x, box.pose.position.y, box.pose.position.z) == (6.5, 8, 9.5)
    assert label.pose.position.z > 11
    assert all(marker.header == HEADER for marker in message.markers)
    assert all(marker.color.a > 0 for marker in rest)


def test_instances_without_a_voxel_are_never_drawn() -> None:
    assert len(conversions.to_markers(HEADER, snapshot([0]), min_voxels=0).markers) == 1


def test_a_path_has_position_and_rotation() -> None:
    turn = np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    turn[:3, 3] = 1, 2, 3
    path = conversions.to_path(HEADER, np.array([np.eye(4), turn]))
    first, second = (stamped.pose for stamped in path.poses)
    assert (first.orientation.w, first.position.x) == (1.0, 0.0)
    assert (second.position.x, second.position.y, second.position.z) == (1, 2, 3)
    assert abs(second.orientation.z) == pytest.approx(np.sqrt(0.5))
    assert second.orientation.z * second.orientation.w > 0
    assert conversions.to_path(HEADER, np.empty((0, 4, 4))).poses == []
