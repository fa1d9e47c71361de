"""Networks of encoders as graphs of fixed shape, for runtimes other than torch's own.

Only images go through them. Text towers stay in torch: prompts are rare and short.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import nn

Network = Callable[[torch.Tensor], torch.Tensor | tuple[torch.Tensor, ...]]
"""Images in, one or several tensors out: a torch module, or something that runs the same graph elsewhere."""


@dataclass(frozen=True)
class Graph:
    """A network with the one shape that it is run at.

    Attributes:
        name: ``patch`` or ``crop``; with the trio's name it names files.
        network: On its device, in evaluation mode; takes one float32 tensor and returns one float32 tensor, or a tuple.
        shape: Shape of its input: (n, 3, H, W), images as the encoder prepares them. Whoever runs it pads fewer than n.
        outputs: Names of its outputs, in order; the first has embeddings, or logits that become such, along the last axis.
    """

    name: str
    network: nn.Module
    shape: tuple[int, int, int, int]
    outputs: tuple[str, ...]


@runtime_checkable
class GraphEncoder(Protocol):
    """A patch or crop encoder whose network can be run elsewhere."""

    def graph(self, height: int, width: int) -> Graph:
        """Describe its network at the shape that it is run at for an image of this size, pixels."""

    def run_with(self, network: Network) -> None:
        """Run another network in place of its own; it takes and returns tensors of the encoder's device."""
