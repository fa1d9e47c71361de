"""The packages behind the runtimes, and how each is installed where it is missing."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from fus3dmaps_core.encoders.optional_packages import EXTRA
from fus3dmaps_core.errors import EncoderError

_MINIMUM_TENSORRT = 10
HOW_TO_GET_TENSORRT = (
    "on a Jetson it comes with JetPack ('sudo apt install tensorrt python3-libnvinfer'; a virtual environment sees it if it "
    "was made with --system-site-packages), on x86-64 'pip install tensorrt-cu12'"
)


def import_onnxruntime() -> ModuleType:
    """Import the package ``onnxruntime``.

    Raises:
        EncoderError: It is not installed.
    """
    return _import("onnxruntime", f"use {EXTRA}")


def import_onnx() -> ModuleType:
    """Import the package ``onnx``, with which graphs are read and written.

    Raises:
        EncoderError: It is not installed.
    """
    return _import("onnx", f"use {EXTRA}")


def check_exporter() -> None:
    """Check that torch can write ONNX, for which it needs ``onnx`` and ``onnxscript``.

    Raises:
        EncoderError: One of them is not installed.
    """
    import_onnx()
    _import("onnxscript", f"use {EXTRA}")


def import_tensorrt() -> ModuleType:
    """Import the package ``tensorrt``, version 10 or newer.

    Raises:
        EncoderError: It is missing or older; the message says how to get it.
    """
    tensorrt = _import("tensorrt", HOW_TO_GET_TENSORRT)
    version = str(tensorrt.__version__)
    if int(version.split(".")[0]) < _MINIMUM_TENSORRT:
        raise EncoderError(
            f"parameter 'encoder.runtime': tensorrt {version} is older than {_MINIMUM_TENSORRT}.0; {HOW_TO_GET_TENSORRT}"
        )
    return tensorrt


def _import(module: str, advice: str) -> ModuleType:
    try:
        return import_module(module)
    except (ImportError, OSError) as error:  # Shared libraries of another CUDA end in either.
        problem = "is not installed" if isinstance(error, ModuleNotFoundError) else f"cannot be imported ({error})"
        raise EncoderError(f"parameter 'encoder.runtime': the package '{module}' {problem}; {advice}") from None
