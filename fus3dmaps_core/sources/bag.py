"""Posed frames from a rosbag2 recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.errors import FrameError, RecordingError
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.recorded_files import TopicSummary
from fus3dmaps_core.sources.pairing import FramePairer, PairedMessages
from fus3dmaps_core.sources.streams import Stream, uses_tf
from fus3dmaps_core.sources.transforms import TransformTree

_TF_TYPE = "tf2_msgs/msg/TFMessage"
_TF_TOPICS = ("/tf", "/tf_static")


class BagSource:
    """Reads the configured topics from a recording and pairs their messages as the live node does.

    Topic names match with or without their leading slash. TF is read from ``/tf`` and ``/tf_static``. Use it as a context
    manager; each iteration starts from the beginning.

    Attributes:
        pairer: The pairer of the current (or last) iteration; it counts drops.
    """

    def __init__(self, path: Path, config: InputConfig) -> None:
        """Open a recording.

        Raises:
            RecordingError: It cannot be read, or a topic is missing or has another message type. The message names the
                topic and its parameter and lists the topics of the recording.
            ConfigError: As :class:`FramePairer`.
        """
        self._config = config
        self.pairer, _ = self._new_pairer()
        self._reader = RecordingReader(path)
        try:
            found = [(stream.role, self._require(stream)) for stream in self.pairer.streams()]
            if uses_tf(config):
                self._require_tf()
        except RecordingError:
            self._reader.close()
            raise
        self._frames = sum(summary.count for role, summary in found if role == "rgb")

    def __len__(self) -> int:
        """Count the colour images in the recording; each becomes at most one frame."""
        return self._frames

    def __iter__(self) -> Iterator[PairedMessages]:
        """Yield the pairs in the order of the recording; :attr:`pairer` counts messages that cannot be used.

        Raises:
            RecordingError: After everything readable was delivered, if the recording is damaged.
        """
        self.pairer, add = self._new_pairer()
        pairer = self.pairer
        damage: RecordingError | None = None
        messages = self._reader.messages(add)
        while True:
            try:
                raw = next(messages, None)
            except RecordingError as error:
                damage = error
                break
            if raw is None:
                break
            try:
                message = self._reader.deserialize(raw)
            except RecordingError as error:
                pairer.drops.add_error(FrameError(str(error), reason="bad_message"))
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
        """Return the source: the recording is open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Release the files."""
        self.close()

    def _new_pairer(self) -> tuple[FramePairer, dict[str, Callable[[Any], None]]]:
        """Make a pairer, and a function for each topic that hands it a message."""
        tree = TransformTree(self._config.max_pose_gap_s) if uses_tf(self._config) else None
        pairer = FramePairer(self._config, tree)
        add = {_absolute(stream.topic): stream.add for stream in pairer.streams()}
        if tree is not None:
            add |= {topic: _transform_adder(tree, pairer, topic) for topic in _TF_TOPICS}
        return pairer, add

    def _require(self, stream: Stream) -> TopicSummary:
        topic, msgtype = _absolute(stream.topic), stream.msgtype
        found = self._reader.topics.get(topic)
        if found is not None and found.msgtype == msgtype and found.count > 0:
            return found
        if found is None:
            problem = f"has no topic '{topic}'"
        elif found.count == 0:
            problem = f"holds no messages on topic '{topic}'"
        else:
            problem = f"holds {found.msgtype} on topic '{topic}', not {msgtype}"
        raise self._refusal(f"{problem} (parameter '{stream.parameter}')")

    def _require_tf(self) -> None:
        found = [self._reader.topics.get(name) for name in _TF_TOPICS]
        if not any(summary is not None and summary.msgtype == _TF_TYPE and summary.count for summary in found):
            source = "pose_source" if self._config.pose_source == "tf" else "extrinsic_source"
            raise self._refusal(f"holds no transforms on '/tf' or '/tf_static' (parameter 'input.{source}')")

    def _refusal(self, problem: str) -> RecordingError:
        listing = ", ".join(f"{t.topic} ({t.msgtype}, {t.count} messages)" for t in self._reader.topics.values())
        damage = f"; it is truncated or damaged ({self._reader.damage})" if self._reader.damage else ""
        return RecordingError(f"recording '{self._reader.path}' {problem}; it has {listing}{damage}")


def _absolute(topic: str) -> str:
    return "/" + topic.lstrip("/")


def _transform_adder(tree: TransformTree, pairer: FramePairer, topic: str) -> Callable[[Any], None]:
    def add(message: Any) -> None:
        for refused in tree.add(message, topic, static=topic == "/tf_static"):
            pairer.drops.add_error(refused)

    return add
