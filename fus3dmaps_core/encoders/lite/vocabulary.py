"""The words that pixels are turned into: names of ImageNet and COCO classes, as text embeddings.

Embedding two thousand short sentences takes half a minute on a small machine, so the result is kept in the user's cache
directory under a key made of the text model, the words and the recipe. Where the cache cannot be read it is computed anew;
where it cannot be written nothing is kept.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.lite.packaged_files import IMAGENET_NAMES, TEXT_MODEL, TOKENIZER
from fus3dmaps_core.encoders.lite.text import WIDTH, SentenceModel

COCO_CATEGORIES = 91
"""Category ids run from 1 to 90."""

_COCO_NAMES = {
    1: "person", 2: "bicycle", 3: "car", 4: "motorcycle", 5: "airplane", 6: "bus", 7: "train", 8: "truck", 9: "boat",
    10: "traffic light", 11: "fire hydrant", 13: "stop sign", 14: "parking meter", 15: "bench", 16: "bird", 17: "cat",
    18: "dog", 19: "horse", 20: "sheep", 21: "cow", 22: "elephant", 23: "bear", 24: "zebra", 25: "giraffe", 27: "backpack",
    28: "umbrella", 31: "handbag", 32: "tie", 33: "suitcase", 34: "frisbee", 35: "skis", 36: "snowboard", 37: "sports ball",
    38: "kite", 39: "baseball bat", 40: "baseball glove", 41: "skateboard", 42: "surfboard", 43: "tennis racket",
    44: "bottle", 46: "wine glass", 47: "cup", 48: "fork", 49: "knife", 50: "spoon", 51: "bowl", 52: "banana", 53: "apple",
    54: "sandwich", 55: "orange", 56: "broccoli", 57: "carrot", 58: "hot dog", 59: "pizza", 60: "donut", 61: "cake",
    62: "chair", 63: "couch", 64: "potted plant", 65: "bed", 67: "dining table", 70: "toilet", 72: "tv", 73: "laptop",
    74: "mouse", 75: "remote", 76: "keyboard", 77: "cell phone", 78: "microwave", 79: "oven", 80: "toaster", 81: "sink",
    82: "refrigerator", 84: "book", 85: "clock", 86: "vase", 87: "scissors", 88: "teddy bear", 89: "hair drier",
    90: "toothbrush",
}  # fmt: skip

# ImageNet classes that no room holds: they only soak up the doubt about ordinary things. Pets, food and drink stay.
_LIVING = range(398)
_PETS = (1, *range(151, 269), *range(281, 286), *range(330, 334), 338, 339)
_LANDSCAPES_AND_PLANTS = (*range(970, 981), *range(984, 999))

# The form in which something is said matters to a sentence model: names and prompts go through the same ones.
_FORMS = ("{}", "a photo of {}")
_RECIPE = 1  # Part of the cache's key; counts changes of how the arrays below are made.

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Vocabulary:
    """Text embeddings of the class names, centred on their mean.

    Attributes:
        mean: (384,) float32, mean embedding of the ImageNet names that are in use. What all names share says nothing.
        imagenet: (1000, 384) float32, embeddings minus the mean.
        coco: (91, 384) float32 by category id, embeddings minus the mean; zero where there is no such category.
    """

    mean: NDArray[np.float32]
    imagenet: NDArray[np.float32]
    coco: NDArray[np.float32]


def possible_classes() -> NDArray[np.bool_]:
    """Mark the ImageNet classes that may be seen in a room: (1000,) bool."""
    possible = np.ones(1000, bool)
    possible[list(_LIVING)] = False
    possible[list(_PETS)] = True
    possible[list(_LANDSCAPES_AND_PLANTS)] = False
    return possible


def embed_in_forms(model: SentenceModel, phrases: Sequence[str]) -> NDArray[np.float32]:
    """Embed n phrases as the unit mean over all prompt forms: (n, 384) float32."""
    sentences = [form.format(phrase) for phrase in phrases for form in _FORMS]
    return _unit(model.embed(sentences).reshape(-1, len(_FORMS), WIDTH).mean(axis=1))


def load_vocabulary(model: SentenceModel) -> Vocabulary:
    """Load the vocabulary from the cache, or compute it and keep it there.

    Raises:
        EncoderError: The file of class names is missing or altered.
    """
    names = [_with_article(line.split(",")[0].strip()) for line in IMAGENET_NAMES.locate().read_text().splitlines()]
    coco = {category: _with_article(name) for category, name in _COCO_NAMES.items()}
    path = _cache_path(names, coco)
    found = _read(path)
    if found is None:
        _log.info("computing the text embeddings of the class names (once; then kept as '%s')", path)
        found = _compute(model, names, coco)
        _write(path, found)
    return found


def _compute(model: SentenceModel, names: list[str], coco: dict[int, str]) -> Vocabulary:
    imagenet = embed_in_forms(model, names)
    mean = imagenet[possible_classes()].mean(axis=0)
    by_category = np.zeros((COCO_CATEGORIES, WIDTH), np.float32)
    by_category[list(coco)] = embed_in_forms(model, list(coco.values())) - mean
    return Vocabulary(mean, imagenet - mean, by_category)


def _with_article(name: str) -> str:
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def _unit(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    unit: NDArray[np.float32] = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
    return unit


def _cache_path(names: list[str], coco: dict[int, str]) -> Path:
    parts = [
        str(_RECIPE),
        TEXT_MODEL.sha256,
        TOKENIZER.sha256,
        *_FORMS,
        *names,
        *(f"{key} {name}" for key, name in coco.items()),
    ]
    parts.append(possible_classes().tobytes().hex())
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()
    root = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG specification has relative paths ignored.
    directory = Path(root) if Path(root).is_absolute() else Path("~/.cache").expanduser()
    return directory / "fus3dmaps" / f"lite-vocabulary-{key[:32]}.npz"


def _read(path: Path) -> Vocabulary | None:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            found = Vocabulary(arrays["mean"], arrays["imagenet"], arrays["coco"])
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        _log.warning("cached class names '%s' cannot be read (%s); they are computed anew", path, error)
        return None
    for array, shape in ((found.mean, (WIDTH,)), (found.imagenet, (1000, WIDTH)), (found.coco, (COCO_CATEGORIES, WIDTH))):
        if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
            _log.warning("cached class names '%s' are not what they should be; they are computed anew", path)
            return None
    return found


def _write(path: Path, vocabulary: Vocabulary) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A file of its own name, renamed when whole: readers and other writers never see half a file.
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=path.stem, delete=False) as stream:
            temporary = Path(stream.name)
            try:
                np.savez(stream, mean=vocabulary.mean, imagenet=vocabulary.imagenet, coco=vocabulary.coco)
                stream.close()
                temporary.replace(path)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
    except OSError as error:
        _log.warning("cannot keep the class names' embeddings as '%s': %s", path, error)
