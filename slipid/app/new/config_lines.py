"""Lines and tables of a new config, with comments and open questions; drawing of the robot."""

import json
import math
from dataclasses import dataclass
from textwrap import TextWrapper

import numpy as np

from slipid.model.geometry import Geometry

QUESTION_MARK = "# ? "
"""Beginning of a line with an open question."""
_COLUMN = 38
"""Column of the text at which comments begin, if the key and its value are short enough."""
_WIDTH = 98
"""Largest width of lines of comments [character]."""


@dataclass(frozen=True)
class ConfigLine:
    """Line of a config with one key.

    Attributes:
        key: name of the key.
        value: value as TOML text.
        comment: meaning of the key.
        question: question that the user has to answer here; empty if there is none.
        commented_out: True if the line is written as a comment, without effect.
    """

    key: str
    value: str
    comment: str = ""
    question: str = ""
    commented_out: bool = False

    def text(self) -> str:
        """Return the text of the line, preceded by its question."""
        question = _question_lines(self.question)
        line = f"{'# ' if self.commented_out else ''}{self.key} = {self.value}"
        if not self.comment:
            return question + line
        if len(line) < _COLUMN:
            line = line.ljust(_COLUMN - 1)
        elif len(line) + len(self.comment) + 3 > _WIDTH + 4:
            above = "".join(f"# {part}\n" for part in wrapped(self.comment, _WIDTH - 2))
            return question + above + line
        return f"{question}{line} # {self.comment}"


@dataclass(frozen=True)
class ConfigBlock:
    """Table of a config.

    Attributes:
        header: header line, such as `[robot]`; empty for keys or comments without a header.
        lines: keys of the table.
        above: comments above the table.
        below: comments at the end of the table.
        questions: open questions about the whole table.
    """

    header: str
    lines: tuple[ConfigLine, ...] = ()
    above: tuple[str, ...] = ()
    below: tuple[str, ...] = ()
    questions: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the text of the table."""
        out = [f"# {part}".rstrip() for text in self.above for part in wrapped(text, _WIDTH - 2)]
        out += [_question_lines(question).rstrip("\n") for question in self.questions]
        out += [self.header] if self.header else []
        out += [line.text() for line in self.lines]
        out += [f"# {part}".rstrip() for text in self.below for part in wrapped(text, _WIDTH - 2)]
        return "\n".join(out)

    @property
    def open_questions(self) -> tuple[str, ...]:
        """Return all open questions of the table and its keys."""
        lines = (f"{line.key}: {line.question}" for line in self.lines if line.question)
        return (*self.questions, *lines)


def toml(value: object) -> str:
    """Return a plain value as TOML text on one line; whole floats have no decimal point."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(one) for one in value) + "]"
    return json.dumps(value, ensure_ascii=False)


def _question_lines(question: str) -> str:
    """Return a question as comment lines, the first of which begins with `QUESTION_MARK`."""
    if not question:
        return ""
    first, *others = wrapped(question, _WIDTH - len(QUESTION_MARK))
    return "".join([f"{QUESTION_MARK}{first}\n", *(f"#   {part}\n" for part in others)])


def wrapped(text: str, width: int) -> list[str]:
    """Return a text as lines of at most `width` characters; existing line breaks are kept."""
    wrapper = TextWrapper(width, break_long_words=False, break_on_hyphens=False)
    lines = text.splitlines() or [""]
    return [
        part for line in lines for part in (wrapper.wrap(line) if len(line) > width else [line])
    ]


