"""Damaged runs that `slipid check` names: dead encoders, whole and half runs, exchanged columns.

    .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_damaged_runs.py

Every fourth run is damaged at once, in four rounds, one kind of damage after the other. The damaged
runs are counted that a finding of the severity "wrong" names. Not every damage can be found: the
wheels of some runs hardly turn, and exchanged columns change little where wheels turn equally.
Undamaged runs must have no such finding; they were in view when the thresholds were set. Prints a
table; needs the public data sets for all robots but that of the demo.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.quick import QUICK

EVERY = 4
ROBOTS = ("robotino", *(() if QUICK else ("robotino2022", "warthog", "husky")))


@pytest.mark.parametrize("name", ROBOTS)
def test_damaged_runs_are_named(name, request, tmp_path):
    from slipid.app.config import parsed
    from slipid.app.logs import packaged_config, packaged_path, unpack
    from slipid.app.problem import read_fit_task
    from slipid.data.check.findings import wrong
    from slipid.data.check.sanity import findings
    from slipid.data.runs import collect
    from slipid.support.progress import Reporter

    if name == "robotino":
        unpack(tmp_path)
        folder = tmp_path / "fit" / "logs"
    else:
        data = request.getfixturevalue("real_data")
        folder = data / ("robotino2022" if name == "robotino2022" else "drive_skid")
    config = parsed(packaged_path(f"{name}.toml"), packaged_config(f"{name}.toml"))
    task = read_fit_task(config, Path(folder), Reporter(quiet=True))
    runs, robot = task.dataset, task.robot.geometry

    def named(logs):
        found = wrong(findings(collect(logs, runs.session), robot))
        return {run for finding in found for run in finding.runs or [log.name for log in logs]}

    assert named(runs.logs) == set()
    print(f"\n{name}, {len(runs)} runs, damaged ones named (and sound ones named in vain):")
    for damage, change in damages(runs.wheel_angle.shape[1]):
        count = vain = 0
        for first in range(EVERY):
            logs = list(runs.logs)
            for k in range(first, len(logs), EVERY):
                logs[k] = replace(logs[k], wheel_angle=change(logs[k].wheel_angle))
            damaged = {log.name for log in logs[first::EVERY]}
            found = named(logs)
            count += len(found & damaged)
            vain += len(found - damaged)
        print(f"  {damage}: {count} ({vain})")


def damages(wheels: int) -> Iterator[tuple[str, Callable[[np.ndarray], np.ndarray]]]:
    """Names of damages, and functions of the angles (row, wheel) that make them."""
    for wheel in range(wheels):
        yield (
            f"wheel {wheel + 1} never counts",
            lambda angle, w=wheel: held(angle, w, 0, len(angle)),
        )
    for wheel in range(wheels):
        yield (
            f"wheel {wheel + 1} stops counting halfway",
            lambda angle, w=wheel: held(angle, w, len(angle) // 2, len(angle)),
        )
    for wheel in range(wheels):
        yield (
            f"wheel {wheel + 1} begins to count halfway",
            lambda angle, w=wheel: held(angle, w, 0, len(angle) // 2),
        )
    for a, b in combinations(range(wheels), 2):
        order = [{a: b, b: a}.get(wheel, wheel) for wheel in range(wheels)]
        yield f"wheels {a + 1} and {b + 1} exchanged", lambda angle, o=order: angle[:, o]


def held(angle, wheel, first, last):
    """The angles with that of a wheel constant in some rows."""
    out = angle.copy()
    part = angle[first:last, wheel]
    out[first:last, wheel] = part[0]
    out[last:, wheel] -= part[-1] - part[0]
    return out
