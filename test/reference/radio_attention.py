"""The two attentions of RADIO's last block, one token and one head at a time."""

from __future__ import annotations

import numpy as np


def project(tokens: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    return tokens @ weight.T + bias


def softmax(logits: list[float]) -> np.ndarray:
    powers = np.exp(np.asarray(logits) - max(logits))
    return powers / powers.sum()


def split(tokens: np.ndarray, attention: dict[str, np.ndarray], heads: int):
    """Queries, keys and values of (N, width) tokens: (heads, N, width / heads) each."""
    width = tokens.shape[1]
    joined = project(tokens, attention["qkv.weight"], attention["qkv.bias"])
    return (
        np.stack([joined[:, part * width + head * width // heads :][:, : width // heads] for head in range(heads)])
        for part in range(3)
    )


def neighbourhood(
    tokens: np.ndarray, attention: dict[str, np.ndarray], heads: int, prefix: int, rows: int, columns: int, sigma: float
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


def recursive(tokens: np.ndarray, attention: dict[str, np.ndarray], heads: int, scale: float) -> np.ndarray:
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
