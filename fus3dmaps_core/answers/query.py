"""Queries by text or by image: similarities of every voxel of a layer, and ranked instances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.config.schema import QueryConfig
from fus3dmaps_core.encoders.protocols import CropEncoder, TextEncoder
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.masks import Masks
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.map_scan import Finding
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap
from fus3dmaps_core.voxel_map.snapshots import InstanceSnapshot

DEFAULT_LAYER = "fused_instances"
IMAGE_PROMPT = "image"
"""Stands in the place of the prompt in answers to an image."""

_MIN_IMAGE_PX = 8
_MAX_PROMPT_LENGTH = 4096
_MAX_PROMPTS = 256


@dataclass(frozen=True)
class TextQuery:
    """What to look for.

    Attributes:
        prompts: What to look for; each is answered on its own.
        negative_prompts: What the thing is not. With them a score is a probability, without them a cosine.
        layer: One of LAYERS.
        threshold: Instances and voxels with a lower score are left out; None leaves nothing out.
        top_k: At most this many instances per prompt.
        min_voxels: Instances that occupy fewer voxels are not ranked.
    """

    prompts: Sequence[str]
    negative_prompts: Sequence[str] = ()
    layer: str = DEFAULT_LAYER
    threshold: float | None = None
    top_k: int = 5
    min_voxels: int = 4

    def __post_init__(self) -> None:
        """Take a single text for a list of one; it is a sequence, too, of letters."""
        for name in ("prompts", "negative_prompts"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))

    @classmethod
    def of(cls, prompts: str | Sequence[str] | TextQuery, defaults: QueryConfig, **options: Any) -> TextQuery:
        """Make a query of one prompt, of several, or return the query that is given.

        Args:
            prompts: What to look for.
            defaults: What holds for a query that does not say it.
            **options: Other attributes of the query, by name.
        """
        if isinstance(prompts, TextQuery):
            return replace(prompts, **options)
        return cls(prompts, **{"top_k": defaults.top_k, "min_voxels": defaults.min_voxels, **options})

    def in_embeddings(self, prompts: NDArray[np.float32], negatives: NDArray[np.float32], logit_scale: float) -> LayerQuery:
        """Replace the words by their embeddings: (p, d) of the prompts, (q, d) of the negative prompts."""
        given = negatives if len(negatives) else None
        return LayerQuery(self.layer, prompts, given, logit_scale, self.threshold, self.top_k, self.min_voxels)

    def check(self) -> None:
        """Raise QueryError, naming the field, unless the query can be put to a map."""
        if not self.prompts:
            raise QueryError("prompts: at least one prompt is needed")
        check_texts("prompts", self.prompts)
        check_texts("negative_prompts", self.negative_prompts)
        check_layer(self.layer)
        if self.threshold is not None and not math.isfinite(self.threshold):
            raise QueryError(f"threshold: must be a finite number, got {self.threshold}")
        if self.top_k < 1:
            raise QueryError(f"top_k: must be at least 1, got {self.top_k}")


def check_texts(field: str, texts: Sequence[str]) -> None:
    """Raise QueryError, naming the field, if there are too many texts or one of them is empty or too long."""
    if len(texts) > _MAX_PROMPTS:
        raise QueryError(f"{field}: {len(texts)} are more than the {_MAX_PROMPTS} that are allowed")
    for index, text in enumerate(texts):
        if not text.strip():
            raise QueryError(f"{field}[{index}]: is empty")
        if len(text) > _MAX_PROMPT_LENGTH:
            raise QueryError(f"{field}[{index}]: {len(text)} characters are more than {_MAX_PROMPT_LENGTH}")


def check_layer(layer: str) -> None:
    """Raise QueryError unless this is one of LAYERS."""
    if layer not in LAYERS:
        raise QueryError(f"layer: unknown layer '{layer}', known are {', '.join(LAYERS)}")


def check_space(semantic_map: SemanticMap, text_encoder: TextEncoder) -> None:
    """Raise QueryError, naming both trios, if the map holds embeddings of another trio than the encoder's.

    Spaces of equal width mean different things by the same numbers: their cosines would rank, and say nothing.
    """
    if semantic_map.space and text_encoder.space != semantic_map.space:
        raise QueryError(
            f"prompts: they are embedded by encoder '{text_encoder.space}', the map was built with '{semantic_map.space}'"
        )


@dataclass(frozen=True, repr=False)
class RankedInstance:
    """An instance as the answer to a prompt.

    Attributes:
        id: Instance id.
        prompt: The prompt it answers.
        score: Mean over its voxels of the layer's score: a cosine, or with negative prompts a probability.
        weight: Observations behind its embedding.
        centroid_m: (3,) float32, metres, map frame.
        box_min_m: (3,) float32, smallest corner of its voxels.
        box_max_m: (3,) float32, largest corner of its voxels.
        voxels: Voxels that it occupies: those whose top hypothesis it is.
    """

    id: int
    prompt: str
    score: float
    weight: float
    centroid_m: NDArray[np.float32]
    box_min_m: NDArray[np.float32]
    box_max_m: NDArray[np.float32]
    voxels: int

    def __repr__(self) -> str:
        """Say in one line what was found where."""
        return f"RankedInstance({self.prompt!r}: {self.line()})"

    def line(self) -> str:
        """Describe the instance in one line: score, position and size in metres, voxels, id."""
        x, y, z = self.centroid_m.tolist()
        width, depth, height = (self.box_max_m - self.box_min_m).tolist()
        place, size = f"at ({x:.2f}, {y:.2f}, {z:.2f}) m", f"{width:.2f} x {depth:.2f} x {height:.2f} m"
        return f"score {self.score:.3f} {place}, {size}, {self.voxels} voxels, id {self.id}"


@dataclass(frozen=True, repr=False)
class QueryAnswer:
    """Similarities of a layer and the best instances.

    Attributes:
        layer: The layer that was asked.
        points_m: (n, 3) float32 voxel centres, metres, map frame.
        similarity: (n,) float32 score of each voxel: the best over the prompts.
        instances: Best first; ties by id, then by the order of the prompts.
    """

    layer: str
    points_m: NDArray[np.float32]
    similarity: NDArray[np.float32]
    instances: list[RankedInstance]

    def __repr__(self) -> str:
        """List the instances, one a line, below what was compared."""
        head = f"QueryAnswer: {len(self.instances)} instances by {len(self.points_m):,} voxels of layer '{self.layer}'"
        lines = (f"{place:3}. {found.prompt}: {found.line()}" for place, found in enumerate(self.instances, start=1))
        return "\n".join([head, *lines])


def answer_query(semantic_map: SemanticMap, text_encoder: TextEncoder, query: TextQuery, logit_scale: float) -> QueryAnswer:
    """Answer a text query from one layer of the map [sec: Implementation Details]. The map is not changed.

    With negative prompts the score of a voxel is its relevancy, the smallest over the negatives of
    exp(s c) / (exp(s c) + exp(s c_negative)), s being the logit scale and c the cosines.

    Raises:
        QueryError: The query is malformed, the layer is empty, or the encoder is another trio's; the message names the field
            or both trios.
    """
    query.check()
    check_space(semantic_map, text_encoder)
    _check_not_empty(semantic_map)
    texts = text_encoder.encode_text([*query.prompts, *query.negative_prompts])
    count = len(query.prompts)
    return _answer(semantic_map, query, texts[:count], texts[count:], logit_scale)


def embed_image(crop_encoder: CropEncoder, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Embed a picture of one thing as the crops of objects are embedded: the whole image is its mask.

    Args:
        crop_encoder: Of the trio whose space the map lives in.
        rgb: (H, W, 3) uint8.

    Returns:
        (1, d) float32, unit length.

    Raises:
        QueryError: The image is too small to show anything.
    """
    height, width = rgb.shape[:2]
    if min(height, width) < _MIN_IMAGE_PX:
        raise QueryError(f"image: {width}x{height} pixels are too few, at least {_MIN_IMAGE_PX}x{_MIN_IMAGE_PX} are needed")
    return crop_encoder.encode_crops(rgb, Masks.from_masks(np.ones((1, height, width), bool)))


