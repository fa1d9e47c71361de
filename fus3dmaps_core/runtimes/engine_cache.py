"""TensorRT engines on disk: each serves one graph on one kind of GPU with one version of TensorRT."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from fus3dmaps_core.config.schema import Precision
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.cached_files import graph_hash, slug, write_atomically
from fus3dmaps_core.runtimes.tensorrt_engine import build_engine, load_engine

_HASH_DIGITS = 16

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Gpu:
    """What an engine is built for.

    Attributes:
        name: As the driver says it.
        capability: Major and minor compute capability.
    """

    name: str
    capability: tuple[int, int]

    @classmethod
    def of(cls, device: str) -> Gpu:
        """Describe the GPU behind a CUDA device of torch."""
        properties = torch.cuda.get_device_properties(torch.device(device))
        return cls(properties.name, (properties.major, properties.minor))

    @property
    def slug(self) -> str:
        """The GPU as part of a file's name."""
        return f"{slug(self.name)}-sm{self.capability[0]}{self.capability[1]}"


def engine_path(directory: Path, graph: Path, shape: tuple[int, ...], precision: Precision, version: str, gpu: Gpu) -> Path:
    """Return where the engine of a graph is kept; the name holds all that makes another engine necessary.

    Args:
        directory: Directory of engines.
        graph: ONNX file; its name and its hash are part of the name.
        shape: Shape of its input.
        precision: Precision of the graph.
        version: Version of TensorRT.
        gpu: GPU that the engine is for.

    Raises:
        EncoderError: The graph cannot be read.
    """
    try:
        content = graph_hash(graph)[:_HASH_DIGITS]
    except OSError as error:
        raise EncoderError(f"graph '{graph}': it cannot be read: {error.strerror}") from None
    parts = (slug(graph.stem), content, "x".join(map(str, shape)), precision, f"trt{slug(version)}", gpu.slug)
    return directory / f"{'_'.join(parts)}.engine"


def cached_engine(
    tensorrt: ModuleType,
    graph: Path,
    shape: tuple[int, ...],
    precision: Precision,
    gpu: Gpu,
    directory: Path,
) -> tuple[Any, Path]:
    """Load the engine of a graph from its file, or build it and keep it there.

    A file that TensorRT refuses, because it is cut short or from elsewhere, is replaced.

    Args:
        tensorrt: The package.
        graph: ONNX file.
        shape: Shape of its input.
        precision: Precision of the graph.
        gpu: The current CUDA device.
        directory: Directory of engines; made if it is missing.

    Returns:
        The engine, and where it is kept.

    Raises:
        EncoderError: It cannot be built or kept.
    """
    version = str(tensorrt.__version__)
    path = engine_path(directory, graph, shape, precision, version, gpu)
    if path.is_file():
        engine = load_engine(tensorrt, path.read_bytes())
        if engine is not None:
            return engine, path
        _log.warning("TensorRT refuses the engine '%s'; it is built anew", path)
    timings = directory / f"timings_trt{slug(version)}_{gpu.slug}.cache"
    plan = build_engine(tensorrt, graph, timings)
    engine = load_engine(tensorrt, plan)
    if engine is None:
        raise EncoderError(f"graph '{graph}': TensorRT {version} cannot load the engine that it built")
    try:
        write_atomically(path, plan)
    except OSError as error:
        raise EncoderError(f"parameter 'encoder.graph_directory': cannot write '{path}': {error.strerror}") from None
    return engine, path
