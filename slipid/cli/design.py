"""`slipid design`: the next runs to drive."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Json, OutFolder, Quiet, emit, guarded
from slipid.support.content import Content
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.identify.design.proposal import Design

SHOWN = 3
"""Goals that have a column of their own."""


@guarded
def design(
    out: OutFolder,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", help="Parameter to sharpen; * and ? allowed; may be repeated."
        ),
    ] = None,
    predict: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FLOOR[@LOAD][:SPEED[:HEADING]]",
            help="Prediction to sharpen, as gray:0.3:45 [m/s, deg]; may be repeated.",
        ),
    ] = None,
    runs: Annotated[int, typer.Option(min=1, max=1000, help="How many to propose.")] = 12,
    headings: Annotated[
        str | None, typer.Option(metavar="LIST", help="Of candidates, as 0,45,90 [deg].")
    ] = None,
    speeds: Annotated[
        str | None, typer.Option(metavar="LIST", help="Of candidates, as 0.1,0.2 [m/s].")
    ] = None,
    turns: Annotated[
        str | None, typer.Option(metavar="LIST", help="Turning rates, as -40,0,40 [deg/s].")
    ] = None,
    distance: Annotated[
        float | None, typer.Option(metavar="M", help="Of every run [m]; as driven by default.")
    ] = None,
    floor: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Floor that can be driven on.")
    ] = None,
    load: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Load set-up that can be driven.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Propose the next runs: those that shrink a parameter or a prediction most.

    Writes design.json, design.png and design_commands.csv to OUT.
    """
    from slipid.identify.design import proposal
    from slipid.identify.design.wish import Wish
    from slipid.identify.fit_file import load as load_fit
    from slipid.support.jax_setup import setup_jax

    wanted = Wish(
        parameter or (),
        predict or (),
        runs,
        headings,
        speeds,
        turns,
        distance,
        floor or (),
        load or (),
    )
    with Reporter(quiet=quiet) as report:
        setup_jax(quiet=True)
        fit = load_fit(out)
        report.stage("simulating candidate runs")
        found = proposal.design(fit, wanted)
        report.stage("drawing")
        written = write(found, out)
    emit(json, found.content, lambda: show(found.content, out, written))
    return 0 if found.reached else 1


def write(found: "Design", out: Path) -> list[str]:
    """Write a design; where it proposes no runs, files of an earlier one do not stay."""
    from slipid.identify.design.proposal import commands
    from slipid.plots.design import design_figure
    from slipid.plots.drawing import save
    from slipid.support.files import write_bytes, write_json

    write_json(out / "design.json", found.content)
    table, picture = out / "design_commands.csv", out / "design.png"
    if not found.drives:
        for old in (table, picture):
            old.unlink(missing_ok=True)
        return ["design.json"]
    write_bytes(table, commands(found).encode())
    save(design_figure(found), picture)
    return ["design.json", table.name, picture.name]


def show(found: Content, out: Path, written: Sequence[str]) -> None:
    """Print the content of design.json: runs to drive next, what they shrink, what they save."""
    from slipid.report.page import Page

    page = Page()
    if found["runs"]:
        _runs(found)
        rest = len([g for g in found["goals"] if g["reachable"]]) - SHOWN
        more = f"; {rest} more goals are in design.json" if rest > 0 else ""
        page.line(f"std after each run{more}")
    for s in found["runs_saved"].values():
        page.line(_saving(s))
    page.notes(found["messages"])
    page.files(out, written)


def _runs(found: Content) -> None:
    """Table of proposed runs."""
    from rich.text import Text

    from slipid.report.page import Page, table

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
    Page().table(made)


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
