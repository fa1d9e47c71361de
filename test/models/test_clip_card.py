"""The card of the trio ``clip_dinoiser`` against its true architecture, and wrong weights with what to get instead."""

from __future__ import annotations

import pytest
from safetensors.torch import save_file
from torch import nn

from fus3dmaps_core.encoders.clip_dinoiser import CARD
from fus3dmaps_core.encoders.clip_dinoiser.network import build_clip, load_clip, load_heads
from fus3dmaps_core.encoders.clip_dinoiser.published import CLIP, HEADS
from fus3dmaps_core.errors import EncoderError


def test_the_card_says_what_the_architecture_has():
    visual = build_clip().visual
    assert tuple(visual.patch_size) == (CARD.patch_px, CARD.patch_px)
    assert visual.output_dim == CARD.dimension


@pytest.mark.parametrize(("load", "name", "file"), [(load_clip, "open_clip_model", CLIP), (load_heads, "last", HEADS)])
def test_another_networks_weights_are_refused_with_where_to_get_the_right_ones(tmp_path, load, name, file):
    save_file(nn.Linear(3, 2).state_dict(), tmp_path / f"{name}.safetensors")
    # As the converted file of one's own; under the published name the heads would be refused by their hash.
    with pytest.raises(EncoderError, match="another architecture") as refusal:
        load(str(tmp_path))
    for part in (f"download {file.source}", str(file.cached_path), "encoder.weights"):
        assert part in str(refusal.value)
    assert "\n" not in str(refusal.value)
