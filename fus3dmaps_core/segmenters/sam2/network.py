"""SAM 2.1 Hiera tiny as transformers has it: built offline, with the weights of the published video model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.weights import find_weights, fit, read_state, saying_what_to_get
from fus3dmaps_core.segmenters.sam2.published import PARAMETER, SAM2

SIDE = 1024
"""Side of the square images that the published weights were trained on, pixels."""

_STRIDES = (4, 8, 16)  # Of the three levels of features.
# The published file is the video model's. What follows remembers earlier frames, which a single image does not have.
_OF_VIDEO = (
    "mask_downsample.",
    "memory_attention.",
    "memory_encoder.",
    "memory_temporal_positional_encoding",
    "no_memory_positional_encoding",
    "no_object_pointer",
    "object_pointer_proj.",
    "occlusion_spatial_embedding_parameter",
    "temporal_positional_encoding_projection_layer.",
)
# One tensor under two names, of which some writers of safetensors keep one.
_TWINS = ("shared_image_embedding.positional_embedding", "prompt_encoder.shared_embedding.positional_embedding")


def build_sam2(side: int = SIDE) -> Any:
    """Build the ``Sam2Model`` with random weights, on the CPU.

    Args:
        side: Side of the square images it takes, pixels, a multiple of 128; its parameters are the same for any.

    Raises:
        EncoderError: The package ``transformers`` is missing or has no SAM 2.
    """
    configuration = import_optional("transformers.models.sam2.configuration_sam2", "sam2", "segmenter")
    modeling = import_optional("transformers.models.sam2.modeling_sam2", "sam2", "segmenter")
    config = configuration.Sam2Config(
        vision_config=configuration.Sam2VisionConfig(
            backbone_config=configuration.Sam2HieraDetConfig(image_size=[side, side]),
            backbone_feature_sizes=[[side // stride, side // stride] for stride in _STRIDES],
        ),
        prompt_encoder_config=configuration.Sam2PromptEncoderConfig(image_size=side),
    )
    return modeling.Sam2Model(config).eval().requires_grad_(False)


def load_sam2(weights: str, side: int = SIDE) -> Any:
    """Load the ``Sam2Model`` onto the CPU, with its published weights or those that ``segmenter.weights`` names.

    Raises:
        EncoderError: A package or the weights are missing, damaged, or another architecture's.
    """
    network = build_sam2(side)
    path = find_weights(PARAMETER, weights, SAM2)
    with saying_what_to_get(PARAMETER, SAM2):
        fit(network, image_weights(read_state(path)), f"weights '{path}'")
    return network


def image_weights(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Select the video model's weights that single images need, by the names of ``Sam2Model``."""
    kept = {name: value for name, value in state.items() if not name.startswith(_OF_VIDEO)}
    for missing, present in (_TWINS, _TWINS[::-1]):
        if missing not in kept and present in kept:
            kept[missing] = kept[present]
    return kept
