"""Random weights of every large trio, where the published ones would lie on a machine that needs no network.

The networks are as wide as the published ones. RADIO's transformers have four blocks, as their checkpoints may say; SigLIP's
text towers have one block and few words, as :func:`expect_random_weights` has the trios expect: each prompt is embedded in
eighty sentences, which takes a minute and a half through 27 blocks on two cores.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import siglip2_files
import torch
from radio_files import VARIANTS, any_content, find_checkout, with_any_content, write_checkpoint, write_text

from fus3dmaps_core.encoders import siglip2
from fus3dmaps_core.encoders.clip_dinoiser import network as clip_dinoiser
from fus3dmaps_core.encoders.clip_dinoiser.heads import DinoiserHeads
from fus3dmaps_core.encoders.radio import naradio, radseg
from fus3dmaps_core.encoders.radio.loading import RadioVariant
from fus3dmaps_core.encoders.radio.published import REVISION
from fus3dmaps_core.encoders.siglip_text import TextTower
from fus3dmaps_core.encoders.weights import WeightFile

MODELS = {"naradio": "vit_large_patch16_224", "radseg": "vit_base_patch16_224"}
BLOCKS = 4
VOCABULARY = 100


@dataclass(frozen=True)
class WeightsCache:
    """Where they are.

    Attributes:
        environment: Variables under which a process finds them as it finds published ones.
    """

    environment: dict[str, str]


def expect_random_weights(set_attribute: Callable[[Any, str, Any], None] = setattr) -> None:
    """Have the trios of this process take files of any content where they know a hash, and text towers of one block."""
    for module, variant in ((naradio, naradio.NARADIO), (radseg, radseg.RADSEG)):
        set_attribute(module, "ENCODER", _with_short_text(with_any_content(variant)).definition)
    set_attribute(siglip2, "TEXT", _short(siglip2.TEXT))
    set_attribute(siglip2, "MODEL", any_content(siglip2.MODEL))
    set_attribute(clip_dinoiser, "HEADS", any_content(clip_dinoiser.HEADS))


def write_weights(root: Path) -> WeightsCache:
    """Write random weights of all trios, always the same ones."""
    torch.manual_seed(17)
    with torch.inference_mode():
        _write_radio(root)
        _write_clip_dinoiser(root)
        _write_siglip2(root)
    return WeightsCache({"XDG_CACHE_HOME": str(root), "TORCH_HOME": str(root / "torch"), "HF_HOME": str(root / "hub")})


def _short(tower: TextTower) -> TextTower:
    return replace(tower, layers=1, vocabulary=VOCABULARY)


def _with_short_text(variant: RadioVariant) -> RadioVariant:
    return replace(variant, text=_short(variant.text))


def _write_radio(root: Path) -> None:
    checkout = find_checkout()
    hub = root / "torch" / "hub"
    hub.mkdir(parents=True)
    (hub / f"NVlabs_RADIO_{REVISION}").symlink_to(checkout, target_is_directory=True)
    for name, model in MODELS.items():
        variant = VARIANTS[name]
        write_checkpoint(_place(root, variant.radio), checkout, name, 1520, 3, model, depth=BLOCKS)
        write_text(root, _with_short_text(variant))
        for file in (variant.text.weights, variant.text.tokenizer):
            shutil.move(root / file.file_name, _place(root, file))


def _write_clip_dinoiser(root: Path) -> None:
    from safetensors.torch import save_file

    save_file(clip_dinoiser.build_clip().state_dict(), _place(root, clip_dinoiser.CLIP))
    torch.save(DinoiserHeads().state_dict(), _place(root, clip_dinoiser.HEADS))


def _write_siglip2(root: Path) -> None:
    from safetensors.torch import save_file

    model = siglip2_files.random_model(384, _short(siglip2.TEXT))
    save_file(siglip2_files.published_state(model), _place(root, siglip2.MODEL))
    siglip2_files.write_tokenizer(_place(root, siglip2.TOKENIZER))


def _place(root: Path, file: WeightFile) -> Path:
    """Return where a published file lies in the cache below a directory, and make its folder."""
    path = root / "fus3dmaps" / file.cached_path.parent.name / file.cached_path.name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
