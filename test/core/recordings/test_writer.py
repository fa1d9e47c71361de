"""Recordings read by other readers (mcap's own, rosbags), and the conventions of the format."""

from __future__ import annotations

import resource

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded_frames import PERIOD_NS, START_NS, noise_frames
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.errors import ConfigError, RecordingError
from fus3dmaps_core.frame import PosedFrame
from fus3dmaps_core.recordings.writer import CAMERA_FRAME, RecordingWriter

TYPES = {
    "/rgb/image": "sensor_msgs/msg/Image",
    "/depth/image": "sensor_msgs/msg/Image",
    "/rgb/camera_info": "sensor_msgs/msg/CameraInfo",
    "/pose": "geometry_msgs/msg/PoseStamped",
}


def write(path, frames, config=None, **options):
    with RecordingWriter(path, config, **options) as writer:
        for frame in frames:
            writer.write(frame)
    return path


@pytest.fixture(scope="module")
def frames():
    return noise_frames(14)


@pytest.mark.parametrize("compression", ["lz4", "zstd", "none"])
def test_as_mcap_sees_it(tmp_path, frames, compression):
    with write(tmp_path / "bag.mcap", frames, compression=compression).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        assert header.profile == "ros2"
        assert header.library.startswith("fus3dmaps ")
        assert {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()} == TYPES
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        image = next(schema for schema in summary.schemas.values() if schema.name == "sensor_msgs/msg/Image")
        assert b"MSG: std_msgs/Header\n" in image.data
        assert b"MSG: builtin_interfaces/Time\n" in image.data
        for channel in summary.channels.values():
            assert channel.message_encoding == "cdr"
            assert "reliability: reliable" in channel.metadata["offered_qos_profiles"]
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
        assert summary.statistics.message_count == 4 * len(frames)
        assert summary.statistics.message_start_time == START_NS
        assert summary.statistics.message_end_time == START_NS + 13 * PERIOD_NS
        assert {index.compression for index in summary.chunk_indexes} == {compression.replace("none", "")}
        messages = list(reader.iter_messages(log_time_order=False))
    assert all(message.data[:4] == b"\x00\x01\x00\x00" for _, _, message in messages)
    assert all(message.log_time == message.publish_time for _, _, message in messages)
    times = [message.log_time for _, _, message in messages]
    assert times == sorted(times)
    assert [channel.topic for _, channel, _ in messages[:4]] == ["/rgb/camera_info", "/pose", "/depth/image", "/rgb/image"]


def test_as_rosbags_sees_it(tmp_path, frames):
    with AnyReader([write(tmp_path / "bag.mcap", frames)]) as reader:
        assert {topic: info.msgtype for topic, info in reader.topics.items()} == TYPES
        assert reader.start_time == START_NS
        found = {topic: [] for topic in TYPES}
        for connection, stamp_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
            found[connection.topic].append(message)
    for i, frame in enumerate(frames):
        rgb, depth = found["/rgb/image"][i], found["/depth/image"][i]
        assert (rgb.encoding, rgb.height, rgb.width, rgb.step) == ("rgb8", 120, 160, 480)
        assert (depth.encoding, depth.height, depth.width, depth.step) == ("16UC1", 120, 160, 320)
        assert rgb.header.frame_id == depth.header.frame_id == CAMERA_FRAME == "camera_optical_frame"
        np.testing.assert_array_equal(rgb.data.reshape(120, 160, 3), frame.rgb)
        np.testing.assert_array_equal(depth.data.view("<u2").reshape(120, 160), np.rint(frame.depth_m.astype(float) * 1000))
        info = found["/rgb/camera_info"][i]
        assert (info.width, info.height, info.distortion_model) == (160, 120, "plumb_bob")
        assert info.header.frame_id == CAMERA_FRAME
        np.testing.assert_array_equal(info.d, np.zeros(5))
        np.testing.assert_array_equal(info.k, [150, 0, 79.5, 0, 151, 60.25, 0, 0, 1])
        np.testing.assert_array_equal(info.r, np.eye(3).ravel())
        np.testing.assert_array_equal(info.p, [150, 0, 79.5, 0, 0, 151, 60.25, 0, 0, 0, 1, 0])
        stamped = found["/pose"][i]
        position, q = stamped.pose.position, stamped.pose.orientation
        assert stamped.header.frame_id == "map"
        np.testing.assert_allclose([position.x, position.y, position.z], frame.T_world_camera[:3, 3])
        np.testing.assert_allclose(
            Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), frame.T_world_camera[:3, :3], atol=1e-12
        )


def test_same_frames_give_the_same_bytes(tmp_path, frames):
    first = write(tmp_path / "a.mcap", frames).read_bytes()
    assert write(tmp_path / "b.mcap", frames).read_bytes() == first
    assert write(tmp_path / "a.mcap", frames, overwrite=True).read_bytes() == first


