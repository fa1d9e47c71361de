"""The base of every section of the schema, and the marks that say when a parameter can change."""

from __future__ import annotations

from enum import Enum
from typing import Annotated, TypeVar

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
