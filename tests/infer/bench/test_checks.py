"""Logs that contradict the meaning of their columns are refused before a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.infer.bench.checks import check_records
from slipid.support.errors import DataError
from tests.helpers import made_bench as made


@pytest.fixture(scope="module")
def record():
    return made.logged(made.driven(made.FLYWHEEL), 100, seed=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {"current": 1000 * r.current}, "unit of the current"),
        (lambda r: {"current": r.voltage, "voltage": r.current}, "exchanged"),
        (lambda r: {"current": -r.current}, "current has the wrong sign"),
        (lambda r: {"speed": -r.speed}, "speed has the wrong sign"),
        (lambda r: {"voltage": -r.voltage}, "voltage has the wrong sign"),
        (lambda r: {"current": np.abs(r.current)}, "--unsigned"),
        (lambda r: {"speed": 0.3 * np.sin(r.time)}, "does not turn"),
        (lambda r: {"speed": 30 * r.speed}, "rpm"),
        (lambda r: {"current": np.zeros_like(r.current)}, "in every row"),
        (lambda r: {"voltage": None, "current": -r.current}, "accelerates against its current"),
    ],
)
def test_a_wrong_log_is_refused_with_a_next_step(record, change, message):
    with pytest.raises(DataError, match=message) as error:
        check_records([replace(record, **change(record))], "left")
    assert "made, motor left: " in str(error.value)
    assert "expected" in str(error.value)


def test_time_does_not_run_backwards(record):
    back = {k: getattr(record, k)[::-1] for k in ("voltage", "current", "speed")}
    with pytest.raises(DataError, match="accelerates against its current"):
        check_records([replace(record, **back)], "")


def test_a_short_log_is_refused_with_its_number_of_blocks(record):
    short = record.mapped(lambda x: x[100:200])
    with pytest.raises(DataError, match=r"turns in \d+ short blocks .* at least 30"):
        check_records([short], "")


def test_a_known_unit_of_the_current_is_not_doubted(record):
    check_records([replace(record, current=1000 * record.current)], "", unit_known=True)
    check_records([record], "")


@pytest.mark.parametrize("channel", ["voltage", "current"])
def test_a_log_without_a_channel_is_accepted(record, channel):
    check_records([replace(record, **{channel: None})], "")
