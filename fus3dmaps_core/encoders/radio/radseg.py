"""The trio ``radseg``: C-RADIO v3-B with self-correlating recursive attention, in SigLIP 2's space; d = 1152.

It follows Alama et al. 2025, "RADSeg", who report a higher accuracy than NARADIO's with a third of the parameters. Their
sliding windows and the aggregation over them are left out: a frame is one pass. The code's licence admits research and
evaluation only, the weights' is the NVIDIA Open Model License; SigLIP 2 is Apache-2.0.
:mod:`fus3dmaps_core.encoders.radio.published` lists the files that are needed.
"""

from __future__ import annotations

from typing import Any

from torch import nn

from fus3dmaps_core.encoders.radio.loading import RadioVariant
from fus3dmaps_core.encoders.radio.published import C_RADIO_BASE, SIGLIP2
from fus3dmaps_core.encoders.radio.recursive_attention import RecursiveAttention


def _attention(attention: Any, prefix_tokens: int) -> nn.Module:
    return RecursiveAttention(attention)


RADSEG = RadioVariant(
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

ENCODER = RADSEG.definition
