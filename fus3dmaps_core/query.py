"""Text queries: prompts to similarities of every voxel of a layer, and to ranked instances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.protocols import TextEncoder
from fus3dmaps_core.errors import QueryError
from fus3dmaps_core.semantic_map import LAYERS, SemanticMap
from fus3dmaps_core.snapshots import InstanceSnapshot, SimilarityBlock

DEFAULT_LAYER = "fused_instances"
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

    def check(self) -> None:
        """Raise QueryError, naming the field, unless the query can be asked of a map."""
        if not self.prompts:
            raise QueryError("prompts: at least one prompt is needed")
        for name, texts in (("prompts", self.prompts), ("negative_prompts", self.negative_prompts)):
            if len(texts) > _MAX_PROMPTS:
                raise QueryError(f"{name}: {len(texts)} are more than the {_MAX_PROMPTS} that are allowed")
            for index, text in enumerate(texts):
                if not text.strip():
                    raise QueryError(f"{name}[{index}]: is empty")
                if len(text) > _MAX_PROMPT_LENGTH:
                    raise QueryError(f"{name}[{index}]: {len(text)} characters are more than {_MAX_PROMPT_LENGTH}")
        if self.layer not in LAYERS:
            raise QueryError(f"layer: unknown layer '{self.layer}', known are {', '.join(LAYERS)}")
        if self.threshold is not None and not math.isfinite(self.threshold):
            raise QueryError(f"threshold: must be a finite number, got {self.threshold}")
        if self.top_k < 1:
            raise QueryError(f"top_k: must be at least 1, got {self.top_k}")


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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


def answer_query(semantic_map: SemanticMap, text_encoder: TextEncoder, query: TextQuery, logit_scale: float) -> QueryAnswer:
    """Answer a text query from one layer of the map [sec: Implementation Details]. The map is not changed.

    With negative prompts the score of a voxel is its relevancy, the smallest over the negatives of
    exp(s c) / (exp(s c) + exp(s c_negative)), s being the logit scale and c the cosines.

    Raises:
        QueryError: The query is malformed or the layer is empty; the message names the field.
    """
    query.check()
    if semantic_map.voxel_count == 0:
        raise QueryError("the map is empty: nothing has been mapped yet")
    texts = text_encoder.encode_text([*query.prompts, *query.negative_prompts])
    collector = _Collector(query, logit_scale)
    instances = semantic_map.visit_similarity(query.layer, texts, collector.add)
    if not collector.voxels:
        raise QueryError(f"layer: '{query.layer}' is empty in this map")
    return QueryAnswer(query.layer, *collector.points(), collector.ranked(instances))


class _Collector:
    """Gathers an answer from blocks of voxels; beside the answer it holds sums for each instance only."""

    def __init__(self, query: TextQuery, logit_scale: float) -> None:
        self._query, self._logit_scale = query, logit_scale
        self._points_m = np.empty((0, 3), np.float32)
        self._best = np.empty(0, np.float32)
        self._kept = 0
        self._totals = np.zeros((len(query.prompts), 0))
        self._members = np.zeros(0, np.int64)
        self.voxels = 0

    def add(self, block: SimilarityBlock) -> None:
        """Take the next voxels."""
        if not self.voxels:
            # As large as the answer can become; pages that are never written are never real.
            self._points_m, self._best = np.empty((block.map_voxels, 3), np.float32), np.empty(block.map_voxels, np.float32)
            self._totals = np.zeros((len(self._query.prompts), block.map_instances))
            self._members = np.zeros(block.map_instances, np.int64)
        self.voxels += len(block.cosines)
        scores = _scores(block.cosines, len(self._query.prompts), self._logit_scale)
        best = scores.max(axis=1) if scores.shape[1] > 1 else scores[:, 0]
        chosen = slice(None) if self._query.threshold is None else best >= self._query.threshold
        end = self._kept + len(best[chosen])
        self._points_m[self._kept : end], self._best[self._kept : end] = block.centers_m[chosen], best[chosen]
        self._kept = end
        # Voxels without an instance are counted for one before the first.
        places, lengths = block.instances + 1, block.map_instances + 1
        self._members += np.bincount(places, minlength=lengths)[1:]
        for totals, column in zip(self._totals, scores.T, strict=True):
            totals += np.bincount(places, column, minlength=lengths)[1:]

    def points(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Centres and scores of the voxels that passed the threshold."""
        return self._points_m[: self._kept], self._best[: self._kept]

    def ranked(self, instances: InstanceSnapshot) -> list[RankedInstance]:
        """The best instances of each prompt."""
        rankable = np.flatnonzero((self._members > 0) & (instances.voxel_counts >= self._query.min_voxels))
        ranked: list[tuple[float, int, int, RankedInstance]] = []
        for order, (prompt, totals) in enumerate(zip(self._query.prompts, self._totals, strict=True)):
            means = totals[rankable] / self._members[rankable]
            # Rows are in ascending order of id, so a stable sort breaks ties by the lowest id.
            for row in np.argsort(-means, kind="stable")[: self._query.top_k]:
                score = float(means[row])
                if self._query.threshold is None or score >= self._query.threshold:
                    answer = _instance(instances, int(rankable[row]), prompt, score)
                    ranked.append((-score, answer.id, order, answer))
        return [entry[3] for entry in sorted(ranked, key=lambda entry: entry[:3])]


def _scores(cosines: NDArray[np.float32], prompts: int, logit_scale: float) -> NDArray[np.float32]:
    positive, negative = cosines[:, :prompts], cosines[:, prompts:]
    if not negative.shape[1]:
        return positive
    # The smallest relevancy is that of the largest negative; the logistic function is its two-way softmax.
    margin = logit_scale * (positive - negative.max(axis=1, keepdims=True)).astype(np.float64)
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * margin)), dtype=np.float32)


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
