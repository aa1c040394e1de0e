"""Text about checks of logs before a fit, and about self tests."""

from collections.abc import Mapping, Sequence

from rich.text import Text

from slipid.data.check.findings import by_reason
from slipid.fitting.calibration.result import Calibration
from slipid.report.calibration import show_calibration
from slipid.report.page import Groups, Page, grouped, percent, table, verdict
from slipid.support.content import Content

RECOVERED = {"yes": "green", "roughly": "yellow", "no": "red", "wrong": "magenta"}
"""Colours of a self test's verdicts on how a parameter was recovered."""
LARGEST_DRIFT = 3e-4
"""Relative difference of the rates of two clocks that is larger than quartz clocks can have [1]."""


def _clocks(clocks: Mapping[str, Content]) -> str:
    """Return a sentence about the clock offsets of poses, their intervals, and the drift."""
    offsets = [clock["offset_s"] for clock in clocks.values()]
    wide = [0.5 * (high - low) for low, high in (c["offset_interval90_s"] for c in clocks.values())]
    rate = max((clock["drift"] for clock in clocks.values()), key=abs)
    question = f"; rates differ by up to {1e6 * rate:+.0f} ppm: is the video's frame rate correct?"
    by = ", ".join(sorted({clock["told_by"] for clock in clocks.values()}))
    return (
        f"clock of the poses, from the motion ({by}): {min(offsets):+.3f} to {max(offsets):+.3f} s "
        f"from the robot's in {len(clocks)} runs; 90 % intervals +- {1e3 * min(wide):.1f} to "
        f"{1e3 * max(wide):.1f} ms{question if abs(rate) > LARGEST_DRIFT else ''}"
    )


def show_check(page: Page, found: Content) -> None:
    """Write the content of check.json, with its findings first."""
    page.findings(found["findings"])
    _show_groups(page, found["groups"])
    page.line("channels: " + ", ".join(found["channels"]))
    if found["clocks"]:
        page.line(_clocks(found["clocks"]))
    _show_settings(page, found)
    if "calibration" in found:
        show_calibration(page, Calibration.of_json(found["calibration"]))
    if found["parameters"]:
        _show_expected(page, found["parameters"] | found["derived"])
    page.notes(found["messages"])
    skipped = by_reason(found.get("skipped", ()))
    page.notes((*skipped, *found.get("suspects", ())), first=True)
    page.notes(f"repaired in {count} runs: {note}" for note, count in found["notes"].items())


def _show_groups(page: Page, groups: Sequence[Content]) -> None:
    """Write a table of the runs by floor, load set-up and session, with what they cover."""
    made = table(
        ("surface", "load", "session", "runs", "minutes", "headings", r"speeds \[m/s]"),
        "runs of the logs, with commanded headings and speeds",
        ("runs", "minutes", "headings"),
    )
    for row in groups:
        made.add_row(
            row["surface"],
            row["load"],
            Text(row["session"]),
            str(row["runs"]),
            f"{row['seconds'] / 60:.1f}",
            str(row["headings"] or ""),  # 0 without commands, or for turns on the spot
            " ".join(f"{v:g}" for v in row["speeds"]),
        )
    page.table(made)
    floors = list(dict.fromkeys(row["surface"] for row in groups))
    runs, minutes = (sum(row[k] for row in groups) for k in ("runs", "seconds"))
    on = f"{len(floors)} floor{'s' if len(floors) > 1 else ''}"
    page.line(f"{runs} runs on {on}, {minutes / 60:.1f} minutes")


def _show_settings(page: Page, found: Content) -> None:
    """Write the limits and the noise that logs show, as tables for the config."""
    if not found["settings"]:
        return
    usual, longest = found["gaps_s"]["usual"], found["gaps_s"]["longest"]
    page.line(
        "limits and noise of this robot by its logs, which `slipid identify` uses where the config "
        "has none: the highest values driven, with a reserve of 20 % for wheel speed and motor "
        "voltage, and the noise while the wheels rest; rows are usually "
        f"{usual:.3g} s apart, and at most {longest:.3g} s. For the config:"
    )
    for group, values in found["settings"].items():
        page.line(f"\n[robot.{group}]")
        for key, value in values.items():
            page.line(f"{key} = {value:g}")
    page.line()


