"""Results as tables for people, on stdout."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

COLOUR = {"identified": "green", "weak": "yellow", "not_identified": "red", "at_bound": "magenta"}


def _console() -> Console:
    return Console(highlight=False)


def number(x: Any, digits: int = 4) -> str:
    """A number or a few, short."""
    if x is None:
        return ""
    if isinstance(x, Sequence):
        return " ".join(number(v, digits) for v in x)
    return f"{x:.{digits}g}"


def _interval(x: Any) -> str:
    if x is None:
        return ""
    if isinstance(x[0], Sequence):
        return "  ".join(_interval(pair) for pair in x)
    return f"{x[0]:.4g} .. {x[1]:.4g}"


def estimates(items: Iterable[Any], title: str) -> Table:
    """Table of estimates; numbers of single sessions are left to the files."""
    table = Table(title=title, title_justify="left", show_edge=False, pad_edge=False)
    for name in ("parameter", "value", "unit", "90 % interval", "verdict", "from"):
        table.add_column(name, overflow="fold")
    for e in items:
        if "session_yaw" in e.path or e.verdict == "fixed" and e.provenance == "borrowed":
            continue
        colour = COLOUR.get(e.verdict, "dim")
        verdict = f"[{colour}]{e.verdict.replace('_', ' ')}[/{colour}]"
        table.add_row(
            e.path, number(e.value), e.unit, _interval(e.interval90), verdict, e.provenance
        )
    return table


def identified(fit: Any, out: Path, written: Sequence[str]) -> None:
    """What `identify` found."""
    console = _console()
    console.print(estimates(fit.parameters.values(), f"{len(fit.runs)} runs, {fit.rounds} rounds"))
    for sentence in fit.messages:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)
    state = "converged" if fit.converged else "NOT converged"
    console.print(f"{state}: {fit.reason}", markup=False, soft_wrap=True)
    console.print(f"in {out}: {', '.join(written)}", markup=False, soft_wrap=True)


def validation(found: dict[str, Any]) -> None:
    """Summary of a validation: one row per floor and model."""
    table = Table(show_edge=False, pad_edge=False)
    for name in ("surface", "model", "end-point error", "median", "length", "heading"):
        table.add_column(name)
    table.add_column("in 90 %")
    table.add_column("runs")
    for surface, models in found["summary"].items():
        for model, s in models.items():
            table.add_row(
                surface,
                model,
                _percent(s["endpoint_error_mean"]),
                _percent(s["endpoint_error_median"]),
                _percent(s["length_error_mean"]),
                ""
                if s["heading_error_median_deg"] is None
                else f"{s['heading_error_median_deg']:.2f} deg",
                _percent(s["coverage90"]),
                str(s["runs"]),
            )
    _console().print(table)


def _percent(x: float | None) -> str:
    return "" if x is None else f"{100 * x:.2f} %"
