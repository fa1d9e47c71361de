"""CLIP's image transformer, MaskCLIP's value path and guided pooling in plain numpy: one token and one head at a time."""

from __future__ import annotations

import math

import numpy as np

Weights = dict[str, np.ndarray]

_erf = np.vectorize(math.erf)


def normalised(x: np.ndarray, weights: Weights, name: str) -> np.ndarray:
    """Layer norm over the last axis."""
    mean, variance = x.mean(axis=-1, keepdims=True), x.var(axis=-1, keepdims=True)
    return (x - mean) / np.sqrt(variance + 1e-5) * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def linear(x: np.ndarray, weights: Weights, name: str) -> np.ndarray:
    return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]


def perceptron(x: np.ndarray, weights: Weights, name: str) -> np.ndarray:
    hidden = linear(x, weights, f"{name}.c_fc")
    return linear(0.5 * hidden * (1 + _erf(hidden / math.sqrt(2))), weights, f"{name}.c_proj")


def attention(x: np.ndarray, weights: Weights, name: str, heads: int) -> np.ndarray:
    """Self-attention of (n, width) tokens, one query of one head at a time."""
    width = x.shape[1]
    step = width // heads
    queries, keys, values = np.split(x @ weights[f"{name}.in_proj_weight"].T + weights[f"{name}.in_proj_bias"], 3, axis=1)
    mixed = np.zeros_like(x)
    for head in range(heads):
        part = slice(head * step, (head + 1) * step)
        for token in range(len(x)):
            scores = keys[:, part] @ queries[token, part] / math.sqrt(step)
            share = np.exp(scores - scores.max())
            mixed[token, part] = share / share.sum() @ values[:, part]
    return linear(mixed, weights, f"{name}.out_proj")


def cubic_weights(old: int, new: int) -> np.ndarray:
    """(new, old) matrix of cubic interpolation (a = -0.75), pixel centres aligned, borders repeated."""
    matrix = np.zeros((new, old))
    a = -0.75
    for row in range(new):
        position = (row + 0.5) * old / new - 0.5
        first = math.floor(position)
        for neighbour in range(first - 1, first + 3):
            distance = abs(position - neighbour)
            if distance <= 1:
                weight = (a + 2) * distance**3 - (a + 3) * distance**2 + 1
            else:
                weight = a * distance**3 - 5 * a * distance**2 + 8 * a * distance - 4 * a
            matrix[row, min(max(neighbour, 0), old - 1)] += weight
    return matrix


def embedded(image: np.ndarray, weights: Weights, patch: int) -> tuple[np.ndarray, int, int]:
    """Tokens of a (3, H, W) image, class token first, and the grid of its patches."""
    rows, columns = image.shape[1] // patch, image.shape[2] // patch
    kernel = weights["conv1.weight"].reshape(len(weights["conv1.weight"]), -1)
    tokens = [weights["class_embedding"]]
    for row in range(rows):
        for column in range(columns):
            pixels = image[:, row * patch : (row + 1) * patch, column * patch : (column + 1) * patch]
            tokens.append(kernel @ pixels.reshape(-1))
    positions = weights["positional_embedding"]
    side = math.isqrt(len(positions) - 1)
    grid = positions[1:].reshape(side, side, -1)
    grid = np.einsum("ra,cb,abw->rcw", cubic_weights(side, rows), cubic_weights(side, columns), grid)
    positions = np.concatenate([positions[:1], grid.reshape(rows * columns, -1)])
    return normalised(np.array(tokens) + positions, weights, "ln_pre"), rows, columns


def patch_features(
    image: np.ndarray, weights: Weights, patch: int, heads: int, layers: int
) -> tuple[np.ndarray, np.ndarray]:
    """MaskCLIP's projected features (d, rows, columns) and the heads' input (width, rows, columns)."""
    x, rows, columns = embedded(image, weights, patch)
    intermediate = x
    for layer in range(layers - 1):
        name = f"transformer.resblocks.{layer}"
        x = x + attention(normalised(x, weights, f"{name}.ln_1"), weights, f"{name}.attn", heads)
        if layer == layers - 3:
            intermediate = normalised(x, weights, f"{name}.ln_2")
        x = x + perceptron(normalised(x, weights, f"{name}.ln_2"), weights, f"{name}.mlp")
    name, width = f"transformer.resblocks.{layers - 1}", x.shape[1]
    value_weight = weights[f"{name}.attn.in_proj_weight"][2 * width :]
    value_bias = weights[f"{name}.attn.in_proj_bias"][2 * width :]
    values = normalised(x, weights, f"{name}.ln_1") @ value_weight.T + value_bias
    x = x + linear(values, weights, f"{name}.attn.out_proj")
    x = x + perceptron(normalised(x, weights, f"{name}.ln_2"), weights, f"{name}.mlp")
    projected = normalised(x, weights, "ln_post") @ weights["proj"]
    return tuple(tokens[1:].T.reshape(-1, rows, columns) for tokens in (projected, intermediate))
