"""Errors of fitted motors on held-out rows, beside those of least squares, as text."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slipid.infer.held_out import HeldOut

WORDS = {
    "least_squares": "least squares",
    "least_squares_with_offset": "least squares with offsets",
}
"""Names of the rivals in words."""
SIMULATED = "held-out rows, simulated from the voltage alone"
PREDICTED = "motors in held-out windows, from voltage and wheel speed"


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
    own, rivals = found.errors, found.rivals
    yield from _row("speed", "rad/s", own.speed, {name: e.speed for name, e in rivals.items()})
    yield from _row("current", "A", own.current, {name: e.current for name, e in rivals.items()})


def _row(
    channel: str, unit: str, size: float | None, rivals: dict[str, float | None]
) -> Iterator[HeldOutRow]:
    """Yield the errors of a channel if there are any."""
    if size is not None:
        others = {WORDS[name]: f"{x:.3g}" for name, x in rivals.items() if x is not None}
        yield HeldOutRow(channel, unit, f"{size:.3g}", others)


def held_out_sentence(found: "HeldOut", about: str = SIMULATED) -> str:
    """Return the errors of all channels in one line, which begins with what they are `about`."""
    parts = []
    for row in held_out_rows(found):
        others = ", ".join(f"{name} {size}" for name, size in row.rivals.items())
        parts.append(f"{row.channel} within {row.error} {row.unit} ({others})")
    return f"{about}: {'; '.join(parts)}"
