"""The base of every section of the schema, and what a field says about its parameter besides type and default."""

from __future__ import annotations

from enum import Enum
from typing import Annotated, Any, TypeVar

import annotated_types
from pydantic import BaseModel, ConfigDict
from pydantic.fields import FieldInfo

T = TypeVar("T")


class Section(BaseModel):
    """Part of the configuration: unknown keys, infinities and changes after it was made are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Changes(Enum):
    """Moments at which a running node takes another value of a parameter."""

    ANY_TIME = 0
    UNCONFIGURED = 1
    NEVER = 2


Changeable = Annotated[T, Changes.ANY_TIME]
"""Type of a parameter that can change at any time."""

Fixed = Annotated[T, Changes.NEVER]
"""Type of a parameter that only matters when the node starts."""


def when_it_changes(field: FieldInfo) -> Changes:
    """Return the mark of a field; without one it shapes the models, the map or the topics of a configured node."""
    return next((mark for mark in field.metadata if isinstance(mark, Changes)), Changes.UNCONFIGURED)


_SIGNS = {
    annotated_types.Ge: (">=", "ge"),
    annotated_types.Gt: (">", "gt"),
    annotated_types.Le: ("<=", "le"),
    annotated_types.Lt: ("<", "lt"),
}


def bounds(field: FieldInfo) -> dict[str, Any]:
    """Return the bounds of a field by their sign: ``>=``, ``>``, ``<=`` or ``<``."""
    signs = [(bound, *_SIGNS[type(bound)]) for bound in field.metadata if type(bound) in _SIGNS]
    return {sign: getattr(bound, name) for bound, sign, name in signs}


def choices(field: FieldInfo) -> tuple[str, ...]:
    """Return the texts that a field allows; empty if it is not a choice of texts."""
    values = getattr(field.annotation, "__args__", ())
    return values if all(isinstance(value, str) for value in values) else ()
