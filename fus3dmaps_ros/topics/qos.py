"""QoS profiles by name."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from fus3dmaps_core.config.input import QosProfile
from fus3dmaps_core.sources.streams import QOS_PROFILES


def named_qos(name: QosProfile, depth: int) -> QoSProfile:
    """Return the QoS profile of a name that keeps the last ``depth`` messages.

    ``sensor_data`` is best effort and volatile, and matches any publisher. ``reliable`` is volatile, too.
    ``transient_local`` is reliable and gets what a latched publisher sent before. ``best_available`` is the most that all
    publishers offer that exist when it subscribes; without any it is as ``transient_local``.
    """
    qos = QOS_PROFILES[name]
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy[qos.reliability],
        durability=DurabilityPolicy[qos.durability],
    )


LATCHED = named_qos("transient_local", 1)
"""QoS of everything that the node publishes: late subscribers get the last message."""

SERVICE_QOS = named_qos("reliable", 1000)
"""The default keeps ten requests: of a hundred that come at once, ninety would wait for ever. A client that sends many at
once needs this profile, too, for its requests and the replies."""
