"""Reading of recordings of every shape: bare files, directories, killed recorders, damaged files."""

from __future__ import annotations

import pytest
from recorded_frames import PERIOD_NS, START_NS, noise_frames
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.writer import RecordingWriter

COUNTS = {"/depth/image": 20, "/pose": 20, "/rgb/camera_info": 20, "/rgb/image": 20}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Write twenty frames in two chunks."""
    path = tmp_path_factory.mktemp("recording") / "bag.mcap"
    with RecordingWriter(path) as writer:
        for frame in noise_frames(20):
            writer.write(frame)
    return path


def as_directory(source, directory, plugin):
    """Write the same messages with rosbags as a rosbag2 directory."""
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with RecordingReader(source) as reader, Writer(directory, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(topic, summary.msgtype, typestore=typestore)
            for topic, summary in reader.topics.items()
        }
        for message in reader.messages():
            writer.write(connections[message.topic], message.stamp_ns, message.data)
    return directory


def counts(reader):
    return {topic: summary.count for topic, summary in reader.topics.items()}


def test_bare_file(recording):
    with RecordingReader(recording) as reader:
        assert counts(reader) == COUNTS
        assert reader.topics["/pose"].msgtype == "geometry_msgs/msg/PoseStamped"
        assert reader.message_count == 80
        assert (reader.start_ns, reader.end_ns) == (START_NS, START_NS + 19 * PERIOD_NS)
        assert reader.duration_s == pytest.approx(1.9)
        assert reader.damage is None
        messages = list(reader.messages())
        assert [message.stamp_ns for message in messages] == sorted(message.stamp_ns for message in messages)
        only = list(reader.messages({"/pose"}))
        assert only == [message for message in messages if message.topic == "/pose"]
        assert reader.deserialize(only[3]).header.frame_id == "map"
        assert list(reader.messages({"/nothing"})) == []


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_directories_and_their_files_hold_the_same(recording, tmp_path, plugin):
    directory = as_directory(recording, tmp_path / "bag", plugin)
    (file,) = [path for path in directory.iterdir() if path.suffix in (".mcap", ".db3")]
    with RecordingReader(recording) as reader:
        expected = list(reader.messages())
    for path in (directory, file):
        with RecordingReader(path) as reader:
            assert counts(reader) == COUNTS
            assert reader.duration_s == pytest.approx(1.9)
            assert sorted(reader.messages()) == sorted(expected)


def test_directory_of_a_killed_recorder(recording, tmp_path):
    """There is no metadata.yaml, one complete file and one truncated file."""
    data = recording.read_bytes()
    (tmp_path / "bag_9.mcap").write_bytes(data)
    (tmp_path / "bag_10.mcap").write_bytes(data[: len(data) * 2 // 3])
    with RecordingReader(tmp_path) as reader:
        assert reader.damage is not None
        assert 80 < reader.message_count < 160
        read = list(_until_error(reader))
        assert len(read) == reader.message_count
        with pytest.raises(RecordingError, match=f"{len(read)} messages were readable"):
            list(reader.messages())
    (tmp_path / "bag_9.mcap").unlink()
    with RecordingReader(tmp_path) as reader:
        assert 0 < reader.message_count < 80


def _until_error(reader):
    messages = reader.messages()
    while True:
        try:
            yield next(messages)
        except RecordingError:
            return


@pytest.mark.parametrize("share", [0.55, 0.7, 0.95, 0.9999])
def test_a_truncated_file_gives_what_is_readable_then_an_error(recording, tmp_path, share):
    with RecordingReader(recording) as reader:
        whole = list(reader.messages())
    data = recording.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: int(len(data) * share)])
    with RecordingReader(path) as reader:
        assert reader.damage
        read = list(_until_error(reader))
        assert 0 < len(read) <= len(whole)
        assert reader.message_count == len(read)
        assert read == whole[: len(read)]
        assert reader.end_ns == read[-1].stamp_ns
        assert reader.topics["/pose"].msgtype == "geometry_msgs/msg/PoseStamped"
        with pytest.raises(RecordingError, match=rf"cut\.mcap' is truncated.*; {len(read)} messages were readable"):
            list(reader.messages())


@pytest.mark.parametrize("size", [0, 1, 7, 8, 9, 30, 60, 1000, 100_000])
def test_a_file_cut_before_its_first_message_is_refused(recording, tmp_path, size):
    path = tmp_path / "cut.mcap"
    path.write_bytes(recording.read_bytes()[:size])
    with pytest.raises(RecordingError, match=r"cut\.mcap"):
        RecordingReader(path)


def test_damage_inside_shows_while_reading(recording, tmp_path):
    data = bytearray(recording.read_bytes())
    middle = len(data) * 3 // 4
    data[middle : middle + 64] = bytes(64)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    with RecordingReader(path) as reader:
        read = list(_until_error(reader))
        assert 0 < len(read) < 80
        with pytest.raises(RecordingError, match=rf"damaged\.mcap.*{len(read)} messages"):
            list(reader.messages())


@pytest.mark.parametrize("name", ["text.mcap", "text.db3", "text.bag", "text"])
def test_files_that_are_no_recordings_are_refused(tmp_path, name):
    path = tmp_path / name
    path.write_text("once upon a time there was a recording that was none")
    with pytest.raises(RecordingError, match=name):
        RecordingReader(path)


def test_missing_empty_and_foreign_directories_are_refused(tmp_path, recording):
    with pytest.raises(RecordingError, match="nowhere' does not exist"):
        RecordingReader(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="is not a recording"):
        RecordingReader(tmp_path)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: 5")
    with pytest.raises(RecordingError, match="cannot be read"):
        RecordingReader(tmp_path)
    with Writer(tmp_path / "empty", version=9, storage_plugin=StoragePlugin.MCAP):
        pass
    with pytest.raises(RecordingError, match="empty' holds no messages"):
        RecordingReader(tmp_path / "empty")


def test_a_truncated_database_is_refused_or_told(recording, tmp_path):
    directory = as_directory(recording, tmp_path / "bag", StoragePlugin.SQLITE3)
    (file,) = directory.glob("*.db3")
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    with pytest.raises(RecordingError, match="bag"), RecordingReader(directory) as reader:
        list(reader.messages())
