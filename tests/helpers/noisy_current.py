"""A motor whose currents are measured with noise: made experiments, and what a fit finds of R, C_e.

Voltages follow the current that flows; the ammeter's noise is in the log alone. Of the motion
everything is known, so that an experiment is fitted in seconds.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from slipid.fitting.optimise import optimise
from slipid.fitting.problem import FitState, Problem
from slipid.lab.selftest.replicates import simulate_windows
from slipid.search_space import Choice
from tests.helpers.made_windows import made, robot

MOTOR = {"motor.resistance": 5.95, "motor.back_emf": 0.0425}
STD = {
    "camera.place": 0.0005,
    "camera.heading": 0.003,
    "process.along": 0.004,
    "process.across": 0.004,
    "process.yaw": 0.008,
    "run.along": 0.008,
    "run.across": 0.008,
    "run.yaw": 0.03,
    "current.window": 0.02,
    "current.run": 0.01,
    "voltage.window": 0.05,
}
SIGNAL = 0.1
"""Std of the currents that flow, about [A]."""
MU = 0.15
"""Friction of the floors, for currents of this size."""
FREE = [
    Choice("*", free=False),
    Choice("motor.resistance", start=5.0, free=True),
    Choice("motor.back_emf", free=True),
    Choice("motor.coulomb_friction", free=True),
    Choice("motor.viscous_friction", free=True),
    Choice("surface.*.friction", free=True),
]


@functools.cache
def truth():
    """A robot with the motor above, whose floors make currents of the wanted size."""
    blank = robot(sessions=("one",))
    return eqx.tree_at(
        lambda r: (
            r.motor.resistance,
            r.motor.back_emf,
            r.motor.coulomb_friction,
            r.motor.viscous_friction,
            r.surfaces.friction,
            r.body.mass_ratio,
        ),
        blank,
        (
            *(jnp.asarray(x) for x in (*MOTOR.values(), 0.01, 0.002)),
            jnp.full(2, MU),
            jnp.ones(2),
        ),
    )


@functools.cache
def problem(signed: bool = True, runs: int = 480) -> Problem:
    """What experiments have in common; its windows say what was driven."""
    return Problem(made(truth(), runs=runs, count=4, signed=signed), truth(), FREE)


@dataclass(frozen=True)
class Found:
    """Logs of R and C_e less their truth, and the stds that the fit claims."""

    error: np.ndarray
    std: np.ndarray
    converged: bool


def experiment(seed: int, ammeter: float, signed: bool = True) -> Problem:
    """Windows of a made experiment, with so much noise of a window's mean current [A]."""
    common, rng = problem(signed), np.random.default_rng(seed)
    driven = replace(common.windows, current_var=np.full_like(common.windows.current, ammeter**2))
    return common.of(simulate_windows(truth(), driven, rng, STD))


def fitted(this: Problem) -> Found:
    """The fit of an experiment."""
    log_v = 2 * np.log(this.noise.typical)
    end = optimise(this, start=FitState(this.space.start, log_v, 0, np.inf, np.inf, "joint"))
    at = np.array([this.space.slices[path].start for path in MOTOR])
    error = end.state.z[at] - np.log(list(MOTOR.values()))
    return Found(error, np.sqrt(np.diag(end.covariance))[at], end.converged)
