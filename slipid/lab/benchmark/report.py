"""Tables and figures of the benchmark, on a terminal and on one page of HTML.

Figures show the end-point errors of every row of the benchmark, one panel per protocol; the page
embeds them.
"""

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from rich.text import Text

from slipid.plots import drawing
from slipid.report.page import Page, table
from slipid.support.content import Content
from slipid.support.files import write_bytes

COLUMNS: Mapping[str, tuple[str, float, int]] = {
    "endpoint_error": ("end point, %", 100.0, 1),
    "behind": ("minus slipid's", 100.0, 1),
    "length_error": ("length, %", 100.0, 1),
    "heading_error_deg": ("heading, deg", 1.0, 1),
    "twist_error": ("twist, mm/s", 1000.0, 0),
    "coverage90": ("in 90 %", 100.0, 0),
    "slip_auc": ("slip AUC", 1.0, 2),
    "floor_accuracy": ("floor, %", 100.0, 0),
    "energy_error": ("energy, %", 100.0, 0),
}
"""Column heading, factor to the displayed unit and decimal places, by field of `RowSummary`."""
WITH_INTERVALS = ("endpoint_error", "behind")
"""Fields that are shown with their 90 % intervals."""
BRIEF = ("endpoint_error", "behind", "coverage90")
"""Fields that are shown as text; the HTML page has all of them."""


def show_benchmark(page: Page, found: Content) -> None:
    """Print every table, best rows first, and the sentences that summarise the tables."""
    for name, one in found["sets"].items():
        for protocol, rows in one["protocols"].items():
            about = found["protocols"][protocol]
            title = f"\n{name}: {about}; end points over the {one['over']}"
            brief = [number for number in shown(rows) if number in BRIEF]
            head, body = methods(rows, brief, COSTS[1:2])
            made = table(head, title, right=head[1:])
            for row, *cells in body:
                made.add_row(Text(row), *cells)
            page.table(made)
            page.line(f"{len(body)} methods; {PAGE} has all their errors and costs")
            for sentence in absent(rows):
                page.line(sentence)
    for name, one in others(found):
        if one.failure:
            page.line(f"\n{name}: {one.failure}")
            continue
        made = table(one.head, f"\n{one.title}", right=one.head[1:])
        for of_row in one.body:
            made.add_row(*of_row)
        page.table(made)
        page.line(f"{len(one.body)} rows, the best first")
    page.line()
    for sentence in found["reading"]:
        page.line(sentence)


COSTS = ("numbers", "fit, s", "step, us")


