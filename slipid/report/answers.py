"""Text about predictions and comparisons of slip models, proposed runs, exports and trials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from slipid.report.page import Page, counted, heading, table
from slipid.support.content import Content

if TYPE_CHECKING:
    from slipid.deploy.export import Exported

MOST_SHOWN_GOALS = 2
"""Largest number of goals of a design that have a column in the table of runs."""
MOST_SHOWN_MODELS = 5
"""Largest number of slip models in a table of a comparison."""
SHOWN_MODELS: tuple[str, ...] = ("nominal", "calibrated", "identified", "selected")
"""Slip models of a validation that are shown beside the best of the others."""
_ERRORS = (
    "endpoint_error_mean",
    "endpoint_error_median",
    "endpoint_error_over_path_mean",
    "length_error_mean",
)
"""Errors of a validation file that are shown, in the order of the columns."""


def show_validation(page: Page, found: Content) -> None:
    """Write the summary of a validation file, one row per floor and model."""
    columns = ("end/chord", "median", "end/path", "length", "heading", "in 90 %", "runs")
    made = table(
        ("model", *columns),
        "open-loop predictions of slipid and of the best other model, in percent and deg",
        columns,
    )
    for surface, models in found["summary"].items():
        heading(made, surface)
        for model in _shown_models(models):
            s = models[model]
            turn = s["heading_error_median_deg"]
            inside = s["coverage90"]
            made.add_row(
                f"  {model}",
                *(_percent(s[key]) for key in _ERRORS),
                "" if turn is None else f"{turn:.2f}",
                "" if inside is None else f"{100 * inside:.0f}",
                str(s["runs"]),
            )
    page.table(made)
    page.line(
        "end/chord, end/path: mean error of the end point over the displacement and over the path "
        "length; median: of end/chord; length: of the displacement; in 90 %: ends in the predicted "
        "90 % region"
    )
    best = {floor: _best(models) for floor, models in found["summary"].items()}
    page.line(
        f"smallest error of all: {', '.join(f'{floor}: {model}' for floor, model in best.items())}"
    )


def _shown_models(models: Content) -> list[str]:
    """Return the models of slipid, and the best one of the others."""
    own = [model for model in SHOWN_MODELS if model in models]
    if others := {m: s for m, s in models.items() if m not in own}:
        own.append(_best(others))
    return own


def _best(models: Content) -> str:
    return min(models, key=lambda model: models[model]["endpoint_error_mean"])


def _percent(share: float | None) -> str:
    """Return a fraction in percent with two or more digits, empty for None."""
    if share is None:
        return ""
    return f"{100 * share:.2f}" if share < 0.1 else f"{100 * share:.1f}"


def show_comparison(page: Page, found: Content) -> None:
    """Write the content of comparison.json: for each question the best models, and sentences."""
    for question, answer in found["questions"].items():
        page.table(_ranking(question, answer))
        models = len(answer["cost"])
        page.line(
            "mean end-point error in percent, and fitted numbers; best, tied: by the log density "
            f"of held-out runs, within its clustered standard error. {models} models were "
            "compared: comparison.png shows them, and comparison.json has all numbers"
        )
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
                    f"correct 90 % regions: {counted(missed)}"
                )
        page.line()
    over = found["data"]["over_several_floors"]
    if over["refused"]:
        page.line(over["refused"])
    elif over["runs"]:
        page.line(
            f"the force balance is also fitted to runs over several floors ({over['runs']}), "
            "without those with a held-out heading or speed; other models take only the camera "
            "from this fit"
        )
    if found["surfaces"]:
        one = found["surfaces"]["all"]
        page.line(
            "error of slip on a floor that was not fitted, root mean square over floors: one curve "
            f"of current {one['pooled']['floors']:.3f}, a constant "
            f"{one['constant']['floors']:.3f}; with a curve fitted to the floor itself "
            f"{one['per_surface']['floors']:.3f}"
        )


def _ranking(question: str, answer: Content) -> Table:
    """Return the table of the best models under one kind of held-out runs, a column per floor.

    The best models have the smallest sum of their ranks over the floors.
    """
    floors = answer["floors"]
    ranks = dict.fromkeys(answer["cost"], 0)
    for one in floors.values():
        order = sorted(one["models"], key=lambda model: -one["models"][model]["difference"])
        for place, model in enumerate(order):
            ranks[model] += place
    names = [f"{floor}\n({one['runs']})" for floor, one in floors.items()]
    columns = (*names, "numbers")
    title = f"{question} held out: the {MOST_SHOWN_MODELS} best models, and runs on every floor"
    made = table(("model", *columns), title, columns)
    for model in sorted(ranks, key=ranks.__getitem__)[:MOST_SHOWN_MODELS]:
        cells = [_ranking_cell(one["models"][model]) for one in floors.values()]
        made.add_row(model, *cells, _numbers(answer["cost"][model]["numbers"]))
    return made


def _ranking_cell(m: Content) -> str:
    """Return the end-point error [%] of a model on a floor, and whether it is best or tied."""
    colour = {"best": "bold green", "tied": "green"}.get(m["verdict"])
    error = f"{100 * m['endpoint_error']:.1f}"
    return error if colour is None else f"[{colour}]{m['verdict']} {error}[/{colour}]"


def _numbers(count: dict[str, int]) -> str:
    """Return, as text, the numbers of fitted parameters per floor and for all floors together."""
    floors = sorted({n for floor, n in count.items() if floor != "shared"})
    own = f"{floors[0]}" if len(floors) == 1 else f"{floors[0]}-{floors[-1]}"
    return f"{own} + {count['shared']}" if count["shared"] else own


def show_design(page: Page, found: Content) -> None:
    """Write the content of design.json: runs to drive next, expected stds, savings over grids."""
    if found["runs"]:
        goals = [g for g in found["goals"] if g["reachable"]]
        page.table(_runs(found, goals[:MOST_SHOWN_GOALS]))
        for k, g in enumerate(goals[:MOST_SHOWN_GOALS], 1):
            page.line(f"std {k}: {g['name']} [{g['unit']}], after each run and those before it")
        if (more := len(goals) - MOST_SHOWN_GOALS) > 0:
            page.line(f"{more} further goals are in design.json")
    for s in found["runs_saved"].values():
        page.line(_saving(s))
    page.notes(found["messages"])


def _runs(found: Content, goals: Sequence[Content]) -> Table:
    """Return the table of proposed runs, with the expected std of each goal after each run."""
    units = (r"\[deg]", r"\[m/s]", r"\[deg/s]", r"\[m]", r"\[s]")
    names = ("heading", "speed", "turn", "path", "time")
    numbers = [f"{name}\n{unit}" for name, unit in zip(names, units, strict=True)]
    stds = [f"std {k}" for k in range(1, len(goals) + 1)]
    made = table(
        ("run", "floor", "load", *numbers, *stds), "runs to drive next", ("run", *numbers, *stds)
    )
    made.add_row("", "now", *[""] * 6, *(_uncertain(g["now"], g["unit"]) for g in goals))
    for k, run in enumerate(found["runs"], 1):
        made.add_row(
            str(k),
            Text(run["floor"]),
            Text(run["load"]),
            f"{run['heading_deg']:.0f}" if run["speed"] else "",
            f"{run['speed']:g}" if run["speed"] else "",
            f"{math.degrees(run['turn_rate']):.0f}" if run["turn_rate"] else "",
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
    """Write which forms a robot was exported to, and warnings about its parameters."""
    page.line(f"exported: {', '.join(done.forms)}; README.md explains how to use each")
    page.notes(done.warnings)


def show_trial(page: Page, found: Content) -> None:
    """Write a table of every controller's errors, as medians over the starts."""
    columns = (
        *("closure\n\\[mm]", "over en-\ncoders'", "worse\nstarts", "ended"),
        *("off path\n\\[mm]", "1st side\n\\[mm]", "heading\n\\[deg]"),
    )
    count = min(row["runs"] for row in found["summary"].values())
    made = table(("controller", *columns), f"medians of {count} starts", columns)
    for name, row in found["summary"].items():
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        worse = row.get("worse_share")
        made.add_row(
            name,
            f"{row['closure_error_median']:.0f}",
            "" if ratio is None else f"{100 * ratio['value']:.0f} %",
            "" if worse is None else f"{100 * worse:.0f} %",
            f"{100 * row['finished_share']:.0f} %",
            f"{row['cross_track_rmse']:.0f}",
            f"{row['first_side_along_track_mm']:.0f}",
            f"{row['heading_error_deg']:.1f}",
        )
    page.table(made)
    page.line(
        "over encoders': closure error over that with encoders; worse starts: share with a larger "
        "closure error than with encoders; ended: share that ended its path; 1st side: error along "
        "it; trial.json has 90 % intervals and every run"
    )
    page.line(found["verdict"])
    for name, row in found["summary"].items():
        if row["recovery_share"]:
            page.line(
                f"{name}: tried to free itself in {100 * row['recovery_share']:.0f} % of the runs, "
                f"and drove on in {100 * row['freed_share']:.0f} % of these"
            )
