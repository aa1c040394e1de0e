"""`slipid selftest`: what an experiment can recover."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import ConfigFile, Json, Out, Quiet, emit, guarded
from slipid.support.content import Content
from slipid.support.progress import Reporter

COLOUR = {"yes": "green", "roughly": "yellow", "no": "red", "wrong": "magenta"}


@guarded
def selftest(
    config: ConfigFile,
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="DIR", help="Logs whose wheel motion is taken, if any."),
    ] = None,
    out: Out = Path("selftest_out"),
    replicates: Annotated[int, typer.Option(min=1, help="Made experiments.")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of truths and noise.")] = 0,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Make this very experiment with known truth, fit it, and say what it recovers.

    Without --data it is the plan of [selftest] in the config. Writes selftest.json; goes on from
    the replicates that are done. Exit code 1 where a number that is wanted is not recovered.
    """
    from slipid.selftest.experiment import selftest as run

    with Reporter(quiet=quiet) as report:
        found = run(config, data, out, replicates, seed, report)
    emit(json, found, lambda: show(found, out))
    return 0 if found["recovered"] else 1


def show(found: Content, out: Path) -> None:
    """Print the content of selftest.json."""
    from rich.text import Text

    from slipid.report.page import Page, percent, table, verdict

    page = Page()
    numbers = table(
        ("parameter", "unit", "error", "of truth", "z rms", "in 90 %", "verdict", "recovered"),
        f"{found['replicates']} made experiments like this one ({found['runs']} runs), "
        f"{found['converged']} fits converged",
    )
    for path, e in found["parameters"].items():
        share = None if e["recovered"] == "no" else e["relative_error_rms"]
        numbers.add_row(
            Text(path),
            e["unit"],
            f"{e['error_rms']:.2g}",
            "" if share is None else f"{100 * share:.1f} %",
            f"{e['z_rms']:.2f}",
            f"{round(e['coverage90'] * e['intervals'])} of {e['intervals']}",
            e["verdict"].replace("_", " "),
            verdict(e["recovered"], COLOUR) + (" *" if path in found["wanted"] else ""),
        )
    page.table(numbers)
    page.line("* wanted; wrong: errors larger than the fits say\n")
    floors = table(
        ("surface", "slip curve off by", "at most", "in its band", "prediction off by", "encoders")
    )
    for floor, c in found["curves"].items():
        p = found["predictions"].get(floor, {})
        floors.add_row(
            floor,
            f"{c['median_gap']:.4f}",
            f"{c['largest_gap']:.4f}",
            percent(c["coverage90"]),
            percent(p.get("identified")),
            percent(p.get("encoder")),
        )
    page.table(floors)
    page.notes(found["messages"])
    if found["failed"]:
        page.line(f"NOT recovered: {', '.join(found['failed'])}")
    page.files(out, ("selftest.json", "replicates.json"))
