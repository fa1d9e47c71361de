"""What every kind of recorded file offers to the reader."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol


class RawMessage(NamedTuple):
    """One recorded message.

    Attributes:
        topic: Full topic name, e.g. ``/rgb/image``.
        msgtype: Message type, e.g. ``sensor_msgs/msg/Image``.
        stamp_ns: Time of recording, nanoseconds.
        data: The serialised message, CDR with its four-byte header.
    """

    topic: str
    msgtype: str
    stamp_ns: int
    data: bytes


@dataclass(frozen=True)
class TopicSummary:
    """What a recording holds of a topic: its name, message type and number of messages."""

    topic: str
    msgtype: str
    count: int


class RecordedFiles(Protocol):
    """One opened file, or a directory of files with an index."""

    @property
    def topics(self) -> dict[str, TopicSummary]:
        """What it holds, by topic."""
        ...

    @property
    def start_ns(self) -> int:
        """Earliest time of recording, nanoseconds."""
        ...

    @property
    def end_ns(self) -> int:
        """Latest time of recording, nanoseconds."""
        ...

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """The messages of the given topics, or of all."""
        ...

    def close(self) -> None:
        """Release the files."""
        ...
