"""Networks of encoders as graphs of fixed shape, for runtimes other than torch's own.

Images alone go through them. Text towers stay in torch: a prompt comes once in a while and is short.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import nn

Network = Callable[[torch.Tensor], torch.Tensor | tuple[torch.Tensor, ...]]
"""Images in, one or several tensors out: a torch module, or what runs the same graph elsewhere."""


@dataclass(frozen=True)
class Graph:
    """A network with the one shape that it is run at.

    Attributes:
        name: ``patch`` or ``crop``; with the trio's name it names files.
        network: On its device, in evaluation mode; takes one float32 tensor and returns one float32 tensor, or a tuple.
        shape: Of its input: (n, 3, H, W), images as the encoder prepares them. Fewer than n are padded by who runs it.
        outputs: Names of its outputs, in order; the first are embeddings along the last axis, or logits that become such.
    """

    name: str
    network: nn.Module
    shape: tuple[int, int, int, int]
    outputs: tuple[str, ...]


@runtime_checkable
class GraphEncoder(Protocol):
    """A patch or crop encoder whose network can be run elsewhere."""

    def graph(self, height: int, width: int) -> Graph:
        """Its network at the shape it is run at for an image of this size, pixels."""
        ...

    def run_with(self, network: Network) -> None:
        """Run this in place of the network; it takes and returns tensors of the encoder's device."""
        ...