def answer_image_query(
    semantic_map: SemanticMap,
    embedding: NDArray[np.float32],
    text_encoder: TextEncoder,
    query: TextQuery,
    logit_scale: float,
) -> QueryAnswer:
    """Answer a query whose one prompt is an image; otherwise as :func:`answer_query`.

    Args:
        semantic_map: The map, which is not changed.
        embedding: (1, d) of the image, see :func:`embed_image`.
        text_encoder: Encodes the negative prompts.
        query: Its only prompt is the name that the answers bear, IMAGE_PROMPT.
        logit_scale: Factor of the cosines where there are negative prompts.

    Raises:
        QueryError: As :func:`answer_query`.
    """
    query.check()
    check_space(semantic_map, text_encoder)
    _check_not_empty(semantic_map)
    negative = text_encoder.encode_text(query.negative_prompts) if query.negative_prompts else embedding[:0]
    return _answer(semantic_map, query, embedding, negative, logit_scale)


def _check_not_empty(semantic_map: SemanticMap) -> None:
    if semantic_map.voxel_count == 0:
        raise QueryError("the map is empty: nothing has been mapped yet")


def _answer(
    semantic_map: SemanticMap,
    query: TextQuery,
    positive: NDArray[np.float32],
    negative: NDArray[np.float32],
    logit_scale: float,
) -> QueryAnswer:
    found = semantic_map.search(query.in_embeddings(positive, negative, logit_scale))
    if not found.voxels:
        raise QueryError(f"layer: '{query.layer}' is empty in this map")
    return QueryAnswer(query.layer, found.points_m, found.similarity, _ranked(query, found))


def _ranked(query: TextQuery, found: Finding) -> list[RankedInstance]:
    """Merge the best instances of all prompts."""
    ranked: list[tuple[float, int, int, RankedInstance]] = []
    for order, (prompt, (places, scores)) in enumerate(zip(query.prompts, found.best, strict=True)):
        for place, score in zip(places.tolist(), scores.tolist(), strict=True):
            if query.threshold is None or score >= query.threshold:
                answer = _instance(found.instances, place, prompt, score)
                ranked.append((-score, answer.id, order, answer))
    return [entry[3] for entry in sorted(ranked, key=lambda entry: entry[:3])]


def _instance(instances: InstanceSnapshot, row: int, prompt: str, score: float) -> RankedInstance:
    return RankedInstance(
        int(instances.ids[row]),
        prompt,
        score,
        float(instances.weights[row]),
        instances.centroids_m[row],
        instances.boxes_min_m[row],
        instances.boxes_max_m[row],
        int(instances.voxel_counts[row]),
    )