_ARROWS = "↑↖←↙↓↘→↗"
"""Arrows that show directions, from ahead (up) counter-clockwise in steps of 45 deg."""
_LINES = r"|\-/"
"""Characters for lines along the directions ahead (up), ahead left, left and back left."""
_ROWS, _COLUMNS, _LEAST = 5, 13, 3
"""Size of the drawing, counted from the robot's middle: largest number of rows to the foremost or
rearmost wheel, number of columns to either side, and least number of rows ahead."""
_MARGIN = 12
"""Number of columns beyond the wheels, for the y axis and the labels."""
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Letters that stand for motors that several wheels share."""
LABEL_WIDTH = 3
"""Number of characters that show a wheel in the drawing: number, arrow, and letter of its motor."""


def drawing(robot: Geometry) -> str:
    """Return a text drawing of the robot seen from above, followed by a line about every wheel.

    The x axis (ahead) points up and the y axis to the left. A wheel is drawn as its number in the
    order of the log columns, an arrow in the direction in which it rolls at a positive speed, and
    the letter of the motor that it shares with other wheels. Of a robot that steers, the axles are
    drawn.
    """
    if robot.driven is not None:
        return _axles(robot)
    lines = [
        "seen from above, arrows: direction of a positive wheel speed",
        "",
        *_picture(_grid_wheels(robot)),
        "",
        *(_wheel_line(robot, wheel) for wheel in range(robot.wheels)),
        *_motor_lines(robot),
    ]
    return "\n".join(line.rstrip() for line in lines)


def _axles(robot: Geometry) -> str:
    """Return a drawing of the axles of a robot that steers."""
    count = robot.drives
    encoders = f", {count} encoder{'s' if count > 1 else ''}"
    front, rear = (encoders if robot.driven == axle else "" for axle in ("front", "rear"))
    lines = [
        "seen from above, wheels rolling ahead at a positive speed",
        "",
        "         ^ x",
        f"       [ / ]   front axle, steered, positive to the left{front}",
        "         |",
        f"         |     wheelbase {float(robot.base_radius):.3f} m",
        "         |",
        f"  y <--[ + ]   rear axle, from which x counts{rear}",
    ]
    return "\n".join(lines)


def direction(degrees: float) -> str:
    """Return a direction, given as an angle counter-clockwise from ahead [deg], in words."""
    names = ("ahead", "ahead left", "left", "back left", "back", "back right", "right")
    return (*names, "ahead right")[round(degrees / 45) % 8]


def _grid_wheels(robot: Geometry) -> dict[tuple[int, int], str]:
    """Return the label of each wheel, keyed by its row and column in the drawing.

    Rows are counted downwards and columns to the right, from the robot's middle. A character is
    about twice as high as wide, so one row is as far as two columns. A label that would overlap
    another one is moved down.
    """
    place = np.asarray(robot.place) * float(robot.base_radius)
    step = max(np.abs(place[:, 0]).max() / _ROWS, np.abs(place[:, 1]).max() / (_COLUMNS / 2), 1e-9)
    labels: dict[tuple[int, int], str] = {}
    for k, (x, y) in enumerate(place.tolist()):
        row, column = -round(x / step), -round(2 * y / step)
        near = range(column - LABEL_WIDTH, column + LABEL_WIDTH + 1)
        while any((row, c) in labels or (row, c) == (0, 0) for c in near):
            row += 1
        arrow = _ARROWS[round(math.degrees(robot.drive_angle[k]) / 45) % 8]
        labels[row, column] = f"{k + 1}{arrow}{_letter(robot, k)}"
    return labels


def _letter(robot: Geometry, wheel: int) -> str:
    """Return the letter of the motor that a wheel shares with others; empty if it has its own."""
    if not robot.drive_of or robot.drive_of.count(robot.drive_of[wheel]) == 1:
        return ""
    return _LETTERS[robot.drive_of[wheel] % len(_LETTERS)]


def _picture(labels: dict[tuple[int, int], str]) -> list[str]:
    """Return the lines of a drawing with the axes and with labels, keyed by row and column."""
    rows, columns = zip(*labels, strict=True)
    top, bottom = min(-_LEAST, *rows) - 1, max(0, *rows)
    width = max(_COLUMNS, *map(abs, columns)) + _MARGIN
    canvas = [[" "] * (2 * width) for _ in range(bottom - top + 1)]

    def put(row: int, column: int, text: str) -> None:
        canvas[row - top][width + column : width + column + len(text)] = text

    for row in range(top + 1, 0):
        put(row, 0, "|")
    put(top, 0, "^ x")
    left = min(columns) - 6 if 0 in rows else -8
    put(0, left - 3, "y <" + "-" * -left + "+")
    for (row, column), label in labels.items():
        put(row, column - 1, label)
    lines = ["".join(row).rstrip() for row in canvas]
    blank = min(len(line) - len(line.lstrip()) for line in lines if line)
    return [f"    {line[blank:]}" if line else "" for line in lines]


def _wheel_line(robot: Geometry, wheel: int) -> str:
    """Return a line about a wheel: its position, drive direction and rollers."""
    x, y = (float(robot.base_radius) * c for c in robot.place[wheel])
    degrees = math.degrees(robot.drive_angle[wheel]) % 360
    motion = f"drives {direction(degrees)}" + (f" ({degrees:.0f} deg)" if degrees % 90 else "")
    if robot.grips[wheel]:
        rollers = "no rollers"
    else:
        rollers = f"rollers at {math.degrees(robot.roller_angle[wheel]):.0f} deg"
        rollers += _tilt(degrees, math.degrees(robot.roller_angle[wheel]))
    at = f"{_corner(x, y):<12} x = {x:+.3f} m, y = {y:+.3f} m"
    return f"wheel {wheel + 1}: {at}, {motion}, {rollers}"


def _tilt(drive: float, roller: float) -> str:
    """Return a remark with a stroke that shows the tilt of a wheel's upper rollers from above.

    The stroke is one of `_LINES`; the remark is empty if the rollers are not tilted. `drive` is the
    drive direction and `roller` the roller angle [deg].
    """
    if abs(roller % 180 - 90) < 1:
        return ""
    # The rollers on top are tilted the opposite way to those that touch the floor.
    return f", from above {_LINES[round((drive + roller - 90) / 45) % 4]}"


def _corner(x: float, y: float) -> str:
    """Return the corner or side of the robot, in words, at which a point x, y [m] lies."""
    edge = 0.2 * math.hypot(x, y)
    along = "front" if x > edge else "rear" if x < -edge else ""
    return f"{along} {'left' if y > edge else 'right' if y < -edge else ''}".strip()


def _motor_lines(robot: Geometry) -> list[str]:
    """Return a line with the wheels of each log column; no lines if no motor has several wheels."""
    if not robot.drive_of:
        return []
    out = []
    for drive in range(robot.drives):
        wheels = [str(k + 1) for k, d in enumerate(robot.drive_of) if d == drive]
        first = robot.drive_of.index(drive)
        letter = f"motor {_letter(robot, first)}".rstrip() + ", "
        plural = "s" if len(wheels) > 1 else ""
        out.append(f"{letter}column {drive + 1} of the logs: wheel{plural} {' and '.join(wheels)}")
    return out
