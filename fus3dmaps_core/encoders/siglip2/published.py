"""The files of weights that this trio needs: where they are published, and under which licence."""

from __future__ import annotations

from fus3dmaps_core.encoders.siglip_text import TextTower
from fus3dmaps_core.encoders.weights import WeightFile

_REPOSITORY = "google/siglip2-base-patch16-384"
_REVISION = "f775b65a79762255128c981547af89addcfe0f88"


def _file(title: str, name: str, sha256: str) -> WeightFile:
    return WeightFile(
        title=title,
        file_name=name,
        url=f"https://huggingface.co/{_REPOSITORY}/resolve/{_REVISION}/{name}",
        hub=_REPOSITORY,
        revision=_REVISION,
        sha256=sha256,
        licence="Apache-2.0",
    )


MODEL = _file("SigLIP 2 B/16 model", "model.safetensors", "ed72c0ace85020ae610fc817c2538b9cae5a477b012a50859c60af5b3ad30857")
"""Both towers, as the package ``transformers`` names their weights."""

TOKENIZER = _file("SigLIP 2 B/16 tokenizer", "tokenizer.json", "")

TEXT = TextTower(
    weights=MODEL,
    tokenizer=TOKENIZER,
    vocabulary=256_000,
    end_id=1,
    pad_id=0,
    dimension=768,
    width=768,
    hidden=3072,
    layers=12,
    heads=12,
    templates="SIMPLE_IMAGENET_TEMPLATES",
)
"""Asked with 7 of the 80 templates: CLIP's authors selected them from these, and they did a little better than all, above
all in small models. A prompt then takes a tenth of the time, which counts on a small machine."""
