"""Cameras: the model over time, lens, separate depth sensor and transports, and several cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import ros_messages as ros
from compressed_messages import compressed_depth_png, compressed_depth_rvl, depth_png, jpeg, png
from fed_pairer import FedPairer
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.config.schema import Config, ImageConfig
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.geometry.registration import register_depth
from fus3dmaps_core.sources.transforms import TransformTree

MS = 1_000_000
S = 1_000_000_000
START = 100 * S
IDENTITY = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
RNG = np.random.default_rng(3)


def see(pairer: FedPairer, stamp_ns: int, rgb=None, depth=None, camera: int = 0) -> None:
    pairer.add_depth(ros.image(stamp_ns, "16UC1") if depth is None else depth, camera)
    pairer.add_rgb(ros.image(stamp_ns) if rgb is None else rgb, camera)


def info(stamp_ns: int = 0, d=(), focal: float = 40.0):
    message = ros.camera_info(stamp_ns, 64, 48, focal)
    message.d = np.array(d, float)
    return message


COLORS = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)
DEPTH_MM = RNG.integers(500, 4000, (48, 64)).astype(np.uint16)


@pytest.mark.parametrize(
    ("rgb_transport", "compress", "exact"), [("compressed", png, True), ("compressed", jpeg, False)], ids=["png", "jpeg"]
)
@pytest.mark.parametrize(
    ("depth_transport", "compress_depth"),
    [
        ("compressed", depth_png),
        ("compressedDepth", compressed_depth_png),
        ("compressedDepth", compressed_depth_rvl),
    ],
)
def test_compressed_images_meet_like_raw_ones(rgb_transport, compress, exact, depth_transport, compress_depth):
    pairer = FedPairer(InputConfig(rgb_transport=rgb_transport, depth_transport=depth_transport))
    topics = {stream.parameter: (stream.topic, stream.msgtype) for stream in pairer.streams()}
    assert topics["input.rgb_topic"] == ("rgb/image/compressed", "sensor_msgs/msg/CompressedImage")
    assert topics["input.depth_topic"] == (f"depth/image/{depth_transport}", "sensor_msgs/msg/CompressedImage")
    pairer.add_camera_info(info())
    pairer.add_pose(ros.pose(START))
    smooth = cv2.resize(COLORS[::12, ::16], (64, 48), interpolation=cv2.INTER_CUBIC)
    see(pairer, START, ros.compressed(START, *compress(smooth)), ros.compressed(START, *compress_depth(DEPTH_MM)))
    (paired,) = pairer.poll()
    frame = paired.decode(ImageConfig())
    np.testing.assert_array_equal(np.rint(frame.depth_m * 1000), DEPTH_MM)
    if exact:
        np.testing.assert_array_equal(frame.rgb, smooth)
    else:
        assert np.abs(frame.rgb.astype(int) - smooth).mean() < 6


def test_a_topic_that_has_its_suffix_keeps_it():
    pairer = FedPairer(InputConfig(rgb_topic="/cam/image_raw/compressed", rgb_transport="compressed"))
    assert next(stream.topic for stream in pairer.streams()) == "/cam/image_raw/compressed"


def test_a_truncated_image_is_counted_by_name():
    pairer = FedPairer(InputConfig(rgb_transport="compressed"))
    image_format, data = jpeg(COLORS)
    pairer.add_rgb(ros.compressed(START, image_format, data[:100]))
    assert pairer.drops.counts() == {"bad_compression": 1}
    assert "rgb/image/compressed" in pairer.drops.latest()["bad_compression"]


@pytest.mark.parametrize("rectify", [True, False])
@pytest.mark.parametrize("scale", [1, 2])
def test_distortion_is_undone_once_wanted(rectify, scale):
    """Depth of half the resolution is rectified with the same lens."""
    d = (-0.2, 0.05, 0.001, -0.002, 0.0)
    pairer = FedPairer(InputConfig(rectify=rectify))
    pairer.add_camera_info(info(d=d))
    pairer.add_pose(ros.pose(START))
    depth_mm = DEPTH_MM[::scale, ::scale]
    see(pairer, START, ros.image(START, "rgb8", COLORS), ros.image(START, "16UC1", depth_mm))
    frame = pairer.poll()[0].decode(ImageConfig())
    K = Intrinsics(40.0, 40.0, 31.5, 23.5, 64, 48)
    K_depth = K.resized(64 // scale, 48 // scale).matrix
    if rectify:
        expected = cv2.undistort(COLORS, K.matrix, np.array(d))
        # OpenCV's own rounding of the map to 1/32 pixel.
        assert np.abs(frame.rgb[2:-2, 2:-2].astype(int) - expected[2:-2, 2:-2]).mean() < 2
        size = depth_mm.shape[::-1]
        x, y = cv2.initUndistortRectifyMap(K_depth, np.array(d), None, K_depth, size, cv2.CV_32FC1)
        expected_mm = cv2.remap(depth_mm, x, y, cv2.INTER_NEAREST)
    else:
        np.testing.assert_array_equal(frame.rgb, COLORS)
        expected_mm = depth_mm
    assert (np.rint(frame.depth_m * 1000) == expected_mm).mean() > 0.99
    assert frame.intrinsics == K


@pytest.mark.parametrize("source", ["parameter", "tf"])
def test_depth_of_another_camera_is_registered(source):
    config = InputConfig(
        depth_registered=False,
        extrinsic_source=source,
        body_frame="camera",
        T_rgb_depth=[0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] if source == "parameter" else IDENTITY,
    )
    tree = TransformTree(1.0)
    tree.add(ros.transforms(("camera", "ir", 0, (0.2, 0.0, 0.0))), "/tf_static", static=True)
    pairer = FedPairer(config, tree)
    assert "depth/camera_info" in [stream.topic for stream in pairer.streams()]
    depth_mm = np.full((30, 30), 1000, np.uint16)
    depth = ros.image(START, "16UC1", depth_mm)
    depth.header.frame_id = "ir"
    pairer.add_pose(ros.pose(START))
    pairer.add_camera_info(info())
    see(pairer, START, ros.image(START, "rgb8", COLORS), depth)
    assert pairer.poll() == []  # The model of the depth camera is not there yet.
    pairer.add_depth_camera_info(ros.camera_info(0, 30, 30, 25.0))
    frame = pairer.poll()[0].decode(ImageConfig())
    T = np.eye(4)
    T[0, 3] = 0.2
    depth_camera = Intrinsics(25.0, 25.0, 14.5, 14.5, 30, 30)
    expected = register_depth((depth_mm * np.float32(0.001)), depth_camera, frame.intrinsics, T)
    np.testing.assert_array_equal(frame.depth_m, expected)
    # The wall's left end is at x = 0.2 - 15 / 25 m for the colour camera, 1 m away: column 31.5 - 0.4 x 40 = 15.5.
    assert (frame.depth_m[8:40, 17:] == 1).all()
    assert (frame.depth_m[:, :15] == 0).all()


def test_the_model_of_a_depth_camera_that_never_comes_is_named():
    pairer = FedPairer(InputConfig(depth_registered=False))
    pairer.add_pose(ros.pose(START))
    pairer.add_camera_info(info())
    see(pairer, START, ros.image(START, "rgb8", COLORS), ros.image(START, "16UC1", DEPTH_MM))
    assert pairer.flush() == []
    assert "depth/camera_info" in pairer.drops.latest()["no_camera_info"]


def test_a_changed_model_holds_from_its_stamp_on():
    pairer = FedPairer(InputConfig())
    pairer.add_camera_info(ros.camera_info(START, focal=5.0))
    pairer.add_camera_info(ros.camera_info(START + 90 * MS, focal=5.0))
    see(pairer, START)
    see(pairer, START + 100 * MS)
    pairer.add_camera_info(ros.camera_info(START + 100 * MS, focal=7.0))
    see(pairer, START + 200 * MS)
    for stamp_ns in (START, START + 200 * MS):
        pairer.add_pose(ros.pose(stamp_ns))
    assert [paired.intrinsics.fx for paired in pairer.poll()] == [5.0, 7.0, 7.0]
    assert pairer.drops.counts() == {"intrinsics_changed": 1}
    assert "fx=5.0" in pairer.drops.latest()["intrinsics_changed"]
    assert "fx=7.0" in pairer.drops.latest()["intrinsics_changed"]
    assert "rgb/camera_info" in pairer.drops.latest()["intrinsics_changed"]


def test_a_frame_that_changes_is_counted_once_and_followed():
    pairer = FedPairer(InputConfig())
    pairer.add_camera_info(ros.camera_info())
    for i in range(4):
        stamp_ns = START + i * 100 * MS
        rgb = ros.image(stamp_ns)
        rgb.header.frame_id = "camera" if i < 2 else "other"
        pairer.add_pose(ros.pose(stamp_ns))
        see(pairer, stamp_ns, rgb)
    assert len(pairer.poll()) == 4
    assert pairer.drops.counts() == {"frame_id_changed": 1}
    assert "'camera' to 'other'" in pairer.drops.latest()["frame_id_changed"]


def two_cameras(**values) -> FedPairer:
    pairer = FedPairer(
        InputConfig(cameras="front, rear", T_body_camera=[*IDENTITY, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0, 1.0], **values)
    )
    for camera in (0, 1):
        pairer.add_camera_info(ros.camera_info(), camera)
    return pairer


def test_each_camera_has_its_namespace_and_its_mounting():
    pairer = two_cameras()
    assert [stream.topic for stream in pairer.streams()] == [
        *("front/rgb/image", "front/depth/image", "front/rgb/camera_info"),
        *("rear/rgb/image", "rear/depth/image", "rear/rgb/camera_info"),
        "pose",
    ]
    pairer.add_pose(ros.pose(START, (1.0, 0.0, 0.0)))
    see(pairer, START, camera=1)
    see(pairer, START, camera=0)
    assert sorted(paired.T_world_camera[:2, 3].tolist() for paired in pairer.poll()) == [[1.0, 0.0], [1.0, 5.0]]
    pairer.add_rgb(ros.image(START, "yuv422"), 1)
    assert "rear/rgb/image" in pairer.drops.latest()["unknown_encoding"]


@given(front=st.sets(st.integers(0, 60)), rear=st.sets(st.integers(0, 60)), order=st.randoms(), delay=st.integers(0, 10))
def test_frames_of_cameras_interleave_by_stamp(front, rear, order, delay):
    """Depth is late by a different time for each camera. All frames come, and none before an earlier one that was there."""
    pairer = two_cameras(max_wait_s=100.0)
    for i in range(61):
        pairer.add_pose(ros.pose(START + i * 100 * MS))
    events = [(stamp, "rgb", camera, stamp) for camera, all_ in ((0, front), (1, rear)) for stamp in all_]
    events += [
        (stamp + (delay if camera else 0), "depth", camera, stamp)
        for camera, all_ in ((0, front), (1, rear))
        for stamp in all_
    ]
    ready = []
    shown: list[int] = []
    for _, kind, camera, stamp in sorted(events, key=lambda event: (event[0], event[1] != "rgb")):
        stamp_ns = START + stamp * 100 * MS
        if kind == "rgb":
            pairer.add_rgb(ros.image(stamp_ns), camera)
            shown.append(stamp_ns)
        else:
            pairer.add_depth(ros.image(stamp_ns, "16UC1"), camera)
        ready += [paired.stamp_ns for paired in pairer.poll()]
        assert ready == sorted(shown)[: len(ready)]
    ready += [paired.stamp_ns for paired in pairer.flush()]
    assert ready == sorted(START + stamp * 100 * MS for stamp in [*front, *rear])
    assert not pairer.drops.counts()


def test_a_time_jump_of_one_camera_starts_all_anew():
    pairer = two_cameras()
    pairer.add_pose(ros.pose(START))
    for camera in (0, 1):
        see(pairer, START, camera=camera)
    pairer.add_pose(ros.pose(START - 50 * S))
    for camera in (0, 1):
        see(pairer, START - 50 * S, camera=camera)
    assert [paired.stamp_ns for paired in pairer.poll()] == [START, START, START - 50 * S, START - 50 * S]
    assert pairer.drops.counts() == {"time_jump": 1}


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"cameras": "a,b"}, "T_body_camera"),
        ({"cameras": "a,,b"}, "cameras"),
        ({"cameras": "a,a"}, "cameras"),
        ({"cameras": "/a"}, "cameras"),
        ({"cameras": "a", "rgb_topic": "/rgb"}, "rgb_topic"),
        ({"cameras": "a,b", "T_body_camera": IDENTITY * 2, "T_rgb_depth": IDENTITY * 3}, "T_rgb_depth"),
        ({"camera_frame": "a,b"}, "camera_frame"),
        ({"extrinsic_source": "tf"}, "body_frame"),
        ({"rgb_transport": "theora"}, "rgb_transport"),
        ({"pose_qos": "quick"}, "pose_qos"),
        ({"tf_timeout_s": 0.0}, "tf_timeout_s"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused_by_name(values, named):
    with pytest.raises(ConfigError, match=rf"'input\.{named}'"):
        Config.from_flat({f"input.{key}": value for key, value in values.items()})


def test_cameras_in_tf_need_no_numbers():
    config = Config.from_flat({"input.cameras": "a,b", "input.pose_source": "tf", "input.camera_frame": "x, y"})
    tree = TransformTree(1.0)
    tree.add(ros.transforms(("map", "x", 0, (1.0, 0.0, 0.0)), ("map", "y", 0, (2.0, 0.0, 0.0))), "/tf", static=True)
    pairer = FedPairer(config.input, tree)
    for camera in (0, 1):
        pairer.add_camera_info(ros.camera_info(), camera)
        see(pairer, START + camera, camera=camera)
    assert [paired.T_world_camera[0, 3] for paired in pairer.poll()] == [1.0, 2.0]
