"""Tables and figures of the benchmark, on a terminal and on one page of HTML."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from rich.text import Text as Cell

from slipid.lab.benchmark.summary import TOO_FEW
from slipid.report import page as terminal
from slipid.report.html import figures as draw
from slipid.report.html.blocks import Badge, Block, FigureBlock, PageSection, TableBlock, TextBlock
from slipid.report.html.page import WebPage
from slipid.support.content import Content

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


def show_benchmark(page: terminal.Page, found: Content) -> None:
    """Print every table, best rows first, and the sentences that summarise the tables."""
    for name, one in found["sets"].items():
        for protocol, rows in one["protocols"].items():
            about = found["protocols"][protocol]
            title = f"\n{name}: {about}; end points over the {one['over']}"
            brief = [number for number in shown(rows) if number in BRIEF]
            head, body = methods(rows, brief, COSTS[1:2])
            made = terminal.table(head, title, right=head[1:])
            for row, *cells in body:
                made.add_row(Cell(row), *cells)
            page.table(made)
            page.line(f"{len(body)} methods; {PAGE} has all their errors and costs")
            for sentence in absent(rows):
                page.line(sentence)
    for name, one in others(found):
        if one.failure:
            page.line(f"\n{name}: {one.failure}")
            continue
        made = terminal.table(one.head, f"\n{one.title}", right=one.head[1:])
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


def in_words(name: str, value: Sequence[float | None] | None) -> str:
    """Return a field's value as a string, with its interval if the field is in `WITH_INTERVALS`.

    The string is empty for None.
    """
    if value is None:
        return ""
    _, factor, places = COLUMNS[name]
    sign = "+" if name == "behind" else ""
    middle, *ends = (f"{factor * x:{sign}.{places}f}" for x in value if x is not None)
    return _with_interval(middle, ends) if name in WITH_INTERVALS else middle


def _with_interval(middle: str, ends: Sequence[str]) -> str:
    """Return a value with the ends of its interval, or with "-" if it has none."""
    return f"{middle} [{', '.join(ends) or '-'}]"


def costs_of(row: Content) -> list[str]:
    """Return a row's number of parameters, time to fit [s] and time per step [us], as text."""
    fit, step = row["fit_s"], row["step_us"]
    seconds = "< 0.1" if fit < 0.1 else f"{fit:.1f}" if fit < 10 else f"{fit:.0f}"
    return [str(row["numbers"]), seconds, f"{step:.1f}" if step < 10 else f"{step:.0f}"]


def absent(rows: Content) -> list[str]:
    """Return a line for each reason why rows are absent, unconverged or without an interval.

    A line begins with the names of the rows.
    """
    why: dict[str, list[str]] = {}
    for name, row in rows.items():
        if any(row[field] is not None and row[field][1] is None for field in WITH_INTERVALS):
            why.setdefault(TOO_FEW, []).append(name)
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
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        relative = "" if ratio is None else f"{100 * ratio['value']:.0f}"
        if ratio is not None and name != "encoder":
            ends = [f"{100 * x:.0f}" for x in ratio["interval90"] or ()]
            relative = _with_interval(relative, ends)
        ends = [f"{x:.0f}" for x in row["interval90"]["closure_error_median"] or ()]
        closure = _with_interval(f"{row['closure_error_median']:.0f}", ends)
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
    if any(after["accuracy"][1] is None for row in rows for after in row["after"]):
        title = f"{title}; -: {TOO_FEW}, or all answers are right, or none is"
    seconds = [after["seconds"] for after in rows[0]["after"]] if rows else []
    head = ("correct, %, after", *(f"{x:g} s" for x in seconds), "points above slipid", "numbers")
    body: list[tuple[str, ...]] = []
    for row in sorted(rows, key=lambda row: -row["after"][-1]["accuracy"][0]):
        percents = (
            [f"{100 * x:.0f}" for x in a["accuracy"] if x is not None] for a in row["after"]
        )
        right = [_with_interval(middle, ends) for middle, *ends in percents]
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


