"""The code and weights that the trios on RADIO need: where they are published, and under which licences."""

from __future__ import annotations

from fus3dmaps_core.encoders.siglip_text import TextTower
from fus3dmaps_core.encoders.weights import WeightFile

REPOSITORY = "NVlabs/RADIO"
REVISION = "c0f37017930e9dda53f93424cf4bf39fc51f287e"
CODE_LICENCE = "NVIDIA Source Code License for RADIO (research and evaluation only)"

RADIO_LARGE = WeightFile(
    title="RADIO v2.5-L",
    file_name="radio-v2.5-l_half.pth.tar",
    url="https://huggingface.co/nvidia/RADIO/resolve/main/radio-v2.5-l_half.pth.tar",
    hub="nvidia/RADIO",
    revision="main",
    sha256="50324e8cb086885126a896ad9ecbac46355cf0e4c1d8363763b01693a4618ff1",
    licence="NVIDIA Source Code License for RADIO (research and evaluation only)",
)

C_RADIO_BASE = WeightFile(
    title="C-RADIO v3-B",
    file_name="c-radio_v3-b_half.pth.tar",
    url="https://huggingface.co/nvidia/C-RADIOv3-B/resolve/main/c-radio_v3-b_half.pth.tar",
    hub="nvidia/C-RADIOv3-B",
    revision="main",
    sha256="",
    licence="NVIDIA Open Model License",
)


def _file(title: str, repository: tuple[str, str], name: str, sha256: str = "") -> WeightFile:
    hub, revision = repository
    return WeightFile(
        title=title,
        file_name=name,
        url=f"https://huggingface.co/{hub}/resolve/{revision}/{name}",
        hub=hub,
        revision=revision,
        sha256=sha256,
        licence="Apache-2.0",
    )


_SIGLIP = ("google/siglip-so400m-patch14-384", "9fdffc58afc957d1a03a25b10dba0329ab15c2a3")
_SIGLIP2 = ("google/siglip2-so400m-patch16-naflex", "cc24074f717b612951c2dead130904ab9b65a81e")

SIGLIP = TextTower(
    weights=_file(
        "SigLIP SO400M model",
        _SIGLIP,
        "model.safetensors",
        "ea2abad2b7f8a9c1aa5e49a244d5d57ffa71c56f720c94bc5d240ef4d6e1d94a",
    ),
    tokenizer=_file(
        "SigLIP SO400M tokenizer",
        _SIGLIP,
        "tokenizer.json",
        "c6e405cb7c670d56636a9402c81023a55bc6c3c53d89cf02b92f5c5005bfe920",
    ),
    vocabulary=32_000,
    end_id=1,
    pad_id=1,
)
"""The teacher of RADIO v2.5's adaptor ``siglip``."""

SIGLIP2 = TextTower(
    weights=_file("SigLIP 2 SO400M NaFlex model", _SIGLIP2, "model.safetensors"),
    tokenizer=_file("SigLIP 2 SO400M NaFlex tokenizer", _SIGLIP2, "tokenizer.json"),
    vocabulary=256_000,
    end_id=1,
    pad_id=0,
)
"""The teacher of C-RADIO v3-B's adaptor ``siglip2``; larger models' ``siglip2-g`` is another space, of 1536 dimensions."""
