"""An encoder trio as the registry knows it: its card, and how it is loaded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from fus3dmaps_core.encoders.cards import EncoderCard
from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder


@dataclass(frozen=True)
class EncoderDefinition:
    """The definition of a trio, which its module offers the registry under the name ``ENCODER``.

    Attributes:
        card: What there is to know about the trio without loading it.
        load_trio: Loads the three encoders; takes the arguments of :func:`fus3dmaps_core.encoders.registry.load_trio` that
            follow the name.
        load_text_encoder: Loads the text encoder alone; takes the device and the weights.
    """

    card: EncoderCard
    load_trio: Callable[[str, float, str], EncoderTrio]
    load_text_encoder: Callable[[str, str], TextEncoder]
