"""`slipid export-run`: write a run beside its predictions as an MCAP file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import Json, OutFolder, Quiet, emit, for_robots, option, renew
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.app.run_export.mcap_file import McapTopic
    from slipid.report.page import Page


@for_robots
def export_run(
    fitted: OutFolder,
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN",
            help="Name of a run as in run.json, or a part that only its name has; or the path of "
            "another log in the data folder.",
        ),
    ],
    out: Annotated[Path, option("FILE", "MCAP file to write, such as run.mcap.")],
    data: Annotated[
        Path | None, option("DIR", "Folder of the logs; by default that of `slipid identify`.")
    ] = None,
    map: Annotated[
        Path | None, option("FILE", "Floor map in the frame of the poses, drawn below the run.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Write a run and its predictions as an MCAP file, for Foxglove and rerun.

    Topics (docs/mcap.md): /pose, /path, /robot and frames in /tf, for each of
    measured, nominal (lengths of the config), calibrated, selected (the model
    selected on the floor) and estimator (robot.json run over the log) (m);
    /region90/selected and /region90/estimator (m); /floor_map (m);
    /floor/probability and /floor/under_wheels; /slip_ratio,
    /wheel_speed_rad_s and /current_a (A) for each wheel.

    Times are those of the log; poses are earlier than logged by their lag.
    """
    from slipid.app.run_export.mcap_file import mcap_of, require_mcap
    from slipid.app.run_export.run_view import run_view
    from slipid.support.files import write_bytes
    from slipid.support.folder import MARKS, refuse_foreign
    from slipid.support.jax_setup import setup_jax

    require_mcap()
    refuse_foreign(out, MARKS[".mcap"])
    setup_jax(quiet=True)
    with Reporter(quiet=quiet) as report:
        view = run_view(fitted, run, data, map, report)
        report.stage("writing")
        file = mcap_of(view)
        write_bytes(out, file.data)
    content = {
        "schema": "slipid.export_run/1",
        "file": str(out),
        "run": view.log.name,
        "fitted": view.fitted,
        "selected_model": view.selected,
        "topics": {
            one.name: {"schema": one.schema, "unit": one.unit, "messages": one.messages}
            for one in file.topics
        },
        "notes": list(view.notes),
    }
    emit(
        json,
        content,
        lambda page: show(page, file.topics, view.notes),
        [renew(fitted)],
        out.parent,
        [out.name],
    )
    return 0


def show(page: "Page", topics: "tuple[McapTopic, ...]", notes: tuple[str, ...]) -> None:
    """Print the topics of the file, and notes about what is missing."""
    from slipid.report.page import table

    rows = table(("topic", "schema", "unit", "messages"), "topics", right=("messages",))
    for one in topics:
        rows.add_row(one.name, one.schema, one.unit, str(one.messages))
    page.table(rows)
    page.line("open the file in Foxglove, or by: rerun FILE")
    page.notes(notes)
