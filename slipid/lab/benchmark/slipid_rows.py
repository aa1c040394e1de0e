"""The rows of slipid: its force balance on known floors, and its estimator on unknown floors."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.app.problem import ConfigFitTask
from slipid.data.floor_map import FloorMap
from slipid.data.runs import Runs
from slipid.deploy.deploy import robot_of_force_balance
from slipid.deploy.floors import floor_of
from slipid.deploy.replay import LONGEST_STEP_S
from slipid.fitting import likelihood as lk
from slipid.fitting.optimise import optimise
from slipid.fitting.problem import FitState, Problem
from slipid.fitting.variances import DEGREES
from slipid.infer.slip_curves import current_trend
from slipid.lab.benchmark.steps import RunBatch
from slipid.predict.folds import problem_of_runs
from slipid.predict.predictive import ForceBalance, force_balance_of
from slipid.predict.slip_model import (
    PredictedRun,
    RobotSpec,
    RunSignals,
    body_poses,
    relative_to_start,
)
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.interface import MIXED_FLOORS_PENALTY, NO_FLOOR, Measurement, Settings
from slipid.robot.record import LogSensors
from slipid.support.checkpoint import Checkpoint

NAME = "slipid"
TOLERANCE = 0.1
"""A fit has converged when no parameter changes by more than this multiple of its std.

Predictions then change by far less than their errors vary between runs."""
STEPS_MULTIPLE = 16
"""The steps of a replay are padded to a multiple of this number, so that the estimator is compiled
for few array sizes."""
RUNS_PER_CALL = 32
"""Number of runs in one call of an estimator. Smaller numbers are padded, so that the estimator is
compiled for a single array size."""


@dataclass(frozen=True, eq=False)
class SlipidFit:
    """slipid fitted to some runs of a data set.

    Attributes:
        contact: fitted force balance, which predicts runs.
        job: fit task of all runs of the data set.
        floors: indices of the fitted floors.
        highest_speed: highest wheel speed in the fitted runs [rad/s].
        trend: trend of current residuals, see `slipid.infer.slip_curves.current_trend`.
        seconds: duration of the fit [s].
        converged: True if the fit converged.
    """

    contact: ForceBalance
    job: ConfigFitTask
    floors: tuple[int, ...]
    highest_speed: float
    trend: tuple[float, float]
    seconds: float
    converged: bool

    @property
    def numbers(self) -> int:
        """Number of fitted parameters."""
        return self.contact.space.size

    @cached_property
    def deployed(self) -> DeployedRobot:
        """The fitted robot in its deployed form, with all floors of the data set."""
        signed = self.job.dataset.current_is_signed
        return robot_of_force_balance(
            self.contact, self.highest_speed, self.trend, LogSensors(signed)
        )


def fit_slipid(
    job: ConfigFitTask, problem: Problem, training: np.ndarray, kept: Checkpoint
) -> SlipidFit:
    """Return slipid fitted to some runs of a fit task, or the fit that was saved before.

    Args:
        job: fit task of all runs of the data set.
        problem: `job.problem()`; fits that are given the same problem share compiled functions.
        training: indices of the runs that are fitted.
        kept: checkpoint from which the fit is loaded, or to which it is saved.
    """
    problem = problem_of_runs(problem, job.choices, job.dataset, training)
    keep = np.isin(problem.windows.run, training).astype(float)
    if (found := kept.load("fit")) is None:
        began = time.perf_counter()
        most = job.settings.rounds
        optimum = optimise(problem, keep=keep, most_rounds=most, tolerance=TOLERANCE)
        about = {
            "covariance": optimum.covariance,
            "seconds": time.perf_counter() - began,
            "converged": bool(optimum.converged),
        }
        kept.save("fit", optimum.state.arrays | about)
        found = kept.load("fit")
        assert found is not None
    covariance, seconds, converged = (found.pop(k) for k in ("covariance", "seconds", "converged"))
    contact = force_balance_of(problem, FitState.of(found), covariance, keep)
    robot, w = contact.robot, problem.windows.segments(np.flatnonzero(keep > 0))
    names = {job.dataset.logs[k].surface for k in training.tolist()}
    return SlipidFit(
        contact=contact,
        job=job,
        floors=tuple(k for k, name in enumerate(robot.surfaces.labels) if name in names),
        highest_speed=float(np.abs(w.turn / w.dt[..., None]).max()),
        trend=current_trend(robot, lk.batch(w, robot)) if w.has_current else (0.0, 0.0),
        seconds=float(seconds),
        converged=bool(converged),
    )


def forecast(fit: SlipidFit, batch: RunBatch, spec: RobotSpec) -> list[PredictedRun]:
    """Return the force balance's predictions of runs on known floors, with electric power."""
    w = batch.windows
    tracks, cov = fit.contact.ends(w)
    robot = fit.contact.robot
    paths = body_poses(robot, w.session, tracks.predicted)
    has_current = fit.job.dataset.current is not None
    amps = np.abs(np.asarray(_currents(robot, lk.batch(w, robot)))) if has_current else None

    def predicted(k: int, run: RunSignals) -> PredictedRun:
        driven = replace(run, current=None if amps is None else amps[k], current_is_signed=False)
        return PredictedRun(
            path=relative_to_start(paths[k]),
            end_covariance=turned_covariance(cov[k], -float(paths[k, 0, 2])),
            freedom=DEGREES,
            power=None if amps is None else driven.power(spec),
        )

    return [predicted(k, run.signals) for k, run in enumerate(batch.runs)]


