"""RADIO's last block with either attention of patches: one token and one head at a time, and what comes after it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

Weights = dict[str, np.ndarray]

LAYER_EPSILON = 1e-6
"""Of the layer norms in timm's vision transformers; attention's own and those of RADIO's heads have torch's 1e-5."""


def project(tokens: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    return tokens @ weight.T + bias


def softmax(logits: list[float]) -> np.ndarray:
    powers = np.exp(np.asarray(logits) - max(logits))
    return powers / powers.sum()


def layer_norm(values: np.ndarray, weights: Weights, name: str, epsilon: float) -> np.ndarray:
    """Over the last axis."""
    centred = values - values.mean(axis=-1, keepdims=True)
    scaled = centred / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + epsilon)
    return scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def gelu(values: np.ndarray) -> np.ndarray:
    return values * 0.5 * (1 + torch.erf(torch.from_numpy(values) / 2**0.5).numpy())


def split(tokens: np.ndarray, attention: Weights, heads: int):
    """Queries, keys and values of (N, width) tokens: (heads, N, width / heads) each, the first two normed if trained so."""
    width = tokens.shape[1]
    joined = project(tokens, attention["qkv.weight"], attention["qkv.bias"])
    parts = [
        np.stack([joined[:, part * width + head * width // heads :][:, : width // heads] for head in range(heads)])
        for part in range(3)
    ]
    for place, name in enumerate(("q_norm", "k_norm")):
        if f"{name}.weight" in attention:
            parts[place] = layer_norm(parts[place], attention, name, 1e-5)
    return parts


def neighbourhood(
    tokens: np.ndarray, attention: Weights, heads: int, prefix: int, rows: int, columns: int, sigma: float
) -> np.ndarray:
    """softmax(K K^T / sqrt(d) + G) V: (N, width)."""
    _, keys, values = split(tokens, attention, heads)
    out = np.zeros_like(tokens)
    size = tokens.shape[1] // heads
    for head in range(heads):
        for i in range(len(tokens)):
            logits = []
            for j in range(len(tokens)):
                nearness = 0.0
                if i >= prefix and j >= prefix:
                    (row_i, column_i), (row_j, column_j) = divmod(i - prefix, columns), divmod(j - prefix, columns)
                    assert row_i < rows
                    nearness = np.exp(-((row_i - row_j) ** 2 + (column_i - column_j) ** 2) / (2 * sigma**2))
                logits.append(keys[head, i] @ keys[head, j] / np.sqrt(size) + nearness)
            out[i, head * size : (head + 1) * size] = softmax(logits) @ values[head]
    return project(out, attention["proj.weight"], attention["proj.bias"])


def recursive(tokens: np.ndarray, attention: Weights, heads: int, scale: float) -> np.ndarray:
    """The trained attention, then one by the cosines of what it gave: (N, width)."""
    queries, keys, values = split(tokens, attention, heads)
    size = tokens.shape[1] // heads
    first = np.zeros_like(tokens)
    for head in range(heads):
        for i in range(len(tokens)):
            shares = softmax([queries[head, i] @ keys[head, j] / np.sqrt(size) for j in range(len(tokens))])
            first[i, head * size : (head + 1) * size] = shares @ values[head]
    first = project(first, attention["proj.weight"], attention["proj.bias"])
    second = np.zeros_like(tokens)
    for head in range(heads):
        part = first[:, head * size : (head + 1) * size]
        part = part / np.linalg.norm(part, axis=1, keepdims=True)
        for i in range(len(tokens)):
            cosines = [part[i] @ part[j] for j in range(len(tokens))]
            alike = [j for j, cosine in enumerate(cosines) if cosine >= 0]
            second[i, head * size : (head + 1) * size] = softmax([scale * cosines[j] for j in alike]) @ values[head][alike]
    return project(second, attention["proj.weight"], attention["proj.bias"])


def last_block(tokens: np.ndarray, weights: Weights, attend: Callable[[np.ndarray, Weights], np.ndarray]) -> np.ndarray:
    """The block around an attention, on (N, width) tokens that enter it.

    Args:
        tokens: Of one image.
        weights: Of the block, as timm names them.
        attend: Takes tokens and the weights of the attention.
    """
    attention = {name.removeprefix("attn."): value for name, value in weights.items() if name.startswith("attn.")}
    attended = attend(layer_norm(tokens, weights, "norm1", LAYER_EPSILON), attention)
    tokens = tokens + attended * weights["ls1.gamma"]
    hidden = project(layer_norm(tokens, weights, "norm2", LAYER_EPSILON), weights["mlp.fc1.weight"], weights["mlp.fc1.bias"])
    return tokens + project(gelu(hidden), weights["mlp.fc2.weight"], weights["mlp.fc2.bias"]) * weights["ls2.gamma"]
