"""Exceptions that refuse a request: this package's errors, and rclpy's for arguments and names that it cannot use."""

from __future__ import annotations

from rclpy.exceptions import NameValidationException
from rclpy.impl.implementation_singleton import rclpy_implementation

from fus3dmaps_core.errors import Fus3dmapsError

# The binding's exception classes have no public module; UnknownROSArgsError does not derive from RCLError.
REFUSALS: tuple[type[Exception], ...] = (
    Fus3dmapsError,
    NameValidationException,
    rclpy_implementation.RCLError,
    rclpy_implementation.UnknownROSArgsError,
)
"""Exceptions that are shown as one line, not as a traceback."""


def one_line(error: Exception) -> str:
    """Return the message of an error without the line breaks that the middleware puts into its messages."""
    return " ".join(str(error).split())
