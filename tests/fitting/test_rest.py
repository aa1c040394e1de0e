"""Friction of a window in which wheels rest for a part: it is that of the part that moves."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import slipid as sl
from slipid.data.runs import collect
from slipid.data.windows import windows
from slipid.fitting import likelihood as lk
from slipid.model.motor import sign_of_motion
from slipid.support.errors import DataError
from tests.helpers import resting


@pytest.mark.slow
@pytest.mark.parametrize("signed", [True, False])
def test_currents_of_windows_with_rest_are_those_of_their_friction(signed):
    w = windows(resting.runs(signed), resting.RADIUS)
    true = resting.robot().on(["lab"])
    true = eqx.tree_at(
        lambda r: (r.motor.coulomb_friction, r.motor.viscous_friction, r.motor.back_emf),
        true,
        tuple(jnp.asarray(x) for x in (resting.DRY, resting.VISCOUS, resting.BACK_EMF)),
    )
    b = lk.batch(w, true)
    no_force = jnp.zeros((*w.turn.shape, 2))
    off = np.asarray(lk.predicted_current(true, b, no_force)) - w.current
    mixed = (np.abs(w.direction) > 0.1) & (np.abs(w.direction) < 0.9)
    assert mixed.sum() > 16
    assert np.abs(off[mixed]).max() < 0.015
    of_mean = replace(b, direction=sign_of_motion(b.turn / b.dt[..., None]))
    off = np.asarray(lk.predicted_current(true, of_mean, no_force)) - w.current
    assert np.abs(off[mixed]).max() > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("voltage", [True, False])
def test_dry_friction_is_not_viscous_where_rest_and_motion_mix(voltage):
    known = {} if voltage else {k: resting.TRUTH[k] for k in ("motor.resistance", "motor.back_emf")}
    fit = sl.fit(resting.runs(voltage=voltage), resting.robot(), fixed=known, quiet=True)
    assert fit.converged
    for path, truth in resting.TRUTH.items():
        if path not in known:
            found = fit.parameters[path]
            assert found.value == pytest.approx(truth, rel=0.02), path
            assert abs(found.value - truth) < 2.5 * found.std, path
            assert found.verdict == "identified"


@pytest.mark.slow
def test_windows_at_rest_say_nothing_of_friction():
    robot = resting.robot().on(["lab"])
    w = windows(resting.runs(), resting.RADIUS, per_segment=8)
    still = (np.abs(w.turn) < 1e-3).all(axis=-1)
    assert still.sum() > 8

    def amps(scale):
        dry = scale * robot.motor.coulomb_friction
        rubbed = eqx.tree_at(lambda r: r.motor.coulomb_friction, robot, dry)
        b = lk.batch(w, rubbed)
        return np.asarray(lk.predicted_current(rubbed, b, jnp.zeros((*w.turn.shape, 2))))

    moved = np.abs(amps(2.0) - amps(1.0))
    assert moved[still].max() < 1e-6
    assert moved[~still].max() > 0.01


@pytest.mark.slow
def test_torques_tell_friction_and_nothing_electric():
    fit = sl.fit(resting.torques(), resting.robot(), quiet=True)
    assert fit.converged
    for name in ("resistance", "back_emf", "inductance", "brush_drop", "efficiency"):
        assert fit.parameters[f"motor.{name}"].verdict == "fixed"
    for path in ("motor.coulomb_friction", "motor.viscous_friction"):
        low, high = fit.parameters[path].interval90
        assert low < resting.TRUTH[path] < high, (path, low, high)
    assert "voltage" not in str(fit)


def test_torques_do_not_go_with_currents():
    one, other = resting.torques().logs[0], resting.runs(voltage=False).logs[1]
    with pytest.raises(DataError, match=r"run01.csv and run00.csv: .* torque_constant"):
        collect([one, other])
