"""QoS profiles by name."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from fus3dmaps_core.config.input import QosProfile

_POLICIES: dict[QosProfile, tuple[ReliabilityPolicy, DurabilityPolicy]] = {
    "sensor_data": (ReliabilityPolicy.BEST_EFFORT, DurabilityPolicy.VOLATILE),
    "reliable": (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE),
    "transient_local": (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL),
    "best_available": (ReliabilityPolicy.BEST_AVAILABLE, DurabilityPolicy.BEST_AVAILABLE),
}


def named_qos(name: QosProfile, depth: int) -> QoSProfile:
    """Return the QoS profile of a name that keeps the last ``depth`` messages.

    ``sensor_data`` is best effort and volatile, and matches any publisher. ``reliable`` is volatile, too.
    ``transient_local`` is reliable and gets what a latched publisher sent before. ``best_available`` is the most that all
    publishers offer that exist when it subscribes; without any it is as ``transient_local``.
    """
    reliability, durability = _POLICIES[name]
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability)


LATCHED = named_qos("transient_local", 1)
"""QoS of everything that the node publishes: late subscribers get the last message."""

SERVICE_QOS = named_qos("reliable", 1000)
"""The default keeps ten requests: of a hundred that come at once, ninety would wait for ever. A client that sends many at
once needs this profile, too, for its requests and the replies."""