def _show_expected(page: Page, numbers: Mapping[str, Content]) -> None:
    """Write ratios of expected posterior std to prior std of parameters, with expected verdicts.

    If the estimates are ranges, the least informative end comes first.
    """
    made = table(
        ("parameter", "std ratio", "expected verdict"),
        "\nbefore a fit: std after it over std of the prior",
    )
    groups, good, count = Groups(made), 0, 0
    for path, e in grouped(numbers.items(), lambda item: item[0]):
        if e["ratio"] is None or "session_yaw" in path:
            continue
        # The ratio of an electric parameter may exceed 1, since the uncertainty of the motion
        # is added to that of its prior.
        keys = (("ratio", "verdict"), ("best_ratio", "best_verdict"))
        ends = [(min(e[ratio], 1.0), e[word]) for ratio, word in keys if ratio in e]
        ratios = dict.fromkeys(f"{ratio:.3f}" for ratio, _ in ends)
        words = dict.fromkeys(verdict(word) for _, word in ends)
        made.add_row(groups.name(path), " .. ".join(ratios), " to ".join(words))
        good, count = good + (ends[0][1] == "identified"), count + 1
    page.table(made)
    page.line(
        f"{good} of {count} are expected to be identified even by the least informative of "
        "plausible floors, motors and noise; only the fit itself can find at bound or disputed"
    )


def show_bench_check(page: Page, found: Content) -> None:
    """Write the content of check.json of bench logs: ranges of signals, expected information."""
    channels = ("voltage", "current", "speed")
    units = (r"voltage \[V]", r"current \[A]", r"speed \[rad/s]")
    made = table(("log", "rows", "seconds", "rows/s", *units), right=("rows", "seconds", "rows/s"))
    for row in found["logs"]:
        spans = [
            "none" if row[k] is None else f"{row[k][0]:.3g} .. {row[k][1]:.3g}" for k in channels
        ]
        rate = f"{1 / row['row_period_s']:.4g}"
        made.add_row(Text(row["name"]), str(row["rows"]), f"{row['seconds']:.1f}", rate, *spans)
    page.table(made)
    lacking = [k for k in channels if any(row[k] is None for row in found["logs"])]
    page.line(f"lowest and highest values; missing: {', '.join(lacking) or 'nothing'}")
    _show_expected(page, found["parameters"])
    page.notes(found["messages"])


def show_selftest(page: Page, found: Content) -> None:
    """Write the content of selftest.json: recovery of parameters, slip curves and predictions."""
    _show_recovery(page, found)
    columns = ("surface", "curve off by", "at most", "in its band", "prediction", "encoders")
    floors = table(columns, "\nslip curves and predictions", columns[1:])
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
    page.line(
        "slip less the true slip, the share of it inside the 90 % band, and end-point errors of "
        "the fit's predictions and of encoders"
    )
    page.notes(found["messages"])
    if found["failed"]:
        page.line(f"NOT recovered: {', '.join(found['failed'])}")


def _show_recovery(page: Page, found: Content) -> None:
    """Write a table of how well parameters are recovered, and what its marks mean."""
    columns = ("parameter", "error", "unit", "of truth", "z rms", "in 90 %", "recovered")
    made = table(
        columns,
        f"{found['replicates']} simulated experiments like this one ({found['runs']} runs), "
        f"{found['converged']} fits converged",
        ("error", "of truth", "z rms", "in 90 %"),
    )
    groups = Groups(made)
    for path, e in grouped(found["parameters"].items(), lambda item: item[0]):
        share = None if e["recovered"] == "no" else e["relative_error_rms"]
        made.add_row(
            groups.name(path),
            f"{e['error_rms']:.2g}",
            e["unit"],
            "" if share is None else f"{100 * share:.1f} %",
            f"{e['z_rms']:.2f}",
            f"{round(e['coverage90'] * e['intervals'])} of {e['intervals']}",
            verdict(e["recovered"], RECOVERED) + (" *" if path in found["wanted"] else ""),
        )
    page.table(made)
    page.line("* wanted; wrong: errors larger than expected from the intervals of the fits")
