"""Where RADIO's code and weights come from, and what is refused by name: other files, other adaptors, code in a file."""

from __future__ import annotations

import argparse
import os
import re
import shutil
from pathlib import Path
from urllib.error import URLError

import numpy as np
import pytest
import torch
from radio_files import VARIANTS, with_any_content, write_checkpoint

from fus3dmaps_core.encoders.radio import checkout as checkout_module
from fus3dmaps_core.encoders.radio.checkout import find_checkout, import_from
from fus3dmaps_core.encoders.radio.checkpoint import read_checkpoint
from fus3dmaps_core.encoders.radio.loading import load_networks, load_text_encoder, load_trio
from fus3dmaps_core.encoders.radio.naradio import NARADIO
from fus3dmaps_core.encoders.radio.published import REVISION
from fus3dmaps_core.encoders.radio.radseg import RADSEG
from fus3dmaps_core.encoders.registry import load_trio as load_by_name
from fus3dmaps_core.encoders.registry import names
from fus3dmaps_core.encoders.weights import find_weights
from fus3dmaps_core.errors import EncoderError


class Harmful:
    """Runs a command where a file is read as Python objects."""

    def __init__(self, witness: Path) -> None:
        self.witness = witness

    def __reduce__(self):
        return os.mkdir, (str(self.witness),)


@pytest.fixture
def content(loaded) -> dict:
    return torch.load(loaded.checkpoint, weights_only=False)


def test_both_trios_are_known_by_name():
    assert {"naradio", "radseg"} <= set(names())


def test_the_code_is_fetched_at_the_pinned_revision(monkeypatch, tmp_path, checkout):
    asked = []

    def fetch(name, **options):
        asked.append((name, options["trust_repo"]))
        shutil.copytree(
            checkout, tmp_path / "hub" / name.replace("/", "_").replace(":", "_"), ignore=shutil.ignore_patterns(".git")
        )

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(checkout_module, "check_reachable", lambda _: None)
    monkeypatch.setattr(torch.hub, "list", fetch)
    found = find_checkout("", "naradio")
    assert asked == [(f"NVlabs/RADIO:{REVISION}", True)]
    assert re.fullmatch("[0-9a-f]{40}", REVISION)  # A commit: branches and tags move.
    assert (found / "hubconf.py").is_file()
    assert find_checkout("", "naradio") == found  # From the cache.
    assert len(asked) == 1


def test_without_a_network_the_message_says_what_to_put_where(monkeypatch, tmp_path):
    def refuse(*_, **__):
        raise URLError("no network")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(checkout_module, "check_reachable", lambda _: None)
    monkeypatch.setattr(torch.hub, "list", refuse)
    with pytest.raises(EncoderError, match=rf"naradio.*no network.*{REVISION}\.zip.*NVlabs_RADIO_{REVISION}") as refusal:
        find_checkout("", "naradio")
    assert "\n" not in str(refusal.value)


def test_a_host_that_does_not_answer_is_not_waited_for(monkeypatch, tmp_path):
    def no_answer(address, timeout):
        raise TimeoutError(f"{address[0]} timed out after {timeout:.0f} s")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr("urllib.request.getproxies", dict)
    monkeypatch.setattr("socket.create_connection", no_answer)
    with pytest.raises(EncoderError, match=rf"github\.com timed out after 5 s.*{REVISION}\.zip"):
        find_checkout("", "naradio")


def test_another_package_of_the_same_name_is_not_mistaken_for_it(checkout, tmp_path):
    import_from(checkout, "radio.adaptor_module_factory", "naradio")
    (tmp_path / "radio").mkdir()
    (tmp_path / "radio" / "adaptor_module_factory.py").touch()
    with pytest.raises(EncoderError, match=r"radio\.adaptor_module_factory.*is in use"):
        import_from(tmp_path, "radio.adaptor_module_factory", "naradio")


