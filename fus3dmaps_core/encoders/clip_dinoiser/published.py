"""The files of weights that this trio needs: where they are published, and under which licence."""

from __future__ import annotations

from fus3dmaps_core.encoders.weights import WeightFile

ARCHITECTURE = "ViT-B-16"
"""Name of the CLIP model in the package ``open_clip``."""

CLIP = WeightFile(
    title="CLIP ViT-B-16 laion2b_s34b_b88k",
    file_name="open_clip_model.safetensors",
    url="",
    hub="laion/CLIP-ViT-B-16-laion2B-s34B-b88K",
    revision="7288da5a0d6f0b51c4a2b27c624837a9236d0112",
    sha256="",
    licence="MIT",
)

_COMMIT = "a954aae6fb61f5ff18834e50a0c78a2258cd9afb"

HEADS = WeightFile(
    title="CLIP-DINOiser heads",
    file_name="last.pt",
    url=f"https://raw.githubusercontent.com/wysoczanska/clip_dinoiser/{_COMMIT}/checkpoints/last.pt",
    hub="",
    revision=_COMMIT,
    sha256="",
    licence="Apache-2.0",
    git_blob="0b6c94d9c439ebac7bcb07fe805be3654ea03c7f",
)
