"""Tables of the reference robots, and of the numbers of one of them; 80 columns wide."""

from collections.abc import Iterator, Sequence
from textwrap import fill, wrap

import numpy as np
from rich.table import Table
from rich.text import Text

from slipid.app.reference_robots import ReferenceNumber, ReferenceRobot
from slipid.report.page import Page, percent, table, verdict

_WIDTH = 80
_ERRORS = ("nominal", "calibrated", "selected")
_EXPLAINED = "radius: calibrated over nominal; errors of held-out end points over the path"
_CALIBRATED = {
    "rolling_radius_m": "rolling radius",
    "effective_track_m": "effective track",
    "effective_base_m": "effective base",
    "centre_of_rotation_m": "centre of rotation ahead",
}


def show_robots(page: Page, robots: Sequence[ReferenceRobot]) -> None:
    """Write a table of all reference robots, with a row for every floor."""
    driven = [one for one in robots if one.floors]
    page.table(_floors(driven))
    page.line(_EXPLAINED)
    for one in robots:
        if not one.floors:
            page.line(f"{one.name}: {one.about}")
    page.line(
        f"{len(driven)} robots and {len(robots) - len(driven)} set of motors, identified from "
        "public logs"
    )


def show_robot(page: Page, one: ReferenceRobot) -> None:
    """Write the source of a reference robot, its errors, and its numbers in groups."""
    page.line(f"{one.name}: {one.about}")
    of = one.source
    for part in (of.title, of.url, of.doi and f"doi: {of.doi}", f"{of.runs} runs, {of.licence}"):
        for line in wrap(part or "", _WIDTH - 2):
            page.line(f"  {line}")
    if one.nominal:
        sizes = ", ".join(f"{key} = {_plain(value)}" for key, value in one.nominal.items())
        page.line(fill(f"nominal: {sizes}", _WIDTH))
    if one.floors:
        page.table(_floors([one]))
        page.line(_EXPLAINED)
    groups = _groups(one)
    for group, numbers in groups.items():
        made = table((group, "value", "90 % interval", "verdict"), right=("value",))
        for name, number in numbers.items():
            for label, value, (low, high) in _rows(one, number):
                ends = f"{low:.3g} .. {high:.3g}"
                made.add_row(
                    Text(f"{name}{label}"),
                    f"{value:.3g} {number.unit}",
                    ends,
                    verdict(number.verdict),
                )
        page.table(made)
    hidden = sum(not number.is_determined for number in one.numbers.values())
    for note in one.notes:
        page.line(fill(f"note: {note}", _WIDTH))
    page.line(
        f"{sum(map(len, groups.values()))} numbers; {hidden} that the logs do not determine are "
        f"left out (--json has all).\nThe fit is {one.trust}; slipid {one.origin.slipid}, "
        f"{one.origin.date}."
    )


def _floors(robots: Sequence[ReferenceRobot]) -> Table:
    """Return a table of calibrated radius, errors and selected model on every floor."""
    made = table(
        ("robot", "drive", "floor", "radius", *_ERRORS, "model"), right=("radius", *_ERRORS)
    )
    for one in robots:
        for k, (name, floor) in enumerate(one.floors.items()):
            radius = one.multiplier("wheel_radius", name)
            errors = (percent(floor.error_over_path.get(model)) for model in _ERRORS)
            who = ("", "") if k else (one.name, one.drive)
            size = "" if radius is None else f"{radius:.3f}"
            made.add_row(*who, Text(name), size, *errors, floor.selected)
    return made


def _groups(one: ReferenceRobot) -> dict[str, dict[str, ReferenceNumber]]:
    """Return the determined numbers by name, in groups: robot, motor, and every floor."""
    found: dict[str, dict[str, ReferenceNumber]] = {}
    for path, number in one.numbers.items():
        if number.is_determined and not path.startswith("calibration.multipliers."):
            group, name = _placed(path)
            found.setdefault(group, {})[name] = number
    return {group: found[group] for group in sorted(found, key=_order)}


def _order(group: str) -> tuple[int, str]:
    """Return the key by which groups are sorted: the robot, its motors, then floors by name."""
    return (("robot", "motor", "on").index(group.split(" ")[0]), group)


def _placed(path: str) -> tuple[str, str]:
    """Return the group of a number, and its name in the group."""
    group, _, rest = path.partition(".")
    if group == "calibration":
        part, _, rest = rest.partition(".")
        if part == "surfaces":
            rest, _, part = rest.rpartition(".")
        return f"on {rest}", _CALIBRATED[part]
    if group == "surface":
        floor, _, rest = rest.partition(".")
        return f"on {floor}", rest
    if group == "motor":
        label = rest.rpartition("@")[2] if "@" in rest else ""
        return f"motor {label}".strip(), rest.replace(f"@{label}", "").replace("/motor.", "/")
    return group, rest


def _rows(
    one: ReferenceRobot, number: ReferenceNumber
) -> Iterator[tuple[str, float, tuple[float, float]]]:
    """Yield label, value and interval of a number, or of each of its entries."""
    if not isinstance(number.value, tuple):
        yield "", number.value, number.mean[1]
        return
    two_sides = one.drive in ("skid", "differential") and len(number.value) == 2
    labels = ("left", "right") if two_sides else range(1, len(number.value) + 1)
    ends = np.asarray(number.interval90).tolist()
    for label, value, (low, high) in zip(labels, number.value, ends, strict=True):
        yield f" {label}", value, (low, high)


def _plain(value: object) -> str:
    """Return a nominal size as text."""
    if isinstance(value, list):
        return f"[{', '.join(map(_plain, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value).lower()
