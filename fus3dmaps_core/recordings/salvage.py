"""Reading of a truncated or damaged MCAP file, left by a killed recorder, a full disk or an incomplete copy."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from fus3dmaps_core.recordings.recorded_files import RawMessage, TopicSummary


class SalvagedMcap:
    """The readable part of a damaged MCAP file, from its start to the damage, in the order of the file.

    Attributes:
        topics: Summaries of the topics of the readable part, by name.
        start_ns: Earliest log time, nanoseconds.
        end_ns: Latest log time, nanoseconds.
    """

    def __init__(self, path: Path) -> None:
        """Read the file once to find how far it can be read; a file without a readable message has no topics."""
        self._path = path
        self.topics: dict[str, TopicSummary] = {}
        self.start_ns = self.end_ns = 0
        for message in self.messages(None):
            known = self.topics.get(message.topic, TopicSummary(message.topic, message.msgtype, 0))
            self.start_ns = min(self.start_ns, message.stamp_ns) if self.topics else message.stamp_ns
            self.end_ns = max(self.end_ns, message.stamp_ns)
            self.topics[message.topic] = replace(known, count=known.count + 1)

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """Yield the messages up to the damage, of the given topics or of all."""
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        with self._path.open("rb") as stream:
            records = StreamReader(stream, validate_crcs=True).records
            while True:
                try:
                    record = next(records, None)
                # A damaged file can make the parser fail anywhere, with any exception. The caller knows of the damage.
                except Exception:
                    return
                if record is None:
                    return
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = (record.topic, schemas.get(record.schema_id, ""))
                elif isinstance(record, Message) and record.channel_id in channels:
                    topic, msgtype = channels[record.channel_id]
                    if topics is None or topic in topics:
                        yield RawMessage(topic, msgtype, record.log_time, record.data)

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""
