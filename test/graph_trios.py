"""Every trio with random weights, narrow and for small crops, and a toy one for what does not depend on the network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from radio_files import find_checkout, small_text_variant, with_norms, write_checkpoint, write_text
from siglip2_files import random_model, write_directory
from torch import nn
from torch.nn import functional

from fus3dmaps_core.encoders import siglip2
from fus3dmaps_core.encoders.clip_dinoiser import make_trio
from fus3dmaps_core.encoders.clip_dinoiser.heads import DinoiserHeads
from fus3dmaps_core.encoders.network_graphs import Graph, Network
from fus3dmaps_core.encoders.protocols import EncoderTrio, PatchEmbeddings
from fus3dmaps_core.encoders.radio import loading
from fus3dmaps_core.encoders.siglip2 import published as siglip2_published
from fus3dmaps_core.encoders.siglip2.network import read_vision
from fus3dmaps_core.encoders.siglip_text import read_text
from fus3dmaps_core.masks import Masks

TRIOS = ("lite", "clip_dinoiser", "naradio", "radseg", "siglip2")
HEIGHT, WIDTH = 100, 150  # No multiples of a patch.
CROP_PX = 64


def narrow_clip_dinoiser() -> EncoderTrio:
    """Make a narrow trio: the heads need the full width of 768, but there are 3 blocks in place of 12."""
    from open_clip.model import CLIP

    torch.manual_seed(7)
    vision = {"image_size": CROP_PX, "layers": 3, "width": 768, "patch_size": 16}
    text = {"context_length": 77, "vocab_size": 49408, "width": 32, "heads": 2, "layers": 1}
    clip = CLIP(embed_dim=512, vision_cfg=vision, text_cfg=text).eval().requires_grad_(False)
    return make_trio(clip, DinoiserHeads().eval().requires_grad_(False), "cpu", 0.05)


def narrow_radio(name: str, folder: Path) -> EncoderTrio:
    torch.manual_seed(11)
    checkout, variant = find_checkout(), replace(small_text_variant(name), crop_px=CROP_PX)
    (folder / "RADIO").symlink_to(checkout, target_is_directory=True)
    with_norms(write_checkpoint(folder / variant.radio.file_name, checkout, name, 48, 2, "vit_tiny_patch16_224", depth=3))
    write_text(folder, variant)
    return loading.load_trio(variant, "cpu", 0.05, str(folder))


def narrow_siglip2(folder: Path) -> EncoderTrio:
    """Make a narrow trio: an embedding has the full width of 768, but there are 3 blocks in place of 12."""
    torch.manual_seed(13)
    text = replace(siglip2_published.TEXT, vocabulary=40, width=32, hidden=48, layers=1, heads=2)
    write_directory(folder, random_model(CROP_PX, text))
    tokens = read_vision(folder / "model.pt")
    tokens.vision.encoder.layers = tokens.vision.encoder.layers[:3]
    reader = read_text(text, folder / "model.pt", folder / "tokenizer.json", "cpu", "siglip2")
    return siglip2.make_trio(tokens, reader, "cpu", 0.05)


def boxes(count: int) -> Masks:
    masks = np.zeros((count, HEIGHT, WIDTH), bool)
    for place, mask in enumerate(masks):
        mask[place : place + 50, 3 * place : 3 * place + 70] = True
    return Masks.from_masks(masks)


class ToyNetwork(nn.Module):
    """Unit embeddings of 8-pixel patches by one layer, and a saliency."""

    def __init__(self, seed: int, scale: float = 1.0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.conv = nn.Conv2d(3, 16, 8, 8, bias=False).requires_grad_(False)
        self.conv.weight.copy_(scale * torch.randn(self.conv.weight.shape, generator=generator))
        self.mix = nn.Parameter(torch.randn(16, 16, generator=generator), requires_grad=False)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        patches = self.conv(images.to(self.mix.dtype)).permute(0, 2, 3, 1) @ self.mix
        return functional.normalize(patches.float(), dim=3), torch.sigmoid(patches.float().mean(dim=3))


class ToyCrops(nn.Module):
    def __init__(self, patches: ToyNetwork) -> None:
        super().__init__()
        self.patches = patches

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return functional.normalize(self.patches(images)[0].mean(dim=(1, 2)), dim=1)


class ToyPatchEncoder:
    def __init__(self, network: ToyNetwork) -> None:
        self._network: nn.Module = network
        self.run: Network = network

    def grid(self, height: int, width: int) -> tuple[int, int]:
        return height // 8, width // 8

    def encode_patches(self, rgb: np.ndarray) -> PatchEmbeddings:
        with torch.inference_mode():
            embeddings, saliency = self.run(torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255)
        return PatchEmbeddings(embeddings[0].numpy(), saliency[0].numpy())

    def graph(self, height: int, width: int) -> Graph:
        return Graph("patch", self._network, (1, 3, height, width), ("embeddings", "saliency"))

    def run_with(self, network: Network) -> None:
        self.run = network


class ToyCropEncoder(ToyPatchEncoder):
    def __init__(self, network: ToyNetwork) -> None:
        super().__init__(network)
        self._network = self.run = ToyCrops(network)

    def encode_crops(self, rgb: np.ndarray, masks: Masks) -> np.ndarray:
        crops = [rgb[y : y + 16, x : x + 16] for x, y, _, _ in masks.boxes]
        images = torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float() / 255
        with torch.inference_mode():
            return torch.cat([self.run(batch) for batch in images.split(4)]).numpy()

    def graph(self, height: int, width: int) -> Graph:
        return Graph("crop", self._network, (4, 3, 16, 16), ("embeddings",))


class NoText:
    space = "toy"

    def encode_text(self, prompts):
        return np.zeros((len(prompts), 16), np.float32)


def toy_trio(seed: int = 1, scale: float = 1.0) -> EncoderTrio:
    network = ToyNetwork(seed, scale).eval()
    return EncoderTrio("toy", 16, 1.0, 100.0, ToyPatchEncoder(network), ToyCropEncoder(network), NoText())
