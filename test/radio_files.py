"""RADIO checkpoints with random weights, written as its authors publish theirs, and text towers to go with them."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import torch

from fus3dmaps_core.encoders.radio.checkout import import_from
from fus3dmaps_core.encoders.radio.loading import RadioVariant
from fus3dmaps_core.encoders.radio.naradio import NARADIO
from fus3dmaps_core.encoders.radio.published import REVISION
from fus3dmaps_core.encoders.radio.radseg import RADSEG
from fus3dmaps_core.encoders.weights import WeightFile

STAND_IN = Path(__file__).parent / "models" / "radio" / "stand_in"
TEACHERS = {
    "naradio": (("clip", "open_clip"), ("siglip", "open_clip"), ("dino_v2", "dino"), ("sam", "sam")),
    "radseg": (("clip", "open_clip"), ("siglip2", "siglip2"), ("dino_v2", "dino"), ("sam", "sam")),
}
VARIANTS = {"naradio": NARADIO, "radseg": RADSEG}
WORDS = "a an the of in red blue photo square cup game video"


def find_checkout() -> Path:
    """Find RADIO's own code on this machine, or else a stand-in of the same classes."""
    named = os.environ.get("FUS3DMAPS_RADIO_CHECKOUT")
    candidates = [Path(named)] if named else [Path(torch.hub.get_dir()) / f"NVlabs_RADIO_{REVISION}"]
    return next((path for path in candidates if (path / "hubconf.py").is_file()), STAND_IN)


def options(name: str, model: str, **model_options) -> argparse.Namespace:
    """Describe the networks of a checkpoint, as far as their construction asks for it."""
    return argparse.Namespace(
        model=model,
        model_kwargs=model_options,
        in_chans=None,
        input_size=None,
        pretrained=False,
        num_classes=0,
        drop=0.0,
        drop_path=None,
        drop_block=None,
        gp=None,
        bn_momentum=None,
        bn_eps=None,
        torchscript=False,
        initial_checkpoint="",
        cpe_max_size=2048,
        teachers=[{"name": teacher, "type": kind, "use_summary": teacher != "sam"} for teacher, kind in TEACHERS[name]],
        cls_token_per_teacher=True,
        register_multiple=8,
        mlp_version="v2",
        spectral_reparam=False,
        spectral_heads=False,
    )


def write_checkpoint(path: Path, checkout: Path, name: str, hidden: int, inner: int, model: str, **model_options) -> Path:
    """Write a checkpoint with random weights for the trio of this name."""
    described = options(name, model, **model_options)
    build = import_from(checkout, "radio.radio_model", name).create_model_from_args
    network = build(argparse.Namespace(**{**vars(described), "model_kwargs": dict(model_options)}))
    factory = import_from(checkout, "radio.adaptor_module_factory", name)
    state = {f"base_model.{key}": value for key, value in network.state_dict().items()}
    for index, _ in enumerate(described.teachers):
        # Every teacher's head has the trio's width, so that taking the wrong one is not found by its shape alone.
        head = factory.create_mlp_from_config("v2", network.embed_dim, hidden, VARIANTS[name].dimension, inner)
        state |= {f"_heads.{index}.{key}": value for key, value in head.state_dict().items()}
    state["input_conditioner.norm_mean"] = torch.tensor([0.48145466, 0.4578275, 0.40821073]).reshape(3, 1, 1)
    state["input_conditioner.norm_std"] = torch.tensor([0.26862954, 0.26130258, 0.27577711]).reshape(3, 1, 1)
    torch.save({"state_dict": state, "args": described}, path)
    return path


def with_norms(path: Path) -> Path:
    """Rewrite a checkpoint as one with a final norm and a feature normalizer, under the names that RADIO has for them.

    Without them both are identities, and layer scales are all the same: what is left out or exchanged would not show.
    """
    content = torch.load(path, weights_only=False)
    state, described = content["state_dict"], content["args"]
    width = state["base_model.blocks.0.norm1.weight"].shape[0]
    described.model_norm = True
    state["base_model.norm.weight"], state["base_model.norm.bias"] = 1 + 0.3 * torch.randn(width), 0.3 * torch.randn(width)
    state["_feature_normalizer.mean"] = 0.3 * torch.randn(width)
    state["_feature_normalizer.tx"] = torch.linalg.qr(torch.randn(width, width))[0] * (0.5 + torch.rand(width, 1))
    for name in state:
        if name.endswith((".norm1.weight", ".norm2.weight", ".ls1.gamma", ".ls2.gamma")):
            state[name] = 0.5 + torch.rand(width)
    torch.save(content, path)
    return path


def any_content(file: WeightFile) -> WeightFile:
    """Return the file without its hash: random weights have no published one."""
    return replace(file, sha256="", git_blob="")


def with_any_content(variant: RadioVariant) -> RadioVariant:
    """Return the variant with files that may hold random weights."""
    text = replace(variant.text, weights=any_content(variant.text.weights), tokenizer=any_content(variant.text.tokenizer))
    return replace(variant, radio=any_content(variant.radio), text=text)


def small_text_variant(name: str) -> RadioVariant:
    """Return the variant with a narrow text tower of the same class, and files of any content."""
    variant = with_any_content(VARIANTS[name])
    return replace(variant, text=replace(variant.text, vocabulary=100, width=32, hidden=64, layers=2, heads=2))


def write_text(folder: Path, variant: RadioVariant, lengths_differ: bool = False) -> torch.nn.Module:
    """Write files of a text tower with random weights, and of a tokenizer with a few words; return the tower.

    Args:
        folder: Where to.
        variant: Whose tower.
        lengths_differ: Whether embeddings of sentences differ in length by factors. In a tower of random weights they do
            not, and neither do their directions.
    """
    from safetensors.torch import save_file
    from tokenizers import Tokenizer, models, pre_tokenizers

    from fus3dmaps_core.encoders.siglip_text import build_tower

    tower = build_tower(variant.text, variant.name).to_empty(device="cpu")
    for weight in tower.parameters():
        torch.nn.init.normal_(weight, std=0.2)
    if lengths_differ:
        _spread(tower, variant)
    others = {"logit_scale": torch.zeros(1), "vision_model.post_layernorm.weight": torch.ones(4)}
    state = {f"text_model.{key.removeprefix('text_model.')}": value for key, value in tower.state_dict().items()}
    save_file(state | others, folder / "model.safetensors")
    words = {word: place for place, word in enumerate(["<pad>", "<eos>", "<unk>", *WORDS.split()])}
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))
    return tower


def _spread(tower: torch.nn.Module, variant: RadioVariant) -> None:
    """Draw weights in which sentences have more influence; the bias at the end takes away what they have in common."""
    weights = dict(tower.named_parameters())
    for name, weight in weights.items():
        torch.nn.init.normal_(weight, mean=1.0 if name.endswith("norm.weight") else 0.0)
    words, context = 3 + len(WORDS.split()), variant.text.context
    rows = [
        [*torch.randint(2, words, (count,)).tolist(), variant.text.end_id] + [variant.text.pad_id] * (context - count - 1)
        for count in range(4, 20)
    ]
    with torch.no_grad():
        embeddings = tower(input_ids=torch.tensor(rows), position_ids=torch.arange(context)[None]).pooler_output
        next(weight for name, weight in weights.items() if name.endswith("head.bias")).sub_(embeddings.mean(dim=0))
