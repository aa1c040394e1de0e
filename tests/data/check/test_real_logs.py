"""The check raises no alarm on any real set: carpets, skid steers, cameras with a wrong scale."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from slipid.data.check.sanity import findings
from tests.helpers.real_sets import REAL_SETS, skid_runs, two_sides


@cache
def runs_of(real, folder):
    return real.read(folder)


@pytest.mark.slow
@pytest.mark.parametrize("real", REAL_SETS, ids=lambda s: s.name)
def test_no_false_alarm(real, real_data):
    found = findings(runs_of(real, real_data), real.robot(), real.mass_kg)
    assert [f for f in found if f.severity != "note"] == []


@pytest.mark.slow
@pytest.mark.parametrize("real", REAL_SETS, ids=lambda s: s.name)
def test_a_part_of_the_runs_raises_none_either(real, real_data):
    """Every third run raises no alarm either, since thresholds are not tuned to whole sets."""
    runs = runs_of(real, real_data)
    for first in range(3):
        part = runs.subset(np.arange(first, len(runs), 3))
        found = findings(part, real.robot(), real.mass_kg)
        assert [f for f in found if f.severity != "note"] == []


@pytest.mark.slow
def test_wheels_in_the_air_are_found(real_data):
    runs = skid_runs("husky_in_the_air", False, real_data)
    found = findings(runs, two_sides(0.165, 0.55), 50.0)
    assert [f.kind for f in found if f.severity == "wrong"] == ["pose_unexplained"]


@pytest.mark.slow
def test_currents_of_the_supply_are_distinguished_from_those_of_torque(real_data):
    runs = skid_runs("warthog_grass_2024_7_29", True, real_data)
    found = findings(runs, two_sides(0.30, 1.08))
    (note,) = (f for f in found if f.kind == "current_of_supply")
    # some are below zero, so they cannot be read as magnitudes
    assert "remove the current from the layout" in (note.remedy or "")
