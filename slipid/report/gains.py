"""Feed-forward and feedback gains as a table, and as sentences."""

from collections.abc import Iterator
from dataclasses import dataclass

from rich.text import Text

from slipid.report.numbers import estimate, interval
from slipid.report.page import Page, heading, table, verdict
from slipid.support.content import Content

EQUATION = "V = kS sign(w) + kV w + kA dw/dt"
HEAD = ("gain", "value", "unit", "90 % interval", "verdict", "per rotation", "per metre")
"""Columns of a table of gains."""


@dataclass(frozen=True)
class GainRow:
    """One feed-forward gain as text.

    Attributes:
        name: motor or axis that the gain belongs to.
        gain: name of the gain.
        value: value [unit].
        unit: unit of the value.
        interval90: 90 % interval [unit].
        verdict: verdict on its identification.
        per_rotation: value per rotation instead of per radian; empty for a voltage.
        per_metre: value per metre of the wheel's rim; empty for a voltage, or without a wheel.
    """

    name: str
    gain: str
    value: str
    unit: str
    interval90: str
    verdict: str
    per_rotation: str
    per_metre: str


def gain_rows(found: Content) -> Iterator[GainRow]:
    """Yield a row for each gain in the content `feedforward` of a result file."""
    for name, parts in found.items():
        for gain in (key for key in ("kS", "kV", "kA", "kG") if key in parts):
            one = parts[gain]
            shown, ends = estimate(one["value"], one["interval90"]), interval(one["interval90"])
            others = (parts.get(unit, {}).get(gain) for unit in ("per_rotation", "per_metre"))
            rotation, metre = (
                "" if x is None else estimate(x["value"], x["interval90"]) for x in others
            )
            yield GainRow(name, gain, shown, one["unit"], ends, one["verdict"], rotation, metre)


def feedback_sentences(found: Content) -> list[str]:
    """Return a sentence on the feedback gains of each motor or axis, and one on their design."""
    out = []
    for name, one in found.items():
        shown = {
            key: f"{x['value']:.4g} {x['unit']}" for key, x in one.items() if key[-3:-1] == "_k"
        }
        word = one["verdict"].replace("_", " ")
        out.append(
            f"feedback of {name}: velocity loop kP {shown['velocity_kP']}; position loop kP "
            f"{shown['position_kP']}, kD {shown['position_kD']} ({word})"
        )
    if found:
        demand = next(iter(found.values()))["demand"]
        out.append(
            f"feedback is designed as by WPILib's SysId: largest position error "
            f"{demand['position_error']:.3g} rad, velocity error a quarter of the speed at 12 V, "
            f"{demand['effort']:g} V, a period of {demand['period_s']:g} s, measurements "
            f"{demand['delay_s']:g} s late"
        )
    return out


def show_gains(page: Page, content: Content) -> None:
    """Write the gains in the content of a result file, if there are any."""
    rows = list(gain_rows(content.get("feedforward", {})))
    if not rows:
        return
    columns = HEAD if any(row.per_metre for row in rows) else HEAD[:-1]
    made = table(columns, f"\nfeed-forward gains, {EQUATION}", ("value", *HEAD[-2:]))
    names = [row.name for row in rows]
    for k, row in enumerate(rows):
        if row.name not in names[:k]:
            heading(made, row.name)
        word = verdict(row.verdict)
        cells = (row.value, row.unit, row.interval90, word, row.per_rotation, row.per_metre)
        made.add_row(Text(f"  {row.gain}"), *cells[: len(columns) - 1])
    page.table(made)
    for sentence in feedback_sentences(content["feedback"]):
        page.line(sentence)
