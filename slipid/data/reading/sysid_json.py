"""Reading of the JSON files of SysId and of frc-characterization, its predecessor.

Each test (slow-forward, ...) has rows of numbers: time [s], voltage [V], position [rev] and
velocity [rev/s] of the mechanism, twice for the sides of a drivetrain. They are turns whatever
`units` the file names, since `unitsPerRotation` is applied only when SysId reads them.
"""

import hashlib
import json
from pathlib import Path

import numpy as np

from slipid.data.reading.table import Table, raw_bytes, text_lines
from slipid.data.reading.table_format import TableFormat
from slipid.support.errors import bad_data

_TESTS = ("slow-forward", "slow-backward", "fast-forward", "fast-backward")
_ONE = {"timestamp": 0, "voltage": 1, "position": 2, "velocity": 3}
_SIDES = {"timestamp": 0, "left voltage": 1, "right voltage": 2, "left velocity": 5}
_SIDES |= {"right velocity": 6}
_OLD_ONE = {"timestamp": 0, "voltage": 3, "position": 5, "velocity": 7}
_OLD_SIDES = {"timestamp": 0, "left voltage": 3, "right voltage": 4, "left velocity": 7}
_OLD_SIDES |= {"right velocity": 8}
_UNITS = {"timestamp": "s", "voltage": "V", "position": "rev", "velocity": "rev/s"}


def read_sysid_json(path: Path) -> tuple[TableFormat, Table]:
    """Return the format of a file of SysId, and its rows with their tests.

    Raises:
        DataError: the file is not one of SysId, or a row is not made of numbers.
    """
    raw = raw_bytes(path)
    try:
        content = json.loads("\n".join(text_lines(path, raw)))
    except (ValueError, RecursionError) as error:
        raise bad_data(path, f"not JSON ({error})", "a file of SysId") from error
    found = content if isinstance(content, dict) else {}
    tests = {name: found[name] for name in _TESTS if found.get(name)}
    if not tests:
        raise bad_data(path, "no rows of a test", f"a file of SysId with {', '.join(_TESTS)}")
    rows = {name: _rows(path, name, test) for name, test in tests.items()}
    width = {part.shape[1] for part in rows.values()}
    sides = str(found.get("test", "")).startswith("Drivetrain")
    columns = {4: _ONE, 9: _SIDES, 10: _OLD_SIDES if sides else _OLD_ONE}.get(min(width), {})
    if len(width) > 1 or not columns:
        have = f"rows of {' and '.join(map(str, sorted(width)))} numbers"
        raise bad_data(path, have, "4 numbers in every row, 9 for a drivetrain, or 10 in old files")
    values = np.concatenate([*rows.values()])[:, [*columns.values()]]
    lines = np.arange(1, len(values) + 1)
    names = np.repeat([*rows], [len(part) for part in rows.values()])
    table = Table(path, hashlib.sha256(raw).hexdigest(), tuple(columns), values, lines, names)
    units = tuple(_UNITS[name.rpartition(" ")[2]] for name in columns)
    return TableFormat(path, "", 1, 0, 2, tuple(columns), units), table


def _rows(path: Path, name: str, test: object) -> np.ndarray:
    """Return the rows of a test; raise `DataError` if they are not rows of numbers."""
    rows = test if isinstance(test, list) else [test]
    for k, row in enumerate(rows, start=1):
        plain = isinstance(row, list) and all(type(x) in (int, float) for x in row)
        if not plain or not isinstance(rows[0], list) or len(row) != len(rows[0]):
            expected = "a list of numbers, as many as in the other rows"
            raise bad_data(path, f"{str(row)[:40]} in '{name}'", expected, row=k)
    try:
        return np.array(rows, dtype=float)
    except OverflowError as error:
        raise bad_data(path, f"a number that is too large in '{name}'", "volts, turns") from error
