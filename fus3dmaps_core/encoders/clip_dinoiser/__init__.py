"""The paper's trio ``clip_dinoiser``: CLIP's features, pooled where CLIP-DINOiser sees one object; d = 512.

CLIP is OpenCLIP's ViT-B/16, trained on LAION-2B (package ``open_clip``, MIT); the heads are those of Wysoczanska et al. 2024
(Apache-2.0). :mod:`fus3dmaps_core.encoders.clip_dinoiser.published` lists the files that are needed. ``encoder.weights``
is a directory that holds both, or CLIP's file or repository of the hub; the heads then are the published ones.
"""

from __future__ import annotations

from typing import Any

from fus3dmaps_core.encoders.cards import EncoderCard
from fus3dmaps_core.encoders.clip_dinoiser.heads import DinoiserHeads
from fus3dmaps_core.encoders.clip_dinoiser.network import MEAN, STD, ClipCrops, ClipDinoiser, load_clip, load_heads
from fus3dmaps_core.encoders.clip_dinoiser.published import CLIP, HEADS
from fus3dmaps_core.encoders.clip_dinoiser.text import ClipTextEncoder
from fus3dmaps_core.encoders.definition import EncoderDefinition
from fus3dmaps_core.encoders.devices import check_device
from fus3dmaps_core.encoders.network_encoders import NetworkCropEncoder, NetworkPatchEncoder
from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder

CARD = EncoderCard(
    name="clip_dinoiser",
    summary="The paper's lighter trio: CLIP ViT-B/16, its patches pooled by DINOiser's heads.",
    dimension=512,
    variance_ratio=5.0,  # [sec: Vision Models]
    patch_px=16,
    code_licence="MIT (OpenCLIP)",
    files=(CLIP, HEADS),
    packages=("open_clip", "torchvision", "safetensors"),
)

_LOGIT_SCALE = 100.0  # The factor that CLIP learned; training caps it here.


def load_trio(device: str, crop_padding: float, weights: str) -> EncoderTrio:
    """Load the three encoders.

    Args:
        device: Torch device, e.g. ``cpu`` or ``cuda:0``.
        crop_padding: Padding around a mask's box, as a share of its size.
        weights: Where the weights are, see :mod:`fus3dmaps_core.encoders.weights`.

    Raises:
        EncoderError: The device cannot be used, a package is missing, or weights are missing, damaged or others.
    """
    check_device(device)
    return make_trio(load_clip(weights), load_heads(weights), device, crop_padding)


def load_text_encoder(device: str, weights: str) -> TextEncoder:
    """Load the text encoder alone; the heads are not needed.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    check_device(device)
    clip = load_clip(weights)
    del clip.visual
    return ClipTextEncoder(clip.to(device), device)


def make_trio(clip: Any, heads: DinoiserHeads, device: str, crop_padding: float) -> EncoderTrio:
    """Make the three encoders from loaded networks.

    Args:
        clip: ``open_clip`` CLIP model with an image transformer.
        heads: CLIP-DINOiser's heads.
        device: Torch device that both are moved to.
        crop_padding: As in :func:`load_trio`.
    """
    network = ClipDinoiser(clip.visual, heads).eval().to(device)
    clip.to(device)
    return EncoderTrio(
        name=CARD.name,
        dimension=CARD.dimension,
        variance_ratio=CARD.variance_ratio,
        logit_scale=_LOGIT_SCALE,
        patch=NetworkPatchEncoder(network, network.maskclip.patch_px, MEAN, STD, device, outputs=("embeddings", "saliency")),
        crop=NetworkCropEncoder(
            ClipCrops(clip.visual).eval(), CARD.dimension, int(clip.visual.image_size[0]), MEAN, STD, crop_padding, device
        ),
        text=ClipTextEncoder(clip, device),
    )


ENCODER = EncoderDefinition(CARD, load_trio, load_text_encoder)
