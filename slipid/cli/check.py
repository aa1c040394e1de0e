"""`slipid check`: what logs can tell, before any fit."""

from slipid.cli.common import ConfigFile, DataFolder, Json, MaybeOut, Quiet, emit, guarded
from slipid.support.content import Content
from slipid.support.progress import Reporter


@guarded
def check(
    config: ConfigFile,
    data: DataFolder,
    out: MaybeOut = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Read and validate logs; say what they can tell before anything is fitted."""
    from slipid.job import check as job
    from slipid.plots.raw import raw_plots

    with Reporter(quiet=quiet) as report:
        done = job.check(config, data, out, report)
        if out is not None:
            report.stage("drawing")
            raw_plots(done.job.dataset, out)
    emit(json, done.content, lambda: show(done.content))
    return 0


def show(found: Content) -> None:
    """Print the content of check.json."""
    from rich.text import Text

    from slipid.report.page import Page, table, verdict

    page = Page()
    groups = table(("surface", "load", "session", "runs", "minutes", "headings", "speeds [m/s]"))
    for row in found["groups"]:
        groups.add_row(
            row["surface"],
            row["load"],
            Text(row["session"]),
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"]),
            " ".join(f"{v:g}" for v in row["speeds"]),
        )
    page.table(groups)
    page.line("channels: " + ", ".join(found["channels"]))
    for note, count in found["notes"].items():
        page.line(f"repaired in {count} runs: {note}")
    before = table(
        ("parameter", "unit", "std after / before", "verdict"),
        "before any fit: what the logs can be expected to tell",
    )
    for path, e in (found["parameters"] | found["derived"]).items():
        if e["ratio"] is not None and "session_yaw" not in path:
            before.add_row(Text(path), e["unit"], f"{e['ratio']:.3f}", verdict(e["verdict"]))
    page.table(before)
    page.notes(found["messages"])
