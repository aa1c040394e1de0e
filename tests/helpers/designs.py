"""Runs chosen from nothing against as many of the 2021 grid, on a robot whose truth is known.

The test fits windows made straight from the model, the benchmark fits whole logs with every trap.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from slipid.data.runs import collect
from slipid.data.windows import windows
from slipid.fitting import likelihood as lk
from slipid.fitting import noise as of_noise
from slipid.fitting.optimise import optimise
from slipid.fitting.problem import FitState, Problem
from slipid.infer.design import fisher as info
from slipid.infer.design.planned_runs import (
    HEADINGS,
    PlannedRun,
    candidates,
    paper_grid,
    steady_windows,
)
from slipid.infer.design.planner import Planner, parameter_goal, prediction_goal, weighed
from slipid.infer.result import Channels
from slipid.lab.selftest.logs import SimulatedSensors, nominal_robot, simulate_logs, true_robot
from slipid.predict import open_loop as replay
from slipid.search_space import Choice
from tests.helpers.made_windows import simulate_windows

SETUP = ("soft", "as_built")
LOAD = "robot.load_share@as_built"
DISTANCE = 0.7
SENSORS = SimulatedSensors(has_voltage=False)
ANY = PlannedRun(*SETUP, 0.0, 0.2)
TRUTH = true_robot([ANY])
CHOICES = [
    Choice("camera.scale", prior_mean=1.117, prior_std=0.002),
    Choice("camera.lag", prior_mean=0.056, prior_std=0.01),
    Choice("camera.marker_yaw", free=True),
    Choice("robot.mass", fixed=12.0),
    Choice("motor.resistance", fixed=5.5),
    Choice("motor.back_emf", fixed=0.0514),
]
PREDICTED = [
    PlannedRun(*SETUP, float(np.radians(a)), v, 0.0, DISTANCE) for v in (0.1, 0.2) for a in HEADINGS
]


def std_of(name, rows=40):
    """True std of a variance component; of the mean of a window of so many rows."""
    return SENSORS.ripple / np.sqrt(rows) if name.endswith("window") else SENSORS.of(name)


@functools.cache
def planner():
    names = of_noise.noise(steady_windows([ANY], TRUTH, Channels()), TRUTH).names
    return Planner(TRUTH, CHOICES, {n: std_of(n) ** 2 for n in names}, Channels())


@dataclass(frozen=True)
class Plans:
    """Both plans with what is expected of them: std of load shares and of predictions."""

    drives: dict[str, list[PlannedRun]]
    expected: dict[str, tuple[float, float]]


@functools.cache
def plans(count):
    """So many runs chosen from nothing, so many of the grid at random."""
    this, start = planner(), planner().nothing()
    offered = candidates([SETUP], {"soft": (0.1, 0.2)}, {"soft": DISTANCE}, 0.125)
    grid = paper_grid([SETUP], {"soft": DISTANCE})
    goals = [parameter_goal(this, LOAD), prediction_goal(this, "ends", PREDICTED)]
    rows, of_grid = this.rows(offered), this.rows(grid)
    goal = weighed(goals, start.plus(of_grid), [1.0, 1.0])
    chosen = info.exchanged(start, rows, goal, info.greedy(start, rows, goal, count)[0])
    dealt = np.random.default_rng(0).permutation(len(grid))[:count]
    return Plans(
        {"chosen": [offered[k] for k in chosen], "grid": [grid[k] for k in dealt]},
        {
            name: tuple(g.std(start.plus(r)) for g in goals)
            for name, r in (("chosen", rows.pick(chosen)), ("grid", of_grid.pick(dealt)))
        },
    )


@functools.cache
def problem(count):
    """Compiled for so many runs."""
    return Problem(steady_windows([ANY] * count, TRUTH, Channels()), nominal_robot([ANY]), CHOICES)


def fit_windows(drives, seed):
    """Fit of windows made from the model, begun at the truth; (z, converged)."""
    rng = np.random.default_rng(seed)
    std = {n: std_of(n) for n in problem(len(drives)).noise.names}
    clean = steady_windows(drives, TRUTH, Channels())
    made = simulate_windows(TRUTH, clean, rng, {**std, "current": std["current.soft.window"]})
    this = problem(len(drives)).of(made)
    log_v = np.log([std[n] ** 2 for n in this.noise.names])
    begin = FitState(this.space.vector(TRUTH), log_v, 0, np.inf, np.inf, "joint")
    end = optimise(this, start=begin, most_rounds=15)
    return end.state.z, end.converged


def fit_logs(drives, seed):
    """Fit of logs with every trap, from the staged start; (z, converged)."""
    data = collect(simulate_logs(true_robot(drives), drives, seed, SENSORS))
    end = optimise(problem(len(drives)).of(windows(data, 0.04, 0.056)))
    return end.state.z, end.converged


def errors(z):
    """Real error of the load shares, and of predicted ends over distance, root mean square."""
    this = planner()
    found = this.space.tree(jnp.asarray(z))
    share = np.asarray(found.body.load_share - TRUTH.body.load_share)
    w = steady_windows(PREDICTED, TRUTH, Channels())
    ends = []
    for robot in (found, this.robot):
        step = replay.contact_increments(robot, lk.batch(w, robot))
        ends.append(np.asarray(replay.chain(jnp.zeros((len(w), 3)), step))[:, -1, :2])
    gap = np.linalg.norm(ends[0] - ends[1], axis=1) / DISTANCE
    return np.sqrt(np.mean(share**2)), np.sqrt(np.mean(gap**2))
