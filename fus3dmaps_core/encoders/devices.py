"""The device of a model, tried before anything is loaded onto it."""

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
