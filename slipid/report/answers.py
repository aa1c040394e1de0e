"""Text about comparisons of slip models, proposed runs, exports and trials of controllers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from slipid.report.page import Page, table
from slipid.support.content import Content

if TYPE_CHECKING:
    from slipid.deploy.export import Exported

MOST_SHOWN_GOALS = 3
"""Largest number of goals of a design that have a column in the table of runs."""


def show_comparison(page: Page, found: Content) -> None:
    """Write the content of comparison.json: tables with a row per model, and sentences."""
    for question, answer in found["questions"].items():
        page.line(
            f"{question} held out: log density less that of the best ± clustered standard error "
            "(nats per run), mean end-point error (%), end points in the 90 % region (%)"
        )
        page.table(_ranking(answer))
        for one in answer["floors"].values():
            page.line(one["sentence"])
            low, high = one["band90"]
            missed = [
                f"{model} {100 * m['coverage90']:.0f}"
                for model, m in one["models"].items()
                if not low <= m["coverage90"] <= high
            ]
            if missed:
                page.line(
                    f"  coverage outside the {100 * low:.0f} to {100 * high:.0f} % expected of "
                    f"correct 90 % regions: {', '.join(missed)}"
                )
        page.line()
    if found["surfaces"]:
        one = found["surfaces"]["all"]
        page.line(
            "error of slip on a floor that was not fitted, root mean square over floors: one curve "
            f"of current {one['pooled']['floors']:.3f}, a constant "
            f"{one['constant']['floors']:.3f}; with a curve fitted to the floor itself "
            f"{one['per_surface']['floors']:.3f}"
        )


def _ranking(answer: Content) -> Table:
    """Return the ranking under one kind of held-out runs, a row per model, a column per floor."""
    floors = answer["floors"]
    made = table(())
    made.add_column("model", no_wrap=True)
    for name in (*(f"{floor} ({one['runs']})" for floor, one in floors.items()), "numbers"):
        made.add_column(Text(name), justify="right", no_wrap=True)
    made.add_column("fit [s]", justify="right", no_wrap=True)
    for model, spent in answer["cost"].items():
        cells = [_ranking_cell(one["models"][model]) for one in floors.values()]
        made.add_row(model, *cells, _numbers(spent["numbers"]), f"{spent['fit_s']:.1f}")
    return made


def _ranking_cell(m: Content) -> str:
    """Return a table cell about a model on a floor.

    It has the log density less the best model's [nats per run], the end-point error [%] and the
    coverage of the 90 % region [%].
    """
    colour = {"best": "bold green", "tied": "green"}.get(m["verdict"], "default")
    se = m["se_clustered"]
    if m["verdict"] == "best":
        difference = "best"
    else:
        difference = f"{m['difference']:.1f} ± {'?' if se is None else format(se, '.1f')}"
    error, inside = 100 * m["endpoint_error"], 100 * m["coverage90"]
    return f"[{colour}]{difference}[/{colour}] {error:5.1f} {inside:3.0f}"


def _numbers(count: dict[str, int]) -> str:
    """Return, as text, the numbers of fitted parameters per floor and for all floors together."""
    floors = sorted({n for floor, n in count.items() if floor != "shared"})
    own = f"{floors[0]}" if len(floors) == 1 else f"{floors[0]}-{floors[-1]}"
    return f"{own} + {count['shared']}" if count["shared"] else own


def show_design(page: Page, found: Content) -> None:
    """Write the content of design.json: runs to drive next, expected stds, savings over grids."""
    if found["runs"]:
        page.table(_runs(found))
        rest = len([g for g in found["goals"] if g["reachable"]]) - MOST_SHOWN_GOALS
        more = f"; {rest} further goals are in design.json" if rest > 0 else ""
        page.line(f"std after each run{more}")
    for s in found["runs_saved"].values():
        page.line(_saving(s))
    page.notes(found["messages"])


def _runs(found: Content) -> Table:
    """Return the table of proposed runs, with the expected std of each goal after each run."""
    goals = [g for g in found["goals"] if g["reachable"]][:MOST_SHOWN_GOALS]
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
    """Return a sentence about the number of chosen runs with the information of a grid of runs."""
    grid, count = f"{s['name']} ({s['grid_runs']} runs)", s["greedy_runs"]
    if count is None:
        return f"without earlier data: as many chosen runs are needed for the information of {grid}"
    worse = s["criterion_random_order"] / s["criterion"]
    return (
        f"without earlier data: {count} chosen runs are worth {grid}: {s['ratio']:.0%}; the first "
        f"{count} of it in random order leave {worse:.2g} times the variance"
    )


def show_export(page: Page, done: Exported) -> None:
    """Write the names of the exported files, and warnings about the robot's parameters."""
    page.line(
        f"written to {done.folder}: README.md, robot.json, {', '.join(f'{x}/' for x in done.forms)}"
    )
    page.notes(done.warnings)


def show_trial(page: Page, found: Content, out: Path) -> None:
    """Write a table of every controller's errors, as medians over the starts.

    `out` is the folder of trial.json, to which the text refers.
    """
    errors = ("cross-track", "first side", "heading")
    numbers = ("closure", "of encoders'", "worse", "finished", *errors)
    made = table(("controller", *numbers), right=numbers)
    for name, row in found["summary"].items():
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        worse = row.get("worse_share")
        made.add_row(
            name,
            f"{row['closure_error_median']:.0f} mm",
            "" if ratio is None else f"{100 * ratio['value']:.0f} %",
            "" if worse is None else f"{100 * worse:.0f} %",
            f"{100 * row['finished_share']:.0f} %",
            f"{row['cross_track_rmse']:.0f} mm",
            f"{row['first_side_along_track_mm']:.0f} mm",
            f"{row['heading_error_deg']:.1f} deg",
        )
    page.table(made)
    page.line(found["verdict"])
    for name, row in found["summary"].items():
        if row["recovery_share"]:
            page.line(
                f"{name}: tried to free itself in {100 * row['recovery_share']:.0f} % of the runs, "
                f"and drove on in {100 * row['freed_share']:.0f} % of these"
            )
    count = min(row["runs"] for row in found["summary"].values())
    page.line("worse: share of the starts with a larger closure error than that of encoders")
    page.line(f"medians of {count} starts; 90 % intervals and every run: {out / 'trial.json'}")
    page.line(f"look at: {out / 'trial.png'}")
