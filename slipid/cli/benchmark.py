"""`slipid benchmark` and `slipid paper`: compare slip methods, and reproduce the 2021 paper."""

from pathlib import Path
from typing import Annotated

import typer

from slipid.cli.common import (
    Jobs,
    Json,
    Next,
    Out,
    Quiet,
    emit,
    executor_of,
    flag,
    guarded,
    option,
    suggest,
)
from slipid.support.extras import require
from slipid.support.folder import locked
from slipid.support.progress import Reporter


@guarded
def benchmark(
    data: Annotated[Path, option("DIR", "Folder of the public data sets.")],
    out: Out = Path("out/benchmark"),
    quick: Annotated[bool, flag("--quick", "Use only some of the runs and a single fold.")] = False,
    rows: Annotated[
        str | None, option("NAMES", "Methods to run, separated by commas; all by default.")
    ] = None,
    jobs: Jobs = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Run slipid and published slip estimators on the same logs, and compare their errors.

    The folder given by --data contains the folders of the public data sets: robotino2022,
    robotino2021, drive_skid, borealtc; missing ones are skipped. Simulated runs of the virtual test
    site, which ship with slipid, are always included. The benchmark takes about 17 minutes on two
    cores; with --quick it takes about two minutes, or three when it first compiles its functions.
    Examples of methods are ojeda_gyro and quann_slip; an unknown name prints the list of all
    methods. Writes benchmark.json and benchmark.html. After an interrupt, finished parts are not
    computed again. The exit code is 1 if anything failed.
    """
    require("sklearn", "benchmark", "`slipid benchmark`")
    require("matplotlib", "benchmark", "`slipid benchmark`")
    from slipid.lab.benchmark.benchmark import benchmark as run
    from slipid.lab.benchmark.report import PAGE, benchmark_page, show_benchmark
    from slipid.lab.benchmark.work import BenchmarkOptions
    from slipid.report.html.page import try_page

    only = () if rows is None else tuple(name.strip() for name in rows.split(",") if name.strip())
    with (
        Reporter(quiet=quiet) as report,
        locked(out, "benchmark", "benchmark.json", PAGE),
        executor_of(jobs) as executor,
    ):
        found = run(BenchmarkOptions(data, out, only, quick), executor, report)
        report.stage("writing the page")
        files = (*try_page(benchmark_page(found), out / PAGE, report), "benchmark.json")
    words = ("compare", "robot.toml", "--data", "logs", "--out", "out/compare")
    step = Next("compare slip models on your own logs", words)
    emit(json, found, lambda page: show_benchmark(page, found), [step], out, files)
    every = [
        row
        for one in found["sets"].values()
        for protocol in one["protocols"].values()
        for row in protocol.values()
    ]
    others = [*found["floors"].values(), found["rectangle"] or {}]
    floor_rows = [row for one in others for row in one.get("rows", [])]
    failed = [
        *found["unread"],
        *(row for row in every if row["failed"]),
        *(one for one in others if "failed" in one),
        *(row for row in floor_rows if row["absent"]),
    ]
    return 1 if failed else 0


@guarded
def paper(
    data: Annotated[Path, option("DIR", "Folder that contains the folder robotino2021.")],
    out: Out,
) -> int:
    """Regenerate the tables and figures of the 2021 paper from the paper's data."""
    require("matplotlib", "report", "`slipid paper`")
    from slipid.lab.paper2021.plots import run

    with locked(out, "paper", "paper.json", "figure?_*.png"):
        for path in run(data, out):
            typer.echo(str(path))
    suggest([Next("compare it with other systems", ("benchmark", "--data", data))])
    return 0
