"""The data sets: availability, channels for methods, and runs that slipid fits."""

from pathlib import Path

import numpy as np
import pytest

from slipid.app.logs import packaged_path
from slipid.lab.benchmark.protocols import KINDS, PROTOCOLS
from slipid.lab.benchmark.sets import SOURCES, is_available, read_set
from slipid.support.progress import Reporter

QUIET = Reporter(quiet=True)


def source(name):
    return next(one for one in SOURCES if one.name == name)


def test_every_source_has_a_config_and_kinds_that_there_are():
    assert len({one.name for one in SOURCES}) == len(SOURCES)
    for one in SOURCES:
        assert packaged_path(one.config).is_file()
        assert set(one.kinds) <= {*KINDS, "all"}
        assert set(one.kinds) <= {p.split for p in PROTOCOLS.values()}
        assert ("all" in one.kinds) == (one.crossing is not None)


def test_a_source_without_a_folder_is_not_available(tmp_path):
    assert [one.name for one in SOURCES if is_available(one, tmp_path)] == ["testsite"]
    (tmp_path / "drive_skid").mkdir()
    assert is_available(source("husky"), tmp_path)


@pytest.fixture(scope="module")
def testsite(tmp_path_factory):
    return read_set(source("testsite"), Path("nowhere"), tmp_path_factory.mktemp("out"), QUIET)


def test_recorded_runs_need_no_data_folder(testsite):
    assert len(testsite.logged) == len(testsite.job.dataset) == 120
    assert {fact.floor for fact in testsite.facts} == {"firm", "soft", "soft@moved"}
    assert testsite.spec.determines_twist
    assert {fact.floor for fact in testsite.facts} == {"firm", "soft", "soft@moved"}


def test_thinned_runs_have_every_floor_and_speed(testsite):
    few = testsite.thinned(30)
    assert len(few.logged) == len(few.job.dataset) == len(few.facts) == 30
    assert {fact.floor for fact in few.facts} == {fact.floor for fact in testsite.facts}
    assert {round(fact.speed, 2) for fact in few.facts} == {0.1, 0.2}
    assert testsite.thinned(500) is testsite


@pytest.mark.slow
def test_methods_use_currents_that_the_fit_leaves_out(real_data, tmp_path):
    for name, signed in (("warthog", True), ("husky", False)):
        data = read_set(source(name), real_data, tmp_path, QUIET)
        assert data.logged.current is not None
        assert data.logged.current_is_signed is signed
        assert data.job.dataset.current is None
        assert [log.name for log in data.logged.logs] == [log.name for log in data.job.dataset.logs]
        assert not data.spec.determines_twist


@pytest.mark.slow
def test_a_skid_steers_direction_is_that_of_going_and_turning(real_data, tmp_path):
    data = read_set(source("warthog"), real_data, tmp_path, QUIET)
    base = float(data.job.robot.geometry.base_radius)
    for log, fact in zip(data.logged.logs, data.facts, strict=True):
        ahead, _, turn = np.median(log.twist_command, axis=0)
        assert fact.speed == pytest.approx(np.hypot(ahead, base * turn))
        assert np.tan(np.radians(fact.heading_deg)) == pytest.approx(base * turn / ahead, rel=1e-6)
