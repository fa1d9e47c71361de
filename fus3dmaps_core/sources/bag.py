"""Posed frames from a rosbag2 recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

from fus3dmaps_core.config import InputConfig
from fus3dmaps_core.errors import FrameError, RecordingError
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.storage import TopicSummary
from fus3dmaps_core.sources.pairing import FramePairer, PairedMessages


class BagSource:
    """Reads the topics that the configuration names from a recording and pairs them as the live node does.

    Topic names match with or without their leading slash. Use it as a context manager; each iteration starts anew.

    Attributes:
        pairer: Counts what the current (or last) iteration received and dropped.
        messages_read: Messages of the configured topics taken so far in this iteration.
        messages_total: Messages of the configured topics in the recording.
    """

    def __init__(self, path: Path, config: InputConfig) -> None:
        """Open a recording.

        Raises:
            RecordingError: It cannot be read, or lacks a topic or holds it with another message type; the message names
                the topic and its parameter and lists what the recording has.
            ConfigError: As :class:`FramePairer`.
        """
        self._config = config
        self.pairer = FramePairer(config)
        self.messages_read = 0
        self._reader = RecordingReader(path)
        try:
            self._rgb = self._require("rgb_topic", "sensor_msgs/msg/Image")
            self._depth = self._require("depth_topic", "sensor_msgs/msg/Image")
            self._camera_info = self._require("camera_info_topic", "sensor_msgs/msg/CameraInfo")
            if config.pose_source == "pose":
                self._pose = self._require("pose_topic", "geometry_msgs/msg/PoseStamped")
            else:
                self._pose = self._require("odometry_topic", "nav_msgs/msg/Odometry")
        except RecordingError:
            self._reader.close()
            raise
        self._inputs = {input_.topic: input_ for input_ in (self._rgb, self._depth, self._camera_info, self._pose)}
        self.messages_total = sum(input_.count for input_ in self._inputs.values())

    def __len__(self) -> int:
        """Colour images in the recording, each of which becomes at most one frame."""
        return self._rgb.count

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message of the recording, seconds."""
        return self._reader.duration_s

    def __iter__(self) -> Iterator[PairedMessages]:
        """The pairs in the order of the recording; messages that cannot be used are counted by :attr:`pairer`.

        Raises:
            RecordingError: After everything readable was delivered, if the recording is damaged.
        """
        self.pairer = pairer = FramePairer(self._config)
        self.messages_read = 0
        add = {
            self._rgb.topic: pairer.add_rgb,
            self._depth.topic: pairer.add_depth,
            self._camera_info.topic: pairer.add_camera_info,
            self._pose.topic: pairer.add_pose,
        }
        damage: RecordingError | None = None
        messages = self._reader.messages(self._inputs)
        while True:
            try:
                raw = next(messages, None)
            except RecordingError as error:
                damage = error
                break
            if raw is None:
                break
            self.messages_read += 1
            try:
                message = self._reader.deserialize(raw)
            except RecordingError as error:
                pairer.drop(FrameError(str(error), reason="bad_message"))
                continue
            add[raw.topic](message)
            yield from pairer.poll()
        yield from pairer.flush()
        if damage is not None:
            raise damage

    def close(self) -> None:
        """Release the files."""
        self._reader.close()

    def __enter__(self) -> BagSource:
        """Nothing to do: the recording is open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Release the files."""
        self.close()

    def _require(self, parameter: str, msgtype: str) -> TopicSummary:
        topic = "/" + str(getattr(self._config, parameter)).lstrip("/")
        topics = self._reader.topics
        found = topics.get(topic)
        if found is not None and found.msgtype == msgtype and found.count > 0:
            return found
        if found is None:
            problem = f"has no topic '{topic}'"
        elif found.count == 0:
            problem = f"holds no messages on topic '{topic}'"
        else:
            problem = f"holds {found.msgtype} on topic '{topic}', not {msgtype}"
        listing = ", ".join(f"{t.topic} ({t.msgtype}, {t.count} messages)" for t in topics.values())
        damage = f"; it is truncated or damaged ({self._reader.damage})" if self._reader.damage else ""
        raise RecordingError(
            f"recording '{self._reader.path}' {problem} (parameter 'input.{parameter}'); it has {listing}{damage}"
        )
