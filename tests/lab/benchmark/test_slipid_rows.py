"""Inputs and predictions of slipid's own rows, without a fit."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from slipid.api.runs import simulate_runs
from slipid.fitting.variances import DEGREES
from slipid.lab.benchmark import slipid_rows
from slipid.lab.benchmark.slipid_rows import (
    FloorKnowledge,
    SlipidFit,
    estimator_runs,
    forecast,
    replay,
)
from slipid.lab.benchmark.steps import run_batches
from slipid.predict.slip_model import PredictedRun, RobotSpec
from slipid.robot.estimator import Estimator
from slipid.robot.interface import MIXED_FLOORS_PENALTY, Settings
from tests.helpers.small_twin import deployed


@pytest.fixture(scope="module")
def made():
    return simulate_runs(("firm", "soft"), headings=3, turns=0, seed=3)


def fit_of(made, current=True) -> SlipidFit:
    """Return the robot of the simulated runs in the form of a fit."""

    def ends(w):
        return SimpleNamespace(predicted=w.pose), np.tile(np.diag([4.0, 1.0]), (len(w), 1, 1))

    fit = object.__new__(SlipidFit)
    dataset = SimpleNamespace(current=np.ones(1) if current else None)
    stub = {
        "contact": SimpleNamespace(ends=ends, robot=made.robot),
        "job": SimpleNamespace(dataset=dataset),
        "floors": (0, 1),
        "deployed": deployed(),
    }
    for name, value in stub.items():
        object.__setattr__(fit, name, value)
    return fit


def test_on_a_known_floor_the_region_is_that_of_a_student_t(made):
    one = run_batches(made.runs, made.robot)[0]
    spec = RobotSpec.of(made.robot)
    said = forecast(fit_of(made, current=False), one, spec)
    assert len(said) == len(one.runs)
    for run in said:
        assert run.end_covariance is not None
        # a turn to the run's own start leaves both variances, whatever their axes
        found = np.sort(np.linalg.eigvalsh(run.end_covariance))
        assert found == pytest.approx(np.array([1.0, 4.0]))
        assert run.freedom == DEGREES
        assert run.power is None


@pytest.fixture
def driven(made, monkeypatch):
    """Estimators that were replayed, with the signals of each."""
    calls = []

    def caught(estimator, heard, start):
        calls.append((estimator, heard))
        return [PredictedRun(np.zeros((len(one) + 1, 3))) for one in heard]

    monkeypatch.setattr(slipid_rows, "replay", caught)
    return calls


def labels(floors, made, driven, current=True):
    """Return the floors of each estimator that is replayed on the runs."""
    batches = run_batches(made.runs, made.robot)
    said = estimator_runs(fit_of(made, current), batches, made.runs, floors)
    assert len(said) == len(made.runs)
    return [estimator.robot.labels for estimator, _ in driven]


def test_an_estimator_has_the_floors_that_it_may_meet(made, driven):
    assert labels(FloorKnowledge(), made, driven) == [("firm", "soft")]
    driven.clear()
    assert sorted(labels(FloorKnowledge(floor_known=True), made, driven)) == [("firm",), ("soft",)]
    for estimator, heard in driven:
        assert {one.name for one in heard} == {
            log.name for log in made.runs.logs if log.surface == estimator.robot.labels[0]
        }
    driven.clear()
    (found,) = labels(FloorKnowledge(unseen_floors=True), made, driven)
    assert found[:2] == ("firm", "soft")
    assert "unseen_1" in found


def test_only_a_robot_that_may_stand_on_several_floors_looks_for_them(made, driven):
    labels(FloorKnowledge(), made, driven)
    assert driven[0][0].settings.further_floor_penalty != MIXED_FLOORS_PENALTY
    batches = [
        replace(one, runs=tuple(replace(run, floor="unknown") for run in one.runs))
        for one in run_batches(made.runs, made.robot)
    ]
    estimator_runs(fit_of(made), batches, made.runs, FloorKnowledge())
    assert driven[1][0].settings.further_floor_penalty == MIXED_FLOORS_PENALTY


def test_an_estimator_uses_currents_only_if_it_was_fitted_to_some(made, driven):
    labels(FloorKnowledge(), made, driven, current=True)
    labels(FloorKnowledge(), made, driven, current=False)
    (_, with_currents), (_, without) = driven
    assert all(one.current is not None for one in with_currents)
    assert all(one.current is None for one in without)


@pytest.mark.slow
def test_what_is_not_on_a_floor_of_the_robot_is_unknown(made, monkeypatch):
    monkeypatch.setattr(slipid_rows, "RUNS_PER_CALL", 1)
    robot = deployed().with_unseen()
    heard = run_batches(made.runs, made.robot)[0].runs[0].signals
    (said,) = replay(Estimator(robot, Settings.of(robot)), [heard], np.zeros((1, 3)))
    assert said.floors is not None
    assert list(said.floors) == ["firm", "soft", "unknown"]
    assert sum(said.floors.values()) == pytest.approx(np.ones(len(heard)))
    assert (said.floors["unknown"] > 1e-4).all()
    assert (np.asarray(said.floors["firm"]) > 0).all()
