"""SigLIP's image transformer and its pooling head on one token, in plain numpy: one token and one head at a time."""

from __future__ import annotations

import math

import numpy as np

from reference.clip_vit import Weights, cubic_weights, linear


def normalised(x: np.ndarray, weights: Weights, name: str) -> np.ndarray:
    """Layer norm over the last axis."""
    mean, variance = x.mean(axis=-1, keepdims=True), x.var(axis=-1, keepdims=True)
    return (x - mean) / np.sqrt(variance + 1e-6) * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def perceptron(x: np.ndarray, weights: Weights, name: str) -> np.ndarray:
    hidden = linear(x, weights, f"{name}.fc1")
    bent = 0.5 * hidden * (1 + np.tanh(math.sqrt(2 / math.pi) * (hidden + 0.044715 * hidden**3)))
    return linear(bent, weights, f"{name}.fc2")


def attention(x: np.ndarray, weights: Weights, name: str, heads: int) -> np.ndarray:
    """Self-attention of (n, width) tokens, one query of one head at a time."""
    step = x.shape[1] // heads
    queries, keys, values = (linear(x, weights, f"{name}.{part}_proj") for part in "qkv")
    mixed = np.zeros_like(x)
    for head in range(heads):
        part = slice(head * step, (head + 1) * step)
        for token in range(len(x)):
            scores = keys[:, part] @ queries[token, part] / math.sqrt(step)
            share = np.exp(scores - scores.max())
            mixed[token, part] = share / share.sum() @ values[:, part]
    return linear(mixed, weights, f"{name}.out_proj")


def tokens(image: np.ndarray, weights: Weights, patch: int, heads: int, layers: int) -> np.ndarray:
    """Final tokens (rows * columns, width) of a (3, H, W) image."""
    rows, columns = image.shape[1] // patch, image.shape[2] // patch
    kernel = weights["embeddings.patch_embedding.weight"]
    pixels = image.reshape(3, rows, patch, columns, patch)
    embedded = np.einsum("iryjx,wiyx->rjw", pixels, kernel) + weights["embeddings.patch_embedding.bias"]
    positions = weights["embeddings.position_embedding.weight"]
    side = math.isqrt(len(positions))
    grid = positions.reshape(side, side, -1)
    grid = np.einsum("ra,cb,abw->rcw", cubic_weights(side, rows), cubic_weights(side, columns), grid)
    hidden = (embedded + grid).reshape(rows * columns, -1)
    for layer in range(layers):
        name = f"encoder.layers.{layer}"
        hidden = hidden + attention(normalised(hidden, weights, f"{name}.layer_norm1"), weights, f"{name}.self_attn", heads)
        hidden = hidden + perceptron(normalised(hidden, weights, f"{name}.layer_norm2"), weights, f"{name}.mlp")
    return normalised(hidden, weights, "post_layernorm")


def pooled_alone(token: np.ndarray, weights: Weights, heads: int) -> np.ndarray:
    """The pooling head over a set of one token, probe, keys and softmax and all."""
    width = len(token)
    step = width // heads
    queries, keys, values = np.split(weights["head.attention.in_proj_weight"], 3)
    query_bias, key_bias, value_bias = np.split(weights["head.attention.in_proj_bias"], 3)
    query, key = queries @ weights["head.probe"][0, 0] + query_bias, keys @ token + key_bias
    value = values @ token + value_bias
    mixed = np.zeros(width)
    for head in range(heads):
        part = slice(head * step, (head + 1) * step)
        scores = np.array([query[part] @ key[part] / math.sqrt(step)])
        share = np.exp(scores - scores.max())
        mixed[part] = share[0] / share.sum() * value[part]
    gathered = linear(mixed, weights, "head.attention.out_proj")
    return gathered + perceptron(normalised(gathered, weights, "head.layernorm"), weights, "head.mlp")