@jax.jit
def _currents(robot: Any, b: lk.Batch) -> Array:
    return lk.predicted_current(robot, b, lk.predict(robot, b).motor_force)


@dataclass(frozen=True, eq=False)
class FloorKnowledge:
    """Information that an estimator is given about the floors of its runs.

    Attributes:
        floor_known: True if the floor of each run is given; it is then the estimator's only floor.
        unseen_floors: True if the estimator also considers floors without training runs.
        map: map of the floors, or None; with a map, the estimator starts at the first true pose.
    """

    floor_known: bool = False
    unseen_floors: bool = False
    map: FloorMap | None = None


def estimator_runs(
    fit: SlipidFit, batches: Sequence[RunBatch], data: Runs, floors: FloorKnowledge
) -> list[PredictedRun]:
    """Return the estimator's predictions of runs, in the order of the batches.

    The estimator uses currents only if slipid was fitted to currents.

    Args:
        fit: slipid's fit.
        batches: the runs.
        data: logs to which the indices of the batches refer.
        floors: information about the floors.
    """
    runs = [run for batch in batches for run in batch.runs]
    logs = [data.logs[k] for batch in batches for k in batch.numbers]
    out: dict[int, PredictedRun] = {}
    kinds = [(log.load, log.surface if floors.floor_known else None) for log in logs]
    for load, only in dict.fromkeys(kinds):
        mine = [n for n, kind in enumerate(kinds) if kind == (load, only)]
        estimator = _estimator(fit, load, only, floors, runs[mine[0]].floor == "unknown")
        signals = [runs[n].signals for n in mine]
        if fit.job.dataset.current is None:
            signals = [replace(one, current=None) for one in signals]
        start = np.zeros((len(mine), 3))
        if floors.map is not None:
            start = np.stack([runs[n].pose[0] for n in mine])
        out.update(zip(mine, replay(estimator, signals, start), strict=True))
    return [out[n] for n in range(len(runs))]


def _estimator(
    fit: SlipidFit, load: str, only: str | None, floors: FloorKnowledge, several: bool
) -> Estimator:
    """Return the estimator of a fit for one load set-up.

    Args:
        fit: slipid's fit.
        load: name of the load set-up.
        only: the estimator's only floor; None for all fitted floors.
        floors: information about the floors.
        several: True if a run may cross several floors.
    """
    whole = fit.deployed
    # omit floors without training runs, whose parameters were not fitted
    rows = fit.floors if only is None else (whole.labels.index(only),)
    robot = DeployedRobot.of(whole.record.on(rows), load)
    if floors.unseen_floors:
        robot = robot.with_unseen()
    settings = Settings.of(robot)
    if several or floors.map is not None:
        settings = replace(settings, further_floor_penalty=MIXED_FLOORS_PENALTY)
    known = None if floors.map is None else floor_of(floors.map, robot.labels)
    return Estimator(robot, settings, known)


