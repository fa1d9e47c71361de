"""Recordings to posed frames: the round trip, unusual and damaged recordings, and counts of drops."""

from __future__ import annotations

import numpy as np
import pytest
import ros_messages as ros
from compressed_messages import compressed_depth_rvl, png
from mcap.writer import Writer
from recorded_frames import PERIOD_NS, START_NS, assert_same_frames, noise_frames
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_core.sources.bag import BagSource

S = 1_000_000_000


def write(path, frames, config=None):
    with RecordingWriter(path, config) as writer:
        for frame in frames:
            writer.write(frame)
    return path


def write_messages(path, messages):
    """Write a recording of (topic, log time, message or raw bytes with their type)."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        channels = {}
        for topic, log_ns, message in messages:
            msgtype, data = message if isinstance(message, tuple) else (message.__msgtype__, None)
            if topic not in channels:
                definition, _ = ros.TYPESTORE.generate_msgdef(msgtype, ros_version=2)
                schema = writer.register_schema(msgtype, "ros2msg", definition.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = data or bytes(ros.TYPESTORE.serialize_cdr(message, msgtype))
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()
    return path


def complete(stamp_ns):
    return [
        ("/rgb/camera_info", stamp_ns, ros.camera_info(stamp_ns)),
        ("/pose", stamp_ns, ros.pose(stamp_ns)),
        ("/depth/image", stamp_ns, ros.image(stamp_ns, "16UC1")),
        ("/rgb/image", stamp_ns, ros.image(stamp_ns)),
    ]


@pytest.fixture(scope="module")
def frames():
    return noise_frames(20)


@pytest.fixture(scope="module")
def recording(tmp_path_factory, frames):
    return write(tmp_path_factory.mktemp("recording") / "bag.mcap", frames)


@pytest.mark.parametrize(
    "config",
    [
        InputConfig(),
        InputConfig(rgb_topic="/camera/color", map_frame="world", T_body_camera=[0.1, 0.2, 0.3, 0.5, -0.5, 0.5, -0.5]),
    ],
)
def test_frames_survive_the_round_trip(tmp_path, frames, config):
    with BagSource(write(tmp_path / "bag.mcap", frames[:5], config), config) as source:
        assert len(source) == 5
        for _ in range(2):  # Each iteration starts anew.
            assert_same_frames([paired.decode(ImageConfig()) for paired in source], frames[:5])
            assert not source.pairer.drops.counts()


def test_frames_come_while_reading(recording, monkeypatch):
    read, deserialize = [], RecordingReader.deserialize
    monkeypatch.setattr(RecordingReader, "deserialize", lambda reader, raw: read.append(raw) or deserialize(reader, raw))
    with BagSource(recording, InputConfig()) as source:
        next(iter(source))
        assert len(read) == 4


@pytest.mark.parametrize("share", [0.55, 0.8, 0.9999])
def test_a_truncated_recording_delivers_its_readable_frames_then_an_error(recording, frames, tmp_path, share):
    data = recording.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: int(len(data) * share)])
    delivered: list[PosedFrame] = []
    with BagSource(path, InputConfig()) as source:
        with pytest.raises(RecordingError, match=r"cut\.mcap' is truncated.*\d+ messages were readable"):
            delivered.extend(paired.decode(ImageConfig()) for paired in source)
        assert len(source) >= len(delivered) > 0
    assert_same_frames(delivered, frames[: len(delivered)])


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "empty.mcap").write_bytes(b"")
    for name in ("empty.mcap", "missing.mcap"):
        with pytest.raises(RecordingError, match=name):
            BagSource(tmp_path / name, InputConfig())


@pytest.mark.parametrize("parameter", ["rgb_topic", "depth_topic", "camera_info_topic", "pose_topic"])
def test_a_missing_topic_is_named_with_what_there_is(recording, parameter):
    with pytest.raises(RecordingError) as caught:
        BagSource(recording, InputConfig(**{parameter: "elsewhere/topic"}))
    text = str(caught.value)
    assert "no topic '/elsewhere/topic'" in text
    assert f"input.{parameter}" in text
    assert "/rgb/image (sensor_msgs/msg/Image, 20 messages)" in text
    assert "/pose (geometry_msgs/msg/PoseStamped, 20 messages)" in text


def test_a_topic_of_another_type_is_named(recording):
    with pytest.raises(RecordingError, match=r"holds geometry_msgs/msg/PoseStamped on topic '/pose', not sensor_msgs"):
        BagSource(recording, InputConfig(depth_topic="pose"))
    with pytest.raises(RecordingError, match=r"no topic '/odom' \(parameter 'input\.odometry_topic'\)"):
        BagSource(recording, InputConfig(pose_source="odometry"))


def test_a_topic_without_messages_is_named(tmp_path):
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        rgb = writer.add_connection("/rgb/image", "sensor_msgs/msg/Image", typestore=ros.TYPESTORE)
        writer.add_connection("/depth/image", "sensor_msgs/msg/Image", typestore=ros.TYPESTORE)
        writer.write(rgb, S, ros.TYPESTORE.serialize_cdr(ros.image(S), "sensor_msgs/msg/Image"))
    with pytest.raises(
        RecordingError, match=r"holds no messages on topic '/depth/image' \(parameter 'input\.depth_topic'\)"
    ):
        BagSource(tmp_path / "bag", InputConfig())


def test_odometry_recordings(tmp_path):
    messages = [message for stamp_ns in (S, 2 * S) for message in complete(stamp_ns) if message[0] != "/pose"]
    messages += [("/odom", i * S // 4, ros.odometry(i * S // 4, (i / 4, 0.0, 0.0), frame_id="odom")) for i in range(12)]
    path = write_messages(tmp_path / "bag.mcap", messages)
    with BagSource(path, InputConfig(pose_source="odometry", map_frame="odom")) as source:
        assert [paired.T_world_camera[0, 3] for paired in source] == [1.0, 2.0]


def test_messages_come_in_order_of_recording_not_of_the_file(tmp_path):
    messages = [message for stamp_ns in (S, 2 * S, 3 * S) for message in complete(stamp_ns)]
    path = write_messages(tmp_path / "bag.mcap", sorted(messages, key=lambda message: message[0]))
    with BagSource(path, InputConfig()) as source:
        assert [paired.stamp_ns for paired in source] == [S, 2 * S, 3 * S]


def test_bad_messages_are_dropped_and_counted_and_the_rest_is_delivered(tmp_path):
    second = START_NS + PERIOD_NS
    messages = [
        *complete(START_NS),
        ("/rgb/image", START_NS + 1, ("sensor_msgs/msg/Image", b"\x00\x01\x00\x00\x01\x02")),
        ("/rgb/image", START_NS + 2, ros.image(START_NS + 2, "yuv422")),
        ("/depth/image", START_NS + 3, ros.image(START_NS + 3, "16UC1", data=np.zeros(3, np.uint8))),
        ("/pose", START_NS + 4, ros.pose(START_NS + 4, (float("nan"), 0.0, 0.0))),
        ("/rgb/image", START_NS + 5, ros.image(START_NS - 5)),
        *complete(second),
    ]
    with BagSource(write_messages(tmp_path / "bag.mcap", messages), InputConfig()) as source:
        assert [paired.stamp_ns for paired in source] == [START_NS, second]
        assert source.pairer.drops.counts() == {
            "bad_message": 1,
            "unknown_encoding": 1,
            "size_mismatch": 1,
            "bad_pose": 1,
            "stamp_backwards": 1,
        }
        assert "/rgb/image" in source.pairer.drops.latest()["bad_message"]


def test_images_at_the_end_are_settled(tmp_path):
    messages = [
        *complete(START_NS),
        ("/depth/image", START_NS + 1, ros.image(START_NS + PERIOD_NS - 5_000_000, "16UC1")),
        ("/pose", START_NS + 2, ros.pose(START_NS + PERIOD_NS)),
        ("/rgb/image", START_NS + 3, ros.image(START_NS + PERIOD_NS)),
        ("/rgb/image", START_NS + 4, ros.image(START_NS + 2 * PERIOD_NS)),
    ]
    with BagSource(write_messages(tmp_path / "bag.mcap", messages), InputConfig()) as source:
        assert [paired.stamp_ns for paired in source] == [START_NS, START_NS + PERIOD_NS]
        assert source.pairer.drops.counts() == {"no_depth": 1}


def test_compressed_recordings(tmp_path, frames):
    messages = []
    for frame in frames[:2]:
        stamp_ns = frame.stamp_ns
        depth_mm = np.rint(frame.depth_m * 1000).astype(np.uint16)
        info = ros.camera_info(stamp_ns, 160, 120)
        messages += [
            ("/rgb/camera_info", stamp_ns, info),
            ("/pose", stamp_ns, ros.pose(stamp_ns)),
            ("/depth/image/compressedDepth", stamp_ns, ros.compressed(stamp_ns, *compressed_depth_rvl(depth_mm))),
            ("/rgb/image/compressed", stamp_ns, ros.compressed(stamp_ns, *png(frame.rgb))),
        ]
    path = write_messages(tmp_path / "bag.mcap", messages)
    with BagSource(path, InputConfig(rgb_transport="compressed", depth_transport="compressedDepth")) as source:
        assert len(source) == 2
        for paired, frame in zip(source, frames, strict=False):
            decoded = paired.decode(ImageConfig())
            np.testing.assert_array_equal(decoded.rgb, frame.rgb)
            np.testing.assert_array_equal(np.rint(decoded.depth_m * 1000), np.rint(frame.depth_m * 1000))
    with pytest.raises(RecordingError, match=r"'/rgb/image' \(parameter 'input\.rgb_topic'\).*/rgb/image/compressed"):
        BagSource(path, InputConfig())


def test_poses_from_the_transforms_of_a_recording(tmp_path):
    messages = [message for stamp_ns in (S, 2 * S) for message in complete(stamp_ns) if message[0] != "/pose"]
    messages.append(("/tf_static", 0, ros.transforms(("base", "camera", 0, (0.0, 3.0, 0.0)))))
    messages += [("/tf", t, ros.transforms(("map", "base", t, (t / S, 0.0, 0.0)))) for t in range(0, 3 * S, S // 4)]
    messages.append(("/tf", S, ros.transforms(("map", "ghost", S, (np.nan, 0.0, 0.0)))))
    path = write_messages(tmp_path / "bag.mcap", messages)
    with BagSource(path, InputConfig(pose_source="tf")) as source:
        for _ in range(2):  # Each iteration starts anew.
            assert [paired.T_world_camera[:2, 3].tolist() for paired in source] == [[1.0, 3.0], [2.0, 3.0]]
            assert source.pairer.drops.counts() == {"bad_transform": 1}


def test_a_recording_without_transforms_is_refused(recording):
    with pytest.raises(
        RecordingError, match=r"'/tf' or '/tf_static' \(parameter 'input\.pose_source'\); it has /depth/image"
    ):
        BagSource(recording, InputConfig(pose_source="tf"))


def test_recordings_of_several_cameras(tmp_path):
    messages = []
    for stamp_ns in (S, 2 * S):
        for message in complete(stamp_ns):
            names = [message[0]] if message[0] == "/pose" else [f"/front{message[0]}", f"/rear{message[0]}"]
            messages += [(name, *message[1:]) for name in names]
    path = write_messages(tmp_path / "bag.mcap", messages)
    mountings = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    with BagSource(path, InputConfig(cameras="front,rear", T_body_camera=mountings)) as source:
        assert len(source) == 4
        frames = [(paired.stamp_ns, paired.T_world_camera[1, 3]) for paired in source]
    assert sorted(frames) == [(S, 1.0), (S, 2.0), (2 * S, 1.0), (2 * S, 2.0)]
    assert [stamp_ns for stamp_ns, _ in frames] == [S, S, 2 * S, 2 * S]
