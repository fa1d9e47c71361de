"""Reading of rosbag2 recordings: raw CDR messages in time order, also from truncated files."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.recordings.recorded_files import RawMessage, RecordedFiles, TopicSummary
from fus3dmaps_core.recordings.salvage import SalvagedMcap

_SUFFIXES = (".mcap", ".db3")


class RecordingReader:
    """A rosbag2 directory (``metadata.yaml`` and its .mcap or .db3 files) or a bare .mcap or .db3 file.

    A directory without ``metadata.yaml``, whose recorder was killed, is read file by file. The readable part of a damaged
    .mcap file is delivered. Use it as a context manager.

    Attributes:
        path: The file or directory that was opened.
        damage: What is wrong with the files, or None. Damage inside an indexed file is only found while it is read.
    """

    def __init__(self, path: Path) -> None:
        """Open a recording.

        Raises:
            RecordingError: It does not exist, is no recording, is damaged beyond use or holds no message.
        """
        self.path = path
        self.damage: str | None = None
        if not path.exists():
            raise RecordingError(f"recording '{path}' does not exist")
        self._parts = self._open()
        if self.message_count == 0:
            self.close()
            raise RecordingError(f"recording '{path}' holds no messages" + (f": {self.damage}" if self.damage else ""))

    @property
    def topics(self) -> dict[str, TopicSummary]:
        """Summaries of the recording's topics, by name."""
        merged: dict[str, TopicSummary] = {}
        for part in self._parts:
            for topic, summary in part.topics.items():
                known = merged.get(topic)
                merged[topic] = summary if known is None else replace(known, count=known.count + summary.count)
        return dict(sorted(merged.items()))

    @property
    def message_count(self) -> int:
        """Number of readable messages on all topics."""
        return sum(summary.count for part in self._parts for summary in part.topics.values())

    @property
    def start_ns(self) -> int:
        """Earliest time of recording, nanoseconds."""
        return min(part.start_ns for part in self._parts)

    @property
    def end_ns(self) -> int:
        """Latest time of recording, nanoseconds."""
        return max(part.end_ns for part in self._parts)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message, seconds."""
        return (self.end_ns - self.start_ns) / 1e9

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of the given topics, or of all, in order of time; those of a damaged file in its own order.

        Raises:
            RecordingError: After everything readable was delivered, if the recording is damaged.
        """
        count = 0
        for part in self._parts:
            iterator = part.messages(topics)
            while True:
                try:
                    message = next(iterator, None)
                # Any failure of a parser in a damaged file is answered the same way, by an error that names the file.
                except Exception as error:
                    self.damage = self.damage or _reason(error)
                    break
                if message is None:
                    break
                count += 1
                yield message
        if self.damage is not None:
            raise RecordingError(
                f"recording '{self.path}' is truncated or damaged ({self.damage}); {count} messages were readable"
            )

    def deserialize(self, message: RawMessage) -> Any:
        """Unpack a message of one of ROS 2's common types into an object with its fields.

        Raises:
            RecordingError: The type is unknown or the bytes do not fit it; the message names the topic.
        """
        try:
            return _typestore().deserialize_cdr(message.data, message.msgtype)
        except Exception as error:
            raise RecordingError(
                f"{message.topic}: cannot unpack a message as {message.msgtype}: {_reason(error)}"
            ) from error

    def close(self) -> None:
        """Release the files."""
        for part in self._parts:
            part.close()
        self._parts = []

    def __enter__(self) -> RecordingReader:
        """Return the reader: the recording is open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Release the files."""
        self.close()

    def _open(self) -> list[RecordedFiles]:
        if self.path.is_file():
            if self.path.suffix not in _SUFFIXES:
                raise RecordingError(f"recording '{self.path}' is neither a directory nor a .mcap or .db3 file")
            return [self._open_file(self.path)]
        if (self.path / "metadata.yaml").exists():
            try:
                return [_IndexedFiles(self.path)]
            except Exception as error:
                self.damage = _reason(error)
        files = sorted((p for p in self.path.iterdir() if p.suffix in _SUFFIXES), key=_natural_order)
        if not files:
            raise RecordingError(
                f"recording '{self.path}' cannot be read: {self.damage}"
                if self.damage
                else f"directory '{self.path}' is not a recording: it holds no metadata.yaml, .mcap or .db3 file"
            )
        parts: list[RecordedFiles] = []
        for file in files:
            try:
                parts.append(self._open_file(file))
            except RecordingError as error:
                self.damage = self.damage or str(error)
        if not parts:
            raise RecordingError(f"recording '{self.path}' cannot be read: {self.damage}")
        return parts

    def _open_file(self, path: Path) -> RecordedFiles:
        try:
            return _IndexedFiles(path)
        except Exception as error:
            reason = _reason(error)
            if path.suffix == ".mcap":
                salvaged = SalvagedMcap(path)
                if salvaged.topics:
                    self.damage = reason
                    return salvaged
            raise RecordingError(f"recording '{path}' cannot be read: {reason}") from error


class _IndexedFiles:
    """A directory with metadata or a complete file, which rosbags can open."""

    def __init__(self, path: Path) -> None:
        self._reader = Reader(path)
        self._reader.open()
        self.topics = {
            topic: TopicSummary(topic, info.connections[0].msgtype, info.msgcount)
            for topic, info in self._reader.topics.items()
        }
        self.start_ns = self._reader.start_time
        self.end_ns = self._reader.end_time - 1  # rosbags' end is exclusive.

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        connections = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not connections:
            return
        for connection, stamp_ns, data in self._reader.messages(connections):
            yield RawMessage(connection.topic, connection.msgtype, stamp_ns, data)

    def close(self) -> None:
        self._reader.close()


@cache
def _typestore() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a sort key by which ``bag_10`` follows ``bag_9``."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