@eqx.filter_jit
def _replayed(
    estimator: Estimator,
    start: Float[Array, "run 3"],
    rows: Measurement,
    dt: Float[Array, "run row"],
) -> tuple[Array, Array, Array]:
    """Return estimates after each row of each run.

    The estimates are the pose [m, m, rad], the covariance of the position [m^2], and the
    probability of each floor, averaged over the wheels. `dt` is 0 in the first row and in rows of
    padding [s].
    """

    def step(state: Any, row: tuple[Measurement, Array]) -> Any:
        state, estimate = estimator.step(state, *row)
        floors = jnp.mean(estimate.surface_probability, axis=0)
        return state, (estimate.pose, estimate.covariance[:2, :2], floors)

    def one(pose: Array, *of_run: Any) -> Any:
        return jax.lax.scan(step, estimator.init(pose), of_run)[1]

    return jax.vmap(one)(start, rows, dt)


def replay(
    estimator: Estimator, runs: Sequence[RunSignals], start: np.ndarray
) -> list[PredictedRun]:
    """Return the estimator's predictions of runs from their signals.

    The estimator's first row has zero duration and gives the wheels' first angles. Steps longer
    than `LONGEST_STEP_S` are split into equal parts.

    Args:
        estimator: the estimator.
        runs: signals of the runs.
        start: start pose of each run, shape (run, 3) [m, m, rad].
    """
    parts = [np.ceil(run.dt / LONGEST_STEP_S - 1e-9).astype(int).clip(1) for run in runs]
    longest = max(int(part.sum()) for part in parts)
    longest = -(-longest // STEPS_MULTIPLE) * STEPS_MULTIPLE + 1
    shape, labels = (RUNS_PER_CALL, longest), estimator.robot.labels
    known = [k for k, unseen in enumerate(estimator.robot.unseen) if not unseen]
    out: list[PredictedRun] = []
    for first in range(0, len(runs), RUNS_PER_CALL):
        some = range(first, min(first + RUNS_PER_CALL, len(runs)))
        angle, current = np.full((2, *shape, estimator.robot.drives), np.nan)
        gyro, dt, begin = np.full(shape, np.nan), np.zeros(shape), np.zeros((RUNS_PER_CALL, 3))
        begin[: len(some)] = start[first : first + RUNS_PER_CALL]
        for n, k in enumerate(some):
            run, part = runs[k], parts[k]
            rows = slice(1, int(part.sum()) + 1)
            turn = np.repeat(run.turn / part[:, None], part, axis=0)
            angle[n, 0], angle[n, rows] = 0.0, np.cumsum(turn, axis=0)
            dt[n, rows] = np.repeat(run.dt / part, part)
            if run.current is not None:
                current[n, rows] = np.repeat(run.current, part, axis=0)
            if run.gyro is not None:
                gyro[n, rows] = np.repeat(run.gyro, part)
        measured = {"wheel_angle": angle, "current": current, "gyro": gyro}
        inputs = Measurement(**{name: jnp.asarray(x) for name, x in measured.items()})
        found = _replayed(estimator, jnp.asarray(begin), inputs, jnp.asarray(dt))
        pose, cov, floors = map(np.asarray, found)
        for n, k in enumerate(some):
            ends = np.cumsum(parts[k])
            path = np.concatenate([begin[n][None], pose[n, ends]])
            under = {labels[row]: floors[n, ends, row] for row in known}
            predicted = PredictedRun(
                path=relative_to_start(path),
                end_covariance=turned_covariance(cov[n, ends[-1]], -float(begin[n, 2])),
                floors=under | {NO_FLOOR: 1.0 - sum(under.values())},
            )
            out.append(predicted)
    return out


def turned_covariance(cov: Float[np.ndarray, "2 2"], angle: float) -> Float[np.ndarray, "2 2"]:
    """Return the covariance of a plane vector that is rotated by an angle [rad]."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ cov @ turn.T
