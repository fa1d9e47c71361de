"""The trios on RADIO: what tells one from another, and how each is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch

from fus3dmaps_core.encoders.cards import CodeCheckout, EncoderCard
from fus3dmaps_core.encoders.definition import EncoderDefinition
from fus3dmaps_core.encoders.devices import check_device, default_dtype
from fus3dmaps_core.encoders.network_encoders import NetworkCropEncoder, NetworkPatchEncoder
from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder
from fus3dmaps_core.encoders.radio.adaptor import CropNetwork, PatchNetwork, SummaryHead, load_head
from fus3dmaps_core.encoders.radio.backbone import DenseAttention, RadioBackbone
from fus3dmaps_core.encoders.radio.checkout import ARCHIVE, cached_checkout, find_checkout, import_from, locate_checkout
from fus3dmaps_core.encoders.radio.checkpoint import read_checkpoint
from fus3dmaps_core.encoders.radio.published import CODE_LICENCE
from fus3dmaps_core.encoders.siglip_text import TextTower, read_text
from fus3dmaps_core.encoders.weights import WeightFile, find_weights, only_directory, saying_what_to_get
from fus3dmaps_core.errors import EncoderError

_PATCH_PX = 16  # Of all published RADIO models of these versions.
_PACKAGES = ("einops", "open_clip", "safetensors", "timm", "tokenizers", "torchvision", "transformers")
_LOGIT_SCALE = 100.0  # As the evaluations of these models do; SigLIP's own factor is of this size.


@dataclass(frozen=True)
class RadioVariant:
    """What tells one trio on RADIO from another.

    Attributes:
        name: Registry name.
        summary: What it is and for which machine, a sentence.
        radio: RADIO's checkpoint.
        teacher: Name of the teacher of its vision-language space in the checkpoint.
        text: The teacher's text tower.
        dimension: Embedding width d.
        attention: Makes the attention of the last block for patches.
        variance_ratio: lambda.
        crop_px: Edge of the square that a crop is brought to, a multiple of the patches' edge.
    """

    name: str
    summary: str
    radio: WeightFile
    teacher: str
    text: TextTower
    dimension: int
    attention: DenseAttention
    variance_ratio: float
    crop_px: int

    @property
    def card(self) -> EncoderCard:
        """What there is to know about the trio without loading it."""
        return EncoderCard(
            name=self.name,
            summary=self.summary,
            dimension=self.dimension,
            variance_ratio=self.variance_ratio,
            patch_px=_PATCH_PX,
            code_licence=CODE_LICENCE,
            files=(self.radio, self.text.weights, self.text.tokenizer),
            packages=_PACKAGES,
            checkout=CodeCheckout("RADIO's code", ARCHIVE, cached_checkout, locate_checkout),
        )

    @property
    def definition(self) -> EncoderDefinition:
        """What the registry needs of the trio."""
        return EncoderDefinition(self.card, partial(load_trio, self), partial(load_text_encoder, self))


def load_trio(variant: RadioVariant, device: str, crop_padding: float, weights: str) -> EncoderTrio:
    """Load the three encoders of a trio.

    Args:
        variant: The trio to load.
        device: Torch device, e.g. ``cpu`` or ``cuda:0``.
        crop_padding: Padding around a mask's box, as a share of its size.
        weights: ``encoder.weights``: a directory with RADIO's checkpoint, the text tower's two files and, where it is not to
            come from ``torch.hub``, the folder ``RADIO`` of its code; or RADIO's checkpoint alone, by path or repository; or
            empty.

    Raises:
        EncoderError: The device cannot be used, or a package, code or weights are missing, damaged or others.
    """
    check_device(device)
    backbone, head = load_networks(variant, weights)
    text = load_text_encoder(variant, device, weights)
    return make_trio(variant, backbone, head, text, device, crop_padding, default_dtype(device))


def load_text_encoder(variant: RadioVariant, device: str, weights: str) -> TextEncoder:
    """Load the text encoder of a trio alone: the text tower of its teacher. Nothing of RADIO is needed.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    check_device(device)
    for package in ("open_clip", "transformers"):
        import_optional(package, variant.name)
    directory, tower = only_directory(weights), variant.text  # A file or a repository of the hub is RADIO's.
    tokenizer = find_weights("encoder.weights", directory, tower.tokenizer)
    model = find_weights("encoder.weights", directory, tower.weights)
    with saying_what_to_get("encoder.weights", tower.weights):
        return read_text(tower, model, tokenizer, device, variant.name)


def load_networks(variant: RadioVariant, weights: str) -> tuple[RadioBackbone, SummaryHead]:
    """Load RADIO's transformer and the teacher's head with their weights, on the CPU in float32.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    checkout = find_checkout(weights, variant.name)
    import_from(checkout, "radio.adaptor_module_factory", variant.name)  # First: no other weights would help if this fails.
    path = find_weights("encoder.weights", weights, variant.radio)
    with saying_what_to_get("encoder.weights", variant.radio):
        checkpoint = read_checkpoint(path, checkout, variant.name)
    head = load_head(checkpoint, variant.teacher, checkout, variant.name)
    if head.dimension != variant.dimension:
        raise EncoderError(
            f"weights '{checkpoint.path}': its adaptor embeds in {head.dimension} dimensions, encoder '{variant.name}' in "
            f"{variant.dimension}"
        )
    return RadioBackbone(checkpoint.radio, variant.attention), head


def make_trio(
    variant: RadioVariant,
    backbone: RadioBackbone,
    head: SummaryHead,
    text: TextEncoder,
    device: str,
    crop_padding: float,
    dtype: torch.dtype = torch.float32,
) -> EncoderTrio:
    """Make the three encoders from loaded networks.

    Args:
        variant: The trio to make.
        backbone: RADIO's transformer.
        head: The teacher's head.
        text: Text encoder of the teacher's space.
        device: Torch device that the first two are moved to.
        crop_padding: As in :func:`load_trio`.
        dtype: Precision of transformer and head; embeddings are normalised and handed out in float32.
    """
    patches = PatchNetwork(backbone, head).eval().to(device, dtype)
    crops = CropNetwork(backbone, head).eval().to(device, dtype)
    return EncoderTrio(
        name=variant.name,
        dimension=head.dimension,
        variance_ratio=variant.variance_ratio,
        logit_scale=_LOGIT_SCALE,
        patch=NetworkPatchEncoder(patches, backbone.patch_px, backbone.mean, backbone.std, device),
        crop=NetworkCropEncoder(crops, head.dimension, variant.crop_px, backbone.mean, backbone.std, crop_padding, device),
        text=text,
    )