def benchmark_page(found: Content) -> WebPage:
    """Return the page of benchmark.json: summary, then figures and tables of every data set."""
    names = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    origin = TextBlock([f"{names}; this call took {found['seconds']:.0f} s."], kind="note")
    sections = [
        PageSection("summary", "Summary", [TextBlock(found["reading"], listed=True)]),
        *(_of_set(found, name, one) for name, one in found["sets"].items()),
        *(_of_other(name, one) for name, one in others(found)),
        PageSection("reading", "How to read the tables", [TextBlock([LEGEND]), origin]),
    ]
    lead = (
        "All methods were fitted to the same runs and predict other runs from the sensors of the "
        "robot; the pose is only used at the start. Brackets contain 90 % intervals by a "
        "jackknife over clusters of runs; settings were selected on training runs only."
    )
    return WebPage("Slip methods compared", None, lead, sections)


def _of_set(found: Content, name: str, one: Content) -> PageSection:
    """Return the section about a data set: a figure and a table for every protocol."""
    blocks: list[Block] = [TextBlock([f"{one['about']}; {one['runs']} runs."])]
    for protocol, rows in one["protocols"].items():
        title = f"{protocol.replace('_', ' ')}: {found['protocols'][protocol]}"
        if (figure := ranking_figure(rows, f"{name}_{protocol}", title, one["over"])) is not None:
            blocks.append(figure)
        blocks.append(_table(title, *methods(rows, shown(rows), COSTS)))
        if lines := absent(rows):
            blocks.append(TextBlock(lines, listed=True, kind="note"))
        if lines := settings_lines(rows):
            body = [line.split(": ", 1) for line in lines]
            title = "Settings that were selected, fold by fold."
            blocks.append(TableBlock(title, ("row", "settings"), body, folded=True))
    return PageSection(name, name.replace("_", " "), blocks)


def _of_other(name: str, one: ExtraTable) -> PageSection:
    """Return the section about a table that does not belong to a data set."""
    block: Block = TextBlock([one.failure], kind="warning")
    if not one.failure:
        block = _table(one.title, one.head, one.body)
    return PageSection(name, name.replace("_", " "), [block])


OWN_PREFIX = ("slipid", "contact")
"""Prefixes of the names of slipid's rows, which are highlighted."""


def _table(title: str, head: tuple[str, ...], body: Sequence[tuple[str, ...]]) -> TableBlock:
    """Return a table with row names in the first column; slipid's are highlighted."""
    rows = [(Badge(n, "good") if n.startswith(OWN_PREFIX) else n, *cells) for n, *cells in body]
    return TableBlock(title, head, rows, right=head[1:])


def ranking_figure(rows: Content, name: str, title: str, over: str) -> FigureBlock | None:
    """Return the figure of the end-point errors of one protocol, with 90 % intervals.

    Args:
        rows: rows of the protocol.
        name: identifier of the figure.
        title: title, which describes the protocol.
        over: what errors are divided by.

    Returns:
        None if no row has an end-point error.
    """
    ends = {n: row["endpoint_error"] for n, row in rows.items() if row["endpoint_error"]}
    if not ends:
        return None
    order = sorted(ends, key=lambda row: -ends[row][0])
    data = []
    for own, label, shade in ((True, "slipid", "@orange"), (False, "others", "@blue")):
        mine = [n for n in order if n.startswith(OWN_PREFIX) is own]
        middle = [100 * ends[n][0] for n in mine]
        below, above = (
            [0.0 if ends[n][k] is None else 100 * abs(ends[n][k] - ends[n][0]) for n in mine]
            for k in (1, 2)
        )
        data.append(draw.errors(middle, mine, (below, above), label, shade))
    layout = {
        "xaxis": draw.axis(f"mean end-point error over the {over} [%]", **draw.logarithmic()),
        "yaxis": {"automargin": True, "categoryorder": "array", "categoryarray": order},
        "showlegend": True,
    }
    best = order[-1]
    alt = f"{title}. The best of {len(order)} rows is {best}, off by {100 * ends[best][0]:.1f} %."
    return FigureBlock(name, title, alt, data, layout, "", 130 + 19 * len(order), minimum=460)
