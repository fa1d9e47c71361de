"""The trio as a whole: its contract, and that photographs are found by words that are no class names."""

from __future__ import annotations

import threading
from functools import partial

import cv2
import numpy as np
import pytest
import skimage.data

from fus3dmaps_core.encoders.protocols import EncoderTrio
from fus3dmaps_core.encoders.registry import load_text_encoder, load_trio
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.masks import Masks

PHOTOGRAPHS = ("chelsea", "coffee", "rocket", "astronaut")


@pytest.fixture(scope="module")
def trio() -> EncoderTrio:
    return load_trio("lite", "cpu", 0.05)


def on_a_wall(names: tuple[str, ...]) -> tuple[np.ndarray, Masks]:
    """Put photographs in a row on a grey wall; return the picture and their masks."""
    rgb = np.full((256, 256 * len(names), 3), 180, np.uint8)
    masks = np.zeros((len(names), *rgb.shape[:2]), bool)
    for column, name in enumerate(names):
        picture = getattr(skimage.data, name)()
        scale = 220 / max(picture.shape[:2])
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        y, x = (256 - picture.shape[0]) // 2, 256 * column + (256 - picture.shape[1]) // 2
        rgb[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
        masks[column, y : y + picture.shape[0], x : x + picture.shape[1]] = True
    return rgb, Masks.from_masks(masks)


def test_crops_are_found_by_words_that_are_no_class_names(trio):
    crops = np.concatenate([trio.crop.encode_crops(*on_a_wall((name,))) for name in PHOTOGRAPHS])
    prompts = ["a furry pet that purrs", "a hot drink for the morning", "spaceship launch", "a person"]
    assert (trio.text.encode_text(prompts) @ crops.T).argmax(axis=1).tolist() == [0, 1, 2, 3]


def test_patches_of_the_right_photograph_answer(trio):
    rgb, _ = on_a_wall(("chelsea", "coffee"))
    patches = trio.patch.encode_patches(rgb)
    assert patches.embeddings.shape[:2] == patches.weights.shape == trio.patch.grid(256, 512) == (16, 32)
    assert patches.weights.min() >= 0
    assert patches.weights.max() <= 1
    for prompt, columns in (("a furry pet that purrs", slice(0, 16)), ("a hot drink for the morning", slice(16, 32))):
        similarity = patches.embeddings @ trio.text.encode_text([prompt])[0]
        best = np.unravel_index(similarity.argmax(), similarity.shape)
        assert best[1] in range(columns.start, columns.stop)


def test_an_undecided_image_is_near_no_prompt(trio):
    rgb = np.full((240, 320, 3), 128, np.uint8)
    masks = np.zeros((1, 240, 320), bool)
    masks[0, 60:180, 80:240] = True
    nothing = trio.crop.encode_crops(rgb, Masks.from_masks(masks))
    cat = trio.crop.encode_crops(*on_a_wall(("chelsea",)))
    prompts = trio.text.encode_text(["a cat", "a cup", "a chair", "a rocket", "a book", "a tree"])
    assert (prompts @ nothing[0]).max() < 0.6 * (prompts @ cat[0]).max()


@pytest.mark.parametrize("size", [(480, 640), (100, 130), (33, 32), (1, 1)])
def test_any_size_gets_the_grid_that_was_announced(trio, size, rng):
    rgb = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    patches = trio.patch.encode_patches(rgb)
    assert patches.embeddings.shape == (*trio.patch.grid(*size), trio.dimension)
    assert patches.embeddings.dtype == patches.weights.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(patches.embeddings, axis=-1), 1, atol=1e-5)


def test_the_working_resolution_has_sixteen_pixel_patches(trio):
    assert trio.patch.grid(480, 640) == (30, 40)


def test_no_masks_give_no_rows(trio):
    rgb = np.zeros((48, 64, 3), np.uint8)
    none = trio.crop.encode_crops(rgb, Masks(np.zeros((0, 48, 64), bool), np.zeros((0, 4), np.int32)))
    assert none.shape == (0, trio.dimension)
    assert none.dtype == np.float32
    assert trio.text.encode_text([]).shape == (0, trio.dimension)


