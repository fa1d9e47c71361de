"""The small trio ``siglip2``: SigLIP 2 B/16 alone, whose pooling head also takes each patch by itself; d = 768.

It is the trio for Jetson Orin Nano: one transformer of 93 million parameters embeds patches and crops, weights and code are
Apache-2.0 (Tschannen et al. 2025). :mod:`fus3dmaps_core.encoders.siglip2.published` lists the files that are needed.
``encoder.weights`` is a directory that holds both, or the model's file or repository of the hub; the tokenizer then is the
published one, which all of SigLIP 2's models have.

The published model was trained on images of 384 pixels, 24x24 patches. Its positions are stretched to the 30x40 of a frame
of 480x640, and a crop costs half as much as with the model for 512 pixels, for half a point less of zero-shot accuracy on
ImageNet. The others of the family fit as well: ``google/siglip2-base-patch16-256`` makes crops twice as fast again, and
``google/siglip2-base-patch16-512`` was trained on nearly a frame's number of patches.
"""

from __future__ import annotations

from pathlib import Path

import torch

from fus3dmaps_core.encoders.cards import EncoderCard
from fus3dmaps_core.encoders.definition import EncoderDefinition
from fus3dmaps_core.encoders.devices import check_device, default_dtype
from fus3dmaps_core.encoders.network_encoders import NetworkCropEncoder, NetworkPatchEncoder
from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder
from fus3dmaps_core.encoders.siglip2.network import (
    MEAN,
    PATCH_PX,
    STD,
    WIDTH,
    CropNetwork,
    PatchNetwork,
    SiglipTokens,
    read_vision,
)
from fus3dmaps_core.encoders.siglip2.published import MODEL, TEXT, TOKENIZER
from fus3dmaps_core.encoders.siglip_text import read_text
from fus3dmaps_core.encoders.weights import find_weights, only_directory, saying_what_to_get

CARD = EncoderCard(
    name="siglip2",
    summary="The small trio: SigLIP 2 B/16, its pooling head applied to each patch, for Jetson Orin Nano.",
    dimension=WIDTH,
    variance_ratio=1.0,  # Not known; that of the other trios whose patches go through the head of whole images.
    patch_px=PATCH_PX,
    code_licence="",
    files=(MODEL, TOKENIZER),
    packages=("open_clip", "safetensors", "tokenizers", "transformers"),
)

_LOGIT_SCALE = 100.0  # SigLIP's own factor is of this size.
_PARAMETER = "encoder.weights"


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
    model, tokenizer = _find_files(weights)
    dtype = default_dtype(device)
    with saying_what_to_get(_PARAMETER, MODEL):
        text = read_text(TEXT, model, tokenizer, device, CARD.name, dtype)
        vision = read_vision(model)
    return make_trio(vision, text, device, crop_padding, dtype)


def load_text_encoder(device: str, weights: str) -> TextEncoder:
    """Load the text encoder alone; nothing of the image tower is read.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    check_device(device)
    model, tokenizer = _find_files(weights)
    with saying_what_to_get(_PARAMETER, MODEL):
        return read_text(TEXT, model, tokenizer, device, CARD.name, default_dtype(device))


def make_trio(
    tokens: SiglipTokens, text: TextEncoder, device: str, crop_padding: float, dtype: torch.dtype = torch.float32
) -> EncoderTrio:
    """Make the three encoders from loaded networks.

    Args:
        tokens: Image tower.
        text: Text encoder of the same model.
        device: Torch device that the image tower is moved to.
        crop_padding: As in :func:`load_trio`.
        dtype: Precision of the image tower; embeddings are normalised and handed out in float32.
    """
    tokens = tokens.eval().to(device, dtype)
    return EncoderTrio(
        name=CARD.name,
        dimension=CARD.dimension,
        variance_ratio=CARD.variance_ratio,
        logit_scale=_LOGIT_SCALE,
        patch=NetworkPatchEncoder(PatchNetwork(tokens).eval(), PATCH_PX, MEAN, STD, device),
        crop=NetworkCropEncoder(CropNetwork(tokens).eval(), WIDTH, tokens.size_px, MEAN, STD, crop_padding, device),
        text=text,
    )


def _find_files(weights: str) -> tuple[Path, Path]:
    """Find the files of the model and of the tokenizer."""
    for package in CARD.packages:  # Before gigabytes are fetched.
        import_optional(package, CARD.name)
    model = find_weights(_PARAMETER, weights, MODEL)
    return model, find_weights(_PARAMETER, only_directory(weights), TOKENIZER)  # Anything else is the model's.


ENCODER = EncoderDefinition(CARD, load_trio, load_text_encoder)
