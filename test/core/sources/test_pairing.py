"""Pairing by stamp: known situations, every counted drop, and random streams against a brute-force reference."""

from __future__ import annotations

import numpy as np
import pytest
import ros_messages as ros
from fed_pairer import FedPairer
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import ConfigError

MS = 1_000_000
S = 1_000_000_000
START = 100 * S


def pairer(**values) -> FedPairer:
    built = FedPairer(InputConfig(**values))
    built.add_camera_info(ros.camera_info())
    return built


def feed(target: FedPairer, stamp_ns: int) -> None:
    """Add a complete frame at one stamp."""
    target.add_pose(ros.pose(stamp_ns, (stamp_ns / S, 0.0, 0.0)))
    target.add_depth(ros.image(stamp_ns, "16UC1"))
    target.add_rgb(ros.image(stamp_ns))


def stamps(pairs) -> list[int]:
    return [paired.stamp_ns for paired in pairs]


def test_a_complete_frame_is_ready_at_once_and_once():
    target = pairer()
    feed(target, START)
    (paired,) = target.poll()
    assert paired.stamp_ns == START
    assert paired.T_world_camera[0, 3] == 100.0
    assert paired.intrinsics.fx == 5.0
    assert target.poll() == []
    assert not target.drops.counts()


def test_pixels_are_decoded_on_demand():
    target = pairer()
    target.add_pose(ros.pose(START))
    target.add_depth(ros.image(START, "16UC1", np.full((2, 3), 1500, np.uint16)))
    target.add_rgb(ros.image(START, "bgr8", np.full((4, 6, 3), (1, 2, 3), np.uint8)))
    frame = target.poll()[0].decode(ImageConfig(depth_unit_m=0.002))
    assert frame.stamp_ns == START
    assert frame.rgb[0, 0].tolist() == [3, 2, 1]
    assert frame.depth_m.shape == (2, 3)
    np.testing.assert_allclose(frame.depth_m, 3.0, rtol=1e-6)


