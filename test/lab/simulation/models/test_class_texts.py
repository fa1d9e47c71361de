"""Class texts: unit vectors with the stated cosines."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_core.errors import ConfigError
from fus3dmaps_lab.simulation.models.class_texts import GROUPS, ClassTexts, TextSimilarity, group_of

DIMENSION = 128


def cosines(names: list[str], similarity: TextSimilarity | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the cosines of all pairs of one group, and of all other pairs, over 20 seeds."""
    groups = [group_of(name) for name in names]
    same = np.array([[a is not None and a == b for a in groups] for b in groups])
    related, unrelated = [], []
    for seed in range(20):
        vectors = ClassTexts(names, DIMENSION, seed, similarity).vectors.astype(float)
        upper = np.triu(np.ones_like(same), 1)
        found = vectors @ vectors.T
        related.append(found[upper & same])
        unrelated.append(found[upper & ~same])
    return np.concatenate(related), np.concatenate(unrelated)


@pytest.mark.parametrize("similarity", [TextSimilarity(), TextSimilarity(0.2, 0.9), TextSimilarity(0.0, 0.5)])
def test_cosines_are_as_stated(similarity: TextSimilarity):
    names = sorted(word for group in GROUPS for word in group)
    related, unrelated = cosines(names, similarity)
    root = DIMENSION**0.5
    assert related.mean() == pytest.approx(similarity.related, abs=0.01)
    assert unrelated.mean() == pytest.approx(similarity.unrelated, abs=0.01)
    assert related.std() == pytest.approx((1 - similarity.related) / root, rel=0.1)
    # Directions of groups scatter as well, and are the same for many pairs.
    assert unrelated.std() <= 1.1 * (1 - similarity.unrelated) / root


def test_related_things_are_nearer_than_any_unrelated_ones():
    related, unrelated = cosines(["chair", "stool", "armchair", "cup", "mug", "table", "desk", "exit sign"])
    assert related.min() > unrelated.max()


@given(st.lists(st.text(max_size=30), min_size=1, max_size=5), st.integers(4, 64), st.integers(0, 2**40))
@settings(max_examples=50, deadline=None)
def test_any_prompt_has_a_unit_vector_that_depends_on_nothing_else(prompts: list[str], dimension: int, seed: int):
    texts = ClassTexts(("", "chair"), dimension, seed)
    found = texts.encode(prompts)
    assert found.shape == (len(prompts), dimension)
    assert found.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-6)
    again = ClassTexts(("", "door", "lamp"), dimension, seed)
    assert again.encode(prompts[::-1])[::-1].tobytes() == found.tobytes()


def test_classes_and_prompts_share_one_space():
    texts = ClassTexts(("", "Chair", "cup"), DIMENSION, 3)
    np.testing.assert_array_equal(texts.encode(["", " chair ", "cup"]), texts.vectors)
    assert not np.array_equal(ClassTexts(("", "chair", "cup"), DIMENSION, 4).vectors, texts.vectors)


@pytest.mark.parametrize(
    ("text", "like"), [("office chair", "stool"), ("coffee-table", "desk"), ("desk lamp", "light"), ("Mug", "bottle")]
)
def test_the_last_word_of_a_group_decides(text: str, like: str):
    assert group_of(text) == group_of(like) is not None


def test_unknown_words_have_no_group_and_words_have_one_at_most():
    assert group_of("exit sign") is None
    assert group_of("") is None
    assert len({word for group in GROUPS for word in group}) == sum(len(group) for group in GROUPS)


@pytest.mark.parametrize("cosines_", [(0.8, 0.6), (-0.1, 0.5), (0.5, 1.0)])
def test_numbers_out_of_order_are_refused(cosines_: tuple[float, float]):
    with pytest.raises(ConfigError, match="unrelated"):
        TextSimilarity(*cosines_)


@pytest.mark.parametrize(("dimension", "seed"), [(3, 0), (8, -1)])
def test_a_space_that_cannot_be_is_refused(dimension: int, seed: int):
    with pytest.raises(ConfigError, match="dimension"):
        ClassTexts(("",), dimension, seed)
