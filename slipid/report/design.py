"""Runs to drive next, what they are expected to tell, and what they save."""

import math

from rich.table import Table
from rich.text import Text

from slipid.report.page import Page, table
from slipid.support.content import Content

SHOWN = 3
"""Goals that have a column of their own."""


def show_design(page: Page, found: Content) -> None:
    """Write the content of design.json: runs to drive next, what they shrink, what they save."""
    if found["runs"]:
        page.table(_runs(found))
        rest = len([g for g in found["goals"] if g["reachable"]]) - SHOWN
        more = f"; {rest} more goals are in design.json" if rest > 0 else ""
        page.line(f"std after each run{more}")
    for s in found["runs_saved"].values():
        page.line(_saving(s))
    page.notes(found["messages"])


def _runs(found: Content) -> Table:
    """Table of proposed runs."""
    goals = [g for g in found["goals"] if g["reachable"]][:SHOWN]
    names = ("run", "floor", "load", "heading", "m/s", "turn", "m", "seconds")
    made = table(names, right=[n for n in names if n not in ("floor", "load")])
    for g in goals:
        made.add_column(Text(f"{g['name']} [{g['unit']}]"), justify="right")
    made.add_row("", "now", *[""] * 6, *(_uncertain(g["now"], g["unit"]) for g in goals))
    for k, run in enumerate(found["runs"], 1):
        made.add_row(
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
    return made


def _uncertain(std: float, unit: str) -> str:
    return f"{100 * std:.3g} %" if unit == "m/m" else f"{std:.3g}"


def _saving(s: Content) -> str:
    """One sentence on runs saved."""
    whole = f"{s['name']} ({s['grid_runs']} runs)"
    if s["greedy_runs"] is None:
        return f"from nothing: no fewer chosen runs tell as much as {whole}"
    worse = s["criterion_random_order"] / s["criterion"]
    return (
        f"from nothing: {s['greedy_runs']} chosen runs tell as much as {whole}: {s['ratio']:.0%}; "
        f"the first {s['greedy_runs']} of it in random order leave {worse:.2g} times the variance"
    )
