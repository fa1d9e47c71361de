"""Packages of the extra ``models``, imported only when an encoder or segmenter that needs them is loaded."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from fus3dmaps_core.errors import EncoderError, first_line

EXTRA = "fus3dmaps_ros[models]"


def import_optional(module: str, name: str, kind: str = "encoder") -> ModuleType:
    """Import a module of a package that the base installation does not have.

    Args:
        module: Dotted name.
        name: Name of the encoder or segmenter that needs it, for the message.
        kind: ``encoder`` or ``segmenter``.

    Raises:
        EncoderError: It is not installed, or not for this torch; the message names the parameter that chose it, and
            the extra that has it.
    """
    needs = f"parameter '{kind}.name': {kind} '{name}'"
    try:
        return import_module(module)
    except ImportError as error:
        raise EncoderError(f"{needs} needs '{error.name or module}', which is not installed; use {EXTRA}") from None
    except (RuntimeError, OSError, AttributeError) as error:  # So torchvision fails beside another torch than its own.
        reason = first_line(error)
        raise EncoderError(f"{needs}: cannot import '{module}' ({reason}); install {EXTRA}") from None
