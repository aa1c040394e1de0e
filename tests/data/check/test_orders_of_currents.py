"""The check tells columns of currents and voltages in another order from turned signs."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slipid.data.check.sanity import findings
from slipid.data.runs import collect
from tests.helpers.plain_robot import MECANUM, OMNI, as_runs, drive

KINDS = ("current", "voltage")


def found(robot, *order):
    """Return findings about currents and voltages whose columns are in some order."""
    columns = list(order)
    raws = [
        replace(raw, current=raw.current[:, columns], voltage=raw.voltage[:, columns])
        for raw in drive(robot, runs=8)
    ]
    every = findings(as_runs(raws), robot.geometry, 12.0)
    return [f for f in every if f.kind.startswith(KINDS)]


@pytest.mark.parametrize(
    ("robot", "order", "remedy"),
    [
        (OMNI, (1, 0, 2), "2, 1, 3"),
        (OMNI, (1, 2, 0), "3, 1, 2"),
        (MECANUM, (1, 0, 3, 2), "2, 1, 4, 3"),
    ],
)
def test_another_order_is_named(robot, order, remedy):
    two = found(robot, *order)
    assert [f.kind for f in two] == ["current_order", "voltage_order"]
    assert all((f.remedy or "").endswith(f"in the order {remedy}") for f in two)


def test_the_right_order_is_none():
    assert found(OMNI, 0, 1, 2) == []
    assert found(MECANUM, 0, 1, 2, 3) == []


def test_torques_may_have_sizes_that_currents_have_not():
    runs = as_runs([replace(raw, current=1e-4 * raw.current) for raw in drive(OMNI, runs=8)])
    torques = [replace(log, current_is_torque=True, voltage=None) for log in runs.logs]
    said = [[f.kind for f in findings(r, OMNI.geometry, 12.0)] for r in (runs, collect(torques))]
    assert "current_unit" in said[0]
    assert "current_unit" not in said[1]
