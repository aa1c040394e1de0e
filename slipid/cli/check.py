"""`slipid check`: check logs before a fit, and predict what a fit can identify from them."""

from pathlib import Path
from typing import TYPE_CHECKING

from slipid.cli.common import (
    ConfigFile,
    DataFolder,
    Json,
    MaybeOut,
    Next,
    Quiet,
    can_draw,
    emit,
    guarded,
)
from slipid.support.folder import locked
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.app.config import Config


NAMES = ("check.json", "report.html", "raw_*.png", "bench.png", "bench_*.png")
"""Names of all files that the command writes."""


@guarded
def check(
    config: ConfigFile,
    data: DataFolder,
    out: MaybeOut = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Check logs against the config, and predict which parameters a fit will identify.

    The exit code is 1 if logs and config contradict each other.
    """
    from slipid.app import check as checks
    from slipid.app.config import BenchMotors, read_config
    from slipid.report.checks import show_check

    wanted = read_config(config)
    if isinstance(wanted.content.robot, BenchMotors):
        return bench(wanted, data, out, json, quiet)
    written: tuple[str, ...] = ()
    with Reporter(quiet=quiet) as report, locked(out, "check", *NAMES):
        logs, found = checks.check(config, data, out, report)
        if out is not None:
            from slipid.report.html.check_page import check_page
            from slipid.report.html.page import REPORT, try_page

            written = (
                *try_page(check_page(logs, found, config.name), out / REPORT, report),
                "check.json",
            )
            if can_draw(report):
                from slipid.plots.fit import raw_plots

                written += tuple(path.name for path in raw_plots(logs, out))
    wrong = any(f["severity"] == "wrong" for f in found["findings"])
    if wrong:
        step = Next(f"after correcting {config} or the logs", ("check", config, "--data", data))
    else:
        words = ("identify", config, "--data", data, "--out", Path("out") / config.stem)
        step = Next("fit the robot to these logs", words)
    emit(json, found, lambda page: show_check(page, found), [step], out, written)
    return 1 if wrong else 0


def bench(config: "Config", data: Path, out: Path | None, json: str | None, quiet: bool) -> int:
    """Check the logs of motors on a bench, print the result, and return the exit code."""
    from slipid.app.bench import check_bench
    from slipid.report.checks import show_bench_check

    written: tuple[str, ...] = ()
    with Reporter(quiet=quiet) as report, locked(out, "check", *NAMES):
        fit, found = check_bench(config, data, out, report)
        if out is not None:
            from slipid.report.html.bench_page import bench_page
            from slipid.report.html.page import REPORT, try_page

            written = (
                *try_page(bench_page(fit, config.path.name), out / REPORT, report),
                "check.json",
            )
            if can_draw(report):
                from slipid.plots.bench import bench_plots

                written += tuple(path.name for path in bench_plots(fit, out))
    words = ("identify", config.path, "--data", data, "--out", Path("out") / config.path.stem)
    step = Next("fit the motors to these logs", words)
    emit(json, found, lambda page: show_bench_check(page, found), [step], out, written)
    return 0
