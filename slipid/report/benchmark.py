"""The tables of the benchmark on a terminal."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from rich.text import Text

from slipid.report.page import Page, table
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
"""Heading, factor and places of each number of a row."""
ENDS = ("endpoint_error", "behind")
"""Numbers that are shown with their 90 % interval."""
ON_THE_PAGE = ("length_error", "twist_error")
"""Numbers for which a terminal is too narrow."""


def show_benchmark(page: Page, found: Content) -> None:
    """Write every table, best rows first, and what they say."""
    for name, one in found["sets"].items():
        for protocol, rows in one["protocols"].items():
            about = found["protocols"][protocol]
            title = f"\n{name}: {about}; end points over the {one['over']}"
            brief = [number for number in shown(rows) if number not in ON_THE_PAGE]
            head = ("row", *headings(brief), *COSTS[1:])
            made = table(head, title, right=head[1:])
            for row, content in ranked(rows):
                made.add_row(Text(row), *cells(content, brief), *costs(content)[1:])
            for column in made.columns:
                column.no_wrap = True
            page.table(made)
            page.notes(absent(rows))
    for name, one in others(found):
        if one.said:
            page.line(f"\n{name}: {one.said}")
            continue
        made = table(one.head, f"\n{one.title}", right=one.head[1:])
        for of_row in one.body:
            made.add_row(*of_row)
        page.table(made)
    page.line()
    for sentence in found["reading"]:
        page.line(sentence)


COSTS = ("numbers", "fit, s", "step, us")


def ranked(rows: Content) -> list[tuple[str, Content]]:
    """Rows that are there, the least end-point error first."""
    there = [(name, one) for name, one in rows.items() if one["endpoint_error"] is not None]
    return sorted(there, key=lambda item: item[1]["endpoint_error"][0])


def shown(rows: Content) -> list[str]:
    """Numbers that some row has."""
    return [name for name in COLUMNS if any(row[name] is not None for row in rows.values())]


def headings(numbers: Sequence[str]) -> list[str]:
    """Of numbers by their names."""
    return [COLUMNS[name][0] for name in numbers]


def cells(row: Content, numbers: Sequence[str]) -> list[str]:
    """Numbers of a row in words."""
    return [in_words(name, row[name]) for name in numbers]


def in_words(name: str, value: Sequence[float] | None) -> str:
    """A number, with its interval where it is one of `ENDS`; nothing where it is not known."""
    if value is None:
        return ""
    _, factor, places = COLUMNS[name]
    sign = "+" if name == "behind" else ""
    middle, low, high = (f"{factor * x:{sign}.{places}f}" for x in value)
    return f"{middle} [{low}, {high}]" if name in ENDS else middle


def costs(row: Content) -> list[str]:
    """Fitted numbers, seconds to fit, microseconds a step."""
    fit, step = row["fit_s"], row["step_us"]
    seconds = "< 0.1" if fit < 0.1 else f"{fit:.1f}" if fit < 10 else f"{fit:.0f}"
    return [str(row["numbers"]), seconds, f"{step:.1f}" if step < 10 else f"{step:.0f}"]


def absent(rows: Content) -> list[str]:
    """Why rows are not in a table or not to be trusted, rows of one reason together."""
    why: dict[str, list[str]] = {}
    for name, row in rows.items():
        if row["unconverged"]:
            why.setdefault(f"fits did not come to rest: {row['unconverged']}", []).append(name)
        if row["absent"]:
            why.setdefault(("failed: " if row["failed"] else "") + row["absent"], []).append(name)
    return [f"{', '.join(names)}: {reason}" for reason, names in why.items()]


class Other(NamedTuple):
    """A part of benchmark.json that is one table, or why there is none."""

    title: str
    head: tuple[str, ...]
    body: list[tuple[str, ...]]
    said: str = ""


def others(found: Content) -> list[tuple[str, Other]]:
    """Tables beside those of the data sets, by their names."""
    parts: list[tuple[str, Content, Callable[[Content], Other]]]
    parts = [(name, one, felt) for name, one in found["floors"].items()]
    if found["rectangle"] is not None:
        parts.append(("rectangle", found["rectangle"], rectangle))
    return [
        (name, Other("", (), [], f"failed: {one['failed']}") if "failed" in one else made(one))
        for name, one, made in parts
    ]


def rectangle(driven: Content) -> Other:
    """Controllers of the trial, the least closure error first."""
    plant = {"testsite": "the virtual test site", "twin": "the identified model itself"}
    runs = min(row["runs"] for row in driven["summary"].values())
    title = f"rectangle on {plant[driven['plant']]}, {runs} starts, medians with 90 % intervals"
    head = ("controller", "closure, mm", "of encoders', %", "finished, %", "cross-track, mm")
    rows = sorted(driven["summary"].items(), key=lambda item: item[1]["closure_error_median"])
    body: list[tuple[str, ...]] = []
    for name, row in rows:
        low, high = row["interval90"]["closure_error_median"]
        ratio = row.get("to_encoder", {}).get("closure_error_median")
        said = "" if ratio is None else f"{100 * ratio['value']:.0f}"
        if ratio is not None and name != "encoder":
            said += " [{:.0f}, {:.0f}]".format(*(100 * x for x in ratio["interval90"]))
        closure = f"{row['closure_error_median']:.0f} [{low:.0f}, {high:.0f}]"
        finished, cross = f"{100 * row['finished_share']:.0f}", f"{row['cross_track_rmse']:.0f}"
        body.append((name, closure, said, finished, cross))
    return Other(title, head, body)


def felt(found: Content) -> Other:
    """Classifiers: how often they are right, by the time heard; the best at the end first."""
    chance = f"always naming the commonest floor is right in {100 * found['chance']:.0f} %"
    title = f"{found['about']}; {found['runs']} runs; {chance}"
    if lost := [f"{row['name']}: {row['absent']}" for row in found["rows"] if row["absent"]]:
        title = f"{title}; failed: {'; '.join(lost)}"
    rows = [row for row in found["rows"] if row["after"]]
    seconds = [after["seconds"] for after in rows[0]["after"]] if rows else []
    head = ("right, %, after", *(f"{x:g} s" for x in seconds), "points over slipid", "numbers")
    body: list[tuple[str, ...]] = []
    for row in sorted(rows, key=lambda row: -row["after"][-1]["accuracy"][0]):
        right = [
            "{:.0f} [{:.0f}, {:.0f}]".format(*(100 * x for x in after["accuracy"]))
            for after in row["after"]
        ]
        over = in_words("behind", row["after"][-1]["behind"])
        body.append((row["name"], *right, over, str(row["numbers"])))
    return Other(title, head, body)


def picked(rows: Content) -> list[str]:
    """Settings that cross-validation picked in each fold, of the rows that have some."""
    return [
        f"{name}: {'; '.join(dict.fromkeys(row['settings']))}"
        for name, row in rows.items()
        if any(row["settings"])
    ]
