"""The device of a model, tried before anything is loaded onto it."""

from __future__ import annotations

import torch

from fus3dmaps_core.errors import EncoderError


def check_device(device: str) -> None:
    """Try a torch device by its name, e.g. ``cpu`` or ``cuda:0``.

    Raises:
        EncoderError: Torch does not know it, or there is none.
    """
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # Torch asserts where it was built without CUDA.
        raise EncoderError(f"parameter 'encoder.device': torch cannot use '{device}': {error}") from None
