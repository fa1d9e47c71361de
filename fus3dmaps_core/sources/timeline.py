"""What the inputs of a map have in common: their clock, and the counts of what came and what could not be used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.ledger import Drops
from fus3dmaps_core.messages import fields as messages

_TIME_JUMP_NS = 3_000_000_000  # Delivery can swap neighbours; only another clock or a restart goes back this far.


@dataclass
class Tally:
    """Counts of messages.

    Attributes:
        received: Messages per topic, usable or not.
        drops: What led to no frame or was noteworthy, by reason.
    """

    received: Counter[str] = field(default_factory=Counter)
    drops: Drops = field(default_factory=Drops)

    def drop(self, error: FrameError) -> None:
        """Count a message that cannot be used."""
        self.drops.add(error.reason, str(error))


class Timeline:
    """The stamps of all inputs. Each topic's rise; one that goes far back starts time anew for all of them.

    Attributes:
        last_ns: Latest stamp of each topic since time started.
    """

    def __init__(self, tally: Tally, settle: Callable[[], None], forget: Callable[[], None]) -> None:
        """Start without a stamp.

        Args:
            tally: Counts ``time_jump``.
            settle: Called before time starts anew: what waits is to be paired or dropped.
            forget: Called then: what was kept of the old time is to go.
        """
        self._tally = tally
        self._settle = settle
        self._forget = forget
        self.last_ns: dict[str, int] = {}

    @property
    def newest_ns(self) -> int:
        """Latest stamp of all."""
        return max(self.last_ns.values(), default=0)

    def advance(self, topic: str, message: Any) -> int:
        """The message's stamp, which must be later than the topic's last one unless time has jumped back.

        Raises:
            FrameError: Reason ``stamp_backwards`` or ``stamp_repeated``.
        """
        stamp_ns = messages.stamp_ns(message)
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
            self._tally.drop(
                FrameError(f"{topic}: time jumped back {back_s:.1f} s to {seconds(stamp_ns)}", reason="time_jump")
            )
        self.last_ns[topic] = stamp_ns
        return stamp_ns

    def clear(self) -> None:
        """Start time anew."""
        self.last_ns.clear()
        self._forget()


def seconds(stamp_ns: int) -> str:
    """A stamp in words."""
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"
