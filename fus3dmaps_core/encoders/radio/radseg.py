"""The pair ``radseg``: C-RADIO v3-B with self-correlating recursive attention, in SigLIP 2's space; d = 1152.

It follows Alama et al. 2025, "RADSeg", who report a higher accuracy than NARADIO's with a third of the parameters, but
leaves out their sliding windows and the aggregation over them: a frame is one pass. The code's licence admits research and
evaluation only, the weights' is the NVIDIA Open Model License; SigLIP 2 is Apache-2.0. Which files are needed stands in
:mod:`fus3dmaps_core.encoders.radio.published`.
"""

from __future__ import annotations

from typing import Any

from torch import nn

from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder
from fus3dmaps_core.encoders.radio import pair
from fus3dmaps_core.encoders.radio.published import C_RADIO_BASE, SIGLIP2
from fus3dmaps_core.encoders.radio.recursive_attention import RecursiveAttention


def _attention(attention: Any, prefix_tokens: int) -> nn.Module:
    return RecursiveAttention(attention)


RADSEG = pair.RadioPair(
    name="radseg",
    summary="C-RADIO v3-B with recursive attention; its authors report more than naradio's with a third of its weights.",
    radio=C_RADIO_BASE,
    teacher="siglip2",
    text=SIGLIP2,
    dimension=1152,
    attention=_attention,
    variance_ratio=1.0,  # Not known; NARADIO's, whose kind of features these are.
    crop_px=336,  # As for NARADIO.
)

CARD = RADSEG.card


def load_trio(device: str, crop_padding: float, weights: str) -> EncoderTrio:
    """Load the three encoders, see :func:`fus3dmaps_core.encoders.radio.pair.load_trio`.

    Raises:
        EncoderError: The device cannot be used, or a package, code or weights are missing, damaged or others.
    """
    return pair.load_trio(RADSEG, device, crop_padding, weights)


def load_text_encoder(device: str, weights: str) -> TextEncoder:
    """Load the text encoder alone.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    return pair.load_text_encoder(RADSEG, device, weights)
