"""Encoder trios by name. A new one is a new file or folder with an ``ENCODER``, and a line here."""

from __future__ import annotations

from importlib import import_module
from typing import cast

from fus3dmaps_core.encoders.cards import EncoderCard
from fus3dmaps_core.encoders.definition import EncoderDefinition
from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder
from fus3dmaps_core.errors import EncoderError

_MODULES = {
    "clip_dinoiser": "fus3dmaps_core.encoders.clip_dinoiser",
    "lite": "fus3dmaps_core.encoders.lite",
    "naradio": "fus3dmaps_core.encoders.radio.naradio",
    "radseg": "fus3dmaps_core.encoders.radio.radseg",
    "siglip2": "fus3dmaps_core.encoders.siglip2",
}


def names() -> list[str]:
    """List the names of the known encoder trios."""
    return sorted(_MODULES)


def definition(name: str) -> EncoderDefinition:
    """Import the module of a trio and return its definition; nothing is loaded yet.

    Raises:
        EncoderError: The name is unknown.
    """
    if name not in _MODULES:
        raise EncoderError(f"parameter 'encoder.name': unknown encoder '{name}', known are {', '.join(names())}")
    return cast(EncoderDefinition, import_module(_MODULES[name]).ENCODER)


def card(name: str) -> EncoderCard:
    """Return what there is to know about a trio without loading it.

    Raises:
        EncoderError: The name is unknown.
    """
    return definition(name).card


def load_trio(name: str, device: str, crop_padding: float, weights: str = "") -> EncoderTrio:
    """Load the three encoders of a trio.

    Args:
        name: Registry name.
        device: Torch device, e.g. ``cpu`` or ``cuda:0``.
        crop_padding: Padding around a mask's box, as a share of its size.
        weights: Where its weights are, see :mod:`fus3dmaps_core.encoders.weights`; "" for the published ones.

    Raises:
        EncoderError: The name is unknown, or its packages or weights are missing or altered.
    """
    return definition(name).load_trio(device, crop_padding, weights)


def load_text_encoder(name: str, device: str, weights: str = "") -> TextEncoder:
    """Load the text encoder alone, which is all that a query of a saved map needs.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    return definition(name).load_text_encoder(device, weights)
