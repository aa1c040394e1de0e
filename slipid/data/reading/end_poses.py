"""Poses at the ends of runs, measured by hand and listed in a table with a row for each run.

Columns of the table, of which only `run` is required:

    run                                       name of the run: path relative to the data folder
    x_m, y_m, heading_deg                     pose at the end; the heading counts full turns
    start_x_m, start_y_m, start_heading_deg   pose at the start; 0 if the table lacks the column

Empty cells are coordinates that were not measured. Source: end poses of squares driven in both
directions, Borenstein and Feng 1996, IEEE Transactions on Robotics and Automation 12(6).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import isfinite, nan
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.data.reading.table import named_rows
from slipid.support.errors import bad_data, did_you_mean

_END = ("x_m", "y_m", "heading_deg")
_LARGEST = 1e8
"""Largest size of a coordinate [m] or heading [deg]."""
_START = tuple(f"start_{name}" for name in _END)


@dataclass(frozen=True)
class EndPoses:
    """Poses at the ends of one run: x [m], y [m] and heading [rad], nan where not measured.

    Attributes:
        path: the table.
        row: row of the run in the table, counted from 1.
        start: pose in the first row of the log.
        end: pose in the last row of the log.
    """

    path: Path
    row: int
    start: tuple[float, float, float]
    end: tuple[float, float, float]

    def of(self, log: Log) -> Log:
        """Return a log with these poses in its first and last row, and nan in all others.

        Raises:
            DataError: the log has poses already.
        """
        if log.pose is not None:
            found = f"{log.name} has poses in its log, too"
            raise bad_data(self.path, found, "runs without poses", row=self.row)
        pose = np.full((log.samples, 3), nan)
        pose[0], pose[-1] = self.start, self.end
        fresh = np.zeros(log.samples, bool)
        fresh[[0, -1]] = True
        return replace(log, pose=pose, pose_fresh=fresh)

    def check_turn(self, turned: float) -> None:
        """Raise `DataError` if the heading seems to lack full turns.

        `turned` is the change of heading by the wheels [rad].
        """
        found = self.end[2] - self.start[2]
        if abs(found - turned) > np.pi + 0.2 * abs(turned):
            raise bad_data(
                self.path,
                f"the heading changes by {np.degrees(found):.0f} deg, by the wheels it is "
                f"{np.degrees(turned):.0f} deg",
                "a heading that counts full turns: 360 deg after one turn to the left",
                row=self.row,
                column="heading_deg",
            )


def read_end_poses(path: Path) -> dict[str, EndPoses]:
    """Return the poses of a table, keyed by the name of the run.

    Raises:
        DataError: there is no such table, or a row of it is wrong.
    """
    names, rows = named_rows(path, f"a CSV table with the columns run, {', '.join(_END)}")
    known = ("run", *_END, *_START)
    for name in names:
        if name not in known:
            found = f"no such column{did_you_mean(name, known)}"
            raise bad_data(path, found, f"only {', '.join(known)}", row=1, column=name)
    if "run" not in names or not {*_END} & {*names}:
        raise bad_data(path, "columns are missing", f"run and some of {', '.join(_END)}", row=1)
    out: dict[str, EndPoses] = {}
    for row, cells in rows:
        name = cells.get("run", "").strip()
        if not name or name in out:
            found = f"'{name}' again" if name else "no name of a run"
            raise bad_data(path, found, "every run once", row=row, column="run")
        start = [_number(path, row, cells, c) if c in names else 0.0 for c in _START]
        end = [_number(path, row, cells, column) for column in _END]
        if not any(isfinite(a + b) for a, b in zip(start, end, strict=True)):
            expected = "a number in x_m, y_m or heading_deg, known at the start, too"
            raise bad_data(path, "no coordinate is known at both ends", expected, row=row)
        first, last = ((x, y, float(np.radians(turn))) for x, y, turn in (start, end))
        out[name] = EndPoses(path, row, first, last)
    return out


def _number(path: Path, row: int, cells: dict[str, str], column: str) -> float:
    """Return the number in a cell; nan if the cell is absent or empty."""
    text = cells.get(column, "").strip()
    try:
        value = float(text) if text else nan
    except ValueError:
        value = float("inf")
    if text and not abs(value) <= _LARGEST:
        expected = f"a number of at most {_LARGEST:g}, or nothing"
        raise bad_data(path, repr(text), expected, row=row, column=column)
    return value


def refuse_unused(table: dict[str, EndPoses], runs: Iterable[str]) -> None:
    """Raise `DataError` if a table has a row for a run that is not among `runs`."""
    names = list(runs)
    for name, one in table.items():
        if name not in names:
            found = f"no run '{name}'{did_you_mean(name, names)}"
            expected = "the path of a log relative to the data folder"
            raise bad_data(one.path, found, expected, row=one.row, column="run")
