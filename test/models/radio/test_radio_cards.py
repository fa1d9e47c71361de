"""Cards of the RADIO trios against the trios themselves, and that wrong weights are refused with what to get instead."""

from __future__ import annotations

import shutil

import pytest
import torch

from fus3dmaps_core.encoders.catalogue import catalogue
from fus3dmaps_core.encoders.radio.loading import load_networks
from fus3dmaps_core.encoders.registry import card
from fus3dmaps_core.errors import EncoderError


def test_the_card_says_what_the_encoders_say(loaded):
    own = loaded.variant.card
    assert (own.name, own.variance_ratio) == (loaded.trio.name, loaded.trio.variance_ratio)
    assert own.dimension == loaded.trio.dimension
    for size in ((480, 640), (1, 1), (17, 31), (240, 330)):
        assert own.grid(*size) == loaded.trio.patch.grid(*size)


def test_the_directory_that_loads_is_one_that_is_installed(loaded, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def missing() -> list[str]:
        return next(entry for entry in catalogue(str(folder)) if entry.name == loaded.variant.name).missing

    folder = tmp_path / "weights"
    shutil.copytree(loaded.folder, folder, symlinks=True)
    assert missing() == []
    (folder / "tokenizer.json").unlink()
    assert missing() == [f"{loaded.variant.text.tokenizer.title}: not found"]
    (folder / "RADIO").unlink()
    assert missing() == [f"{loaded.variant.text.tokenizer.title}: not found", "RADIO's code: not found"]


def other(content: dict) -> dict:
    return {"layer.weight": torch.zeros(2)}


def incomplete(content: dict) -> dict:
    del content["state_dict"]["base_model.blocks.2.attn.qkv.weight"]
    return content


@pytest.mark.parametrize(
    ("change", "said"), [(other, "not a checkpoint of RADIO"), (incomplete, "weights of another architecture")]
)
def test_wrong_weights_are_refused_with_where_to_get_the_right_ones(loaded, tmp_path, change, said):
    content = torch.load(loaded.checkpoint, weights_only=False)
    (tmp_path / "RADIO").symlink_to(loaded.folder / "RADIO", target_is_directory=True)
    torch.save(change(content), tmp_path / loaded.variant.radio.file_name)
    with pytest.raises(EncoderError, match=said) as refusal:
        load_networks(loaded.variant, str(tmp_path))
    published = card(loaded.variant.name).files[0]
    for part in (f"download {published.source}", str(published.cached_path), "encoder.weights"):
        assert part in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_checkpoint_that_is_cut_short_is_refused_before_it_is_read(loaded, tmp_path):
    (tmp_path / "RADIO").symlink_to(loaded.folder / "RADIO", target_is_directory=True)
    path = tmp_path / loaded.variant.radio.file_name
    path.write_bytes(loaded.checkpoint.read_bytes()[:-1000])
    with pytest.raises(EncoderError, match=r"cut short; download https://"):
        load_networks(loaded.variant, str(tmp_path))
