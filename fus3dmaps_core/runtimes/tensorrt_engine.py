"""TensorRT engines: built from an ONNX file, which says what is computed in which precision, and loaded again."""

from __future__ import annotations

import logging
from pathlib import Path
from types import ModuleType
from typing import Any

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.cached_files import write_atomically

WORKSPACE_MIB = 2048
"""Scratch memory that an engine may take while it runs; more lets TensorRT choose from more kernels."""

_log = logging.getLogger(__name__)


def build_engine(tensorrt: ModuleType, path: Path, timing_cache: Path) -> bytes:
    """Build the engine of an ONNX file for the current CUDA device; takes minutes.

    Args:
        tensorrt: The package.
        path: ONNX file; weights outside of it are found beside it.
        timing_cache: File with the times that kernels took in earlier builds on this GPU, which make later builds faster;
            it is made or updated.

    Returns:
        The serialised engine.

    Raises:
        EncoderError: TensorRT cannot read the file or build an engine of it.
    """
    logger = _logger(tensorrt)
    builder = tensorrt.Builder(logger)
    # Strongly typed: what the file has in float32 stays float32, so that sums that overflow elsewhere do not do so here.
    network = builder.create_network(1 << int(tensorrt.NetworkDefinitionCreationFlag.STRONGLY_TYPED))
    parser = tensorrt.OnnxParser(network, logger)
    if not parser.parse_from_file(str(path)):
        problem = parser.get_error(0).desc() if parser.num_errors else "no reason given"
        raise EncoderError(f"graph '{path}': TensorRT {tensorrt.__version__} cannot read it: {_line(problem)}")
    config = builder.create_builder_config()
    config.set_memory_pool_limit(tensorrt.MemoryPoolType.WORKSPACE, WORKSPACE_MIB << 20)
    # By default float32 sums are taken in TF32, a thousandth apart from what the file was checked with.
    config.clear_flag(tensorrt.BuilderFlag.TF32)
    cache = config.create_timing_cache(_read(timing_cache))
    # A damaged one, or another version's, is refused, which costs the time that it would have saved.
    if cache is None or not config.set_timing_cache(cache, False):
        cache = config.create_timing_cache(b"")
        config.set_timing_cache(cache, False)
    _log.info("building the TensorRT engine of '%s', which takes minutes", path.name)
    plan = builder.build_serialized_network(network, config)
    if plan is None:
        raise EncoderError(
            f"graph '{path}': TensorRT {tensorrt.__version__} cannot build an engine of it: {_line(logger.last_error)}"
        )
    _keep(timing_cache, bytes(config.get_timing_cache().serialize()))
    return bytes(plan)


def load_engine(tensorrt: ModuleType, plan: bytes) -> Any | None:
    """Load a serialised engine; None where TensorRT refuses it as damaged, or of another version or GPU."""
    return tensorrt.Runtime(_logger(tensorrt)).deserialize_cuda_engine(plan)


def _logger(tensorrt: ModuleType) -> Any:
    class _Logger(tensorrt.ILogger):  # type: ignore[misc, name-defined]
        """Hands TensorRT's messages to logging and remembers the last error, which it has no other way to tell."""

        def __init__(self) -> None:
            super().__init__()
            self.last_error = "no reason given"

        def log(self, severity: Any, message: str) -> None:
            if severity in (tensorrt.ILogger.Severity.INTERNAL_ERROR, tensorrt.ILogger.Severity.ERROR):
                self.last_error = message
                _log.error("TensorRT: %s", message)
            elif severity == tensorrt.ILogger.Severity.WARNING:
                _log.warning("TensorRT: %s", message)

    return _Logger()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _keep(path: Path, content: bytes) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        _log.warning("cannot keep TensorRT's timings as '%s': %s", path, error)


def _line(message: str) -> str:
    return (message.strip().splitlines() or ["no reason given"])[0]
