"""Several cameras, a separate depth camera and a lens with distortion: the map over DDS is the one of the same frames here.

Bit for bit: what the messages carry and the poses are exact in binary, and the arithmetic behind them is the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from reference.agreement import assert_same_bytes
from robot import Robot, camera_info_message, depth_message, pose_message, stand_in_pipeline
from sensor_msgs.msg import CameraInfo
from stand_ins import wall_frame

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_core.geometry.distortion import Distortion, Rectifier
from fus3dmaps_core.geometry.registration import register_depth
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap

START_NS = 1_700_000_000 * 10**9
STEP_NS = 10**8
FRAMES = 4


def mapped_here(frames: Iterable[PosedFrame], **parameters: Any) -> SemanticMap:
    """The map of frames that go into the pipeline directly."""
    pipeline = stand_in_pipeline(Config().with_values(parameters))
    for frame in frames:
        assert pipeline.wants(frame.T_world_camera)
        pipeline.process(frame)
    return pipeline.semantic_map


def assert_same_map(robot: Robot, expected: SemanticMap) -> None:
    assert expected.voxel_count > 500
    assert expected.instance_count > 1
    assert not robot.mapper.drops.counts()
    assert_same_bytes(robot.mapper.pipeline.semantic_map.export_state(), expected.export_state())


# A body as vehicles are: x forward, z up. Two cameras on it look forward and back, each with its own picture.
FRONT = np.array([[0, 0, 1, 0.25], [-1, 0, 0, 0.125], [0, -1, 0, 0.5], [0, 0, 0, 1.0]])
REAR = np.array([[0, 0, -1, -0.5], [1, 0, 0, 0.0], [0, -1, 0, 0.75], [0, 0, 0, 1.0]])
MOUNTINGS = {"front": FRONT, "rear": REAR}
PATCHES = {"front": {"red": (-0.4, 0.0, 0.4)}, "rear": {"blue": (0.5, 0.1, 0.3), "green": (-0.2, 0.2, 0.3)}}
TWO_CAMERAS = {
    "input.cameras": "front,rear",
    "input.T_body_camera": [0.25, 0.125, 0.5, -0.5, 0.5, -0.5, 0.5, -0.5, 0.0, 0.75, -0.5, -0.5, 0.5, 0.5],
}


def drive() -> list[tuple[str, PosedFrame]]:
    """Camera and frame, in turns, while the body drives sideways; stamps of the cameras differ."""
    frames = []
    for number in range(2 * FRAMES):
        camera = ("front", "rear")[number % 2]
        T_world_body = np.eye(4)
        T_world_body[1, 3] = 0.125 * number
        frame = wall_frame(START_NS + number * STEP_NS, patches=PATCHES[camera])
        frames.append((camera, replace(frame, T_world_camera=T_world_body @ MOUNTINGS[camera])))
    return frames


def test_two_cameras_feed_one_map(make_robot) -> None:
    robot = make_robot(**TWO_CAMERAS)
    robot.makers["pose"] = lambda frame: pose_message(replace(frame, T_world_camera=T_world_body_of(frame)))
    for camera, frame in drive():
        robot.map(frame, camera)
    assert_same_map(robot, mapped_here((frame for _, frame in drive()), **TWO_CAMERAS))
    # The walls that they see are 2 m before and behind them.
    centers_m = robot.mapper.pipeline.semantic_map.voxels().centers_m
    ahead = centers_m[:, 0] > 0
    np.testing.assert_allclose(centers_m[ahead, 0], 2.25, atol=0.03)
    np.testing.assert_allclose(centers_m[~ahead, 0], -2.5, atol=0.03)


def T_world_body_of(frame: PosedFrame) -> np.ndarray:  # noqa: N802
    """Of a frame of :func:`drive`, by its stamp."""
    T = np.eye(4)
    T[1, 3] = 0.125 * ((frame.stamp_ns - START_NS) // STEP_NS)
    return T


DEPTH_CAMERA = Intrinsics(fx=256.0, fy=256.0, cx=159.5, cy=119.5, width=320, height=240)
T_RGB_DEPTH = np.array([[1, 0, 0, 0.125], [0, 1, 0, -0.0625], [0, 0, 1, 0.25], [0, 0, 0, 1.0]])
SEPARATE_DEPTH = {
    "input.depth_registered": False,
    "input.T_rgb_depth": [0.125, -0.0625, 0.25, 0.0, 0.0, 0.0, 1.0],
}


def depth_camera_info(frame: PosedFrame) -> CameraInfo:
    size = (DEPTH_CAMERA.height, DEPTH_CAMERA.width)
    return camera_info_message(replace(frame, rgb=np.zeros((*size, 3), np.uint8), intrinsics=DEPTH_CAMERA))


def with_a_box(frame: PosedFrame) -> PosedFrame:
    """With the depth camera's image: a wall at 1.75 m for it, a box in front and a hole."""
    depth_m = np.full((DEPTH_CAMERA.height, DEPTH_CAMERA.width), 1.75, np.float32)
    depth_m[60:120, 100:180] = 1.25
    depth_m[150:170, 200:240] = 0.0
    return replace(frame, depth_m=depth_m)


def test_depth_of_another_camera_and_size_is_registered(make_robot) -> None:
    robot = make_robot(**SEPARATE_DEPTH)
    robot.makers["depth_info"] = depth_camera_info
    robot.makers["depth"] = lambda frame: depth_message(with_a_box(frame))
    frames = [wall_frame(START_NS + number * STEP_NS, x_m=0.25 * number) for number in range(FRAMES)]
    for frame in frames:
        robot.map(frame)
    registered = (
        replace(frame, depth_m=register_depth(with_a_box(frame).depth_m, DEPTH_CAMERA, frame.intrinsics, T_RGB_DEPTH))
        for frame in frames
    )
    assert_same_map(robot, mapped_here(registered, **SEPARATE_DEPTH))
    # The depth camera is 0.25 m before the colour camera: wall and box are 2 m and 1.5 m from that one.
    z_m = robot.mapper.pipeline.semantic_map.voxels().centers_m[:, 2]
    assert (np.minimum(np.abs(z_m - 2.0), np.abs(z_m - 1.5)) < 0.03).all()
    assert (z_m < 1.75).any()


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("plumb_bob", [-0.25, 0.0625, 0.001, -0.002, 0.0]),
        ("rational_polynomial", [-0.25, 0.0625, 0.001, -0.002, 0.01, 0.03, 0.0, 0.0]),
        ("equidistant", [-0.02, 0.01, -0.004, 0.001]),
    ],
)
def test_a_distorted_camera_is_rectified(make_robot, model, coefficients) -> None:
    def distorted_info(frame: PosedFrame) -> CameraInfo:
        message = camera_info_message(frame)
        message.distortion_model, message.d = model, coefficients
        return message

    robot = make_robot()
    robot.makers["info"] = distorted_info
    frames = [wall_frame(START_NS + number * STEP_NS, x_m=0.25 * number) for number in range(FRAMES)]
    for frame in frames:
        robot.map(frame)
    rectifier = Rectifier(frames[0].intrinsics, Distortion(model, tuple(coefficients)))
    rectified = [replace(frame, rgb=rectifier.color(frame.rgb), depth_m=rectifier.depth(frame.depth_m)) for frame in frames]
    assert any((frame.rgb != plain.rgb).any() for frame, plain in zip(rectified, frames, strict=True))
    assert_same_map(robot, mapped_here(rectified))
