"""A network through torch.compile: fused kernels, for one shape, without any file."""

from __future__ import annotations

import torch

from fus3dmaps_core.encoders.network_graphs import Graph
from fus3dmaps_core.errors import EncoderError, first_line
from fus3dmaps_core.runtimes.static_batches import listed, run_in_batches


class CompiledNetwork:
    """A graph's network compiled for its one shape, on its device.

    The compiler's default mode is taken. The modes with CUDA graphs hand out memory that the next batch overwrites, while an
    encoder keeps the embeddings of all batches; the autotuning ones try kernels for minutes at every start.

    Attributes:
        shape: Shape of the input.
    """

    def __init__(self, graph: Graph, trio: str, device: str) -> None:
        """Compile, which takes up to a minute, so that the first frame does not wait for it.

        Args:
            graph: The graph to compile.
            trio: Name of its trio, for messages.
            device: Device that its network is on.

        Raises:
            EncoderError: There is no compiler, or it cannot compile this network.
        """
        self.shape, self._what = graph.shape, f"encoder '{trio}': graph '{graph.name}'"
        self._compiled = torch.compile(graph.network, dynamic=False)
        try:
            with torch.inference_mode():  # As encoders run it; the two modes are compiled apart.
                self._run(torch.zeros(graph.shape, device=device))
        except RuntimeError as error:  # The base of all that the compiler raises.
            reason = first_line(error).rstrip(":;. ")
            raise EncoderError(
                f"parameter 'encoder.runtime': torch cannot compile the graph '{graph.name}' of encoder '{trio}' on "
                f"'{device}': {reason}; it needs a C++ compiler (apt install g++), on CUDA triton; or set it to torch"
            ) from None

    def __call__(self, images: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        """Run any number of images; see :func:`fus3dmaps_core.runtimes.static_batches.run_in_batches`."""
        return run_in_batches(self._run, images, self.shape, self._what)

    def _run(self, images: torch.Tensor) -> list[torch.Tensor]:
        return listed(self._compiled(images))
