"""The trio on its true architecture at full width, with random weights: shapes, spaces, plain numbers, and a whole map.

Only the vocabulary of the text tower is shortened, and most tests use a tower that was "trained" at 64 pixels, whose
position table is the one thing that differs from the published model's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from open_clip.zero_shot_metadata import SIMPLE_IMAGENET_TEMPLATES
from reference.siglip_vit import pooled_alone, tokens
from safetensors.torch import save_file
from siglip2_files import published_state, random_model, write_directory, write_tokenizer
from tokenizers import Tokenizer
from trio_maps import map_by_name, map_with_pooled_patches

from fus3dmaps_core.encoders import siglip2
from fus3dmaps_core.encoders.network_graphs import GraphEncoder
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.encoders.registry import load_text_encoder, load_trio
from fus3dmaps_core.encoders.siglip2.network import (
    CropNetwork,
    PatchNetwork,
    SiglipTokens,
    build_vision,
    read_vision,
)
from fus3dmaps_core.encoders.siglip2.published import MODEL, TEXT, TOKENIZER
from fus3dmaps_core.encoders.siglip_text import build_tower
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.masks import Masks

PATCH_PX, HEADS, LAYERS = 16, 12, 12
MEAN = STD = np.array([0.5, 0.5, 0.5])  # As published, not as the encoder says.
SIZE_PX = 64  # 4x4 positions.
SHORT_TEXT = replace(TEXT, vocabulary=100, layers=2)


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(7)
    return random_model(SIZE_PX, SHORT_TEXT)


@pytest.fixture(scope="module")
def directory(model, tmp_path_factory) -> Path:
    return write_directory(tmp_path_factory.mktemp("siglip2"), model)


@pytest.fixture(autouse=True)
def short_text(monkeypatch):
    monkeypatch.setattr(siglip2, "TEXT", SHORT_TEXT)


@pytest.fixture(scope="module")
def trio(directory) -> EncoderTrio:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(siglip2, "TEXT", SHORT_TEXT)
        return load_trio("siglip2", "cpu", 0.0, str(directory))


@pytest.fixture(scope="module")
def tower(model) -> SiglipTokens:
    return SiglipTokens(model.vision_model)


@pytest.fixture(scope="module")
def weights(model) -> dict[str, np.ndarray]:
    return {name: value.double().numpy() for name, value in model.vision_model.state_dict().items()}


def picture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    return rng.integers(0, 256, (height, width, 3)).astype(np.uint8)


def normalised(rgb: np.ndarray) -> np.ndarray:
    """Normalise an (H, W, 3) uint8 image as the network takes it: (3, H, W)."""
    return ((rgb / 255.0 - MEAN) / STD).transpose(2, 0, 1)


def test_the_architecture_is_the_published_one():
    vision = sum(parameter.numel() for parameter in build_vision(384).parameters())
    text = sum(parameter.numel() for parameter in build_tower(TEXT, "siglip2").parameters())
    assert (vision, text) == (93_176_064, 282_303_744)
    assert vision + text + 2 == 375_479_810  # Of the published file, with the loss's scale and bias.
    assert build_vision(384).config.hidden_act == "gelu_pytorch_tanh"


def test_the_published_size_runs_on_a_frame(rng):
    vision = build_vision(384).to_empty(device="cpu")
    for weight in vision.parameters():
        torch.nn.init.normal_(weight, std=0.02)
    made = siglip2.make_trio(SiglipTokens(vision), None, "cpu", 0.0)
    patches = made.patch.encode_patches(picture(rng, 480, 640))
    assert patches.embeddings.shape == (30, 40, 768)
    np.testing.assert_allclose(np.linalg.norm(patches.embeddings, axis=-1), 1, atol=1e-5)
    assert made.patch.graph(480, 640).shape == (1, 3, 480, 640)
    assert made.crop.graph(480, 640).shape[1:] == (3, 384, 384)


@pytest.mark.parametrize("size", [(64, 64), (100, 130), (1, 1), (96, 32)])
def test_patches_cover_images_of_any_size(trio, rng, size):
    patches = trio.patch.encode_patches(picture(rng, *size))
    grid = (-(-size[0] // 16), -(-size[1] // 16))
    assert trio.patch.grid(*size) == siglip2.CARD.grid(*size) == grid
    assert patches.embeddings.shape == (*grid, trio.dimension)
    assert patches.embeddings.dtype == patches.weights.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(patches.embeddings, axis=-1), 1, atol=1e-5)
    assert np.array_equal(patches.weights, np.ones(grid))


def test_patch_crop_and_text_are_of_one_space(trio, rng):
    rgb = picture(rng, 96, 128)
    masks = np.zeros((2, 96, 128), bool)
    masks[0, 10:60, 20:50] = masks[1, 95, 127] = True
    crops = trio.crop.encode_crops(rgb, Masks.from_masks(masks))
    texts = trio.text.encode_text(["a chair", "", "чашка ☕", "\ud800 broken"])
    assert (trio.name, trio.dimension, trio.variance_ratio, trio.logit_scale) == ("siglip2", 768, 1.0, 100.0)
    assert crops.shape == (2, 768)
    assert texts.shape == (4, 768)
    assert crops.dtype == texts.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(crops, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(texts, axis=1), 1, atol=1e-5)


def test_nothing_to_embed_gives_no_rows(trio):
    rgb = np.zeros((32, 32, 3), np.uint8)
    none = trio.crop.encode_crops(rgb, Masks(np.zeros((0, 32, 32), bool), np.zeros((0, 4), np.int32)))
    assert none.shape == trio.text.encode_text([]).shape == (0, 768)


@pytest.mark.parametrize("size", [(64, 64), (64, 96)])
def test_embeddings_are_plain_tokens_pooled_one_by_one(trio, weights, rng, size):
    rgb = picture(rng, *size)
    found = trio.patch.encode_patches(rgb).embeddings.reshape(-1, 768)
    for token, embedding in zip(tokens(normalised(rgb), weights, PATCH_PX, HEADS, LAYERS), found, strict=True):
        pooled = pooled_alone(token, weights, HEADS)
        np.testing.assert_allclose(embedding, pooled / np.linalg.norm(pooled), atol=1e-5)


def test_an_image_of_one_patch_is_embedded_as_a_whole(trio, model, rng):
    rgb = picture(rng, 16, 16)
    image = torch.from_numpy(normalised(rgb)).float()[None]
    with torch.inference_mode():
        whole = model.vision_model(image, interpolate_pos_encoding=True).pooler_output[0].numpy()
    patch = trio.patch.encode_patches(rgb).embeddings[0, 0]
    np.testing.assert_allclose(patch, whole / np.linalg.norm(whole), atol=1e-5)


def test_the_native_size_uses_the_trained_positions(tower, model, rng):
    image = torch.from_numpy(normalised(picture(rng, SIZE_PX, SIZE_PX))).float()[None]
    with torch.inference_mode():
        own = model.vision_model(image).last_hidden_state
        np.testing.assert_allclose(tower(image).numpy(), own.numpy(), atol=1e-5)


@pytest.mark.parametrize("patch", [(0, 0), (4, 7), (9, 13)])
def test_a_change_of_one_patch_moves_that_patch_most(trio, rng, patch):
    rgb = picture(rng, 160, 224)
    before = trio.patch.encode_patches(rgb).embeddings
    row, column = (PATCH_PX * index for index in patch)
    rgb[row : row + PATCH_PX, column : column + PATCH_PX] = picture(rng, PATCH_PX, PATCH_PX)
    moved = np.linalg.norm(trio.patch.encode_patches(rgb).embeddings - before, axis=-1)
    assert np.unravel_index(moved.argmax(), moved.shape) == patch


def test_a_batch_is_its_images(tower, rng):
    images = torch.from_numpy(np.stack([normalised(picture(rng, 96, 128)) for _ in range(3)])).float()
    for network in (PatchNetwork(tower).eval(), CropNetwork(tower).eval()):
        with torch.inference_mode():
            together = network(images)
            alone = torch.cat([network(image[None]) for image in images])
        np.testing.assert_allclose(together.numpy(), alone.numpy(), atol=1e-5)


def test_crops_are_the_models_own_embeddings_whatever_their_companions(trio, model, rng):
    rgb = picture(rng, 100, 200)
    masks = np.zeros((18, 100, 200), bool)  # More than a batch.
    for row in range(18):
        masks[row, 2 * row : 2 * row + SIZE_PX, 5 * row : 5 * row + SIZE_PX] = True
    masks = Masks.from_masks(masks)
    together = trio.crop.encode_crops(rgb, masks)
    for row in (0, 17):
        x0, y0, x1, y1 = masks.boxes[row]
        with torch.inference_mode():
            own = model.get_image_features(torch.from_numpy(normalised(rgb[y0:y1, x0:x1])).float()[None])
        own = getattr(own, "pooler_output", own)[0].numpy()
        np.testing.assert_allclose(together[row], own / np.linalg.norm(own), atol=1e-5)
        np.testing.assert_allclose(together[row], trio.crop.encode_crops(rgb, masks.take(np.array([row])))[0], atol=1e-5)


def test_a_text_is_the_mean_of_the_models_own_embeddings_of_its_templates(trio, model, directory):
    tokenizer = Tokenizer.from_file(str(directory / "tokenizer.json"))
    units = []
    for template in SIMPLE_IMAGENET_TEMPLATES:
        ids = [*tokenizer.encode(template("red cup").lower().replace(".", "")).ids, 1]
        ids = torch.tensor([ids + [0] * (64 - len(ids))])
        with torch.inference_mode():
            row = model.text_model(input_ids=ids).pooler_output[0].double().numpy()
        units.append(row / np.linalg.norm(row))
    assert len(units) == 7
    mean = np.mean(units, axis=0)
    np.testing.assert_allclose(trio.text.encode_text(["x", "Red CUP!"])[1], mean / np.linalg.norm(mean), atol=1e-5)


def test_bfloat16_stays_close(tower, trio, rng):
    rgb = picture(rng, 64, 96)
    half = SiglipTokens(build_vision(SIZE_PX).to_empty(device="cpu"))
    half.vision.load_state_dict(tower.vision.state_dict())
    half.vision.embeddings.position_ids = torch.arange(16)[None]
    coarse = siglip2.make_trio(half, None, "cpu", 0.0, torch.bfloat16).patch.encode_patches(rgb).embeddings
    assert coarse.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(coarse, axis=-1), 1, atol=1e-5)
    assert (coarse * trio.patch.encode_patches(rgb).embeddings).sum(axis=-1).min() > 0.99


def test_another_runtime_takes_the_networks_place(directory, rng):
    trio = load_trio("siglip2", "cpu", 0.0, str(directory))
    rgb, seen = picture(rng, 60, 90), []
    masks = np.zeros((1, 60, 90), bool)
    masks[0, 10:50, 20:70] = True
    masks = Masks.from_masks(masks)
    before = trio.patch.encode_patches(rgb).embeddings, trio.crop.encode_crops(rgb, masks)
    for encoder in (trio.patch, trio.crop):
        assert isinstance(encoder, GraphEncoder)
        graph = encoder.graph(60, 90)
        encoder.run_with(lambda images, graph=graph: (seen.append((graph, images.shape)), graph.network(images))[1:])
    after = trio.patch.encode_patches(rgb).embeddings, trio.crop.encode_crops(rgb, masks)
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))
    assert [graph.name for graph, _ in seen] == ["patch", "crop"]
    assert seen[0][0].shape == seen[0][1] == (1, 3, 64, 96)
    assert seen[1][0].shape[1:] == seen[1][1][1:] == (3, SIZE_PX, SIZE_PX)


def test_the_text_encoder_alone_is_the_trios(trio, directory):
    text = load_text_encoder("siglip2", "cpu", str(directory))
    assert np.array_equal(text.encode_text(["a cup"]), trio.text.encode_text(["a cup"]))


def test_a_safetensors_file_of_ones_own_goes_with_the_published_tokenizer(trio, model, tmp_path, monkeypatch, rng):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    TOKENIZER.cached_path.parent.mkdir(parents=True)
    write_tokenizer(TOKENIZER.cached_path)
    save_file(published_state(model), tmp_path / "mine.safetensors")
    loaded = load_trio("siglip2", "cpu", 0.0, str(tmp_path / "mine.safetensors"))
    rgb = picture(rng, 64, 96)
    assert np.array_equal(loaded.patch.encode_patches(rgb).embeddings, trio.patch.encode_patches(rgb).embeddings)
    assert np.array_equal(loaded.text.encode_text(["a cup"]), trio.text.encode_text(["a cup"]))


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"visual_projection.weight": torch.ones(1)}, "it has visual_projection.weight"),
        ({"text_model.head.bias": torch.ones(768), "logit_scale": torch.ones(1)}, "it has 0 positions"),
        ({"vision_model.embeddings.position_embedding.weight": torch.ones(15, 768)}, "it has 15 positions"),
    ],
)
def test_another_kind_of_model_is_refused(tmp_path, state, message):
    torch.save(state, tmp_path / "model.pt")
    with pytest.raises(EncoderError, match=rf"model\.pt': not a SigLIP 2 B/16 model of a fixed square size, {message}"):
        read_vision(tmp_path / "model.pt")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("vision_model.head.probe", None, r"SiglipVision\w+: 1 missing \(head\.probe\)"),
        (  # As in the NaFlex model, which cuts patches before the network.
            "vision_model.embeddings.patch_embedding.weight",
            torch.ones(768, 768),
            r"SiglipVision\w+: 1 of another shape \(embeddings\.patch_embedding\.weight \(768, 768\)",
        ),
        ("text_model.extra.bias", torch.ones(768), r"SiglipTextModel: 1 not expected \(.*extra\.bias\)"),
    ],
)
def test_weights_of_another_architecture_are_refused_by_name(model, tmp_path, name, value, message):
    state = {key: weight for key, weight in (published_state(model) | {name: value}).items() if weight is not None}
    torch.save(state, tmp_path / "model.pt")
    write_tokenizer(tmp_path / "tokenizer.json")
    with pytest.raises(EncoderError, match=rf"model\.pt': weights of another architecture than {message}"):
        load_trio("siglip2", "cpu", 0.0, str(tmp_path))


def test_a_file_of_the_published_name_must_have_the_published_hash(model, tmp_path):
    save_file(published_state(model), tmp_path / "model.safetensors")
    write_tokenizer(tmp_path / "tokenizer.json")
    with pytest.raises(EncoderError, match=rf"model\.safetensors' is altered.*not {MODEL.sha256}; download https://"):
        load_trio("siglip2", "cpu", 0.0, str(tmp_path))


@pytest.mark.parametrize("name", ["tokenizer.json", "model.safetensors"])
def test_files_that_are_not_there_are_named(tmp_path, name):
    if name == "tokenizer.json":
        torch.save({"logit_scale": torch.ones(1)}, tmp_path / "model.pt")
    else:
        write_tokenizer(tmp_path / "tokenizer.json")
    with pytest.raises(EncoderError, match=rf"encoder\.weights.*has no '{name}'; download https://huggingface"):
        load_trio("siglip2", "cpu", 0.0, str(tmp_path))


def test_a_path_to_nowhere_is_the_models():
    with pytest.raises(EncoderError, match=r"SigLIP 2 B/16 model: there is no file or directory 'nowhere\.safetensors'"):
        load_text_encoder("siglip2", "cpu", "nowhere.safetensors")


@pytest.mark.parametrize("name", ["mine.safetensors", "mine.pt"])
def test_a_damaged_file_is_named(tmp_path, monkeypatch, name):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    TOKENIZER.cached_path.parent.mkdir(parents=True)
    write_tokenizer(TOKENIZER.cached_path)
    (tmp_path / name).write_bytes(b"not weights" * 100)
    with pytest.raises(EncoderError, match=name):
        load_trio("siglip2", "cpu", 0.0, str(tmp_path / name))


def test_instances_of_pooled_patches_need_no_crop(trio, monkeypatch):
    map_with_pooled_patches(trio, monkeypatch)


def test_the_pipeline_maps_with_the_trio_that_one_parameter_names(directory, monkeypatch):
    map_by_name("siglip2", directory, 768, monkeypatch)
