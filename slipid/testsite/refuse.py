"""Refusals of numbers that no robot can have, where they are given."""

from math import isfinite


def positive(thing: object, *names: str) -> None:
    """ValueError unless these attributes are above 0."""
    for name in names:
        value = getattr(thing, name)
        if not (value > 0 and isfinite(value)):
            raise ValueError(f"{name} = {value}; expected a number above 0")


def at_most(thing: object, **limits: float) -> None:
    """ValueError where these attributes are above their limits."""
    for name, limit in limits.items():
        value = getattr(thing, name)
        if not value <= limit:
            raise ValueError(f"{name} = {value}; expected at most {limit:g}")


def not_negative(thing: object, *names: str) -> None:
    """ValueError unless these attributes are 0 or above."""
    for name in names:
        value = getattr(thing, name)
        if not (value >= 0 and isfinite(value)):
            raise ValueError(f"{name} = {value}; expected 0 or above")
