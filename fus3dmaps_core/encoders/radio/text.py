"""Text encoders of the trios on RADIO: the towers of the teachers whose spaces their heads imitate."""

from __future__ import annotations

from fus3dmaps_core.encoders.optional_packages import import_optional
from fus3dmaps_core.encoders.siglip_text import SiglipTextEncoder, TextTower, read_text
from fus3dmaps_core.encoders.weights import find_weights, only_directory, saying_what_to_get


def load_text(published: TextTower, weights: str, device: str, encoder: str) -> SiglipTextEncoder:
    """Load a text tower, with its published weights or those in the directory that ``encoder.weights`` names.

    Raises:
        EncoderError: A package, the weights or the tokenizer are missing, damaged or another model's.
    """
    for package in ("open_clip", "transformers"):
        import_optional(package, encoder)
    directory = only_directory(weights)  # A file or a repository of the hub is RADIO's.
    tokenizer = find_weights("encoder.weights", directory, published.tokenizer)
    model = find_weights("encoder.weights", directory, published.weights)
    with saying_what_to_get("encoder.weights", published.weights):
        return read_text(published, model, tokenizer, device, encoder)
