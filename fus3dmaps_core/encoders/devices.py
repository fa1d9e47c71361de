"""The device of a model, tried before anything is loaded onto it, and the precision that suits it."""

from __future__ import annotations

import torch

from fus3dmaps_core.errors import EncoderError, first_line


def check_device(device: str) -> None:
    """Try a torch device by its name, e.g. ``cpu`` or ``cuda:0``.

    Raises:
        EncoderError: Torch does not know it, or there is none.
    """
    try:
        torch.empty(0, device=device).cpu()  # And back: "meta" holds no values.
    except (RuntimeError, AssertionError, ImportError) as error:  # Torch asserts where it was built without CUDA.
        # Torch may explain itself over half a hundred lines, the first sentence of which says it.
        reason = first_line(error).partition(". ")[0]
        raise EncoderError(f"parameter 'encoder.device': torch cannot use {device!r}: {reason}") from None


def default_dtype(device: str) -> torch.dtype:
    """Choose a transformer's precision: bfloat16 on CUDA, and float32 elsewhere, where it is the faster one."""
    # SigLIP 2 was trained in bfloat16, and RADIO's authors run it so.
    return torch.bfloat16 if torch.device(device).type == "cuda" else torch.float32
