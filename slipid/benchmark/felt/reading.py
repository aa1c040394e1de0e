"""Runs without poses: a folder per floor, a CSV file per run."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.baselines.floors.interface import Felt
from slipid.support.errors import bad_data

COLUMNS = ("time", "curL", "curR", "velL", "velR", "gyro_z", "accel_std")
"""Time [s], currents without a sign [A], rim speeds [m/s], yaw rate [rad/s], and the std of the
vertical acceleration since the row before [m/s^2]."""
NEEDED = COLUMNS[:5]
"""Columns in which nothing may be missing."""
LONGEST_S = 0.5
"""Time between two rows beyond which a file holds two runs [s]."""
FEWEST = 3
"""Rows that a run has at least."""


def read_felt(root: Path, wheel_radius: float) -> list[Felt]:
    """Runs of a skid-steer robot below a folder, one folder per floor, as `borealtc` has them.

    A file is one run, or several where rows are more than `LONGEST_S` apart.

    Args:
        root: the folder.
        wheel_radius: [m].

    Raises:
        DataError: no file, or one that cannot be read; names file, row and column.
    """
    files = sorted(root.glob("*/*.csv"))
    if not files:
        raise bad_data(root, "no file FLOOR/RUN.csv", "a folder per floor and a file per run")
    return [run for path in files for run in _runs(path, wheel_radius)]


def _runs(path: Path, wheel_radius: float) -> list[Felt]:
    """Runs of one file."""
    rows = _rows(path)
    column = dict(zip(COLUMNS, rows.T, strict=True))
    whole = Felt(
        name=f"{path.parent.name}/{path.stem}",
        floor=path.parent.name.lower(),
        time=column["time"],
        speed=np.stack([column["velL"], column["velR"]], axis=1) / wheel_radius,
        current=np.stack([column["curL"], column["curR"]], axis=1),
        gyro=column["gyro_z"],
        vibration=column["accel_std"],
    )
    edges = [0, *(np.flatnonzero(np.diff(whole.time) > LONGEST_S) + 1), len(whole)]
    parts = [whole.part(int(a), int(b)) for a, b in pairwise(edges)]
    return [part for part in parts if len(part) >= FEWEST]


def _rows(path: Path) -> Float[np.ndarray, "row 7"]:
    """Numbers of a file, columns in the order of `COLUMNS`."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise bad_data(path, f"cannot be read ({error})", "a CSV file") from error
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    for name in COLUMNS:
        if name not in names:
            raise bad_data(path, "no such column", f"columns {', '.join(COLUMNS)}", column=name)
    place = [names.index(name) for name in COLUMNS]
    rows = np.array(
        [_numbers(path, number, line, len(names)) for number, line in enumerate(lines[1:], 2)]
    ).reshape(-1, len(names))[:, place]
    if len(rows) < FEWEST:
        raise bad_data(path, f"{len(rows)} rows", f"{FEWEST} at least")
    for k, name in enumerate(NEEDED):
        missing = np.flatnonzero(~np.isfinite(rows[:, k]))
        if len(missing):
            raise bad_data(path, "no number", "one", row=int(missing[0]) + 2, column=name)
    back = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if len(back):
        row = int(back[0]) + 3
        raise bad_data(path, "does not increase", "growing times", row=row, column="time")
    return np.asarray(rows)


def _numbers(path: Path, number: int, line: str, count: int) -> list[float]:
    """Numbers of a line, NaN where there is nothing."""
    cells = line.split(",")
    if len(cells) != count:
        raise bad_data(path, f"{len(cells)} cells", f"{count}", row=number)
    try:
        return [float(cell) if cell.strip() else float("nan") for cell in cells]
    except ValueError as error:
        raise bad_data(path, str(error), "numbers", row=number) from error