def test_objects_in_a_file_are_refused_and_not_run(loaded, content, checkout, tmp_path):
    path, witness = tmp_path / "harmful.pth.tar", tmp_path / "witness"
    torch.save(content | {"extra": Harmful(witness)}, path)
    with pytest.raises(EncoderError, match=r"harmful\.pth\.tar.*Python objects") as refusal:
        read_checkpoint(path, checkout, loaded.variant.name)
    assert not witness.exists()
    assert "TORCH_FORCE_WEIGHTS_ONLY_LOAD" not in os.environ
    for advice in ("weights_only", "can still be loaded", "trust"):  # Torch's own, under which the command would run.
        assert advice not in str(refusal.value)


def test_a_damaged_file_is_refused(loaded, checkout, tmp_path):
    path = tmp_path / "short.pth.tar"
    path.write_bytes(loaded.checkpoint.read_bytes()[:5000])
    with pytest.raises(EncoderError, match=r"short\.pth\.tar"):
        read_checkpoint(path, checkout, loaded.variant.name)


def test_weights_of_something_else_are_refused(loaded, checkout, tmp_path):
    path = tmp_path / "other.pt"
    torch.save({"layer.weight": torch.zeros(2)}, path)
    with pytest.raises(EncoderError, match=r"other\.pt.*not a checkpoint of RADIO"):
        read_checkpoint(path, checkout, loaded.variant.name)


def test_missing_weights_are_named(loaded, content, checkout, tmp_path):
    path = tmp_path / "incomplete.pth.tar"
    del content["state_dict"]["base_model.blocks.2.attn.qkv.weight"]
    torch.save(content, path)
    with pytest.raises(EncoderError, match=r"incomplete.*1 missing \(blocks\.2\.attn\.qkv\.weight\)"):
        read_checkpoint(path, checkout, loaded.variant.name)


def test_a_checkpoint_without_the_adaptor_says_which_it_has(loaded, content, checkout, tmp_path):
    content["args"].teachers[1]["name"] = "another"
    torch.save(content, tmp_path / loaded.variant.radio.file_name)
    (tmp_path / "RADIO").symlink_to(checkout, target_is_directory=True)
    with pytest.raises(EncoderError, match=rf"'{loaded.variant.teacher}', this one has clip, another, dino_v2, sam"):
        load_networks(loaded.variant, str(tmp_path))


def test_a_missing_head_is_refused(loaded, content, checkout, tmp_path):
    content["state_dict"] = {key: value for key, value in content["state_dict"].items() if not key.startswith("_heads.1.")}
    torch.save(content, tmp_path / loaded.variant.radio.file_name)
    (tmp_path / "RADIO").symlink_to(checkout, target_is_directory=True)
    with pytest.raises(EncoderError, match="head of adaptor"):
        load_networks(loaded.variant, str(tmp_path))


def test_heads_named_after_their_teacher_are_found(loaded, content, checkout, tmp_path):
    teacher = content["args"].teachers[1]["name"]
    content["state_dict"] = {
        key.replace("_heads.1.", f"_heads.{teacher}."): value for key, value in content["state_dict"].items()
    }
    torch.save(content, tmp_path / loaded.variant.radio.file_name)
    (tmp_path / "RADIO").symlink_to(checkout, target_is_directory=True)
    _, head = load_networks(loaded.variant, str(tmp_path))
    features = torch.ones(1, loaded.radio.model.embed_dim)
    torch.testing.assert_close(head(features), loaded.trio.patch.network.head(features))


def test_all_teachers_may_share_one_summary_token(loaded, content, checkout, tmp_path):
    content["args"].cls_token_per_teacher = False
    torch.save(content, tmp_path / "shared.pth.tar")
    described = argparse.Namespace(**vars(content["args"]))
    network = import_from(checkout, "radio.radio_model", loaded.variant.name).create_model_from_args(described)
    content["state_dict"] |= {f"base_model.{key}": value for key, value in network.state_dict().items()}
    torch.save(content, tmp_path / loaded.variant.radio.file_name)
    (tmp_path / "RADIO").symlink_to(checkout, target_is_directory=True)
    assert load_networks(loaded.variant, str(tmp_path))[1].token == 0
    assert loaded.trio.crop.network.head.token == 1


