"""Answers to text queries, voxel by voxel."""

from __future__ import annotations

import math
from dataclasses import dataclass

from reference.objects import occupied_voxels
from reference.semantic_map import ReferenceMap
from reference.vectors import Key, Vector, cosine


def layer_embeddings(reference: ReferenceMap, layer: str) -> dict[Key, Vector]:
    """Embedding of every voxel that has one in a layer."""
    if layer == "dense":
        return dict(reference.dense_mean)
    if layer == "fused_dense":
        fused = {key: reference.fused_dense(key) for key in reference.voxels}
        return {key: embedding for key, embedding in fused.items() if embedding is not None}
    if layer == "instances":
        of_instance = {each: instance.embedding for each, instance in reference.instances.items()}
    else:
        of_instance = {each: reference.query_embedding(each) for each in reference.instances}
    tops = {key: reference.top_of(key) for key in reference.voxels}
    return {key: of_instance[top] for key, top in tops.items() if top is not None}


def relevancy(embedding: Vector, prompt: Vector, negatives: list[Vector], logit_scale: float) -> float:
    """Cosine with the prompt, or with negatives the lowest softmax probability of the prompt against one of them."""
    positive = cosine(embedding, prompt)
    if not negatives:
        return positive
    return min(1.0 / (1.0 + math.exp(logit_scale * (cosine(embedding, negative) - positive))) for negative in negatives)


@dataclass(frozen=True)
class Ranked:
    """One line of the ranking."""

    score: float
    instance_id: int
    prompt: int


def similarity_of_voxels(
    reference: ReferenceMap, layer: str, prompts: list[Vector], negatives: list[Vector], logit_scale: float
) -> dict[Key, float]:
    """Best similarity of any prompt at each voxel of a layer."""
    return {
        key: max(relevancy(embedding, prompt, negatives, logit_scale) for prompt in prompts)
        for key, embedding in layer_embeddings(reference, layer).items()
    }


def ranking(
    reference: ReferenceMap,
    layer: str,
    prompts: list[Vector],
    negatives: list[Vector],
    logit_scale: float,
    min_voxels: int,
    threshold: float,
) -> list[Ranked]:
    """Every instance of every prompt that reaches the threshold, best first (before any top_k)."""
    embeddings = layer_embeddings(reference, layer)
    lines = []
    for number, prompt in enumerate(prompts):
        for instance_id in reference.instances:
            members = occupied_voxels(reference, instance_id)
            scored = [relevancy(embeddings[key], prompt, negatives, logit_scale) for key in members if key in embeddings]
            if len(members) < min_voxels or not scored:
                continue
            score = sum(scored) / len(scored)
            if score >= threshold:
                lines.append(Ranked(score, instance_id, number))
    return sorted(lines, key=lambda line: (-line.score, line.instance_id, line.prompt))
