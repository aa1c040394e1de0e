"""Every broken log is refused with one message: where it is broken, and what was expected."""

from __future__ import annotations

import pytest

from slipid.data.check.columns import refuse_misordered
from slipid.data.check.sanity import findings
from slipid.data.reading.presets import declared_layout
from slipid.data.runs import collect
from slipid.model.geometry import omni
from slipid.support.errors import DataError
from tests.helpers.broken_logs import (
    CASES,
    EXCHANGED,
    GENERIC,
    GENERIC_LAYOUT,
    ROBOTINO,
    Case,
    write_good,
)
from tests.helpers.one_log import read_log


@pytest.fixture
def root(tmp_path):
    write_good(tmp_path)
    return tmp_path


def test_the_table_is_long_and_its_names_differ():
    assert len(CASES) >= 25
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("name", [ROBOTINO, GENERIC])
def test_the_good_logs_are_good(root, name):
    mapping = {"format": "robotino2022"} if name == ROBOTINO else GENERIC_LAYOUT
    log = read_log(root / name, declared_layout(mapping, "layout"), root=root)
    assert (log.name, log.samples, log.notes) == (name, 200, ())


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_broken_log_is_refused_where_it_is_broken(root, case: Case):
    path = root / case.file
    case.breaker(path)
    with pytest.raises(DataError) as caught:
        read_log(path, declared_layout(case.mapping(), "layout"), root=root)
    message = str(caught.value)
    assert [fragment for fragment in case.expected if fragment not in message] == [], message
    assert "\n" not in message
    assert len(message) < 600


@pytest.mark.parametrize("case", EXCHANGED, ids=lambda case: case.name)
def test_exchanged_and_reversed_wheels_are_read_and_then_named(root, case: Case):
    path = root / case.file
    good = read_log(path, declared_layout(case.mapping(), "layout"), root=root)
    refuse_misordered([good])
    case.breaker(path)
    log = read_log(path, declared_layout(case.mapping(), "layout"), root=root)
    with pytest.raises(DataError) as caught:
        refuse_misordered([good, log])
    for part in case.expected:
        assert part in str(caught.value)
    robot = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
    wrong = [f for f in findings(collect([log]), robot) if f.severity == "wrong"]
    kinds = {"wheel_columns", "wheel_order", "wheel_sign", "command_order", "command_sign"}
    assert {f.kind for f in wrong} & kinds, [str(f) for f in wrong]
