"""Results as tables for people, on stdout."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

COLOUR = {"identified": "green", "weak": "yellow", "not_identified": "red", "at_bound": "magenta"}


def _console() -> Console:
    found = Console(highlight=False)
    if not found.is_terminal:  # a file or a pipe has no width: do not wrap
        found = Console(highlight=False, width=140)
    return found


def _rows(e: Any) -> list[tuple[str, Any, Any]]:
    """Name, value and interval of a scalar, or of each entry of a vector."""
    if not e.labels:
        return [(e.path, e.value, e.interval90)]
    intervals = e.interval90 or [None] * len(e.labels)
    names = [e.path] + [""] * (len(e.labels) - 1)
    return [
        (f"{name} [{label}]".strip(), value, interval)
        for name, label, value, interval in zip(names, e.labels, e.value, intervals, strict=True)
    ]


def estimates(items: Iterable[Any], title: str) -> Table:
    """Table of estimates; numbers of single sessions and defaults are left to the files."""
    table = Table(title=title, title_justify="left", show_edge=False, pad_edge=False, box=None)
    for name in ("parameter", "value", "unit", "90 % interval", "verdict", "from"):
        table.add_column(name, justify="right" if name == "value" else "left")
    for e in items:
        if "session_yaw" in e.path or (e.verdict == "fixed" and e.provenance == "borrowed"):
            continue
        colour = COLOUR.get(e.verdict, "dim")
        for k, (name, value, interval) in enumerate(_rows(e)):
            table.add_row(
                Text(name),
                f"{value:.4g}",
                e.unit,
                "" if interval is None else f"{interval[0]:.4g} .. {interval[1]:.4g}",
                "" if k else f"[{colour}]{e.verdict.replace('_', ' ')}[/{colour}]",
                "" if k else e.provenance,
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


def check(found: dict[str, Any]) -> None:
    """What `check` found."""
    console = _console()
    table = Table(show_edge=False, pad_edge=False, box=None)
    for name in ("surface", "load", "session", "runs", "minutes", "headings", "speeds [m/s]"):
        table.add_column(name)
    for row in found["groups"]:
        speeds = " ".join(f"{v:g}" for v in row["speeds"])
        table.add_row(
            row["surface"],
            row["load"],
            Text(row["session"]),
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"]),
            speeds,
        )
    console.print(table)
    console.print("channels: " + ", ".join(found["channels"]), markup=False, soft_wrap=True)
    for note, count in found["notes"].items():
        console.print(f"repaired in {count} runs: {note}", markup=False, soft_wrap=True)
    before = Table(
        title="before any fit: what the logs can be expected to tell",
        title_justify="left",
        show_edge=False,
        pad_edge=False,
        box=None,
    )
    for name in ("parameter", "unit", "std after / before", "verdict"):
        before.add_column(name)
    for path, e in found["parameters"].items():
        if e["ratio"] is None or "session_yaw" in path:
            continue
        colour = COLOUR.get(e["verdict"], "dim")
        verdict = f"[{colour}]{e['verdict'].replace('_', ' ')}[/{colour}]"
        before.add_row(Text(path), e["unit"], f"{e['ratio']:.3f}", verdict)
    console.print(before)
    for sentence in found["messages"]:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)


def validation(found: dict[str, Any]) -> None:
    """Summary of a validation: one row per floor and model."""
    table = Table(show_edge=False, pad_edge=False, box=None)
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


SHOWN = 3
"""Goals that have a column of their own."""


def design(found: dict[str, Any], out: Path, written: Sequence[str]) -> None:
    """Runs to drive next, what they shrink, and what they save."""
    console = _console()
    goals = [g for g in found["goals"] if g["reachable"]][:SHOWN]
    if found["runs"]:
        table = Table(show_edge=False, pad_edge=False, box=None)
        for name in ("run", "floor", "load", "heading", "m/s", "turn", "m", "seconds"):
            table.add_column(name, justify="left" if name in ("floor", "load") else "right")
        for g in goals:
            table.add_column(Text(f"{g['name']} [{g['unit']}]"), justify="right")
        before = [_uncertain(g["now"], g["unit"]) for g in goals]
        table.add_row("", "now", *[""] * 6, *before)
        for k, run in enumerate(found["runs"], 1):
            table.add_row(
                str(k),
                Text(run["floor"]),
                Text(run["load"]),
                f"{run['heading_deg']:.0f} deg" if run["speed"] else "",
                f"{run['speed']:g}" if run["speed"] else "",
                f"{math.degrees(run['turn_rate']):.0f} deg/s" if run["turn_rate"] else "",
                f"{run['distance']:.2g}",
                f"{run['seconds']:.1f}",
                *(_uncertain(run["expected"][g["name"]], g["unit"]) for g in goals),
            )
        console.print(table)
        rest = len([g for g in found["goals"] if g["reachable"]]) - len(goals)
        if rest:
            console.print(f"std after each run; {rest} more goals are in design.json")
        else:
            console.print("std after each run")
    for s in found["runs_saved"].values():
        console.print(_saving(s), markup=False, soft_wrap=True)
    for sentence in found["messages"]:
        console.print(f"note: {sentence}", markup=False, soft_wrap=True)
    console.print(f"in {out}: {', '.join(written)}", markup=False, soft_wrap=True)


def _uncertain(std: float, unit: str) -> str:
    return f"{100 * std:.3g} %" if unit == "m/m" else f"{std:.3g}"


def _saving(s: dict[str, Any]) -> str:
    """One sentence on runs saved."""
    whole = f"{s['name']} ({s['grid_runs']} runs)"
    if s["greedy_runs"] is None:
        return f"from nothing: no fewer chosen runs tell as much as {whole}"
    worse = s["criterion_random_order"] / s["criterion"]
    return (
        f"from nothing: {s['greedy_runs']} chosen runs tell as much as {whole}: {s['ratio']:.0%}; "
        f"the first {s['greedy_runs']} of it in random order leave {worse:.2g} times the variance"
    )


def demo(
    out: Path, done: Any, found: dict[str, Any], rows: Sequence[Any], real: Path | None
) -> None:
    """Truth against estimate, prediction of unseen runs, and where to look."""
    console = _console()
    table = Table(show_edge=False, pad_edge=False, box=None)
    for name in ("parameter", "truth", "identified", "unit", "90 % interval", "truth in it", ""):
        table.add_column(name, justify="right" if name in ("truth", "identified") else "left")
    for r in rows:
        colour = COLOUR.get(r.verdict, "dim")
        table.add_row(
            Text(f"{r.path} [{r.label}]" if r.label else r.path),
            f"{r.truth:.4g}",
            f"{r.value:.4g}",
            r.unit,
            f"{r.interval[0]:.4g} .. {r.interval[1]:.4g}",
            "yes" if r.inside else "no",
            f"[{colour}]{r.verdict.replace('_', ' ')}[/{colour}]",
        )
    console.print(table)
    inside = sum(r.inside for r in rows)
    console.print(f"{inside} of {len(rows)} intervals hold the truth (90 % are meant to)\n")
    console.print("runs it has not seen, predicted open loop:")
    validation(found)
    result = out / "result"
    pictures = [result / name for name in done.written if name.endswith(".png")]
    pictures += sorted(result.glob("validation_*.png"))
    console.print(f"\nlook at: {', '.join(map(str, pictures))}")
    console.print(f"numbers: {result / 'identified.json'}, {result / 'validation.json'}")
    if real is not None:
        data = real / "robotino2022"
        console.print("real logs are here; on them:", markup=False)
        line = f"  slipid identify configs/robotino2022.toml --data {data} --out out/robotino2022"
        console.print(line, markup=False, soft_wrap=True)
        line = f"  slipid validate out/robotino2022 --data {data}"
        console.print(line, markup=False, soft_wrap=True)


def _percent(x: float | None) -> str:
    return "" if x is None else f"{100 * x:.2f} %"


def _degrees(x: float | None) -> str:
    return "" if x is None else f"{x:.2f} deg"
