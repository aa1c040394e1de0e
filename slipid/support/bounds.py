"""Kinds of numbers: pydantic refuses others with a ValueError where they are given."""

from typing import Annotated

from pydantic import ConfigDict, Field

CLOSED = ConfigDict(extra="forbid")
"""Of a dataclass that a config declares: other keys are refused."""

Positive = Annotated[float, Field(gt=0, strict=True, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, strict=True, allow_inf_nan=False)]
Part = Annotated[float, Field(ge=0, lt=1)]
"""Of a whole."""
