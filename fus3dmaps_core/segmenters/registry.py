"""Segmenters by name. A new one is a new file and a line here."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import cast

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.segmenters.protocols import Segmenter

_SEGMENTERS = {
    "lite": "fus3dmaps_core.segmenters.lite",
}


def names() -> list[str]:
    """Names of the known segmenters."""
    return sorted(_SEGMENTERS)


def load_segmenter(name: str, device: str) -> Segmenter:
    """Load a segmenter; its module's ``load(device)`` builds it.

    Raises:
        EncoderError: The name is unknown, or what it needs is not installed.
    """
    if name not in _SEGMENTERS:
        raise EncoderError(f"parameter 'segmenter.name': unknown segmenter '{name}', known are {', '.join(names())}")
    load = cast(Callable[[str], Segmenter], import_module(_SEGMENTERS[name]).load)
    return load(device)