def test_one_pixel_masks_and_full_masks_are_encoded(trio, rng):
    rgb = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    masks = np.zeros((2, 48, 64), bool)
    masks[0, 47, 63] = True
    masks[1] = True
    rows = trio.crop.encode_crops(rgb, Masks.from_masks(masks))
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)


def test_a_crop_does_not_depend_on_its_companions(trio):
    rgb, masks = on_a_wall(PHOTOGRAPHS)
    many = masks.take(np.array([0, 1, 2, 3, 0, 1, 2, 3, 3]))  # more than a batch
    together = trio.crop.encode_crops(rgb, many)
    alone = np.concatenate([trio.crop.encode_crops(rgb, masks.take(np.array([row]))) for row in range(4)])
    np.testing.assert_allclose(together, alone[[0, 1, 2, 3, 0, 1, 2, 3, 3]], atol=1e-5)


def test_the_same_input_gives_the_same_output_bit_for_bit(trio):
    rgb, masks = on_a_wall(("coffee",))
    assert np.array_equal(trio.crop.encode_crops(rgb, masks), trio.crop.encode_crops(rgb, masks))
    assert np.array_equal(trio.patch.encode_patches(rgb).embeddings, trio.patch.encode_patches(rgb).embeddings)
    assert np.array_equal(trio.text.encode_text(["a cup"]), trio.text.encode_text(["a cup"]))


def test_any_text_is_embedded(trio):
    prompts = ["a cup", "", "  ", "чашка кофе", "咖啡杯☕", "\ud800 broken", "nul \x00 here", "a\n\tcup"]
    rows = trio.text.encode_text(prompts)
    assert rows.shape == (len(prompts), trio.dimension)
    assert rows.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-5)
    for prompt, row in zip(prompts, rows, strict=True):
        np.testing.assert_allclose(trio.text.encode_text([prompt])[0], row, atol=1e-5)


def test_what_exceeds_the_models_tokens_is_cut(trio):
    longer = trio.text.encode_text(["word " * 2000])[0]
    assert np.array_equal(longer, trio.text.encode_text(["word " * 3000])[0])
    assert not np.allclose(longer, trio.text.encode_text(["word " * 20])[0], atol=1e-3)


def test_the_text_encoder_alone_is_the_trios(trio):
    alone = load_text_encoder("lite", "cpu")
    assert np.array_equal(alone.encode_text(["something to sit on"]), trio.text.encode_text(["something to sit on"]))


def test_two_threads_get_what_one_gets(trio):
    pictures = [on_a_wall((name,)) for name in PHOTOGRAPHS]
    expected = [
        (trio.crop.encode_crops(*picture), trio.text.encode_text([name]))
        for picture, name in zip(pictures, PHOTOGRAPHS, strict=True)
    ]
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}

    def work(worker: int) -> None:
        order = range(4) if worker == 0 else reversed(range(4))
        rows = {row: (trio.crop.encode_crops(*pictures[row]), trio.text.encode_text([PHOTOGRAPHS[row]])) for row in order}
        found[worker] = [rows[row] for row in range(4)]

    threads = [threading.Thread(target=work, args=(worker,)) for worker in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for worker in range(2):
        for (crop, text), (expected_crop, expected_text) in zip(found[worker], expected, strict=True):
            np.testing.assert_allclose(crop, expected_crop, atol=1e-6)
            np.testing.assert_allclose(text, expected_text, atol=1e-6)


@pytest.mark.parametrize(
    "load", [lambda weights: load_trio("lite", "cpu", 0.05, weights), partial(load_text_encoder, "lite", "cpu")]
)
def test_weights_of_ones_own_are_refused_by_name(load):
    with pytest.raises(EncoderError, match=r"encoder\.weights.*'lite'.*'mine\.pt'"):
        load("mine.pt")


@pytest.mark.parametrize("device", ["cuda:99", "abacus"])
def test_an_unusable_device_is_named(device):
    with pytest.raises(EncoderError, match=rf"encoder\.device.*{device}"):
        load_text_encoder("lite", device)