def test_pose_is_interpolated_to_the_colour_image_and_the_camera_is_mounted_on_the_body():
    half = float(np.sqrt(0.5))
    target = pairer(T_body_camera=[0.0, 0.0, 1.0, 0.0, 0.0, half, half])
    target.add_pose(ros.pose(START, (0.0, 0.0, 0.0)))
    target.add_depth(ros.image(START + 50 * MS, "16UC1"))
    target.add_rgb(ros.image(START + 50 * MS))
    assert target.poll() == []
    target.add_pose(ros.pose(START + 100 * MS, (2.0, 0.0, 0.0)))
    (paired,) = target.poll()
    expected = [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
    np.testing.assert_allclose(paired.T_world_camera, expected, atol=1e-12)


def test_odometry_takes_the_place_of_poses():
    target = pairer(pose_source="odometry")
    target.add_pose(ros.odometry(START, (1.0, 2.0, 3.0)))
    target.add_depth(ros.image(START, "16UC1"))
    target.add_rgb(ros.image(START))
    np.testing.assert_array_equal(target.poll()[0].T_world_camera[:3, 3], [1, 2, 3])


def test_mounting_that_is_no_pose_is_refused():
    with pytest.raises(ConfigError, match=r"input\.T_body_camera"):
        FedPairer(InputConfig(T_body_camera=[0.0] * 7))


def test_nearest_depth_wins_even_if_it_comes_later():
    target = pairer()
    target.add_pose(ros.pose(START))
    target.add_depth(ros.image(START - 15 * MS, "16UC1"))
    target.add_rgb(ros.image(START))
    assert target.poll() == []
    target.add_depth(ros.image(START + 5 * MS, "16UC1"))
    assert target.poll()[0].depth.header.stamp.nanosec == 5 * MS


@pytest.mark.parametrize(("offset_ns", "pairs"), [(20 * MS, 1), (20 * MS + 1, 0), (-20 * MS, 1), (-20 * MS - 1, 0)])
def test_depth_within_the_tolerance_only(offset_ns, pairs):
    target = pairer(sync_tolerance_s=0.02)
    target.add_pose(ros.pose(START))
    target.add_depth(ros.image(START + offset_ns, "16UC1"))
    target.add_rgb(ros.image(START))
    assert len(target.flush()) == pairs
    assert target.drops.counts()["no_depth"] == 1 - pairs


def test_depth_that_cannot_come_any_more_is_not_waited_for():
    target = pairer()
    target.add_rgb(ros.image(START))
    target.add_depth(ros.image(START + 40 * MS, "16UC1"))
    assert target.poll() == []
    assert target.drops.counts() == {"no_depth": 1}
    assert "rgb/image" in target.drops.latest()["no_depth"]
    assert "depth/image" in target.drops.latest()["no_depth"]
    assert "0.040 s" in target.drops.latest()["no_depth"]


def test_images_from_before_the_first_pose_are_dropped():
    target = pairer()
    target.add_depth(ros.image(START, "16UC1"))
    target.add_rgb(ros.image(START))
    target.add_pose(ros.pose(START + MS))
    assert target.poll() == []
    assert target.drops.counts() == {"no_pose": 1}
    feed(target, START + 2 * MS)
    assert stamps(target.poll()) == [START + 2 * MS]


def test_images_in_a_gap_of_the_trajectory_are_dropped():
    target = pairer(max_pose_gap_s=0.5)
    target.add_pose(ros.pose(START))
    target.add_depth(ros.image(START + 300 * MS, "16UC1"))
    target.add_rgb(ros.image(START + 300 * MS))
    target.add_pose(ros.pose(START + 501 * MS))
    assert target.poll() == []
    assert target.drops.counts() == {"pose_gap": 1}
    assert "pose" in target.drops.latest()["pose_gap"]


@pytest.mark.parametrize(("missing", "reason"), [("pose", "no_pose"), ("depth", "no_depth"), ("info", "no_camera_info")])
def test_waiting_ends_by_the_stamps_of_the_messages(missing, reason):
    target = FedPairer(InputConfig(max_wait_s=2.0))
    if missing != "info":
        target.add_camera_info(ros.camera_info())
    ready = []
    for i in range(101):
        stamp_ns = START + i * 100 * MS
        if missing != "pose":
            target.add_pose(ros.pose(stamp_ns))
        if missing != "depth":
            target.add_depth(ros.image(stamp_ns, "16UC1"))
        target.add_rgb(ros.image(stamp_ns))
        ready += target.poll()
    assert ready == []
    assert target.drops.counts() == {reason: 80}
    assert target.flush() == []
    assert target.drops.counts() == {reason: 101}


def test_a_camera_model_that_comes_late_serves_the_waiting_images():
    target = FedPairer(InputConfig())
    for i in range(3):
        feed(target, START + i * 100 * MS)
    assert target.poll() == []
    target.add_camera_info(ros.camera_info())
    assert len(target.poll()) == 3


@pytest.mark.parametrize(
    ("add", "reason", "topic"),
    [
        (lambda p: p.add_rgb(ros.image(START, "yuv422")), "unknown_encoding", "rgb/image"),
        (lambda p: p.add_rgb(ros.image(START, height=0)), "bad_image", "rgb/image"),
        (lambda p: p.add_rgb(ros.image(START, data=np.zeros(5, np.uint8))), "size_mismatch", "rgb/image"),
        (lambda p: p.add_rgb(ros.image(START, pixels=np.zeros((6, 4, 3), np.uint8))), "size_mismatch", "rgb/image"),
        (lambda p: p.add_depth(ros.image(START, "rgb8")), "unknown_encoding", "depth/image"),
        (lambda p: p.add_depth(ros.image(START, "16UC1", step=3)), "bad_image", "depth/image"),
        (lambda p: p.add_camera_info(ros.camera_info(focal=0.0)), "bad_intrinsics", "rgb/camera_info"),
        (lambda p: p.add_pose(ros.pose(START, (np.nan, 0.0, 0.0))), "bad_pose", "pose"),
        (lambda p: p.add_pose(ros.pose(START, quaternion=(0.0,) * 4)), "bad_pose", "pose"),
        (lambda p: p.add_pose(ros.pose(START, frame_id="odom")), "wrong_frame", "pose"),
    ],
)
def test_bad_messages_are_counted_and_named_and_pairing_goes_on(add, reason, topic):
    target = pairer()
    add(target)
    assert target.drops.counts() == {reason: 1}
    assert topic in target.drops.latest()[reason]
    feed(target, START)
    assert stamps(target.poll()) == [START]
    assert target.drops.counts() == {reason: 1}


def test_wrong_frame_names_both_frames():
    target = pairer()
    target.add_pose(ros.pose(START, frame_id="odom"))
    assert "'odom'" in target.drops.latest()["wrong_frame"]
    assert "'map'" in target.drops.latest()["wrong_frame"]
    target = pairer(map_frame="odom")
    target.add_pose(ros.pose(START, frame_id="/odom"))
    assert not target.drops.counts()


def test_depth_of_another_resolution_but_not_of_another_shape():
    target = pairer()
    for stamp_ns, shape in [(START, (2, 3)), (START + MS, (4, 4)), (START + 2 * MS, (8, 12))]:
        target.add_pose(ros.pose(stamp_ns))
        target.add_depth(ros.image(stamp_ns, "16UC1", np.zeros(shape, np.uint16)))
        target.add_rgb(ros.image(stamp_ns))
    assert stamps(target.poll()) == [START, START + 2 * MS]
    assert target.drops.counts() == {"size_mismatch": 1}
    assert "4x4" in target.drops.latest()["size_mismatch"]


def test_a_camera_model_of_another_size_is_noticed_at_pairing():
    target = FedPairer(InputConfig())
    feed(target, START)
    target.add_camera_info(ros.camera_info(width=12, height=8))
    assert target.poll() == []
    assert target.drops.counts() == {"size_mismatch": 1}


def test_stamps_that_run_backwards_are_dropped_and_counted():
    target = pairer()
    feed(target, START)
    feed(target, START - 500 * MS)
    feed(target, START)
    feed(target, START + 100 * MS)
    assert stamps(target.poll()) == [START, START + 100 * MS]
    assert target.drops.counts() == {"stamp_backwards": 3, "stamp_repeated": 3}
    assert "0.500 s" in target.drops.latest()["stamp_backwards"]


def test_a_looped_recording_starts_over():
    target = pairer()
    ready = []
    for loop in range(3):
        for i in range(100):
            feed(target, START + i * 100 * MS + loop)
            ready += target.poll()
    assert len(ready) == 300
    # In each loop the pose comes first; it clears the clocks of the others, so that a jump counts once.
    assert target.drops.counts() == {"time_jump": 2}
    assert "9.9 s" in target.drops.latest()["time_jump"]


def test_a_time_jump_settles_what_was_waiting():
    target = pairer()
    target.add_pose(ros.pose(START))
    target.add_depth(ros.image(START + 50 * MS, "16UC1"))
    target.add_rgb(ros.image(START + 50 * MS))
    feed(target, START - 60 * S)
    assert stamps(target.poll()) == [START - 60 * S]
    assert target.drops.counts() == {"time_jump": 1, "no_pose": 1}


def test_reset_forgets_time_but_not_the_counts():
    target = pairer()
    feed(target, START)
    target.add_rgb(ros.image(START + 10 * MS))
    target.add_rgb(ros.image(START))
    target.reset()
    assert target.flush() == []
    feed(target, START - S)
    assert stamps(target.poll()) == [START - S]
    assert target.drops.counts() == {"stamp_backwards": 1}


@pytest.mark.parametrize("alive", ["rgb", "depth", "pose"])
def test_memory_is_bounded_when_only_one_input_is_alive(alive):
    target = pairer(max_wait_s=1.0)
    for i in range(500):
        stamp_ns = START + i * 100 * MS
        if alive == "rgb":
            target.add_rgb(ros.image(stamp_ns))
        elif alive == "depth":
            target.add_depth(ros.image(stamp_ns, "16UC1"))
        else:
            target.add_pose(ros.pose(stamp_ns))
        target.poll()
    assert target.waiting < 20


def reference(rgb, depth, poses, tolerance_ns, gap_ns) -> dict[int, tuple[int, float]]:
    """Compute the expected pairs from whole streams: colour stamp -> depth stamp, x position."""
    expected = {}
    for stamp in rgb:
        near = [d for d in depth if abs(d - stamp) <= tolerance_ns]
        before, after = [p for p in poses if p <= stamp], [p for p in poses if p >= stamp]
        if not near or not before or not after or after[0] - before[-1] > gap_ns:
            continue
        distance = min(abs(d - stamp) for d in near)
        expected[stamp] = (min(d for d in near if abs(d - stamp) == distance), (stamp - START) / S)
    return expected


def stream(name: str):
    return st.lists(st.integers(1, 300), max_size=25).map(
        lambda steps: [(name, START + int(total) * 5 * MS) for total in np.cumsum(steps)]
    )


@settings(max_examples=100)
@example(  # A pose that comes long after the others must not push out what a waiting image needs.
    rgb=[("rgb", START + 2105 * MS)],
    depth=[("depth", START + 2095 * MS)],
    poses=[("pose", START + offset_ms * MS) for offset_ms in (1610, 2110, 2690, 4190)],
    delays_ms=(0, 0, 61),
    tolerance_ms=60,
)
@given(
    rgb=stream("rgb"),
    depth=stream("depth"),
    poses=stream("pose"),
    delays_ms=st.tuples(*[st.integers(0, 900)] * 3),
    tolerance_ms=st.integers(0, 60),
)
def test_random_streams_agree_with_brute_force(rgb, depth, poses, delays_ms, tolerance_ms):
    """Streams of any rhythm and delay give the same pairs as if all messages had been known at once."""
    config = InputConfig(sync_tolerance_s=tolerance_ms / 1000, max_pose_gap_s=0.5, max_wait_s=2.0)
    target = FedPairer(config)
    target.add_camera_info(ros.camera_info())
    delays = dict(zip(("rgb", "depth", "pose"), delays_ms, strict=True))
    ready = []
    for name, stamp_ns in sorted(rgb + depth + poses, key=lambda event: (event[1] + delays[event[0]] * MS, event[0])):
        if name == "rgb":
            target.add_rgb(ros.image(stamp_ns))
        elif name == "depth":
            target.add_depth(ros.image(stamp_ns, "16UC1"))
        else:
            target.add_pose(ros.pose(stamp_ns, ((stamp_ns - START) / S, 0.0, 0.0)))
        ready += target.poll()
    ready += target.flush()

    expected = reference([s for _, s in rgb], [s for _, s in depth], [s for _, s in poses], tolerance_ms * MS, 500 * MS)
    assert stamps(ready) == sorted(expected)
    for paired in ready:
        depth_ns, x_m = expected[paired.stamp_ns]
        assert ros_stamp(paired.depth) == depth_ns
        assert paired.T_world_camera[0, 3] == pytest.approx(x_m, abs=1e-9)
    assert len(ready) + sum(target.drops.counts().values()) == len(rgb)


def ros_stamp(message) -> int:
    return message.header.stamp.sec * S + message.header.stamp.nanosec
