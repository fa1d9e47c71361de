"""Middleware settings for large messages."""

from __future__ import annotations

import os
from pathlib import Path

_PROFILE = Path(__file__).with_name("fastdds_large_messages.xml")
_FAST_DDS_SETTINGS = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


def enlarge_shared_memory() -> None:
    """Give this process's publishers enough shared memory for images, unless the environment configures Fast DDS already.

    Must be called before the process makes its first ROS node; other middlewares ignore it.
    """
    if not any(name in os.environ for name in _FAST_DDS_SETTINGS):
        os.environ[_FAST_DDS_SETTINGS[0]] = str(_PROFILE)
