"""A fit recovers the numbers of robots with every kind of drive."""

import numpy as np
import pytest

from tests.helpers.kept import kept
from tests.helpers.kinds import SHAPES, experiment, fitted


@pytest.mark.slow
@pytest.mark.parametrize("kind", kept(SHAPES, ["skid"]))  # each compiles a fit
def test_a_robot_of_every_drive_is_recovered_within_its_intervals(kind):
    made = experiment(kind)
    fit = fitted(made.truth, made.data, made.choices)
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