def test_another_width_than_the_trios_is_refused(loaded, content, checkout, tmp_path):
    factory = import_from(checkout, "radio.adaptor_module_factory", loaded.variant.name)
    head = factory.create_mlp_from_config("v2", loaded.radio.model.embed_dim, 48, 640, 2)
    content["state_dict"] |= {f"_heads.1.{key}": value for key, value in head.state_dict().items()}
    torch.save(content, tmp_path / loaded.variant.radio.file_name)
    (tmp_path / "RADIO").symlink_to(checkout, target_is_directory=True)
    variant = loaded.variant
    with pytest.raises(EncoderError, match=rf"640 dimensions, encoder '{variant.name}' in {variant.dimension}"):
        load_networks(variant, str(tmp_path))


@pytest.mark.parametrize("name", ["model.safetensors", "tokenizer.json"])
def test_a_damaged_file_of_the_text_tower_is_named(loaded, tmp_path, name):
    for file in ("model.safetensors", "tokenizer.json"):
        shutil.copy(loaded.folder / file, tmp_path)
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:100])
    with pytest.raises(EncoderError, match=name):
        load_text_encoder(loaded.variant, "cpu", str(tmp_path))


def test_another_text_tower_is_refused(loaded):
    """The trio itself wants the published tower, which the narrow one is not."""
    with pytest.raises(EncoderError, match="another architecture than SiglipTextModel"):
        load_text_encoder(with_any_content(VARIANTS[loaded.variant.name]), "cpu", str(loaded.folder))


def test_files_of_a_published_name_and_hash_must_be_the_published_ones(loaded):
    published = VARIANTS[loaded.variant.name]
    with_hash = [file for file in (published.radio, published.text.weights, published.text.tokenizer) if file.sha256]
    assert len(with_hash) == {"naradio": 3, "radseg": 0}[loaded.variant.name]
    for known in with_hash:
        with pytest.raises(EncoderError, match=rf"altered or incomplete, its sha256 is .*not {known.sha256}"):
            find_weights("encoder.weights", str(loaded.folder), known)


@pytest.mark.parametrize("device", ["cuda:99", "abacus"])
def test_an_unusable_device_is_named(loaded, device):
    with pytest.raises(EncoderError, match=rf"encoder\.device.*{device}"):
        load_by_name(loaded.variant.name, device, 0.0, str(loaded.folder))


def test_a_directory_without_the_weights_says_so(loaded, checkout, tmp_path):
    (tmp_path / "RADIO").symlink_to(checkout, target_is_directory=True)
    with pytest.raises(EncoderError, match=rf"has no '{loaded.variant.radio.file_name}'"):
        load_trio(loaded.variant, "cpu", 0.0, str(tmp_path))


@pytest.mark.parametrize(
    ("variant", "model", "width", "parameters"),
    [(NARADIO, "vit_large_patch16_224", 1024, 319_881_216), (RADSEG, "vit_base_patch16_224", 768, 98_233_344)],
)
def test_the_published_transformers_run_at_full_width(checkout, tmp_path, rng, variant, model, width, parameters):
    """All blocks of RADIO v2.5-L and C-RADIO v3-B with their teachers' heads, random weights, a frame of 480x640."""
    torch.manual_seed(3)
    (tmp_path / "RADIO").symlink_to(checkout, target_is_directory=True)
    write_checkpoint(tmp_path / variant.radio.file_name, checkout, variant.name, 1520, 3, model)
    backbone, head = load_networks(with_any_content(variant), str(tmp_path))
    (tmp_path / variant.radio.file_name).unlink()
    assert sum(parameter.numel() for parameter in backbone.parameters()) == parameters
    with torch.inference_mode():
        features = backbone.patches(torch.from_numpy(rng.normal(size=(1, 3, 480, 640)).astype(np.float32)))
        assert features.shape == (1, 30, 40, width)
        assert head(features).shape == (1, 30, 40, 1152)
