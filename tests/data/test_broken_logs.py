"""Every broken log is refused with one message: where it is broken, and what was expected."""

from __future__ import annotations

import pytest

from slipid.data.reading.presets import declared_layout
from slipid.support.errors import DataError
from tests.helpers.broken_logs import CASES, GENERIC, GENERIC_LAYOUT, ROBOTINO, Case, write_good
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
