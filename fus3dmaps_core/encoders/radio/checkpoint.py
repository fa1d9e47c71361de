"""A RADIO checkpoint, read by RADIO's own loader, but never as code: only tensors and plain values are let in."""

from __future__ import annotations

import argparse
import os
import pickle
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from fus3dmaps_core.encoders.radio.checkout import import_from
from fus3dmaps_core.encoders.weights import reading_problem
from fus3dmaps_core.errors import EncoderError, first_line

# torch.load heeds it whatever its caller asked for, and RADIO's loader asks for anything that a file may hold.
_WEIGHTS_ONLY = "TORCH_FORCE_WEIGHTS_ONLY_LOAD"
_load_lock = threading.Lock()


@dataclass(frozen=True)
class Checkpoint:
    """What a file of RADIO's weights holds.

    Attributes:
        path: The file.
        radio: ``RADIOModel`` without adaptors, on the CPU, float32, for inference.
        options: Options that it was trained with, which say how its networks are built.
        state: All tensors by name, those of the adaptors' heads among them.
    """

    path: Path
    radio: Any
    options: Any
    state: Mapping[str, torch.Tensor]


def read_checkpoint(path: Path, checkout: Path, encoder: str) -> Checkpoint:
    """Build RADIO's network as the file says, with the file's weights.

    Args:
        path: A checkpoint as RADIO's authors publish them.
        checkout: RADIO's code, see :mod:`fus3dmaps_core.encoders.radio.checkout`.
        encoder: Name of the trio, for messages.

    Raises:
        EncoderError: The file is damaged, holds Python objects, is no RADIO checkpoint, or lacks weights.
    """
    import_from(checkout, "radio.adaptor_module_factory", encoder)
    try:
        with _only_weights(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Missing weights are refused below, and other versions' hints are not ours.
            hub: Any = torch.hub  # Without type hints.
            radio, content = hub.load(
                str(checkout), "radio_model", source="local", version=str(path), return_checkpoint=True, progress=False
            )
    except pickle.UnpicklingError as error:
        raise EncoderError(f"weights '{path}': {reading_problem(error)}") from None
    except (KeyError, AttributeError) as error:
        raise EncoderError(f"weights '{path}': not a checkpoint of RADIO, it has no {first_line(error)}") from None
    except Exception as error:  # The reader and the network's builder raise whatever they come across.
        raise EncoderError(f"weights '{path}': cannot be read as a checkpoint of RADIO: {first_line(error)}") from None
    state = content["state_dict_ema"] if "state_dict_ema" in content else content["state_dict"]
    missing = [name for name in radio.model.state_dict() if not _has(state, f"base_model.{name}")]
    if missing:
        raise EncoderError(
            f"weights '{path}': weights of another architecture than {content['args'].model}: {len(missing)} missing "
            f"({', '.join(missing[:3])}{', ...' if len(missing) > 3 else ''})"
        )
    return Checkpoint(path, radio.eval().requires_grad_(False).float(), content["args"], state)


def _has(state: Mapping[str, torch.Tensor], name: str) -> bool:
    """Tell whether a weight is there, as it is or as the product that it was trained as."""
    parent, _, leaf = name.rpartition(".")
    return name in state or any(key.startswith(f"{parent}.parametrizations.{leaf}.") for key in state)


@contextmanager
def _only_weights() -> Iterator[None]:
    with _load_lock, torch.serialization.safe_globals([argparse.Namespace]):
        before = os.environ.get(_WEIGHTS_ONLY)
        os.environ[_WEIGHTS_ONLY] = "1"
        try:
            yield
        finally:
            if before is None:
                del os.environ[_WEIGHTS_ONLY]
            else:
                os.environ[_WEIGHTS_ONLY] = before
