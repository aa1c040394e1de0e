"""Robots of every kind of drive give back the numbers that made their logs."""

import numpy as np
import pytest

from slipid.data.windows import windows
from slipid.identify.fit.optimise import optimise
from slipid.identify.fit.problem import Problem
from slipid.identify.result import summarise
from slipid.model.robot import build
from slipid.search_space import Space
from tests.helpers.kept import kept
from tests.helpers.kinds import SHAPES, experiment


def fitted(kind):
    made = experiment(kind)
    start = Space(made.truth, made.choices).template
    truth = made.truth
    labels = truth.surfaces.labels, truth.body.loads, truth.camera.sessions
    robot = build(truth.geometry, *labels)
    lag = float(start.camera.lag)
    w = windows(made.data, float(start.geometry.wheel_radius), lag, longest=2.0)
    problem = Problem(w, robot, list(made.choices))
    optimum = optimise(problem)
    return made, summarise(problem, optimum, made.data, made.choices)


@pytest.mark.slow
@pytest.mark.parametrize("kind", kept(SHAPES, ["skid", "mecanum"]))  # each compiles a fit
def test_a_robot_of_every_drive_is_recovered_within_its_intervals(kind):
    made, fit = fitted(kind)
    assert fit.converged, fit.reason
    off, names = [], []
    for e in fit.space.free:
        found = fit.parameters[e.path]
        if found.std is None:
            continue
        gap = (np.asarray(found.value) - np.asarray(e.get(made.truth))) / np.asarray(found.std)
        off += np.atleast_1d(gap).tolist()
        names += [e.path] * np.size(gap)
    worst = int(np.argmax(np.abs(off)))
    assert np.abs(off).max() < 4.0, (names[worst], off[worst])
    assert np.mean(np.abs(off) < 1.645) > 0.75
    assert fit.parameters["motor.back_emf"].verdict == "identified"
    assert fit.parameters["motor.resistance"].value == pytest.approx(2.0, rel=0.1)
    for floor in ("firm", "soft"):
        assert fit.parameters[f"surface.{floor}.creep"].verdict in ("identified", "weak")
