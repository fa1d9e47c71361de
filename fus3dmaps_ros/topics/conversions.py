"""Conversions of arrays to messages and back, without any node."""

from __future__ import annotations

import array
import colorsys
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from fus3dmaps_core.answers.colors import similarity_colors
from fus3dmaps_core.answers.labels import LabelledVoxels
from fus3dmaps_core.answers.query import QueryAnswer, RankedInstance
from fus3dmaps_core.voxel_map.snapshots import InstanceSnapshot, VoxelSnapshot
from fus3dmaps_msgs.msg import SemanticInstance

_FIELD_TYPES: dict[np.dtype[Any], int] = {
    np.dtype(np.int8): PointField.INT8,
    np.dtype(np.uint8): PointField.UINT8,
    np.dtype(np.int16): PointField.INT16,
    np.dtype(np.uint16): PointField.UINT16,
    np.dtype(np.int32): PointField.INT32,
    np.dtype(np.uint32): PointField.UINT32,
    np.dtype(np.float32): PointField.FLOAT32,
    np.dtype(np.float64): PointField.FLOAT64,
}
_SCALARS = {code: dtype for dtype, code in _FIELD_TYPES.items()}
_GOLDEN_RATIO = 0.618033988749895  # Its multiples are spread evenly over the colour circle, however many there are.
_LABEL_HEIGHT_M = 0.12


def to_header(stamp_ns: int, frame: str) -> Header:
    """Make a header with a stamp given in nanoseconds."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame)


def to_duration(seconds: float) -> Duration:
    """Make a duration message."""
    whole, nanoseconds = divmod(round(seconds * 1e9), 1_000_000_000)
    return Duration(sec=whole, nanosec=nanoseconds)


def to_cloud(header: Header, points_m: NDArray[np.floating], columns: Mapping[str, NDArray[Any]]) -> PointCloud2:
    """Make a dense, unorganised point cloud.

    Args:
        header: Stamp and frame.
        points_m: (n, 3), metres; becomes x, y, z in float32.
        columns: Further fields by name, (n,) each, in their own scalar type.
    """
    layout = [(axis, np.dtype(np.float32)) for axis in "xyz"] + [(name, column.dtype) for name, column in columns.items()]
    table = np.empty(len(points_m), dtype=layout)
    for index, axis in enumerate("xyz"):
        table[axis] = points_m[:, index]
    for name, column in columns.items():
        table[name] = column
    offsets: Mapping[str, Any] = table.dtype.fields or {}
    data = array.array("B")
    data.frombytes(table.tobytes())  # The message checks every element of any other kind of sequence.
    return PointCloud2(
        header=header,
        height=1,
        width=len(table),
        fields=[
            PointField(name=name, offset=offsets[name][1], datatype=_FIELD_TYPES[dtype], count=1) for name, dtype in layout
        ],
        is_bigendian=sys.byteorder == "big",
        point_step=table.dtype.itemsize,
        row_step=table.nbytes,
        data=data,
        is_dense=True,
    )


def from_cloud(message: PointCloud2) -> NDArray[Any]:
    """Read a cloud as a structured array (n,) with the message's field names; the inverse of :func:`to_cloud`."""
    order: Literal[">", "<"] = ">" if message.is_bigendian else "<"
    names: list[str] = [field.name for field in message.fields]
    formats: list[np.dtype[Any]] = [_SCALARS[field.datatype].newbyteorder(order) for field in message.fields]
    offsets: list[int] = [field.offset for field in message.fields]
    step: int = message.point_step
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    return np.frombuffer(message.data, dtype=layout, count=message.width * message.height)


def cloud_points(table: NDArray[Any]) -> NDArray[np.float32]:
    """Return the positions (n, 3), metres, of the points that :func:`from_cloud` has read."""
    return np.stack([table[axis] for axis in "xyz"], axis=1)


