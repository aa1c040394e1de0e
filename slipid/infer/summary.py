"""Conversion of an optimisation's result to a `Fit`, with a check of its convergence."""

from collections.abc import Iterable

import numpy as np

from slipid.data.runs import Runs
from slipid.fitting.newton import newton_step
from slipid.fitting.optimise import Optimum
from slipid.fitting.problem import Problem
from slipid.fitting.variances import Blocks
from slipid.infer import slip_curves as curves_of
from slipid.infer.result import Channels, Fit, draws
from slipid.infer.robot_held_out import robot_held_out
from slipid.predict.predictive import force_balance_of
from slipid.search_space import Choice

LARGEST_REMAINING = 0.3
"""Largest remaining Gauss-Newton step of a converged fit [posterior std]."""


def summarise(
    problem: Problem, optimum: Optimum, data: Runs, choices: Iterable[Choice], seed: int = 0
) -> Fit:
    """Return the fit at the end of an optimisation.

    Args:
        problem: likelihood of the runs.
        optimum: end of the search.
        data: runs on one floor each, from which the windows of the problem were made.
        choices: user's choices that the problem was built with.
        seed: seed of the draws from which the bands of the curves are computed.
    """
    z, log_v = optimum.state.z, optimum.state.log_variance
    contact = force_balance_of(problem, optimum.state, optimum.covariance, problem.full_weight)
    linear = problem.linear(z, problem.electric(z, log_v))
    remaining, name = _remaining(problem, optimum, linear)
    settled = remaining < LARGEST_REMAINING
    stuck = f"the solver stopped although its next step would change {name} by {remaining:.2g} stds"
    windows, robot = problem.windows, contact.robot
    judged = windows.has_current and windows.has_voltage and not data.current_is_torque
    several = draws(z, contact.covariance, 400, seed)
    unit = {c.name: c.unit for c in problem.noise.components}
    return Fit(
        space=problem.space,
        choices=tuple(choices),
        z=np.asarray(z),
        covariance=contact.covariance,
        laplace=problem.laplace(z, log_v, problem.full_weight, alone=True),
        shared=contact.shared,
        extrapolation=contact.extrapolation,
        variance=contact.variance,
        variance_unit={name: unit[name] for name in contact.variance},
        runs=tuple((log.name, log.sha256) for log in data.logs)
        + (() if problem.multi_floor is None else problem.multi_floor.runs),
        channels=Channels(
            current=bool(windows.has_current),
            voltage=bool(windows.has_voltage),
            signed=bool(windows.current_is_signed),
            gyro=all(log.gyro is not None for log in data.logs),
            windows=int(windows.dt.shape[1]),
        ),
        curves=curves_of.curves(problem.space, z, several, problem.batch),
        validity=curves_of.validity(data, robot, problem.batch),
        converged=bool(optimum.converged) and settled,
        reason=optimum.reason if settled or not optimum.converged else stuck,
        remaining=remaining,
        rounds=int(optimum.state.round),
        history=tuple(float(x) for x in optimum.history),
        lag=float(windows.lag),
        seed=seed,
        current_trend=curves_of.current_trend(robot, problem.batch)
        if windows.has_current
        else (0.0, 0.0),
        held_out=robot_held_out(problem, optimum.state, linear) if judged else None,
        data=data,
        problem=problem,
        optimum=optimum,
    )


def _remaining(
    problem: Problem, optimum: Optimum, linear: tuple[Blocks, Blocks]
) -> tuple[float, str]:
    """Return the largest coordinate of a full Gauss-Newton step [posterior std], and its name.

    The stds are those of the Laplace covariance, as in the stopping rule of the rounds. Stds from
    the solver's own Jacobian would be too small for friction, since the solver holds the contact
    forces fixed.
    """
    found = newton_step(problem, optimum.state, linear, problem.full_weight)
    steps = np.abs(found.step) / np.sqrt(np.diag(optimum.covariance))
    worst = int(np.argmax(steps))
    return float(steps[worst]), problem.space.names[worst]
