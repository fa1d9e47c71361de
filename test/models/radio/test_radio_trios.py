"""The trios on RADIO with random weights: shapes, spaces, normalisation, plain numbers, and the whole pipeline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.radio_attention import LAYER_EPSILON, gelu, last_block, layer_norm, neighbourhood, project, recursive
from stand_ins import ColorSegmenter, wall_frame
from trio_maps import map_with_pooled_patches

from fus3dmaps_core.answers.query import TextQuery, answer_query
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.encoders.radio.loading import load_networks, make_trio
from fus3dmaps_core.encoders.radio.naradio import NARADIO
from fus3dmaps_core.encoders.radio.radseg import RADSEG
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.pipeline import Pipeline

TEACHER = 1  # The trio's teacher is the second of the checkpoint's, and so is its summary token.
MEAN, STD = np.array([0.48145466, 0.4578275, 0.40821073]), np.array([0.26862954, 0.26130258, 0.27577711])


def picture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    return rng.integers(0, 256, (height, width, 3)).astype(np.uint8)


def whole(height: int, width: int) -> Masks:
    return Masks.from_masks(np.ones((1, height, width), bool))


def unit(values: np.ndarray) -> np.ndarray:
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def in_file(loaded, prefix: str) -> dict[str, np.ndarray]:
    """Return the weights of the checkpoint whose names begin so, under the rest of their names."""
    state = torch.load(loaded.checkpoint, weights_only=False)["state_dict"]
    return {name.removeprefix(prefix): value.double().numpy() for name, value in state.items() if name.startswith(prefix)}


def head(loaded, features: np.ndarray) -> np.ndarray:
    """Apply the teacher's head by its weights in the file alone: unit embeddings of (..., width) features."""
    weights = in_file(loaded, f"_heads.{TEACHER}.")

    def layer(values, name):
        return project(values, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def normed_gelu(values, name):
        return gelu(layer_norm(values, weights, name, 1e-5))

    values = layer(features.astype(np.float64), "fc1")
    for block in range(2):
        values = values + layer(normed_gelu(values, f"blocks.{block}.0"), f"blocks.{block}.2")
    return unit(layer(normed_gelu(values, "final.0"), "final.2"))


def into_the_last_block(loaded, rgb: np.ndarray) -> np.ndarray:
    """Return the tokens (N, width) that RADIO's own pass over an image brings to its last block."""
    seen: list[torch.Tensor] = []
    hook = loaded.radio.model.blocks[-1].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].clone()))
    try:
        with torch.inference_mode():
            loaded.radio(torch.from_numpy(rgb).permute(2, 0, 1)[None] / 255.0)
    finally:
        hook.remove()
    (tokens,) = seen
    return tokens[0].double().numpy()


@pytest.mark.parametrize(("size", "grid"), [((480, 640), (30, 40)), ((336, 336), (21, 21)), ((100, 33), (7, 3))])
def test_every_patch_has_a_unit_embedding_in_the_space_of_text(loaded, rng, size, grid):
    trio = loaded.trio
    patches = trio.patch.encode_patches(picture(rng, *size))
    assert trio.patch.grid(*size) == grid
    assert patches.embeddings.shape == (*grid, trio.dimension)
    assert patches.embeddings.dtype == patches.weights.dtype == np.float32
    assert (patches.weights == 1).all()
    assert patches.weights.shape == grid
    np.testing.assert_allclose(np.linalg.norm(patches.embeddings, axis=-1), 1, atol=1e-5)
    text = trio.text.encode_text(["a red cup"])
    assert text.shape == (1, trio.dimension)
    assert trio.dimension == 1152


