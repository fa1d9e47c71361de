"""The messages and topics of recorded files, and the interface that every kind of recorded file has."""

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
    """A topic of a recording: its name, message type and number of messages."""

    topic: str
    msgtype: str
    count: int


class RecordedFiles(Protocol):
    """One opened recorded file, or a directory of files with an index."""

    @property
    def topics(self) -> dict[str, TopicSummary]:
        """Summaries of the topics, by name."""

    @property
    def start_ns(self) -> int:
        """Earliest time of recording, nanoseconds."""

    @property
    def end_ns(self) -> int:
        """Latest time of recording, nanoseconds."""

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """Yield the messages of the given topics, or of all."""

    def close(self) -> None:
        """Release the files."""
