"""The paper's pair ``naradio``: RADIO v2.5-L with the neighbourhood attention, in SigLIP's space; d = 1152.

RADIO's licence admits research and evaluation only, for its code as for these weights; SigLIP is Apache-2.0. Which files are
needed stands in :mod:`fus3dmaps_core.encoders.radio.published`.
"""

from __future__ import annotations

from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder
from fus3dmaps_core.encoders.radio import pair
from fus3dmaps_core.encoders.radio.neighbourhood_attention import NeighbourhoodAttention
from fus3dmaps_core.encoders.radio.published import RADIO_LARGE, SIGLIP

NARADIO = pair.RadioPair(
    name="naradio",
    summary="The paper's pair: RADIO v2.5-L with neighbourhood attention, in SigLIP's space.",
    radio=RADIO_LARGE,
    teacher="siglip",
    text=SIGLIP,
    dimension=1152,
    attention=NeighbourhoodAttention,
    variance_ratio=1.0,  # [sec: Vision Models]
    crop_px=336,  # Its authors report one point of zero-shot accuracy less than at 768, which is five times the work.
)

CARD = NARADIO.card


def load_trio(device: str, crop_padding: float, weights: str) -> EncoderTrio:
    """Load the three encoders, see :func:`fus3dmaps_core.encoders.radio.pair.load_trio`.

    Raises:
        EncoderError: The device cannot be used, or a package, code or weights are missing, damaged or others.
    """
    return pair.load_trio(NARADIO, device, crop_padding, weights)


def load_text_encoder(device: str, weights: str) -> TextEncoder:
    """Load the text encoder alone.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    return pair.load_text_encoder(NARADIO, device, weights)
