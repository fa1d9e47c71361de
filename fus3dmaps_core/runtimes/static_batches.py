"""Any number of images through a graph that takes a fixed number: whole batches, the last of them padded."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch.nn import functional

from fus3dmaps_core.errors import EncoderError

Run = Callable[[torch.Tensor], Sequence[torch.Tensor]]
"""Runs one whole batch, (n, 3, H, W) contiguous float32; every output has n rows and is the caller's to keep."""


Outputs = torch.Tensor | tuple[torch.Tensor, ...]
"""What a graph gives: a tensor, or several."""


def listed(outputs: Outputs) -> list[torch.Tensor]:
    """Return the outputs of a graph as a list, whether one or several."""
    return [outputs] if isinstance(outputs, torch.Tensor) else list(outputs)


def run_in_batches(run: Run, images: torch.Tensor, shape: Sequence[int], what: str) -> Outputs:
    """Run images through a graph of fixed shape.

    Args:
        run: Runs one batch of that shape.
        images: (m, 3, H, W), any m; brought to contiguous float32.
        shape: (n, 3, H, W) of a batch.
        what: Which graph it is, for the message.

    Returns:
        The graph's output with m rows, or a tuple of them where it has several.

    Raises:
        EncoderError: The images are of another size.
    """
    if images.dim() != len(shape) or tuple(images.shape[1:]) != tuple(shape[1:]):
        raise EncoderError(f"{what} takes images of shape {tuple(shape)[1:]}, got {tuple(images.shape)[1:]}")
    count, size = len(images), int(shape[0])
    images = images.to(torch.float32).contiguous()
    batches = []
    for start in range(0, max(count, 1), size):  # No images are a batch of padding, which gives outputs without rows.
        batch = images[start : start + size]
        rows = len(batch)
        padded = batch if rows == size else functional.pad(batch, (0, 0, 0, 0, 0, 0, 0, size - rows))
        batches.append([output[:rows] for output in run(padded)])
    outputs = batches[0] if len(batches) == 1 else [torch.cat(parts) for parts in zip(*batches, strict=True)]
    return outputs[0] if len(outputs) == 1 else tuple(outputs)
