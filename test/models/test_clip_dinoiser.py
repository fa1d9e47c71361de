"""The trio on its true architecture at full width, with random weights: shapes, spaces, plain numbers, and a whole map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from reference.clip_vit import patch_features
from safetensors.torch import save_file
from trio_maps import map_by_name, map_with_pooled_patches

from fus3dmaps_core.encoders.clip_dinoiser import make_trio
from fus3dmaps_core.encoders.clip_dinoiser.heads import DinoiserHeads
from fus3dmaps_core.encoders.clip_dinoiser.network import ClipDinoiser, build_clip
from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.encoders.registry import load_text_encoder, load_trio
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.masks import Masks

PATCH_PX, HEADS, LAYERS = 16, 12, 12
# What the authors of CLIP and of CLIP-DINOiser published, not what the encoder says of it.
MEAN, STD = np.array([0.48145466, 0.4578275, 0.40821073]), np.array([0.26862954, 0.26130258, 0.27577711])
THRESHOLD = 0.2


@pytest.fixture(scope="module")
def clip():
    torch.manual_seed(7)
    return build_clip()


@pytest.fixture(scope="module")
def heads() -> DinoiserHeads:
    torch.manual_seed(8)
    return DinoiserHeads().eval().requires_grad_(False)


@pytest.fixture(scope="module")
def network(clip, heads) -> ClipDinoiser:
    return ClipDinoiser(clip.visual, heads)


@pytest.fixture(scope="module")
def trio(clip, heads) -> EncoderTrio:
    return make_trio(clip, heads, "cpu", 0.05)


@pytest.fixture(scope="module")
def directory(clip, heads, tmp_path_factory) -> Path:
    """Write weights of one's own, as `encoder.weights` takes them."""
    folder = tmp_path_factory.mktemp("weights")
    save_file(clip.state_dict(), folder / "open_clip_model.safetensors")
    save_file(heads.state_dict(), folder / "last.safetensors")
    return folder


def picture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    return rng.integers(0, 256, (height, width, 3)).astype(np.uint8)


def normalised(rgb: np.ndarray) -> np.ndarray:
    """Normalise an (H, W, 3) uint8 image as the network takes it: (3, H, W)."""
    return ((rgb / 255.0 - MEAN) / STD).transpose(2, 0, 1)


def test_the_architecture_is_the_published_one(clip, heads):
    assert sum(parameter.numel() for parameter in clip.visual.parameters()) == 86_192_640
    assert sum(parameter.numel() for parameter in clip.parameters()) == 149_620_737
    assert {name: tuple(value.shape) for name, value in heads.state_dict().items()} == {
        "obj_proj.weight": (256, 768, 3, 3),
        "obj_proj.bias": (256,),
        "bkg_decoder.weight": (1, 768, 1, 1),
        "bkg_decoder.bias": (1,),
    }


@pytest.mark.parametrize(
    ("size", "grid"), [((480, 640), (30, 40)), ((224, 224), (14, 14)), ((100, 130), (7, 9)), ((1, 1), (1, 1))]
)
def test_patches_cover_images_of_any_size(trio, rng, size, grid):
    patches = trio.patch.encode_patches(picture(rng, *size))
    assert trio.patch.grid(*size) == grid
    assert patches.embeddings.shape == (*grid, trio.dimension)
    assert patches.weights.shape == grid
    assert patches.embeddings.dtype == patches.weights.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(patches.embeddings, axis=-1), 1, atol=1e-5)
    assert patches.weights.min() >= 0
    assert patches.weights.max() <= 1


def test_patch_crop_and_text_are_of_one_space(trio, rng):
    rgb = picture(rng, 96, 128)
    masks = np.zeros((2, 96, 128), bool)
    masks[0, 10:60, 20:50] = masks[1, 95, 127] = True
    crops = trio.crop.encode_crops(rgb, Masks.from_masks(masks))
    texts = trio.text.encode_text(["a chair", "", "чашка ☕", "\ud800 broken"])
    assert (trio.name, trio.dimension, trio.variance_ratio, trio.logit_scale) == ("clip_dinoiser", 512, 5.0, 100.0)
    assert crops.shape == (2, 512)
    assert texts.shape == (4, 512)
    assert crops.dtype == texts.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(crops, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(texts, axis=1), 1, atol=1e-5)


