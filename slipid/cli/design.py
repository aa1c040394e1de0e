"""`slipid design`: propose the next runs to drive."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Json, Next, OutFolder, Quiet, can_draw, emit, for_robots, option
from slipid.support.folder import locked
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.infer.design.proposal import Design

COMMANDS = "design_commands.csv"
"""Name of the file with the commands of the proposed runs."""
NAMES = ("design.json", "design.png", COMMANDS)
"""Names of all files that the command writes."""
SIMULATING_S = 40.0
"""Usual time in which candidate runs are simulated, on two cores [s]."""


@for_robots
def design(
    out: OutFolder,
    parameter: Annotated[
        list[str] | None,
        option(
            "NAME",
            "Parameter whose uncertainty is to be reduced, with * and ? as wildcards; may be "
            "repeated.",
        ),
    ] = None,
    predict: Annotated[
        list[str] | None,
        option(
            "FLOOR[@LOAD][:SPEED[:HEADING]]",
            "Prediction whose uncertainty is to be reduced, such as gray:0.3:45 (m/s, deg); may "
            "be repeated.",
        ),
    ] = None,
    runs: Annotated[int, typer.Option(min=1, max=1000, help="Number of runs to propose.")] = 12,
    headings: Annotated[
        str | None, option("LIST", "Headings of candidate runs in deg, such as 0,45,90.")
    ] = None,
    speeds: Annotated[
        str | None, option("LIST", "Speeds of candidate runs in m/s, such as 0.1,0.2.")
    ] = None,
    turns: Annotated[
        str | None, option("LIST", "Turning rates of candidate runs in deg/s, such as -40,0,40.")
    ] = None,
    distance: Annotated[
        float | None,
        option(
            "M", "Length of a run in m; by default that of the logged runs.", min=1e-3, max=10_000
        ),
    ] = None,
    floor: Annotated[
        list[str] | None,
        option("NAME", "Floor on which runs are possible; may be repeated; all by default."),
    ] = None,
    load: Annotated[
        list[str] | None,
        option(
            "NAME", "Load set-up with which runs are possible; may be repeated; all by default."
        ),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Propose the runs that would most reduce the uncertainty of a parameter or a prediction.

    Writes design.json, design.png and design_commands.csv to OUT.
    """
    from slipid.infer.design import proposal
    from slipid.infer.design.scope import Scope
    from slipid.infer.fit_file import load as load_fit
    from slipid.infer.result_folder import fit_of
    from slipid.report.answers import show_design
    from slipid.support.jax_setup import setup_jax

    goals, places = (parameter or (), predict or ()), (floor or (), load or ())
    with Reporter(quiet=quiet) as report, locked(out, "design", *NAMES):
        setup_jax(quiet=True)
        fit = load_fit(out)
        report.stage("simulating candidate runs", usual_s=SIMULATING_S)
        scope = Scope(fit, *goals, runs, headings, speeds, turns, distance, *places)
        found = proposal.design(scope)
        found = replace(found, content={**found.content, "fit": fit_of(out)})
        written = write(found, out, report)
    words = ("identify", out / "config.toml", "--data", "logs", "--out", f"{out}_again")
    step = Next("after driving them, with the old and the new logs in a folder logs", words)
    emit(json, found.content, lambda page: show_design(page, found.content), [step], out, written)
    return 0 if found.reachable else 1


def write(found: "Design", out: Path, report: Reporter) -> list[str]:
    """Write a design to a folder, and return the names of the files.

    If the design proposes no runs, the files of an earlier design are removed.
    """
    from slipid.infer.design.proposal import commands
    from slipid.support.files import write_bytes, write_json

    table, picture = out / COMMANDS, out / "design.png"
    write_json(out / "design.json", found.content)
    if not found.runs:
        for old in (table, picture):
            old.unlink(missing_ok=True)
        return ["design.json"]
    write_bytes(table, commands(found).encode())
    if not can_draw(report):
        return ["design.json", table.name]
    from slipid.plots.design import design_figure
    from slipid.plots.drawing import save

    save(design_figure(found), picture)
    return ["design.json", table.name, picture.name]
