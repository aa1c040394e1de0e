"""Parameters, gains and limits of a robot as tables, for entering them into a controller by hand.

`gains.md` is for reading and shows each value rounded and with all digits. `gains.csv` has the same
rows with all digits; lines in it that start with # are comments.
"""

import csv
import io
from collections.abc import Iterator
from dataclasses import asdict

from slipid.exports.description import (
    LIMITS,
    VERDICTS,
    NumberRow,
    gains_origin,
    header,
    in_markdown,
    number_rows,
    verdict_text,
)
from slipid.exports.text import interval, one_line, short, table
from slipid.parameter import entries
from slipid.robot.controller import Gains, Limits
from slipid.robot.deployed import DeployedRobot

_NUMBER = ("symbol", "value", "unit", "low90", "high90")
HEAD = ("group", "name", "entry", *_NUMBER, "verdict", "provenance", "meaning")
"""Columns of gains.csv."""
_TITLES = {
    "gains": "Controller gains",
    "limits": "Limits",
    "forward": "Kinematics J: rim speed of a wheel [m/s] from the body twist",
    "inverse": "Pseudo-inverse of J: body twist from rim speeds [m/s]",
    "motor": "Motor, the same for all wheels",
    "wheel_curve": "Slip ratio a + b |I| of each wheel at a current I, fitted over all floors",
    "robot": "Wheels and body",
    "surface": "Floors",
}
_GEOMETRY = ("robot.base_radius", "robot.drive_offset")
_FITTED = "from the motor and all floors"
_TWIST = (("vx", "m/s"), ("vy", "m/s"), ("W", "rad/s"))


def table_files(robot: DeployedRobot) -> dict[str, str]:
    """Return the text of gains.md and gains.csv, for the robot's load set-up."""
    lines = tuple(_lines(robot))
    return {"gains.md": _markdown(robot, lines), "gains.csv": _csv(robot, lines)}


def _lines(robot: DeployedRobot) -> Iterator[NumberRow]:
    yield from _gains(robot)
    for name, value in asdict(Limits()).items():
        unit, about = LIMITS[name]
        sure = ("by hand", "default of slipid")
        yield NumberRow("limits", f"limits.{name}", "", "", float(value), unit, None, *sure, about)
    yield from _matrices(robot)
    yield from _curve(robot)
    ratio, about = float(robot.record.wheels.gear_ratio), "motor speed over wheel speed"
    gear = ("n", ratio, "1", None, "fixed", "override", about)
    yield NumberRow("motor", "wheels.gear_ratio", "", *gear)
    yield from number_rows(robot)


def _gains(robot: DeployedRobot) -> Iterator[NumberRow]:
    gains, tuned = Gains.of(robot), robot.record.gains
    taken = tuned is not None and tuned.is_better and tuned.load == robot.load_setup
    sure = ("tuned, better than set by hand", "robot.json") if taken else ("by hand", "default")
    for e in entries(gains):
        d = e.declaration
        spread = getattr(tuned.values, e.path).spread if tuned is not None and taken else None
        doc = d.doc if spread is None else f"{d.doc}; std at the end of the search {short(spread)}"
        about = (d.symbol, float(e.get(gains)), d.unit, None)
        yield NumberRow("gains", f"gains.{e.path}", "", *about, *sure, doc)


def _matrices(robot: DeployedRobot) -> Iterator[NumberRow]:
    known = robot.record.parameters
    made_of = [f"{path} ({verdict_text(known[path].verdict)})" for path in _GEOMETRY]
    sure = ("derived", f"from {', '.join(made_of)}")
    for k in range(robot.wheels):
        for axis, (name, unit) in enumerate(_TWIST):
            about = ("J", float(robot.forward[k, axis]), f"m/s per {unit}", None, *sure)
            meaning = f"rim speed of wheel {k + 1} per {name}"
            yield NumberRow("forward", f"forward[{k + 1}]", name, *about, meaning)
    for axis, (name, unit) in enumerate(_TWIST):
        for k in range(robot.wheels):
            about = ("J^+", float(robot.inverse[axis, k]), f"{unit} per m/s", None, *sure)
            meaning = f"{name} per rim speed of wheel {k + 1}"
            yield NumberRow("inverse", f"inverse[{name}]", f"wheel {k + 1}", *about, meaning)


def _curve(robot: DeployedRobot) -> Iterator[NumberRow]:
    columns = (("a", "1", "slip ratio without current"), ("b", "1/A", "slip ratio per current"))
    for k, row in enumerate(robot.wheel_curve.tolist()):
        for value, (name, unit, meaning) in zip(row, columns, strict=True):
            about = (name, value, unit, None, "derived", _FITTED, meaning)
            yield NumberRow("wheel_curve", f"wheel_curve.{name}", f"wheel {k + 1}", *about)


def _csv(robot: DeployedRobot, lines: tuple[NumberRow, ...]) -> str:
    text = io.StringIO()
    for line in header(robot):
        # replace double quotes, which would make CSV readers join lines
        text.write(f"# {line}".replace('"', "'") + "\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEAD)
    for x in lines:
        ends = ("", "") if x.interval90 is None else tuple(repr(end) for end in x.interval90)
        words = (x.group, one_line(x.name), x.entry, x.symbol, repr(x.value), x.unit, *ends)
        writer.writerow((*words, x.verdict, x.provenance, x.about))
    return text.getvalue()


def _markdown(robot: DeployedRobot, lines: tuple[NumberRow, ...]) -> str:
    text = ["# Parameters of a robot identified by slipid", "", *in_markdown(robot)]
    text += [gains_origin(robot), ""]
    for group, title in _TITLES.items():
        rows = []
        for x in (x for x in lines if x.group == group):
            number = (x.symbol, short(x.value), repr(x.value), x.unit, interval(x.interval90))
            rows.append(
                (f"`{x.name}`", x.entry, *number, x.verdict_markdown, x.provenance, x.about)
            )
        head = ("name", "", "symbol", "rounded", "value", "unit", "90 % interval", "verdict")
        text += [f"## {title}", "", *table((*head, "provenance", "meaning"), rows), ""]
    text += ["## Verdicts", ""]
    text += [f"- *{verdict_text(v)}*: {about}." for v, about in VERDICTS.items()]
    return "\n".join(text) + "\n"
