"""Broken logs, each made from a good one by one function, with what the message must say.

`write_good(folder)` lays out a data folder with one good run per layout; a `Case` breaks one of
them and says which fragments the one message must contain. The reader's tests and those of the
command line go through the same table.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROBOTINO = "one_surface/gray/exp07.csv"
GENERIC = "generic/run.csv"
ROWS = 200
FIRST = 4  # line of the first row of numbers in the Robotino file; 2 in the generic one

GENERIC_LAYOUT: dict[str, Any] = {
    "ticks_per_revolution": 500,
    "gear_ratio": 10,
    "columns": {
        "time": {"column": "time", "unit": "s"},
        "wheel_ticks": {"columns": ["left", "right"], "unit": "tick"},
        "motor_speed": {"columns": ["left_rpm", "right_rpm"], "unit": "rpm"},
        "current": {"columns": ["left_a", "right_a"], "unit": "A"},
        "voltage": {"columns": ["left_v", "right_v"], "unit": "V"},
        "pose_x": {"column": "x", "unit": "mm"},
        "pose_y": {"column": "y", "unit": "mm"},
        "pose_heading": {"column": "heading", "unit": "deg"},
    },
}

_NAMES = (
    "t;xsetspeed;ysetspeed;setvel;m1setvel;m2setvel;m3setvel;m1pos;m2pos;m3pos;m1vel;m2vel;m3vel;"
    "m1cur;m2cur;m3cur;xcur;ycur;rotcur;xpos;ypos;ang;dx;dy;dang;"
)
_UNITS = (
    "ms;m/s;m/s;rad/s;rad/s;rad/s;rad/s;ticks;ticks;ticks;rad/s;rad/s;rad/s;"
    "A;A;A;A;A;A;pix;pix;deg;mm;mm;deg;"
)


def robotino_text(rows: int = ROWS, heading: float = 20.0, speed: float = 0.1) -> str:
    """A straight run as the Robotino writes it, without noise; the wheels start at 0.1 s."""
    azimuths = [math.radians(a) for a in (60.0, 180.0, 300.0)]
    vx, vy = (speed * f(math.radians(heading)) for f in (math.cos, math.sin))
    command = [(-math.sin(a) * vx + math.cos(a) * vy) / 0.04 * 16 for a in azimuths]
    lines = [_NAMES.replace("t;", "Time;", 1), _UNITS, _NAMES]
    for k in range(rows):
        t = 31.0 * k
        driven = max(0.0, t / 1e3 - 0.1)
        ticks = [round(w * driven * 2000 / (2 * math.pi)) for w in command]
        on = driven > 0
        cells = [t + 0.01, vx, vy, 0, *command, *ticks]
        cells += [w if on else 0 for w in command]
        cells += [round(39 * (0.2 + 0.005 * abs(w))) / 39 if on else 0 for w in command]
        cells += [0, 0, 0]
        cells += [900 - vx * driven / 1.84e-3, 500 + vy * driven / 1.84e-3, 90.0, 0, 0, 0]
        lines.append(";".join(f"{c:.6g}" for c in cells) + ";")
    return "\n".join(lines) + "\n"


def generic_text(rows: int = ROWS) -> str:
    """A two-wheeled robot that drives straight, 50 rows a second."""
    lines = ["time,left,right,left_rpm,right_rpm,left_a,right_a,left_v,right_v,x,y,heading"]
    for k in range(rows):
        t = 0.02 * k
        ticks = round(5000 / (2 * math.pi) * 4.0 * t)
        rpm = 40.0 * 60 / (2 * math.pi)
        cells = [t, ticks, ticks, rpm, rpm, 0.5, 0.6, 6.0, 6.1, 200.0 * t, 1.0, 0.5]
        lines.append(",".join(f"{c:.9g}" for c in cells))
    return "\n".join(lines) + "\n"


def write_good(root: Path) -> None:
    """Lay out both good runs under a data folder."""
    for name, text in ((ROBOTINO, robotino_text()), (GENERIC, generic_text())):
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Case:
    """One way to break one of the good runs.

    Attributes:
        name: of the case.
        breaker: spoils the file in place.
        expected: fragments of the message, all of them.
        file: which of the two runs.
        layout: keys of the layout that the user declares otherwise, merged into it.
    """

    name: str
    breaker: Callable[[Path], None]
    expected: tuple[str, ...]
    file: str = ROBOTINO
    layout: dict[str, Any] = field(default_factory=dict)

    def mapping(self) -> dict[str, Any]:
        """The layout as a config would declare it."""
        base: dict[str, Any] = (
            {"format": "robotino2022", "columns": {}} if self.file == ROBOTINO else GENERIC_LAYOUT
        )
        columns = {**base["columns"], **self.layout.get("columns", {})}
        return {**base, **self.layout, "columns": columns}


def _lines(change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    def breaker(path: Path) -> None:
        lines = path.read_text(encoding="utf-8").splitlines()
        path.write_text("\n".join(change(lines)) + "\n", encoding="utf-8")

    return breaker


def _cell(
    row: int | range, column: str, value: str | Callable[[str], str]
) -> Callable[[Path], None]:
    """Set a cell (or a range of rows of it), found by the name of its column."""
    rows = row if isinstance(row, range) else range(row, row + 1)

    def change(lines: list[str]) -> list[str]:
        delimiter = ";" if lines[0].count(";") else ","
        at = (lines[2] if delimiter == ";" else lines[0]).split(delimiter).index(column)
        for r in rows:
            cells = lines[r - 1].split(delimiter)
            cells[at] = value if isinstance(value, str) else value(cells[at])
            lines[r - 1] = delimiter.join(cells)
        return lines

    return _lines(change)


def _each(*breakers: Callable[[Path], None]) -> Callable[[Path], None]:
    def breaker(path: Path) -> None:
        for one in breakers:
            one(path)

    return breaker


def _bytes(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda path: _write(path, change(path.read_bytes()))


def _write(path: Path, raw: bytes) -> None:
    path.write_bytes(raw)


def _folder_instead(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _swap(names: list[str], a: str, b: str) -> list[str]:
    return [b if n == a else a if n == b else n for n in names]


def _swap_names(a: str, b: str) -> Callable[[Path], None]:
    return _lines(lambda ls: [*ls[:2], ";".join(_swap(ls[2].split(";"), a, b)), *ls[3:]])


def _keep(path: Path) -> None:
    """The file is fine; what is wrong is the declared layout."""


def _add(amount: float) -> Callable[[str], str]:
    return lambda cell: f"{float(cell) + amount:.6g}"


_END = FIRST + ROWS

CASES: tuple[Case, ...] = (
    # the file as a whole
    Case("empty file", lambda p: _write(p, b""), ("exp07.csv", "empty", "expected a header")),
    Case("blank file", lambda p: _write(p, b" \n\n"), ("exp07.csv", "empty")),
    Case("folder", _folder_instead, ("exp07.csv", "a folder", "expected a CSV or Parquet file")),
    Case("missing file", lambda p: p.unlink(), ("exp07.csv", "No such file")),
    Case(
        "binary file",
        _bytes(lambda raw: raw[:400] + bytes(range(256)) + raw[400:]),
        ("exp07.csv row", "binary", "expected text"),
    ),
    Case(
        "utf-16",
        _bytes(lambda raw: raw.decode().encode("utf-16")),
        ("exp07.csv row 1", "UTF-16", "expected UTF-8"),
    ),
    Case(
        "latin-1",
        _bytes(lambda raw: raw.replace(b"Time;", "Zeit für;".encode("latin-1"), 1)),
        ("exp07.csv row 1", "byte 0xfc", "expected UTF-8"),
    ),
    Case(
        "header only",
        _lines(lambda ls: ls[:3]),
        ("exp07.csv row 3", "no row of numbers", "expected data"),
    ),
    Case(
        "ends in the header",
        _lines(lambda ls: ls[:1]),
        ("exp07.csv row 1", "ends after row 1", "expected column names in row 3"),
    ),
    Case(
        "header missing",
        _lines(lambda ls: ls[3:]),
        ("exp07.csv row 3", "numbers", "expected the column names"),
    ),
    Case(
        "one-row file",
        _lines(lambda ls: ls[:4]),
        ("exp07.csv row 4", "1 row(s)", "expected at least 2"),
    ),
    # delimiters and cells
    Case(
        "wrong delimiter",
        _lines(lambda ls: [line.replace(";", ",") for line in ls]),
        (
            "exp07.csv row 3",
            "no delimiter ';'",
            "','",
            "expected cells separated by ';', or delimiter = ',' in",
        ),
    ),
    Case(
        "wrong delimiter declared",
        _keep,
        ("run.csv row 1", "no delimiter '\\t'", "','"),
        GENERIC,
        {"delimiter": "\t"},
    ),
    Case(
        "decimal commas",
        _lines(lambda ls: [*ls[:3], *(line.replace(".", ",") for line in ls[3:])]),
        ("exp07.csv row 4", "column 't'", "'0,01'", "not a decimal comma"),
    ),
    Case(
        "non-numeric cell",
        _cell(50, "m2vel", "fast"),
        ("exp07.csv row 50", "column 'm2vel'", "'fast'", "expected a number"),
    ),
    Case(
        "row too short",
        _lines(lambda ls: [*ls[:20], ls[20].rsplit(";", 4)[0] + ";", *ls[21:]]),
        ("exp07.csv row 21", "23 cells", "expected 26"),
    ),
    Case(
        "row too long",
        _lines(lambda ls: [*ls[:20], ls[20] + "7;", *ls[21:]]),
        ("exp07.csv row 21", "27 cells", "expected 26"),
    ),
    Case(
        "empty line inside",
        _lines(lambda ls: [*ls[:20], "", *ls[20:]]),
        ("exp07.csv row 21", "an empty line"),
    ),
    Case(
        "half-written last line",
        _bytes(lambda raw: raw[:-60]),
        (f"exp07.csv row {_END - 1}", "cut off", "expected 26"),
    ),
    # columns and units
    Case(
        "missing column",
        _lines(lambda ls: [*ls[:2], ls[2].replace("m2pos", "m2poz"), *ls[3:]]),
        ("exp07.csv row 3", "column 'm2pos'", "no such column", "did you mean m2poz"),
    ),
    Case(
        "duplicate column",
        _lines(lambda ls: [*ls[:2], ls[2].replace("m2pos", "m1pos"), *ls[3:]]),
        ("exp07.csv row 3", "column 'm2pos'", "no such column"),
    ),
    Case(
        "duplicate column used",
        _lines(lambda ls: [*ls[:2], ls[2].replace("dx", "xpos"), *ls[3:]]),
        ("exp07.csv row 3", "column 'xpos'", "2 columns of this name", "expected one"),
    ),
    Case(
        "units row disagrees",
        _lines(lambda ls: [ls[0], ls[1].replace("ms;", "s;", 1), *ls[2:]]),
        ("exp07.csv row 2", "column 't'", "'s'", "expected 'ms'"),
    ),
    Case(
        "unknown unit declared",
        _keep,
        ("layout columns.current", "unknown unit 'ampair'", "known: s, ms"),
        GENERIC,
        {"columns": {"current": {"columns": ["left_a", "right_a"], "unit": "ampair"}}},
    ),
    Case(
        "unit of another dimension declared",
        _keep,
        ("layout columns.motor_speed", "'m/s'", "rad/s"),
        GENERIC,
        {"columns": {"motor_speed": {"columns": ["left_rpm", "right_rpm"], "unit": "m/s"}}},
    ),
    Case(
        "unknown channel declared",
        _keep,
        ("layout columns.curent", "no channel 'curent'", "did you mean current", "gyro"),
        GENERIC,
        {"columns": {"curent": {"columns": ["left_a", "right_a"], "unit": "A"}}},
    ),
    Case(
        "different numbers of wheels declared",
        _keep,
        ("layout", "different numbers of wheels", "'current': 1"),
        GENERIC,
        {"columns": {"current": {"columns": ["left_a"], "unit": "A"}}},
    ),
    # time
    Case(
        "time goes backwards",
        _cell(60, "t", _add(-100.0)),
        ("exp07.csv row 60", "column 't'", "goes backwards", "expected time that increases"),
    ),
    Case(
        "time repeats",
        _lines(lambda ls: [*ls[:60], ls[59], *ls[60:]]),
        ("exp07.csv row 61", "column 't'", "time repeats"),
    ),
    Case(
        "constant time",
        _cell(range(FIRST, _END), "t", "5"),
        ("exp07.csv row 5", "column 't'", "in every row", "expected time that increases"),
    ),
    Case(
        "clock jump",
        _cell(range(100, _END), "t", _add(5000.0)),
        ("exp07.csv row 100", "column 't'", "jumps by 5.03 s", "about 0.031 s"),
    ),
    Case(
        "missing time",
        _cell(70, "t", "nan"),
        ("exp07.csv row 70", "column 't'", "no time", "finite number"),
    ),
    Case(
        "time in another unit than declared",
        _keep,
        ("run.csv row 3", "column 'time'", "72 s apart", "unit of time"),
        GENERIC,
        {"columns": {"time": {"column": "time", "unit": "h"}}, "max_gap": 1e6},
    ),
    # values
    Case(
        "burst of missing values",
        _cell(range(80, 130), "m2pos", "NaN"),
        ("exp07.csv row 80", "column 'm2pos'", "no value for 1.58 s", "values about every 0.031 s"),
    ),
    Case(
        "no value at all",
        _cell(range(4, _END), "m1cur", ""),
        ("exp07.csv", "column 'm1cur'", "no value in any row", "numbers"),
    ),
    Case(
        "infinite value",
        _cell(90, "m3vel", "inf"),
        ("exp07.csv row 90", "column 'm3vel'", "infinite"),
    ),
    Case(
        "negative current in an unsigned log",
        _cell(77, "m2cur", "-0.25641"),
        ("exp07.csv row 77", "column 'm2cur'", "negative current", "current_is_signed"),
    ),
    Case(
        "absurd voltage",
        _keep,
        ("run.csv row 2", "column 'left_v'", "voltage of 6000 V", "at most 1000"),
        GENERIC,
        {"columns": {"voltage": {"columns": ["left_v", "right_v"], "unit": "V", "scale": 1000}}},
    ),
    Case(
        "marker swapped for another",
        _each(_cell(range(120, _END), "xpos", _add(-400.0))),
        ("exp07.csv row 120", "column 'xpos'", "pose jumps", "at most 0.5 m"),
    ),
    Case(
        "marker turned over",
        _cell(range(120, _END), "ang", _add(170.0)),
        ("exp07.csv row 120", "column 'ang'", "heading jumps by 170 deg"),
    ),
    Case(
        "pose that never changes",
        _each(
            _cell(range(FIRST, _END), "xpos", "900"),
            _cell(range(FIRST, _END), "ypos", "500"),
        ),
        ("exp07.csv", "column 'xpos'", "constant while a wheel turns", "was the marker visible"),
    ),
    Case(
        "encoder that never counts",
        _cell(range(FIRST, _END), "m3pos", "0"),
        ("exp07.csv", "column 'm3pos'", "constant", "commanded"),
    ),
    Case(
        "encoder that starts anew",
        _cell(range(150, _END), "m3pos", _add(-2e5)),
        ("exp07.csv row 150", "column 'm3pos'", "the wheel turns", "counter restart"),
    ),
)
EXCHANGED = (
    Case(
        "swapped wheels",
        _swap_names("m1pos", "m3pos"),
        ("exp07.csv", "match those of wheel_speed", "order 3, 2, 1"),
    ),
    Case(
        "reversed wheel",
        _cell(range(FIRST, _END), "m1pos", lambda cell: f"{-float(cell):.6g}"),
        ("exp07.csv", "match those of wheel_speed", "order -1, 2, 3"),
    ),
)
"""Logs whose encoders have exchanged or reversed columns: they are read, and sanity names them."""
