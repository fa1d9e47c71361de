"""The paper's trio ``naradio``: RADIO v2.5-L with the neighbourhood attention, in SigLIP's space; d = 1152.

RADIO's licence admits research and evaluation only, for its code as for these weights; SigLIP is Apache-2.0.
:mod:`fus3dmaps_core.encoders.radio.published` lists the files that are needed.
"""

from __future__ import annotations

from fus3dmaps_core.encoders.radio.loading import RadioVariant
from fus3dmaps_core.encoders.radio.neighbourhood_attention import NeighbourhoodAttention
from fus3dmaps_core.encoders.radio.published import RADIO_LARGE, SIGLIP

NARADIO = RadioVariant(
    name="naradio",
    summary="The paper's trio: RADIO v2.5-L with neighbourhood attention, in SigLIP's space.",
    radio=RADIO_LARGE,
    teacher="siglip",
    text=SIGLIP,
    dimension=1152,
    attention=NeighbourhoodAttention,
    variance_ratio=1.0,  # [sec: Vision Models]
    crop_px=336,  # Its authors report one point of zero-shot accuracy less than at 768, which is five times the work.
)

ENCODER = NARADIO.definition