def test_nothing_to_embed_gives_no_rows(trio):
    rgb = np.zeros((32, 32, 3), np.uint8)
    none = trio.crop.encode_crops(rgb, Masks(np.zeros((0, 32, 32), bool), np.zeros((0, 4), np.int32)))
    assert none.shape == trio.text.encode_text([]).shape == (0, 512)


@pytest.mark.parametrize("size", [(64, 96), (224, 224)])
def test_the_value_path_is_the_plain_ones(network, rng, size):
    image = normalised(picture(rng, *size))
    weights = {name: value.double().numpy() for name, value in network.maskclip.visual.state_dict().items()}
    projected, intermediate = patch_features(image, weights, PATCH_PX, HEADS, LAYERS)
    with torch.inference_mode():
        found = network.maskclip(torch.from_numpy(image).float()[None])
    np.testing.assert_allclose(found.projected[0].numpy(), projected, atol=1e-4 * np.abs(projected).max())
    np.testing.assert_allclose(found.intermediate[0].numpy(), intermediate, atol=1e-4 * np.abs(intermediate).max())


def plain_heads(features: np.ndarray, weights: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Compute correlations (patches, patches) and saliency (rows, columns) of (width, rows, columns) features."""
    _, rows, columns = features.shape
    padded = np.pad(features, ((0, 0), (1, 1), (1, 1)), mode="edge")
    projected = weights["obj_proj.bias"][:, None, None] + sum(
        np.einsum("ow,wrc->orc", weights["obj_proj.weight"][:, :, y, x], padded[:, y : y + rows, x : x + columns])
        for y in range(3)
        for x in range(3)
    )
    units = (projected / np.linalg.norm(projected, axis=0)).reshape(-1, rows * columns)
    directions = features / np.linalg.norm(features, axis=0)
    logits = np.einsum("w,wrc->rc", weights["bkg_decoder.weight"][0, :, 0, 0], directions) + weights["bkg_decoder.bias"]
    return units.T @ units, 1 / (1 + np.exp(-logits))


def test_embeddings_are_plain_features_pooled_in_loops(trio, network, heads, rng):
    rgb = picture(rng, 64, 96)
    weights = {name: value.double().numpy() for name, value in network.maskclip.visual.state_dict().items()}
    projected, intermediate = patch_features(normalised(rgb), weights, PATCH_PX, HEADS, LAYERS)
    in_heads = {name: value.double().numpy() for name, value in heads.state_dict().items()}
    correlations, saliency = plain_heads(intermediate, in_heads)
    features = projected.reshape(512, -1).T
    patches = trio.patch.encode_patches(rgb)
    for patch, embedding in enumerate(patches.embeddings.reshape(-1, 512)):
        alike = [other for other in range(len(features)) if correlations[patch, other] >= THRESHOLD]
        pooled = sum(correlations[patch, other] * features[other] for other in alike)
        np.testing.assert_allclose(embedding, pooled / np.linalg.norm(pooled), atol=1e-4)
    np.testing.assert_allclose(patches.weights, saliency, atol=1e-4)


def test_the_native_size_uses_the_trained_positions(network):
    positions = network.maskclip.positions(14, 14)
    np.testing.assert_allclose(positions.numpy(), network.maskclip.visual.positional_embedding.numpy(), atol=1e-6)


@pytest.mark.parametrize("patch", [(0, 0), (4, 7), (9, 13)])
def test_a_change_of_one_patch_moves_that_patch_most(trio, rng, patch):
    rgb = picture(rng, 160, 224)
    before = trio.patch.encode_patches(rgb).embeddings
    row, column = (PATCH_PX * index for index in patch)
    rgb[row : row + PATCH_PX, column : column + PATCH_PX] = picture(rng, PATCH_PX, PATCH_PX)
    moved = np.linalg.norm(trio.patch.encode_patches(rgb).embeddings - before, axis=-1)
    assert np.unravel_index(moved.argmax(), moved.shape) == patch


def test_a_batch_is_its_images(network, rng):
    images = torch.from_numpy(np.stack([normalised(picture(rng, 96, 128)) for _ in range(3)])).float()
    with torch.inference_mode():
        together = network(images)
        alone = [network(image[None]) for image in images]
    for part in (0, 1):
        np.testing.assert_allclose(together[part].numpy(), np.concatenate([one[part].numpy() for one in alone]), atol=1e-5)


def test_crops_are_clips_own_embeddings_whatever_their_companions(trio, clip, rng):
    rgb = picture(rng, 300, 400)
    masks = np.zeros((18, 300, 400), bool)  # More than a batch.
    for row in range(18):
        masks[row, 2 * row : 2 * row + 224, 5 * row : 5 * row + 224] = True
    masks = Masks.from_masks(masks)
    trio_without_padding = make_trio(clip, DinoiserHeads().requires_grad_(False), "cpu", 0.0)
    together = trio_without_padding.crop.encode_crops(rgb, masks)
    for row in (0, 17):
        x0, y0, x1, y1 = masks.boxes[row]
        with torch.inference_mode():
            own = clip.encode_image(torch.from_numpy(normalised(rgb[y0:y1, x0:x1])).float()[None], normalize=True)
        np.testing.assert_allclose(together[row], own[0].numpy(), atol=1e-5)
        alone = trio_without_padding.crop.encode_crops(rgb, masks.take(np.array([row])))
        np.testing.assert_allclose(together[row], alone[0], atol=1e-5)


def test_a_text_is_the_mean_of_clips_embeddings_of_its_templates(trio, clip):
    import open_clip

    sentences = [template("green armchair") for template in open_clip.OPENAI_IMAGENET_TEMPLATES]
    assert len(sentences) == 80
    with torch.inference_mode():
        each = clip.encode_text(open_clip.get_tokenizer("ViT-B-16")(sentences), normalize=True).numpy()
    mean = each.mean(axis=0)
    expected = mean / np.linalg.norm(mean)
    np.testing.assert_allclose(trio.text.encode_text(["x", "green armchair"])[1], expected, atol=1e-5)


def test_a_long_text_is_cut_where_clip_cuts_it(trio):
    tokens = trio.text._tokenizer(["cup " * 100, "cup"])
    assert tokens.shape == (2, 77)
    assert tokens[0, 76] == tokens[1, 2] == 49_407  # The end stays.


def test_weights_of_a_directory_make_the_same_trio(trio, directory, rng):
    loaded = load_trio("clip_dinoiser", "cpu", 0.05, str(directory))
    rgb = picture(rng, 64, 96)
    assert np.array_equal(loaded.patch.encode_patches(rgb).embeddings, trio.patch.encode_patches(rgb).embeddings)
    text = load_text_encoder("clip_dinoiser", "cpu", str(directory))
    assert np.array_equal(text.encode_text(["a cup"]), trio.text.encode_text(["a cup"]))


def test_weights_of_another_architecture_are_refused(directory, heads, tmp_path):
    save_file(heads.state_dict(), tmp_path / "open_clip_model.safetensors")
    with pytest.raises(EncoderError, match=r"open_clip_model\.safetensors.*another architecture than CLIP.*missing"):
        load_trio("clip_dinoiser", "cpu", 0.05, str(tmp_path))


def test_weights_that_are_not_there_are_named(tmp_path):
    with pytest.raises(EncoderError, match=r"encoder\.weights.*open_clip_model\.safetensors.*download https://huggingface"):
        load_trio("clip_dinoiser", "cpu", 0.05, str(tmp_path))


def test_instances_of_pooled_patches_need_no_crop(trio, monkeypatch):
    map_with_pooled_patches(trio, monkeypatch)


def test_the_pipeline_maps_with_the_trio_that_one_parameter_names(directory, monkeypatch):
    map_by_name("clip_dinoiser", directory, 512, monkeypatch)
