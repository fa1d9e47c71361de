"""Cards of the encoder trios: what they say, and that the encoders themselves say the same."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.encoders import registry
from fus3dmaps_core.encoders.cards import EncoderCard
from fus3dmaps_core.encoders.definition import EncoderDefinition
from fus3dmaps_core.errors import EncoderError

SIDES = st.integers(1, 2000)


def a_card(patch_px: int, grid_multiple: int = 1) -> EncoderCard:
    return EncoderCard("a", "A trio.", 8, 1.0, patch_px, "", (), (), grid_multiple=grid_multiple)


@pytest.mark.parametrize("name", registry.names())
def test_every_trio_has_a_card_that_says_all(name):
    assert isinstance(registry.definition(name), EncoderDefinition)
    card = registry.card(name)
    assert card.name == name
    assert card.summary.endswith(".")
    assert card.dimension > 0
    assert card.variance_ratio > 0
    assert card.grid(480, 640) == (30, 40)
    assert card.files or card.shipped
    for file in card.files:
        assert file.licence
        assert file.source.startswith("https://")
    assert all(file.licence for file in card.shipped)
    assert bool(card.shipped) == bool(card.weights_licence)
    # Two files of one name could not lie in one directory, nor those of one title in the own cache.
    assert len({file.file_name for file in card.files}) == len({file.title for file in card.files}) == len(card.files)


def test_the_cards_have_the_papers_figures():
    figures = {name: (registry.card(name).dimension, registry.card(name).variance_ratio) for name in registry.names()}
    assert figures["naradio"] == (1152, 1.0)
    assert figures["clip_dinoiser"] == (512, 5.0)


def test_radio_says_under_which_licence_its_code_and_weights_are():
    for name in ("naradio", "radseg"):
        card = registry.card(name)
        assert "research and evaluation only" in card.code_licence
        assert card.checkout is not None
        assert re.search(r"[0-9a-f]{40}\.zip$", card.checkout.source)
    assert "research and evaluation only" in registry.card("naradio").files[0].licence
    assert registry.card("radseg").files[0].licence == "NVIDIA Open Model License"


def test_an_unknown_trio_has_no_card():
    with pytest.raises(EncoderError, match=r"encoder\.name.*'clap'.*known are clip_dinoiser, lite"):
        registry.card("clap")


@given(SIDES, SIDES, st.integers(1, 40), st.integers(1, 3))
def test_the_grid_is_the_smallest_that_covers_the_image(height, width, patch_px, multiple):
    for side, count in zip((height, width), a_card(patch_px, multiple).grid(height, width), strict=True):
        assert count % multiple == 0
        assert (count - multiple) * patch_px < side <= count * patch_px


@given(SIDES, SIDES)
def test_lites_grid_is_the_one_that_its_encoder_has(height, width):
    from fus3dmaps_core.encoders.lite.patch import LitePatchEncoder

    encoder = LitePatchEncoder.__new__(LitePatchEncoder)  # Its grid asks for no model.
    assert registry.card("lite").grid(height, width) == encoder.grid(height, width)


def test_lite_loads_with_what_its_card_says():
    trio, card = registry.load_trio("lite", "cpu", 0.0), registry.card("lite")
    assert (trio.name, trio.dimension, trio.variance_ratio) == (card.name, card.dimension, card.variance_ratio)
    assert trio.text.encode_text(["a cup"]).shape == (1, card.dimension)
