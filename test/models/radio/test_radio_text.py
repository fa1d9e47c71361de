"""SigLIP's text towers: templates, padding, plain means, and the true sizes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from open_clip.zero_shot_metadata import OPENAI_IMAGENET_TEMPLATES
from tokenizers import Tokenizer

from fus3dmaps_core.encoders import siglip_text
from fus3dmaps_core.encoders.radio.loading import load_text_encoder
from fus3dmaps_core.encoders.radio.naradio import NARADIO
from fus3dmaps_core.encoders.radio.radseg import RADSEG
from fus3dmaps_core.encoders.siglip2.published import TEXT
from fus3dmaps_core.encoders.siglip_text import SiglipTextEncoder, build_tower, canonical, read_text


def test_a_prompt_is_the_unit_mean_of_its_unit_sentences(loaded):
    tokenizer = Tokenizer.from_file(str(loaded.folder / "tokenizer.json"))
    rows = []
    for template in OPENAI_IMAGENET_TEMPLATES:
        sentence = template("red cup").lower().replace(".", "").replace("-", "")
        ids = [*tokenizer.encode(sentence).ids, 1]
        ids = torch.tensor([ids + [loaded.variant.text.pad_id] * (64 - len(ids))])
        with torch.inference_mode():
            rows.append(loaded.tower(input_ids=ids, position_ids=torch.arange(64)[None]).pooler_output[0].double().numpy())
    lengths = np.linalg.norm(rows, axis=1)
    assert len(rows) == 80
    assert lengths.max() > 1.5 * lengths.min()  # Long ones would outweigh short ones.
    mean = np.mean(rows / lengths[:, None], axis=0)
    expected = mean / np.linalg.norm(mean)
    np.testing.assert_allclose(loaded.trio.text.encode_text(["Red cup!"])[0], expected, atol=1e-5)


def test_any_text_is_embedded_and_none_depends_on_the_others(loaded):
    prompts = ["a cup", "", "  ", "чашка кофе", "咖啡杯☕", "\ud800 broken", "nul \x00 here", "cup " * 500]
    rows = loaded.trio.text.encode_text(prompts)
    assert rows.shape == (len(prompts), loaded.trio.dimension)
    assert rows.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(loaded.trio.text.encode_text(prompts[3:4])[0], rows[3], atol=1e-5)


def test_the_text_encoder_alone_is_the_trios_and_needs_nothing_of_radio(loaded, tmp_path):
    for name in ("model.safetensors", "tokenizer.json"):
        (tmp_path / name).symlink_to(loaded.folder / name)
    alone = load_text_encoder(loaded.variant, "cpu", str(tmp_path))
    assert np.array_equal(alone.encode_text(["a blue cup"]), loaded.trio.text.encode_text(["a blue cup"]))


def test_text_is_brought_into_the_form_of_the_training():
    assert canonical("A photo of my  Living_Room's (big) TV-set.") == "a photo of my living rooms big tvset"


def test_the_end_of_what_is_too_long_stays(loaded):
    tokens = loaded.trio.text._tokens(["cup " * 100, "cup", ""])
    assert tokens.shape == (3, 64)
    assert (tokens[0, :63] == tokens[0, 0]).all()
    assert tokens[0, 63] == tokens[1, 1] == tokens[2, 0] == 1
    assert (tokens[1, 2:] == loaded.variant.text.pad_id).all()


@pytest.mark.parametrize(("variant", "vocabulary"), [(NARADIO, 32_000), (RADSEG, 256_000)])
def test_the_published_towers_have_their_published_sizes(variant, vocabulary):
    tower = build_tower(variant.text, variant.name)
    width, hidden = 1152, 4304
    block = 4 * (width + 1) * width + (2 * hidden + 1) * width + hidden + 4 * width
    rest = (vocabulary + 64 + 2) * width + (width + 1) * variant.dimension
    assert sum(parameter.numel() for parameter in tower.parameters()) == 27 * block + rest
    assert tower.config.hidden_act == "gelu_pytorch_tanh"


@pytest.mark.parametrize(
    ("text", "sentences", "slow"), [(NARADIO.text, 80, True), (RADSEG.text, 80, True), (TEXT, 7, False)]
)
def test_towers_are_slow_by_the_products_of_a_prompt(text, sentences, slow):
    layers = [part for name, part in build_tower(text, "some").named_modules() if ".layers." in name]
    weights = sum(part.weight.numel() for part in layers if isinstance(part, torch.nn.Linear))
    products = SiglipTextEncoder(None, None, text, "cpu", "some").products
    assert products == weights * 64 * sentences
    assert (products > siglip_text._SLOW_PRODUCTS) == slow


@pytest.mark.parametrize(("device", "slow", "warned"), [("cpu", 1.0, True), ("cpu", 1e12, False), ("meta", 1.0, False)])
def test_who_asks_a_large_tower_on_the_processor_is_told_to_wait(loaded, monkeypatch, caplog, device, slow, warned):
    """A device without values stands for all that are not the processor."""
    monkeypatch.setattr(siglip_text, "_SLOW_PRODUCTS", slow)
    files = loaded.folder / "model.safetensors", loaded.folder / "tokenizer.json"
    read_text(loaded.variant.text, *files, device, loaded.variant.name)
    lines = [record.message for record in caplog.records if "on the CPU" in record.message]
    assert len(lines) == warned
    assert all(f"encoder '{loaded.variant.name}'" in line and "'encoder.device'" in line for line in lines)