def methods(
    rows: Content, numbers: Sequence[str], costs: Sequence[str]
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return head and body of the table of methods, sorted by end-point error, the smallest first.

    Args:
        rows: rows of a protocol; those without results are omitted.
        numbers: fields of `COLUMNS` that become columns.
        costs: entries of `COSTS`, which become the last columns.
    """
    there = [(name, one) for name, one in rows.items() if one["endpoint_error"] is not None]
    body = [
        (name, *(in_words(n, one[n]) for n in numbers), *_some(costs_of(one), costs))
        for name, one in sorted(there, key=lambda item: item[1]["endpoint_error"][0])
    ]
    return ("row", *(COLUMNS[n][0] for n in numbers), *costs), body


def _some(cells: Sequence[str], costs: Sequence[str]) -> list[str]:
    """Return the cells of some entries of `COSTS`."""
    return [cells[COSTS.index(name)] for name in costs]


def shown(rows: Content) -> list[str]:
    """Return the fields of `COLUMNS` for which at least one row has a value."""
    return [name for name in COLUMNS if any(row[name] is not None for row in rows.values())]


def in_words(name: str, value: Sequence[float] | None) -> str:
    """Return a field's value as a string, with its interval if the field is in `WITH_INTERVALS`.

    The string is empty for None.
    """
    if value is None:
        return ""
    _, factor, places = COLUMNS[name]
    sign = "+" if name == "behind" else ""
    middle, low, high = (f"{factor * x:{sign}.{places}f}" for x in value)
    return f"{middle} [{low}, {high}]" if name in WITH_INTERVALS else middle


def costs_of(row: Content) -> list[str]:
    """Return a row's number of parameters, time to fit [s] and time per step [us], as text."""
    fit, step = row["fit_s"], row["step_us"]
    seconds = "< 0.1" if fit < 0.1 else f"{fit:.1f}" if fit < 10 else f"{fit:.0f}"
    return [str(row["numbers"]), seconds, f"{step:.1f}" if step < 10 else f"{step:.0f}"]


def absent(rows: Content) -> list[str]:
    """Return a line for each reason why rows are absent or unconverged, with the rows' names."""
    why: dict[str, list[str]] = {}
    for name, row in rows.items():
        if row["unconverged"]:
            why.setdefault(f"fits that did not converge: {row['unconverged']}", []).append(name)
        if row["absent"]:
            why.setdefault(("failed: " if row["failed"] else "") + row["absent"], []).append(name)
    return [f"{', '.join(names)}: {reason}" for reason, names in why.items()]


class ExtraTable(NamedTuple):
    """A table of benchmark.json that does not belong to a data set.

    Attributes:
        title: title of the table.
        head: headings of the columns.
        body: rows of the table.
        failure: reason why there is no table, or an empty string.
    """

    title: str
    head: tuple[str, ...]
    body: list[tuple[str, ...]]
    failure: str = ""


def others(found: Content) -> list[tuple[str, ExtraTable]]:
    """Return name and content of each table that does not belong to a data set."""
    parts: list[tuple[str, Content, Callable[[Content], ExtraTable]]]
    parts = [(name, one, classifiers) for name, one in found["floors"].items()]
    if found["rectangle"] is not None:
        parts.append(("rectangle", found["rectangle"], rectangle))
    return [
        (name, ExtraTable("", (), [], f"failed: {one['failed']}") if "failed" in one else made(one))
        for name, one, made in parts
    ]


def rectangle(trial: Content) -> ExtraTable:
    """Return the table of the trial's controllers, sorted by closure error, the smallest first."""
    plant = {"testsite": "the virtual test site", "twin": "the identified model itself"}
    runs = min(row["runs"] for row in trial["summary"].values())
    title = f"rectangle on {plant[trial['plant']]}, {runs} starts, medians with 90 % intervals"
    head = ("controller", "closure, mm", "of encoders', %", "finished, %", "cross-track, mm")
    rows = sorted(trial["summary"].items(), key=lambda item: item[1]["closure_error_median"])
    body: list[tuple[str, ...]] = []
    for name, row in rows:
        low, high = row["interval90"]["closure_error_median"]
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        relative = "" if ratio is None else f"{100 * ratio['value']:.0f}"
        if ratio is not None and name != "encoder":
            relative += " [{:.0f}, {:.0f}]".format(*(100 * x for x in ratio["interval90"]))
        closure = f"{row['closure_error_median']:.0f} [{low:.0f}, {high:.0f}]"
        finished, cross = f"{100 * row['finished_share']:.0f}", f"{row['cross_track_rmse']:.0f}"
        body.append((name, closure, relative, finished, cross))
    return ExtraTable(title, head, body)


def classifiers(found: Content) -> ExtraTable:
    """Return the table of classifiers' accuracies after each time.

    Rows are sorted by their accuracy after the longest time, the best first.
    """
    chance = f"always choosing the most frequent floor gives {100 * found['chance']:.0f} %"
    title = f"{found['about']}; {found['runs']} runs; {chance}"
    if lost := [f"{row['name']}: {row['absent']}" for row in found["rows"] if row["absent"]]:
        title = f"{title}; failed: {'; '.join(lost)}"
    rows = [row for row in found["rows"] if row["after"]]
    seconds = [after["seconds"] for after in rows[0]["after"]] if rows else []
    head = ("correct, %, after", *(f"{x:g} s" for x in seconds), "points above slipid", "numbers")
    body: list[tuple[str, ...]] = []
    for row in sorted(rows, key=lambda row: -row["after"][-1]["accuracy"][0]):
        right = [
            "{:.0f} [{:.0f}, {:.0f}]".format(*(100 * x for x in after["accuracy"]))
            for after in row["after"]
        ]
        over = in_words("behind", row["after"][-1]["behind"])
        body.append((row["name"], *right, over, str(row["numbers"])))
    return ExtraTable(title, head, body)


def settings_lines(rows: Content) -> list[str]:
    """Return a line for each row with settings, which cross-validation selected in each fold."""
    return [
        f"{name}: {'; '.join(dict.fromkeys(row['settings']))}"
        for name, row in rows.items()
        if any(row["settings"])
    ]


PAGE = "benchmark.html"
LEGEND = (
    "End point: distance between the predicted and the true end, over the chord or the path. "
    "Minus slipid's: the difference on the same runs, negative if the row is better. Length: of "
    "the chord or the path. Heading: at the end. Twist: root mean square in windows of half a "
    "second. In 90 %: percentage of end points in the predicted 90 % region. Slip AUC: area under "
    "the receiver operating characteristic of slip detection. Floor: percentage of the time in "
    'which the most probable floor is the true one, or is "unknown" on a floor without training '
    "runs. Energy: error of the electric "
    "energy of a run. Numbers: fitted parameters. Fit, step: time of one fit, and to predict one "
    "step of a run."
)
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 92rem; margin: 2rem auto }
body { padding: 0 1rem }
h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc } h3 { margin-bottom: .3rem }
.wide { overflow-x: auto } img { max-width: 100% }
table { border-collapse: collapse; font-size: 13px; white-space: nowrap }
th, td { text-align: right; padding: .15rem .6rem; border-bottom: 1px solid #eee }
th:first-child, td:first-child { text-align: left; font-family: monospace }
tr.own { background: #fdeee3; font-weight: 600 } .note { color: #666; font-size: 13px }
"""


def write_page(found: Content, pictures: Mapping[str, bytes], out: Path) -> Path:
    """Write the HTML page of a benchmark's content to a folder and return the page's path."""
    path = out / PAGE
    write_bytes(path, page(found, pictures).encode())
    return path


def page(found: Content, pictures: Mapping[str, bytes]) -> str:
    """Return the whole page: summary, then a picture and the tables of every data set.

    Args:
        found: content of benchmark.json.
        pictures: content of PNG files, keyed by the name of the data set that each shows.
    """
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>Slip methods compared</title><style>{STYLE}</style>",
        "<h1>Slip methods compared</h1>",
        "<p>All methods were fitted to the same runs and predict other runs from the sensors of "
        "the robot; the pose is only used at the start. Brackets contain 90&nbsp;% intervals by "
        "resampling of runs; settings were selected on training runs only.</p>",
        f"<p class='note'>{escape(LEGEND)}</p>",
        "<h2>Summary</h2><ul>",
        *(f"<li>{escape(sentence)}</li>" for sentence in found["reading"]),
        "</ul>",
    ]
    for name, one in found["sets"].items():
        parts += _set(found, name, one, pictures.get(name))
    for name, other in others(found):
        parts.append(f"<h2>{escape(name.replace('_', ' '))}</h2>")
        parts.append(f"<p>{escape(other.failure or other.title)}</p>")
        if not other.failure:
            parts.append(html_table(other.head, other.body))
    names = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    note = escape(f"{names}; this call took {found['seconds']:.0f} s")
    parts.append(f"<p class='note'>{note}</p></html>")
    return "\n".join(parts)


def _set(found: Content, name: str, one: Content, drawn: bytes | None) -> list[str]:
    parts = [f"<h2>{escape(name)}</h2><p>{escape(one['about'])}; {one['runs']} runs</p>"]
    if drawn is not None:
        data = b64encode(drawn).decode()
        title = escape(f"End-point errors on {name}")
        parts.append(f"<img alt='{title}' src='data:image/png;base64,{data}'>")
    for protocol, rows in one["protocols"].items():
        title = f"{protocol.replace('_', ' ')}: {found['protocols'][protocol]}"
        parts.append(f"<h3>{escape(title)}</h3>")
        parts.append(html_table(*methods(rows, shown(rows), COSTS)))
        parts += [f"<p class='note'>{escape(line)}</p>" for line in absent(rows)]
        if lines := settings_lines(rows):
            parts.append("<details class='note'><summary>selected settings, fold by fold</summary>")
            parts += [*(f"<div>{escape(line)}</div>" for line in lines), "</details>"]
    return parts


def html_table(head: tuple[str, ...], body: list[tuple[str, ...]]) -> str:
    """Return an HTML table with row names in the first column; slipid's rows are highlighted."""
    lines = [
        "<div class='wide'><table><tr>",
        *(f"<th>{escape(cell)}</th>" for cell in head),
        "</tr>",
    ]
    for row in body:
        own = " class='own'" if row[0].startswith(("slipid", "contact")) else ""
        lines.append(f"<tr{own}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>")
    return "".join([*lines, "</table></div>"])


OWN_PREFIX = "slipid"
"""Prefix of the names of rows that are highlighted."""


def benchmark_pictures(found: Content) -> dict[str, bytes]:
    """Draw a figure for each data set of benchmark.json; return PNG bytes by data set name."""
    made = {n: benchmark_figure(one, found["protocols"], n) for n, one in found["sets"].items()}
    return {name: drawing.png(figure) for name, figure in made.items() if figure is not None}


def benchmark_figure(one: Content, about: Content, name: str) -> Figure | None:
    """Return a figure of one data set: mean end-point errors with 90 % intervals, by protocol.

    The figure is None if no row has an end-point error.

    Args:
        one: content of a data set in benchmark.json.
        about: descriptions of the protocols, keyed by name.
        name: name of the data set.
    """
    protocols = {
        protocol: ends
        for protocol, rows in one["protocols"].items()
        if (ends := {n: row["endpoint_error"] for n, row in rows.items() if row["endpoint_error"]})
    }
    if not protocols:
        return None
    rows = max(len(ends) for ends in protocols.values())
    made, axes = drawing.panels(
        len(protocols),
        4.6,
        1.4 + 0.24 * rows,
        f"{name}: {one['about']}\nmean end-point error over the {one['over']}, 90 % intervals",
    )
    for ax, (protocol, ends) in zip(axes, protocols.items(), strict=True):
        _panel(ax, ends)
        ax.set_title(about[protocol], fontsize=9, loc="left", wrap=True)
    return made


def _panel(ax: Axes, ends: Mapping[str, Sequence[float]]) -> None:
    order = sorted(ends, key=lambda row: -ends[row][0])
    for k, row in enumerate(order):
        middle, low, high = (100 * x for x in ends[row])
        colour = drawing.ORANGE if row.startswith(OWN_PREFIX) else drawing.BLUE
        ax.plot([low, high], [k, k], color=colour, lw=1.5)
        ax.plot(middle, k, "o", color=colour, ms=4)
    ax.set_yticks(np.arange(len(order)), order, fontsize=7)
    for label in ax.get_yticklabels():
        if label.get_text().startswith(OWN_PREFIX):
            label.set_color(drawing.ORANGE)
            label.set_fontweight("bold")
    ax.set_xscale("log")
    ax.set_xlabel("end-point error, %")
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()
    ax.set_ylim(-0.7, len(order) - 0.3)