def test_depth_without_a_usable_reading_becomes_zero(tmp_path):
    (frame,) = noise_frames(1, 3, 2)
    depth_m = np.array([[np.nan, np.inf, -1.0], [65.534, 65.535, 1.0004]], np.float32)
    with AnyReader([write(tmp_path / "bag.mcap", [PosedFrame(*_with_depth(frame, depth_m))])]) as reader:
        (data,) = [data for connection, _, data in reader.messages() if connection.topic == "/depth/image"]
        image = reader.deserialize(data, "sensor_msgs/msg/Image")
    assert image.data.view("<u2").tolist() == [0, 0, 0, 65534, 0, 1000]


def _with_depth(frame, depth_m):
    return frame.stamp_ns, frame.rgb, depth_m, frame.intrinsics, frame.T_world_camera


def test_topics_frame_and_mounting_follow_the_configuration(tmp_path, frames):
    config = InputConfig(
        rgb_topic="/head/rgb", pose_topic="slam/pose", map_frame="world", T_body_camera=[0.0, 0.0, 2.0, 0.5, -0.5, 0.5, -0.5]
    )
    with AnyReader([write(tmp_path / "bag.mcap", frames[:1], config)]) as reader:
        assert set(reader.topics) == {"/head/rgb", "/depth/image", "/rgb/camera_info", "/slam/pose"}
        (data,) = [data for connection, _, data in reader.messages() if connection.topic == "/slam/pose"]
        stamped = reader.deserialize(data, "geometry_msgs/msg/PoseStamped")
    assert stamped.header.frame_id == "world"
    # The first camera stands at (0, 0, 1) unturned; the body that carries it 2 m above itself is at -1 m in its own axes.
    T_body_camera = np.eye(4)
    T_body_camera[:3, :3] = Rotation.from_quat([0.5, -0.5, 0.5, -0.5]).as_matrix()
    T_body_camera[:3, 3] = [0, 0, 2]
    expected = frames[0].T_world_camera @ np.linalg.inv(T_body_camera)
    position = stamped.pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], expected[:3, 3], atol=1e-12)
    with pytest.raises(ConfigError, match="T_body_camera"):
        RecordingWriter(tmp_path / "other.mcap", InputConfig(T_body_camera=[0.0] * 7))


@pytest.mark.parametrize(
    "values",
    [{"rgb_transport": "compressed"}, {"depth_registered": False}, {"pose_source": "tf"}, {"cameras": "front"}],
)
def test_what_is_not_written_cannot_be_asked_for(tmp_path, values):
    with pytest.raises(ConfigError, match=f"input\\.{next(iter(values))}"):
        RecordingWriter(tmp_path / "bag.mcap", InputConfig(**values))
    assert list(tmp_path.iterdir()) == []


def test_existing_files_and_odd_names_are_refused(tmp_path, frames):
    path = write(tmp_path / "bag.mcap", frames[:1])
    before = path.read_bytes()
    with pytest.raises(RecordingError, match=r"bag\.mcap' exists already"):
        RecordingWriter(path)
    with pytest.raises(RecordingError, match=r"bag\.bag' must end in \.mcap"):
        RecordingWriter(tmp_path / "bag.bag")
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_stamps_must_rise(tmp_path, frames):
    with RecordingWriter(tmp_path / "bag.mcap") as writer:
        writer.write(frames[1])
        for frame in frames[:2]:
            with pytest.raises(RecordingError, match=r"bag\.mcap.*not later"):
                writer.write(frame)
        writer.write(frames[2])
        assert writer.frame_count == 2


def test_nothing_appears_unless_the_recording_is_complete(tmp_path, frames):
    path = write(tmp_path / "bag.mcap", frames[:1])
    before = path.read_bytes()
    with pytest.raises(KeyError), RecordingWriter(path, overwrite=True) as writer:  # noqa: PT012
        writer.write(frames[0])
        assert path.read_bytes() == before
        raise KeyError
    assert path.read_bytes() == before
    with pytest.raises(RecordingError, match=r"empty\.mcap.*no frames"), RecordingWriter(tmp_path / "empty.mcap"):
        pass
    assert list(tmp_path.iterdir()) == [path]


def test_a_directory_is_made_or_its_failure_named(tmp_path, frames):
    assert write(tmp_path / "deep" / "er" / "bag.mcap", frames[:1]).is_file()
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match=r"cannot write recording '.*bag\.mcap'"):
        RecordingWriter(tmp_path / "file" / "bag.mcap")


def test_a_full_disk_is_named_and_leaves_nothing(tmp_path, frames):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, limits[1]))
        with pytest.raises(RecordingError, match=r"cannot write recording '.*bag\.mcap': File too large"):
            write(tmp_path / "bag.mcap", frames)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
