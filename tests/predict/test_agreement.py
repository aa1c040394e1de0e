"""Runs over several floors are refused where they worsen a floor's own runs beyond chance."""

from __future__ import annotations

import numpy as np
import pytest

from slipid.predict.agreement import (
    FloorErrors,
    compared,
    contradiction,
    largest_shift,
)
from slipid.search_space import Choice, Space
from tests.helpers.made_windows import robot

RUNS = 12
FLOORS = ["gray"] * RUNS + ["green"] * RUNS


FINE = {"gray": FloorErrors(0.01, 0.01, False), "green": FloorErrors(0.01, 0.01, False)}
STILL = ("surface.gray.creep", 0.5)


def errors(seed=0):
    return 0.02 + 0.01 * np.random.default_rng(seed).uniform(size=2 * RUNS)


@pytest.mark.parametrize(
    ("factor", "noise", "worse"),
    [
        (1.0, 0.0, False),
        (1.3, 0.0, False),  # a small price is paid
        (5.6, 0.0, True),
        (0.2, 0.0, False),
        (1.7, 0.1, False),  # by chance: some runs much better, some much worse
    ],
)
def test_a_floor_is_worse_where_its_errors_grow_much_and_surely(factor, noise, worse):
    old, rng = errors(), np.random.default_rng(1)
    new = old.copy()
    new[RUNS:] = factor * old[RUNS:] + noise * rng.normal(size=RUNS)
    found = compared(FLOORS, old, new, np.full(2 * RUNS, 0.5))
    assert list(found) == ["gray", "green"]
    assert found["green"].is_worse == worse
    assert not found["gray"].is_worse
    assert found["gray"].before == found["gray"].after == pytest.approx(old[:RUNS].mean() / 0.5)


def test_a_single_run_shows_nothing():
    [found] = compared(["gray"], np.array([0.01]), np.array([0.5]), np.ones(1)).values()
    assert not found.is_worse


def test_floors_that_are_worse_are_named_and_no_others():
    reason = contradiction(
        {"gray": FloorErrors(0.0126, 0.0702, True), "green": FloorErrors(0.1, 0.1, False)},
        STILL,
        0.02,
        {"gray": 0.03, "green": 0.03},
        0.5,
    )
    assert "gray grow from 1.3 to 7.0 % of the displacement" in reason
    assert "green" not in reason
    assert "map may be wrong" in reason


@pytest.mark.parametrize(("green", "refused"), [(0.017, False), (0.015, True)])
def test_a_map_that_predicts_worse_than_a_single_floor_is_said_to_be_wrong(green, refused):
    reason = contradiction(FINE, STILL, 0.02, {"gray": 0.05, "green": green}, 0.5)
    assert (reason is not None) == refused
    if refused:
        assert "20.0 mm/s with their map, but 15.0 mm/s as if all wheels were on green" in reason
        assert "map may be wrong" in reason


@pytest.mark.parametrize(
    ("sigma", "held_out", "by_map", "reason"),
    [
        (3.9, 1.1, 0.02, None),
        (3.9, None, 0.02, None),
        (25.0, 0.9, 0.02, "changes by 25 standard errors"),
        (25.0, None, 0.02, "changes by 25 standard errors"),
        (25.0, 0.3, 0.045, "changes by 25 standard errors"),  # a mirrored map
        (25.0, 0.7, 0.02, None),  # held-out runs and the map confirm it
        (np.inf, 0.7, 0.02, "did not converge"),
    ],
)
def test_numbers_that_move_far_are_a_contradiction_unless_held_out_runs_and_the_map_confirm_it(
    sigma, held_out, by_map, reason
):
    found = contradiction(FINE, ("robot.load_share", sigma), by_map, {"gray": 0.05}, held_out)
    assert found is None if reason is None else reason in found


def test_the_largest_shift_is_among_numbers_of_the_motion_without_the_camera():
    blank = robot()
    free = ("surface.*.creep", "surface.*.friction", "camera.scale")
    space = Space(blank, [Choice("*", free=False), *(Choice(path, free=True) for path in free)])
    covariance = np.diag(np.full(space.size, 0.01))
    before, after = np.zeros(space.size), np.full(space.size, 5.0)
    after[space.where(lambda e: e.quantity == "surface.creep")] = 1.0
    after[space.slices["surface.soft.creep"]] = 1.5
    name, sigma = largest_shift(space, before, covariance, after, settled=True)
    assert name == "surface.soft.creep"
    assert sigma == pytest.approx(15.0)
    assert largest_shift(space, before, covariance, after, settled=False)[1] == np.inf
