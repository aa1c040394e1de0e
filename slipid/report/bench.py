"""What is known of motors on a bench, as tables."""

from collections.abc import Sequence

from rich.text import Text

from slipid.identify.bench.verdict import BenchFit
from slipid.report.estimates import estimates
from slipid.report.page import Page, table, verdict
from slipid.support.content import Content


def show_bench(page: Page, fit: BenchFit, taken: Sequence[str] = ()) -> None:
    """Write the numbers of motors, what the logs leave open, and how the fits ended."""
    if taken:
        page.line(f"columns: {'; '.join(taken)}")
    rows = sum(len(r.time) for f in fit.fits for r in f.records)
    motors = f"{len(fit.fits)} motors, " if len(fit.fits) > 1 else ""
    page.table(estimates(fit.parameters.values(), f"{motors}{rows} rows; everything at the shaft"))
    if fit.derived:
        page.table(estimates(fit.derived.values(), "\nknown as ratios, or not even so"))
    page.notes(fit.messages)
    ended = "converged" if fit.converged else "NOT converged"
    model = "" if fit.good or not fit.converged else "; the model does NOT explain the log"
    page.line(f"{ended}: {fit.reason}{model}")


def show_bench_check(page: Page, found: Content) -> None:
    """Write the content of check.json of motors."""
    columns = (
        "log",
        "rows",
        "seconds",
        "rows/s",
        r"voltage \[V]",
        r"current \[A]",
        r"speed \[rad/s]",
    )
    made = table(columns)
    for row in found["logs"]:
        spans = [
            "none" if row[k] is None else f"{row[k][0]:.3g} .. {row[k][1]:.3g}"
            for k in ("voltage", "current", "speed")
        ]
        rate = f"{1 / row['row_period_s']:.4g}"
        made.add_row(Text(row["name"]), str(row["rows"]), f"{row['seconds']:.1f}", rate, *spans)
    page.table(made)
    before = table(
        ("parameter", "unit", "std after / before", "verdict"), "\nwhat the logs can tell"
    )
    for path, e in found["parameters"].items():
        if e["ratio"] is not None:
            before.add_row(Text(path), e["unit"], f"{e['ratio']:.3f}", verdict(e["verdict"]))
    page.table(before)
    page.notes(found["messages"])
