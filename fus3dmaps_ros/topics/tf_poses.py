"""TF on a robot: the buffer and listener of tf2, with the interface that the core expects."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time

from fus3dmaps_core.errors import ConfigError, FrameError
from fus3dmaps_core.messages import fields
from fus3dmaps_core.sources.transforms import NoTransform, TransformGap


def import_tf2_ros() -> Any:
    """Import the package that reads TF.

    Raises:
        ConfigError: It is not installed; the message names the parameters that need it and what to install.
    """
    try:
        return import_module("tf2_ros")
    except ImportError as error:
        raise ConfigError(
            "parameters 'input.pose_source' and 'input.extrinsic_source': tf needs the Python package tf2_ros, which is"
            f" not installed ({error}); on Ubuntu: apt install ros-jazzy-tf2-ros-py"
        ) from None


class TfListener:
    """Listens to ``/tf`` and ``/tf_static`` through tf2_ros and answers lookups without waiting.

    tf2 interpolates across gaps of any length within its ten seconds of history, so ``input.max_pose_gap_s`` has no effect
    here. Lookups are safe in any thread.
    """

    def __init__(self, node: Node) -> None:
        """Start listening.

        Args:
            node: Owner of the subscriptions.

        Raises:
            ConfigError: tf2_ros is not installed.
        """
        self._tf2_ros = tf2_ros = import_tf2_ros()
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def lookup(self, target_frame: str, source_frame: str, stamp_ns: int) -> NDArray[np.float64] | NoTransform:
        """Return T_target_source at a stamp, (4, 4) float64, or the reason why there is none.

        Args:
            target_frame: Frame into which points are transformed.
            source_frame: Frame in which they are given.
            stamp_ns: Nanoseconds.
        """
        tf2 = self._tf2_ros
        target, source = target_frame.lstrip("/"), source_frame.lstrip("/")
        try:
            return self._at(target, source, stamp_ns)[0]
        except (tf2.LookupException, tf2.InvalidArgumentException) as error:
            return NoTransform(TransformGap.UNKNOWN_FRAME, str(error))
        except tf2.ConnectivityException as error:
            return NoTransform(TransformGap.NOT_CONNECTED, str(error))
        except tf2.ExtrapolationException as error:
            gap = TransformGap.AFTER_LAST if self._is_ahead(target, source, stamp_ns) else TransformGap.BEFORE_FIRST
            return NoTransform(gap, str(error))
        except FrameError as error:
            return NoTransform(TransformGap.UNUSABLE, str(error))

    def clear(self) -> None:
        """Forget moving transforms; static ones stay."""
        self._buffer.clear()

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()

    def _at(self, target: str, source: str, stamp_ns: int) -> tuple[NDArray[np.float64], int]:
        """Return a transform and its stamp; stamp 0 means the latest."""
        stamped = self._buffer.lookup_transform(target, source, Time(nanoseconds=stamp_ns))
        return fields.transform_of(stamped, "/tf"), fields.stamp_ns(stamped)

    def _is_ahead(self, target: str, source: str, stamp_ns: int) -> bool:
        """Return whether a stamp is later than all that TF knows, so that the transform may still come."""
        try:
            return stamp_ns > self._at(target, source, 0)[1]
        except (self._tf2_ros.TransformException, FrameError):
            # The edges of the chain have no time in common yet.
            return True
