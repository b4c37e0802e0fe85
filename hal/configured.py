"""The base of every model that a user fills in from YAML."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Configured(BaseModel):
    """Immutable; an unknown key, NaN or infinity is an error, never a silent default."""

    # Built at first use: most models are only parts of one that is used.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)
