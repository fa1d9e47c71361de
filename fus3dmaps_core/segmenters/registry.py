"""Segmenters by name. A new one is a new file and a line here."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import cast

from fus3dmaps_core.config.schema import EncoderConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.segmenters.protocols import Segmenter

_SEGMENTERS = {
    "fastsam": "fus3dmaps_core.segmenters.fastsam",
    "lite": "fus3dmaps_core.segmenters.lite",
    "sam2": "fus3dmaps_core.segmenters.sam2",
}


def names() -> list[str]:
    """List the names of the known segmenters."""
    return sorted(_SEGMENTERS)


def load_segmenter(name: str, encoder: EncoderConfig, weights: str = "") -> Segmenter:
    """Load a segmenter by the ``load(encoder, weights)`` of its module.

    Args:
        name: Registry name.
        encoder: Its ``device``, ``runtime``, ``precision`` and ``graph_directory`` hold for segmenters as well.
        weights: Where its weights are, see :mod:`fus3dmaps_core.encoders.weights`; "" for the published ones.

    Raises:
        EncoderError: The name is unknown, or what it needs is not installed.
    """
    if name not in _SEGMENTERS:
        raise EncoderError(f"parameter 'segmenter.name': unknown segmenter '{name}', known are {', '.join(names())}")
    load = cast(Callable[[EncoderConfig, str], Segmenter], import_module(_SEGMENTERS[name]).load)
    return load(encoder, weights)
