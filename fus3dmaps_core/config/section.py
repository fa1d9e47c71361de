"""What the sections of the configuration schema have in common."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """Part of the configuration: unknown keys, infinities and changes after it was made are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
