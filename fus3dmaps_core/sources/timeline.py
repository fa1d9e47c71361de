"""The shared clock of all inputs of a map, and the counts of messages that could not be used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.ledger import Drops
from fus3dmaps_core.messages import fields

_TIME_JUMP_NS = 3_000_000_000  # Delivery can swap neighbours. Only another clock or a restart goes back this far.


class Timeline:
    """The stamps of all inputs.

    The stamps of each topic must rise. A stamp that goes far back restarts time for all topics.

    Attributes:
        last_ns: Latest stamp of each topic since time (re)started.
    """

    def __init__(self, drops: Drops, settle: Callable[[], None], forget: Callable[[], None]) -> None:
        """Start without a stamp.

        Args:
            drops: Counts ``time_jump``.
            settle: Called before time restarts, to pair or drop what waits.
            forget: Called after that, to remove what belongs to the old time.
        """
        self._drops = drops
        self._settle = settle
        self._forget = forget
        self.last_ns: dict[str, int] = {}

    @property
    def newest_ns(self) -> int:
        """Latest stamp of all topics; 0 without any."""
        return max(self.last_ns.values(), default=0)

    def advance(self, topic: str, message: Any) -> int:
        """Take a message's stamp, which must be later than the topic's last one unless time has jumped back.

        Returns:
            The stamp, nanoseconds.

        Raises:
            FrameError: Reason ``stamp_backwards`` or ``stamp_repeated``.
        """
        stamp_ns = fields.stamp_ns(message)
        last_ns = self.last_ns.get(topic)
        if last_ns is not None and stamp_ns <= last_ns:
            back_s = (last_ns - stamp_ns) / 1e9
            if last_ns - stamp_ns <= _TIME_JUMP_NS:
                raise FrameError(
                    f"{topic}: stamp {seconds(stamp_ns)} is {back_s:.3f} s behind the one before, {seconds(last_ns)}",
                    reason="stamp_backwards" if back_s else "stamp_repeated",
                )
            self._settle()
            self.clear()
            self._drops.add("time_jump", f"{topic}: time jumped back {back_s:.1f} s to {seconds(stamp_ns)}")
        self.last_ns[topic] = stamp_ns
        return stamp_ns

    def clear(self) -> None:
        """Restart time."""
        self.last_ns.clear()
        self._forget()


def seconds(stamp_ns: int) -> str:
    """Format a stamp as seconds."""
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"
