"""Errors of fitted motors on held-out rows, beside those of least squares, as text."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slipid.infer.bench.held_out import Errors, HeldOut

WORDS = {
    "least_squares": "least squares",
    "least_squares_with_offset": "least squares with offsets",
}
"""Names of the rivals in words."""
ABOUT = "held-out rows, simulated from the voltage alone"


@dataclass(frozen=True)
class HeldOutRow:
    """Root mean square errors of one channel.

    Attributes:
        channel: `speed` or `current`.
        unit: unit of the errors.
        error: error of the fitted motor.
        rivals: error of each rival, keyed by its name in words.
    """

    channel: str
    unit: str
    error: str
    rivals: dict[str, str]


def held_out_rows(found: "HeldOut") -> Iterator[HeldOutRow]:
    """Yield the errors of each channel that was logged."""

    def row(channel: str, unit: str, size: float, rivals: dict[str, float]) -> HeldOutRow:
        others = {WORDS[name]: f"{x:.3g}" for name, x in rivals.items()}
        return HeldOutRow(channel, unit, f"{size:.3g}", others)

    def currents(errors: dict[str, "Errors"]) -> dict[str, float]:
        return {name: e.current for name, e in errors.items() if e.current is not None}

    own, rivals = found.errors, found.rivals
    yield row("speed", "rad/s", own.speed, {name: e.speed for name, e in rivals.items()})
    if own.current is not None:
        yield row("current", "A", own.current, currents(rivals))


def held_out_sentence(found: "HeldOut") -> str:
    """Return the errors of all channels in one line."""
    parts = []
    for row in held_out_rows(found):
        others = ", ".join(f"{name} {size}" for name, size in row.rivals.items())
        parts.append(f"{row.channel} within {row.error} {row.unit} ({others})")
    return f"{ABOUT}: {'; '.join(parts)}"
