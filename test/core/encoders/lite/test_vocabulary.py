"""The vocabulary's cache: kept, found again, and ignored where it is broken or cannot be written."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from fus3dmaps_core.encoders.lite.text import WIDTH
from fus3dmaps_core.encoders.lite.vocabulary import load_vocabulary, possible_classes


class CountingModel:
    """Stands in for the sentence model: a fixed unit vector per sentence, and a count of what was asked."""

    def __init__(self) -> None:
        self.sentences = 0

    def embed(self, sentences: Sequence[str]) -> np.ndarray:
        self.sentences += len(sentences)
        rows = np.array(
            [np.random.default_rng(list(sentence.encode())).normal(size=WIDTH) for sentence in sentences], np.float32
        ).reshape(-1, WIDTH)
        return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def same(a, b) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("mean", "imagenet", "coco"))


def test_names_are_embedded_once(cache):
    first, second = CountingModel(), CountingModel()
    computed = load_vocabulary(first)
    assert first.sentences == 2 * (1000 + 80)
    assert same(load_vocabulary(second), computed)
    assert second.sentences == 0
    assert len(list((cache / "fus3dmaps").iterdir())) == 1  # and no temporary file is left


def test_embeddings_are_centred(cache):
    found = load_vocabulary(CountingModel())
    assert np.abs(found.imagenet[possible_classes()].mean(axis=0)).max() < 1e-6
    assert not found.coco[[0, 12, 26]].any()  # COCO has no such categories
    assert found.coco[47].any()


@pytest.mark.parametrize("damage", ["truncate", "garbage", "empty", "shape", "nan", "pickle"])
def test_a_broken_cache_is_computed_anew(cache, damage, caplog):
    expected = load_vocabulary(CountingModel())
    (path,) = (cache / "fus3dmaps").iterdir()
    arrays = {"mean": expected.mean, "imagenet": expected.imagenet, "coco": expected.coco}
    match damage:
        case "truncate":
            path.write_bytes(path.read_bytes()[:1000])
        case "garbage":
            path.write_bytes(b"PK\x03\x04 not an archive")
        case "empty":
            path.write_bytes(b"")
        case "shape":
            np.savez(path, **{**arrays, "mean": expected.mean[:3]})
        case "nan":
            np.savez(path, **{**arrays, "mean": np.full_like(expected.mean, np.nan)})
        case "pickle":
            np.savez(path, **{**arrays, "mean": np.array([{"a": 1}], dtype=object)})
    model = CountingModel()
    assert same(load_vocabulary(model), expected)
    assert model.sentences > 0
    assert str(path) in caplog.text
    again = CountingModel()
    assert same(load_vocabulary(again), expected)
    assert again.sentences == 0  # the broken file was replaced


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert load_vocabulary(CountingModel()).imagenet.shape == (1000, WIDTH)
    assert "cannot keep" in caplog.text
