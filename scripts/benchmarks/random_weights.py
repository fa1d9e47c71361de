"""Random weights of the published sizes, in files as the authors publish theirs; what they cost depends on no value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from fus3dmaps_core.encoders.radio.loading import RadioVariant
from fus3dmaps_core.encoders.weights import WeightFile

_SEED = 17
_TRANSFORMERS = {"naradio": "vit_large_patch16_224", "radseg": "vit_base_patch16_224"}
_HEAD_WIDTH, _HEAD_LAYERS = 1520, 3  # Of the adaptors' heads.
_SIGLIP2_SIDE_PX = 384
# Modules and the names under which they look for the files.
_PUBLISHED_FILES = (
    ("fus3dmaps_core.encoders.clip_dinoiser.network", "CLIP"),
    ("fus3dmaps_core.encoders.clip_dinoiser.network", "HEADS"),
    ("fus3dmaps_core.encoders.siglip2", "MODEL"),
    ("fus3dmaps_core.encoders.siglip2", "TOKENIZER"),
    ("fus3dmaps_core.segmenters.sam2.network", "SAM2"),
)
_RADIO_VARIANTS = (("fus3dmaps_core.encoders.radio.naradio", "NARADIO"), ("fus3dmaps_core.encoders.radio.radseg", "RADSEG"))


def accept_random_weights() -> None:
    """Have trios and segmenters take files of any content under the published names, in this process."""
    for module, name in _PUBLISHED_FILES:
        _replace(module, name, _any_content)
    for module, name in _RADIO_VARIANTS:
        held: Any = import_module(module)
        held.ENCODER = _variant_of_any_content(getattr(held, name)).definition


def write_trio(name: str, folder: Path) -> str:
    """Write what ``encoder.weights`` may name for a trio.

    Args:
        name: Registry name.
        folder: An empty directory.

    Returns:
        The value of ``encoder.weights``; "" where the weights come with packages.

    Raises:
        EncoderError: A package is missing.
        ValueError: There is nothing to make random weights of this trio.
    """
    write = TRIOS.get(name)
    if write is None:
        raise ValueError(f"no random weights for encoder '{name}': name the folder of its weights by --weights")
    torch.manual_seed(_SEED)
    with torch.inference_mode():
        write(folder)
    return "" if name == "lite" else str(folder)


def write_sam2(folder: Path) -> str:
    """Write what ``segmenter.weights`` may name for ``sam2``.

    Raises:
        EncoderError: A package is missing.
    """
    from safetensors.torch import save_file

    torch.manual_seed(_SEED)
    network = import_module("fus3dmaps_core.segmenters.sam2.network").build_sam2()
    save_file({name: value.clone() for name, value in network.state_dict().items()}, folder / "model.safetensors")
    return str(folder)


def radio_code() -> str:
    """Say whose code builds RADIO's networks for random weights: its authors' or that of the tests."""
    files = _helper("radio_files")
    return "stand-in" if files.find_checkout() == files.STAND_IN else "RADIO's own"


def _write_radio(name: str, folder: Path) -> None:
    files = _helper("radio_files")
    checkout, variant = files.find_checkout(), files.VARIANTS[name]
    (folder / "RADIO").symlink_to(checkout.resolve(), target_is_directory=True)
    path = folder / variant.radio.file_name
    files.write_checkpoint(path, checkout, name, _HEAD_WIDTH, _HEAD_LAYERS, _TRANSFORMERS[name])
    files.write_text(folder, variant)


def _write_siglip2(folder: Path) -> None:
    from safetensors.torch import save_file

    files, text = _helper("siglip2_files"), import_module("fus3dmaps_core.encoders.siglip2.published").TEXT
    save_file(files.published_state(files.random_model(_SIGLIP2_SIDE_PX, text)), folder / "model.safetensors")
    files.write_tokenizer(folder / "tokenizer.json")


def _write_clip_dinoiser(folder: Path) -> None:
    from safetensors.torch import save_file

    clip = import_module("fus3dmaps_core.encoders.clip_dinoiser.network").build_clip()
    heads = import_module("fus3dmaps_core.encoders.clip_dinoiser.heads").DinoiserHeads()
    save_file(clip.state_dict(), folder / "open_clip_model.safetensors")
    save_file(heads.state_dict(), folder / "last.safetensors")


def _helper(name: str) -> Any:
    """Import a module of the tests' folder, which scripts/bench has on the path."""
    return import_module(name)


TRIOS: dict[str, Callable[[Path], None]] = {
    "clip_dinoiser": _write_clip_dinoiser,
    "lite": lambda folder: None,  # pip brings them
    "naradio": partial(_write_radio, "naradio"),
    "radseg": partial(_write_radio, "radseg"),
    "siglip2": _write_siglip2,
}
"""Functions that write random weights of each trio into an empty directory."""


def _replace(module: str, name: str, change: Callable[[Any], Any]) -> None:
    held = import_module(module)
    setattr(held, name, change(getattr(held, name)))


def _any_content(file: WeightFile) -> WeightFile:
    return replace(file, sha256="", git_blob="")


def _variant_of_any_content(variant: RadioVariant) -> RadioVariant:
    text = replace(variant.text, weights=_any_content(variant.text.weights), tokenizer=_any_content(variant.text.tokenizer))
    return replace(variant, radio=_any_content(variant.radio), text=text)