def pack_rgb(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Pack colours (n, 3) into the float32 ``rgb`` field that PCL and RViz read."""
    wide = colors.astype(np.uint32)
    return (wide[:, 0] << 16 | wide[:, 1] << 8 | wide[:, 2]).view(np.float32)


def unpack_rgb(packed: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Unpack colours, (n, 3) uint8; the inverse of :func:`pack_rgb`."""
    wide = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([wide >> 16 & 255, wide >> 8 & 255, wide & 255], axis=1).astype(np.uint8)


def to_similarity_cloud(header: Header, answer: QueryAnswer) -> PointCloud2:
    """Make a cloud of the voxels of an answer: x, y, z, similarity and rgb."""
    columns = {"similarity": answer.similarity, "rgb": pack_rgb(similarity_colors(answer.similarity))}
    return to_cloud(header, answer.points_m, columns)


def empty_similarity_cloud(header: Header) -> PointCloud2:
    """Make a similarity cloud without points."""
    nothing = np.empty(0, np.float32)
    return to_cloud(header, np.empty((0, 3), np.float32), {"similarity": nothing, "rgb": nothing})


def to_label_cloud(header: Header, voxels: LabelledVoxels) -> PointCloud2:
    """Make a cloud of labelled voxels: x, y, z, label (int32), score and rgb (one colour a label)."""
    colors = np.zeros((int(voxels.labels.max(initial=0)) + 1, 3), np.uint8)
    for label in np.unique(voxels.labels).tolist():
        color = instance_color(label, alpha=1.0)
        colors[label] = [round(255 * part) for part in (color.r, color.g, color.b)]
    columns = {"label": voxels.labels, "score": voxels.scores, "rgb": pack_rgb(colors[voxels.labels])}
    return to_cloud(header, voxels.points_m, columns)


def empty_label_cloud(header: Header) -> PointCloud2:
    """Make a label cloud without points."""
    nothing = np.empty(0, np.float32)
    return to_label_cloud(header, LabelledVoxels("", np.empty((0, 3), np.float32), np.empty(0, np.int32), nothing))


def to_map_cloud(header: Header, voxels: VoxelSnapshot) -> PointCloud2:
    """Make a cloud of the map: x, y, z, rgb (mean colour) and instance (id of the top hypothesis, -1 without one)."""
    columns = {"rgb": pack_rgb(voxels.colors), "instance": voxels.top_instance.astype(np.int32)}
    return to_cloud(header, voxels.centers_m, columns)


def to_instance(header: Header, found: RankedInstance) -> SemanticInstance:
    """Make a message of a ranked instance."""
    return SemanticInstance(
        header=header,
        id=found.id,
        prompt=found.prompt,
        score=float(found.score),
        weight=float(found.weight),
        centroid=to_point(found.centroid_m),
        box_min=to_point(found.box_min_m),
        box_max=to_point(found.box_max_m),
        voxels=int(found.voxels),
    )


def from_instance(message: SemanticInstance) -> RankedInstance:
    """Read a ranked instance from a message; the inverse of :func:`to_instance`."""
    return RankedInstance(
        id=message.id,
        prompt=message.prompt,
        score=message.score,
        weight=message.weight,
        centroid_m=from_point(message.centroid).astype(np.float32),
        box_min_m=from_point(message.box_min).astype(np.float32),
        box_max_m=from_point(message.box_max).astype(np.float32),
        voxels=message.voxels,
    )


def to_instances(header: Header, instances: InstanceSnapshot, min_voxels: int) -> list[SemanticInstance]:
    """Make messages of the instances with at least ``min_voxels`` voxels (at least one), by ascending id, without prompt."""
    return [
        SemanticInstance(
            header=header,
            id=int(instances.ids[row]),
            weight=float(instances.weights[row]),
            centroid=to_point(instances.centroids_m[row]),
            box_min=to_point(instances.boxes_min_m[row]),
            box_max=to_point(instances.boxes_max_m[row]),
            voxels=int(instances.voxel_counts[row]),
        )
        for row in np.flatnonzero(instances.voxel_counts >= max(min_voxels, 1))
    ]


def to_point(position_m: NDArray[np.floating] | Sequence[float]) -> Point:
    """Make a point message of a position, metres."""
    x, y, z = (float(value) for value in position_m)
    return Point(x=x, y=y, z=z)


def from_point(point: Point) -> NDArray[np.float64]:
    """Read a point message as (3,) metres."""
    return np.array([point.x, point.y, point.z])


def to_path(header: Header, poses: NDArray[np.float64]) -> Path:
    """Make a path of poses (n, 4, 4); every pose has the header of the path."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat() if len(poses) else np.empty((0, 4))
    path = Path(header=header)
    for position, (x, y, z, w) in zip(poses[:, :3, 3], quaternions.tolist(), strict=True):
        pose = Pose(position=to_point(position), orientation=Quaternion(x=x, y=y, z=z, w=w))
        path.poses.append(PoseStamped(header=header, pose=pose))
    return path


def to_markers(header: Header, instances: InstanceSnapshot, min_voxels: int) -> MarkerArray:
    """Make a translucent box and its id for every instance with at least ``min_voxels`` voxels.

    The first marker clears what earlier arrays have drawn.
    """
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    for row in np.flatnonzero(instances.voxel_counts >= max(min_voxels, 1)):
        instance_id = int(instances.ids[row])
        low, high = instances.boxes_min_m[row], instances.boxes_max_m[row]
        markers += _labelled_box(header, instance_id, low, high, str(instance_id), instance_color(instance_id, alpha=0.3))
    return MarkerArray(markers=markers)


def to_answer_markers(header: Header, found: Sequence[SemanticInstance]) -> MarkerArray:
    """Make a translucent box, and over it prompt and score, for every instance of an answer; earlier ones are cleared."""
    markers = [Marker(header=header, action=Marker.DELETEALL)]
    for number, instance in enumerate(found):
        low, high = from_point(instance.box_min), from_point(instance.box_max)
        text = f"{instance.prompt} {instance.score:.2f}"
        markers += _labelled_box(header, number, low, high, text, instance_color(instance.id, alpha=0.4))
    return MarkerArray(markers=markers)


def _labelled_box(
    header: Header,
    number: int,
    low_m: NDArray[np.floating],
    high_m: NDArray[np.floating],
    text: str,
    color: ColorRGBA,
) -> list[Marker]:
    center_m = 0.5 * (low_m + high_m)
    box = Marker(header=header, ns="boxes", id=number, type=Marker.CUBE, action=Marker.ADD)
    box.pose.position = to_point(center_m)
    box.pose.orientation.w = 1.0
    box.scale = Vector3(**dict(zip("xyz", (high_m - low_m).astype(float).tolist(), strict=True)))
    box.color = color
    label = Marker(header=header, ns="labels", id=number, type=Marker.TEXT_VIEW_FACING, action=Marker.ADD)
    label.pose.position = to_point((center_m[0], center_m[1], high_m[2] + 0.5 * _LABEL_HEIGHT_M))
    label.pose.orientation.w = 1.0
    label.scale.z = _LABEL_HEIGHT_M
    label.color = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
    label.text = text
    return [box, label]


def instance_color(instance_id: int, alpha: float) -> ColorRGBA:
    """Return a colour that is always the same for an id and differs clearly between successive ids."""
    red, green, blue = colorsys.hsv_to_rgb(instance_id * _GOLDEN_RATIO % 1.0, 0.8, 1.0)
    return ColorRGBA(r=red, g=green, b=blue, a=alpha)
