"""The segmenter ``sam2``: SAM 2.1 Hiera tiny (Ravi et al. 2024) asked at a grid of points; code and weights Apache-2.0.

A learned segmenter under a permissive licence. It needs the package ``transformers`` and a GPU: every point is a pass of the
decoder, which takes many times what FastSAM takes for the whole image. ``segmenter.weights`` is ``model.safetensors`` of
``facebook/sam2.1-hiera-tiny``, its directory, or that repository of the hub, which is also the default.
"""

from __future__ import annotations

from fus3dmaps_core.config.schema import EncoderConfig
from fus3dmaps_core.encoders.devices import check_device
from fus3dmaps_core.segmenters.sam2.network import load_sam2
from fus3dmaps_core.segmenters.sam2.segmenter import Sam2Segmenter


def load(encoder: EncoderConfig, weights: str) -> Sam2Segmenter:
    """Load the segmenter, which torch runs whatever the runtime of the encoders.

    Args:
        encoder: Its ``device`` is the segmenter's.
        weights: Where the weights are, see :mod:`fus3dmaps_core.encoders.weights`.

    Raises:
        EncoderError: The device cannot be used, the package is missing, or weights are missing, damaged or others.
    """
    check_device(encoder.device)
    return Sam2Segmenter(load_sam2(weights).to(encoder.device), encoder.device)