def test_a_crop_has_radios_own_summary_of_the_image_in_zero_to_one(loaded, rng):
    """RADIO normalises by itself what its authors say it takes; without that, or with it twice, the numbers differ."""
    side = loaded.variant.crop_px
    rgb = picture(rng, side, side)
    with torch.inference_mode():
        summaries = loaded.radio(torch.from_numpy(rgb).permute(2, 0, 1)[None] / 255.0)[0]
    width = summaries.shape[1] // 3  # Of the four teachers sam has no summary.
    expected = head(loaded, summaries[:, TEACHER * width : (TEACHER + 1) * width].numpy())
    np.testing.assert_allclose(loaded.trio.crop.encode_crops(rgb, whole(side, side)), expected, atol=1e-5)


def test_the_network_is_given_normalised_pixels_once(loaded, rng):
    """What enters the first layer, for patches and crops; a conditioner that was lost or run twice shows here."""
    side = loaded.variant.crop_px
    rgb = picture(rng, side, side)
    backbone = loaded.trio.patch.network.backbone
    seen: list[np.ndarray] = []
    hook = backbone._embed.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].numpy().copy()))
    try:
        loaded.trio.patch.encode_patches(rgb)
        loaded.trio.crop.encode_crops(rgb, whole(side, side))
    finally:
        hook.remove()
    expected = ((rgb / 255.0 - MEAN) / STD).transpose(2, 0, 1)[None]
    assert len(seen) == 2
    for images in seen:
        np.testing.assert_allclose(images, expected, atol=1e-5)


def test_without_another_attention_patches_are_radios_own(loaded, rng):
    """The end for patches runs the last block by itself; with the trained attention it must be the block."""

    class Trained(torch.nn.Module):
        def __init__(self, attention, prefix):
            super().__init__()
            self.attention = attention

        def forward(self, tokens, rows, columns):
            return self.attention(tokens)

    variant = replace(loaded.variant, attention=Trained)
    backbone, summary_head = load_networks(variant, str(loaded.folder))
    trio = make_trio(variant, backbone, summary_head, loaded.trio.text, "cpu", 0.0)
    rgb = picture(rng, 64, 96)
    with torch.inference_mode():
        features = loaded.radio(torch.from_numpy(rgb).permute(2, 0, 1)[None] / 255.0)[1]
    expected = head(loaded, features.numpy()).reshape(4, 6, -1)
    np.testing.assert_allclose(trio.patch.encode_patches(rgb).embeddings, expected, atol=1e-5)
    own = loaded.trio.patch.encode_patches(rgb).embeddings
    assert np.abs(own - expected).max() > 1e-3


def test_patches_are_plain_loops_over_the_last_block_with_the_trios_attention(loaded, rng):
    """From the tokens before it to the embeddings, with what the papers say of each trio's attention."""
    rows, columns, heads = 4, 9, 3
    rgb = picture(rng, 16 * rows, 16 * columns)
    tokens = into_the_last_block(loaded, rgb)
    prefix = len(tokens) - rows * columns
    attentions = {
        "naradio": lambda values, attention: neighbourhood(values, attention, heads, prefix, rows, columns, sigma=7.0),
        "radseg": lambda values, attention: recursive(values, attention, heads, scale=10.0),
    }
    values = last_block(tokens, in_file(loaded, "base_model.blocks.2."), attentions[loaded.variant.name])
    features = layer_norm(values, in_file(loaded, "base_model."), "norm", LAYER_EPSILON)[prefix:]
    normalizer = in_file(loaded, "_feature_normalizer.")
    expected = head(loaded, (features - normalizer["mean"]) @ normalizer["tx"].T).reshape(rows, columns, -1)
    found = loaded.trio.patch.encode_patches(rgb).embeddings
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (1, 6), (3, 2)])
def test_a_changed_patch_changes_its_own_embedding_most(loaded, rng, row, column):
    rgb = picture(rng, 64, 128)
    changed = rgb.copy()
    changed[16 * row : 16 * row + 16, 16 * column : 16 * column + 16] = 255
    before, after = (loaded.trio.patch.encode_patches(image).embeddings for image in (rgb, changed))
    moved = np.linalg.norm(after - before, axis=-1)
    assert np.unravel_index(moved.argmax(), moved.shape) == (row, column)


