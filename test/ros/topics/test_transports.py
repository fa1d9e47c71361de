"""One scene over DDS in every image transport and from every pose source gives one map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tf_stand_in
from compressed_messages import compressed_depth_png, compressed_depth_rvl, depth_png, jpeg, png
from robot import POSES, Robot, compressed_message, header
from sensor_msgs.msg import Image
from stand_ins import wall_frame

from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.voxel_map.snapshots import VoxelSnapshot

START_NS = 1_700_000_000 * 10**9
FRAMES = 4


def scene() -> list[PosedFrame]:
    """A camera that moves along a wall that leans back and has holes; depth in whole millimetres."""
    ys, xs = np.mgrid[0:480, 0:640]
    depth_mm = 1800 + xs // 2 + (ys // 7) % 5
    depth_mm[(xs // 40 + ys // 40) % 9 == 0] = 0
    depth_m = depth_mm.astype(np.float32) * np.float32(0.001)
    return [replace(wall_frame(START_NS + i * 10**8, x_m=0.2 * i), depth_m=depth_m) for i in range(FRAMES)]


def millimetres(frame: PosedFrame) -> np.ndarray:
    return np.rint(frame.depth_m * 1000).astype(np.uint16)


def raw_depth(frame: PosedFrame) -> Image:
    """16UC1."""
    message = Image(header=header(frame.stamp_ns), height=480, width=640, encoding="16UC1", step=1280)
    message.data.frombytes(millimetres(frame).tobytes())
    return message


def colors_by(compress: Callable[[np.ndarray], tuple[str, bytes]]) -> Callable[[PosedFrame], Any]:
    return lambda frame: compressed_message(frame.stamp_ns, *compress(frame.rgb))


def depth_by(compress: Callable[[np.ndarray], tuple[str, bytes]]) -> Callable[[PosedFrame], Any]:
    return lambda frame: compressed_message(frame.stamp_ns, *compress(millimetres(frame)))


def mapped(robot: Robot, **makers: Callable[[PosedFrame], Any]) -> VoxelSnapshot:
    robot.makers |= makers
    for frame in scene():
        robot.map(frame)
    assert not robot.mapper.drops.counts()
    return in_order(robot.mapper.pipeline.semantic_map.voxels())


def in_order(voxels: VoxelSnapshot) -> VoxelSnapshot:
    order = np.lexsort(voxels.centers_m.T)
    return VoxelSnapshot(*(values[order] for values in vars(voxels).values()))


@pytest.fixture(scope="module")
def raw_map() -> VoxelSnapshot:
    robot = Robot()
    try:
        return mapped(robot)
    finally:
        robot.close()


@pytest.mark.parametrize(
    ("parameters", "makers"),
    [
        ({}, {"depth": raw_depth}),
        ({"input.rgb_transport": "compressed"}, {"rgb": colors_by(png)}),
        ({"input.depth_transport": "compressed"}, {"depth": depth_by(depth_png)}),
        ({"input.depth_transport": "compressedDepth"}, {"depth": depth_by(compressed_depth_png)}),
        ({"input.depth_transport": "compressedDepth"}, {"depth": depth_by(compressed_depth_rvl)}),
        *[({"input.pose_source": source}, {}) for source in POSES],
    ],
    ids=["raw_16UC1", "png", "depth_png", "compressedDepth_png", "compressedDepth_rvl", *POSES],
)
def test_what_is_lossless_gives_the_same_map(make_robot, raw_map, parameters, makers) -> None:
    voxels = mapped(make_robot(**parameters), **makers)
    assert len(raw_map.centers_m) > 500
    for name, values in vars(voxels).items():
        np.testing.assert_array_equal(values, getattr(raw_map, name), err_msg=name)


def test_jpeg_gives_the_same_voxels_in_colours_that_are_close(make_robot, raw_map) -> None:
    robot = make_robot(**{"input.rgb_transport": "compressed", "input.depth_transport": "compressedDepth"})
    voxels = mapped(robot, rgb=colors_by(jpeg), depth=depth_by(compressed_depth_rvl))
    np.testing.assert_array_equal(voxels.centers_m, raw_map.centers_m)
    np.testing.assert_array_equal(voxels.dense_weight, raw_map.dense_weight)
    difference = np.abs(voxels.colors.astype(int) - raw_map.colors.astype(int))
    assert difference.mean() < 2  # Of 255; colours bleed into their surroundings by half a block of subsampled chroma.
    assert np.quantile(difference, 0.98) < 30


def test_poses_from_tf_give_the_same_map(make_robot, raw_map, monkeypatch) -> None:
    tf_stand_in.install(monkeypatch)
    robot = make_robot(**{"input.pose_source": "tf"})
    buffer = tf_stand_in.latest_buffer()
    robot.makers["info"] = tf_stand_in.before(robot.makers["info"], buffer, "map", "camera")
    voxels = mapped(robot)
    for name, values in vars(voxels).items():
        np.testing.assert_array_equal(values, getattr(raw_map, name), err_msg=name)


def test_an_extrinsic_from_tf_is_the_mounting_of_the_camera(make_robot, raw_map, monkeypatch) -> None:
    """The body is 0.25 m behind its camera and turned as vehicles are: x forward, z up."""
    tf_stand_in.install(monkeypatch)
    robot = make_robot(**{"input.pose_source": "odometry", "input.extrinsic_source": "tf"})
    T_body_camera = np.array([[0, 0, 1, 0.25], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    tf_stand_in.latest_buffer().set_transform_static(tf_stand_in.stamped("base_link", "camera", 0, T_body_camera), "test")
    robot.makers["pose"] = lambda frame: tf_stand_in.odometry(frame, frame.T_world_camera @ np.linalg.inv(T_body_camera))
    voxels = mapped(robot)
    assert len(voxels.centers_m) == pytest.approx(len(raw_map.centers_m), rel=0.02)
    np.testing.assert_allclose(voxels.centers_m.mean(axis=0), raw_map.centers_m.mean(axis=0), atol=0.01)
