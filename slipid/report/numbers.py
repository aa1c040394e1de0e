"""Numbers and intervals as text, with as many digits as their intervals deserve."""

from collections.abc import Sequence
from math import floor, isfinite, log10

MOST_DIGITS = 6
"""Largest number of significant digits [1]."""


def rounded(value: float, width: float) -> str:
    """Return a number as text, to about a hundredth of the width of its interval.

    It has two to six significant digits, and four if the width is 0 or not finite. Numbers with
    intervals of one width have as many decimal places, unless one of them is very small.
    """
    if not (isfinite(width) and isfinite(value)) or width <= 0 or value == 0:
        return f"{value:.4g}"
    size = floor(log10(abs(value)))
    places = min(floor(2 - log10(width) + 1e-9), MOST_DIGITS - 1 - size)
    if size + places < 1 or size < -5 or size > 5:
        return f"{value:#.2g}".removesuffix(".") if size < 2 else f"{value:.{min(size + 1, 5)}g}"
    return f"{value:.{max(places, 0)}f}"


def estimate(value: float, ends: Sequence[float] | None) -> str:
    """Return a number as text, with the digits that its interval deserves."""
    return rounded(value, 0.0 if ends is None else ends[1] - ends[0])


def interval(ends: Sequence[float] | None, between: str = " .. ") -> str:
    """Return an interval as text, empty for None; `between` stands between its ends."""
    return "" if ends is None else between.join(rounded(end, ends[1] - ends[0]) for end in ends)