def test_a_batch_gives_what_single_images_give(loaded, rng):
    network = loaded.trio.patch.network
    images = torch.from_numpy(rng.normal(size=(3, 3, 48, 80)).astype(np.float32))
    with torch.inference_mode():
        torch.testing.assert_close(network(images), torch.cat([network(image[None]) for image in images]), atol=1e-5, rtol=0)
    rgb = picture(rng, 60, 90)
    masks = np.zeros((18, 60, 90), bool)  # More than a batch.
    for place, mask in enumerate(masks):
        mask[place : place + 30, 2 * place : 2 * place + 40] = True
    together = loaded.trio.crop.encode_crops(rgb, Masks.from_masks(masks))
    alone = [loaded.trio.crop.encode_crops(rgb, Masks.from_masks(masks[i : i + 1]))[0] for i in (0, 17)]
    np.testing.assert_allclose(together[[0, 17]], alone, atol=1e-5)
    assert together.shape == (18, loaded.trio.dimension)


def test_nothing_gives_no_rows(loaded):
    none = Masks(np.zeros((0, 48, 64), bool), np.zeros((0, 4), np.int32))
    assert loaded.trio.crop.encode_crops(np.zeros((48, 64, 3), np.uint8), none).shape == (0, loaded.trio.dimension)
    assert loaded.trio.text.encode_text([]).shape == (0, loaded.trio.dimension)


def test_half_precision_is_near_and_of_unit_length(loaded, rng):
    backbone, summary_head = load_networks(loaded.variant, str(loaded.folder))
    trio = make_trio(loaded.variant, backbone, summary_head, loaded.trio.text, "cpu", 0.0, torch.bfloat16)
    rgb = picture(rng, 64, 96)
    for half, single in (
        (trio.patch.encode_patches(rgb).embeddings, loaded.trio.patch.encode_patches(rgb).embeddings),
        (trio.crop.encode_crops(rgb, whole(64, 96)), loaded.trio.crop.encode_crops(rgb, whole(64, 96))),
    ):
        assert half.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(half, axis=-1), 1, atol=1e-5)
        assert (half * single).sum(axis=-1).min() > 0.995


def test_a_pipeline_maps_and_answers(loaded):
    pipeline = Pipeline(Config(), loaded.trio, ColorSegmenter())
    for i in range(3):
        report = pipeline.process(wall_frame(i, x_m=0.2 * i - 0.2))
        assert report.dense
        assert report.instances
    for layer in ("dense", "fused_dense", "instances", "fused_instances"):
        query = TextQuery(["a red square"], layer=layer)
        answer = answer_query(pipeline.semantic_map, loaded.trio.text, query, loaded.trio.logit_scale)
        assert len(answer.points_m)
        assert np.isfinite(answer.similarity).all()


def test_instances_of_pooled_patches_need_no_crop(loaded, monkeypatch):
    map_with_pooled_patches(loaded.trio, monkeypatch)


def test_constants_are_the_published_ones():
    assert (NARADIO.variance_ratio, RADSEG.variance_ratio) == (1.0, 1.0)
    assert (NARADIO.dimension, RADSEG.dimension) == (1152, 1152)
    assert (NARADIO.crop_px, RADSEG.crop_px) == (336, 336)
    assert (NARADIO.teacher, RADSEG.teacher) == ("siglip", "siglip2")
    assert (NARADIO.text.context, RADSEG.text.context) == (64, 64)
    assert (NARADIO.text.end_id, NARADIO.text.pad_id) == (1, 1)
    assert (RADSEG.text.end_id, RADSEG.text.pad_id) == (1, 0)


def test_cosines_are_scaled_as_in_the_evaluations_of_these_models(loaded):
    assert loaded.trio.logit_scale == 100.0
