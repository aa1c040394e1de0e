"""slipid's own rows: the force balance where the floor is told, its estimator where it is not."""

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
from slipid.fit import likelihood as lk
from slipid.fit.optimise import optimise
from slipid.fit.problem import FitState, Problem
from slipid.fit.variances import DEGREES
from slipid.infer.slip_curves import current_trend
from slipid.lab.benchmark.steps import RunBatch, body_poses
from slipid.predict.folds import problem_of_runs
from slipid.predict.predictive import ForceBalance, force_balance_of
from slipid.predict.slip_model import PredictedRun, RobotSpec, RunSignals, relative_to_start
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.interface import MIXED_FLOORS_PENALTY, NO_FLOOR, Readings, Settings
from slipid.robot.record import LogSensors
from slipid.support.checkpoint import Checkpoint

NAME = "slipid"
TOLERANCE = 0.1
"""A fit is done when nothing moves by more than this part of its std: runs scatter far more."""
STEPS = 16
"""Estimators drive a number of steps that is a multiple of it, so that few shapes are compiled."""
TOGETHER = 32
"""Runs that an estimator drives in one call."""
LONGEST_S = 0.25
"""Longer steps are driven in several: what lasts more than half a second is no step to it [s]."""


@dataclass(frozen=True, eq=False)
class SlipidFit:
    """slipid fitted to some runs of a data set.

    Attributes:
        contact: the force balance as it forecasts.
        job: of all runs of the data set.
        seen: which of its floors were fitted, by number.
        highest_speed: of the wheels in these runs [rad/s].
        trend: of their currents, see `slipid.infer.slip_curves.current_trend`.
        seconds: that the fit took; converged: whether it did.
    """

    contact: ForceBalance
    job: ConfigFitTask
    seen: tuple[int, ...]
    highest_speed: float
    trend: tuple[float, float]
    seconds: float
    converged: bool

    @property
    def numbers(self) -> int:
        """How many numbers were fitted."""
        return self.contact.space.size

    @cached_property
    def deployed(self) -> DeployedRobot:
        """The robot as it is deployed, on all floors of the data set."""
        signed = self.job.dataset.current_is_signed
        return robot_of_force_balance(
            self.contact, self.highest_speed, self.trend, LogSensors(signed)
        )


def fit_slipid(
    job: ConfigFitTask, problem: Problem, fitted: np.ndarray, kept: Checkpoint
) -> SlipidFit:
    """The force balance fitted to some runs of a job.

    What was kept of this very fit is not done again. Fits of one `job.problem()` share what was
    compiled for it.
    """
    problem = problem_of_runs(problem, job.choices, job.dataset, fitted)
    keep = np.isin(problem.windows.run, fitted).astype(float)
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
    speed, trend = _seen(problem, contact, keep)
    seen = {job.dataset.logs[k].surface for k in fitted.tolist()}
    rows = tuple(k for k, name in enumerate(contact.robot.surfaces.labels) if name in seen)
    return SlipidFit(contact, job, rows, speed, trend, float(seconds), bool(converged))


def _seen(
    problem: Problem, contact: ForceBalance, keep: Float[np.ndarray, " piece"]
) -> tuple[float, tuple[float, float]]:
    """Highest wheel speed [rad/s] and trend of currents in the pieces that count."""
    w = problem.windows.segments(np.flatnonzero(keep > 0))
    speed = float(np.abs(w.turn / w.dt[..., None]).max())
    if not w.has_current:
        return speed, (0.0, 0.0)
    return speed, current_trend(contact.robot, lk.batch(w, contact.robot))


def forecast(own: SlipidFit, cut: RunBatch, spec: RobotSpec) -> list[PredictedRun]:
    """What the force balance says of runs whose floors it is told, with the electric power."""
    w = cut.windows
    tracks, cov = own.contact.ends(w)
    robot = own.contact.robot
    paths = body_poses(robot, w, tracks.predicted)
    power = _power(own, w, spec) if own.job.dataset.current is not None else None
    return [
        PredictedRun(
            path=relative_to_start(paths[k]),
            end_covariance=turned_covariance(cov[k], -float(paths[k, 0, 2])),
            freedom=DEGREES,
            power=None if power is None else power[k],
        )
        for k in range(len(cut.runs))
    ]


def _power(own: SlipidFit, w: Any, spec: RobotSpec) -> np.ndarray:
    """Electric power of all motors by the currents that the force balance predicts [W]."""
    robot = own.contact.robot
    b = lk.batch(w, robot)
    amps = np.abs(np.asarray(_currents(robot, b)))
    shaft = np.abs(spec.gear_ratio * w.turn / w.dt[..., None])
    return np.asarray(((spec.resistance * amps + spec.back_emf * shaft) * amps).sum(-1))


@jax.jit
def _currents(robot: Any, b: lk.Batch) -> Array:
    return lk.predicted_current(robot, b, lk.predict(robot, b).motor_force)


@dataclass(frozen=True, eq=False)
class FloorKnowledge:
    """What an estimator knows of where it drives.

    Attributes:
        told: whether the floor of each run is told: then it is the only one there is.
        strange: whether there may be floors on which nobody drove.
        map: of the floors; the estimator then starts at the first pose of the body, in its frame.
    """

    told: bool = False
    strange: bool = False
    map: FloorMap | None = None


def estimator_runs(
    own: SlipidFit, cuts: Sequence[RunBatch], data: Runs, place: FloorKnowledge
) -> list[PredictedRun]:
    """What the estimator says of runs, in the order of the cuts, which are of these data.

    It hears currents only if it was fitted to some.
    """
    runs = [(run, cut.numbers[k]) for cut in cuts for k, run in enumerate(cut.runs)]
    out: dict[int, PredictedRun] = {}
    alone = {
        n: data.logs[number].surface if place.told else None for n, (_, number) in enumerate(runs)
    }
    kinds = [(data.logs[number].load, alone[n]) for n, (_, number) in enumerate(runs)]
    for load, only in dict.fromkeys(kinds):
        mine = [n for n, kind in enumerate(kinds) if kind == (load, only)]
        estimator = _estimator(own, load, only, place, runs[mine[0]][0].floor == "unknown")
        heard = [runs[n][0].signals for n in mine]
        if own.job.dataset.current is None:
            heard = [replace(one, current=None) for one in heard]
        said = replay(estimator, heard, _starts(runs, mine, place.map))
        out.update(zip(mine, said, strict=True))
    return [out[n] for n in range(len(runs))]


def _estimator(
    own: SlipidFit, load: str, only: str | None, place: FloorKnowledge, several: bool
) -> Estimator:
    """The estimator of a fit, for all floors that were fitted, or only one."""
    whole = own.deployed
    # a floor that nobody has seen has no numbers
    rows = own.seen if only is None else (whole.labels.index(only),)
    robot = DeployedRobot.of(whole.record.on(rows), load)
    if place.strange:
        robot = robot.with_unseen()
    settings = Settings.of(robot)
    if several or place.map is not None:
        settings = replace(settings, further_floor_penalty=MIXED_FLOORS_PENALTY)
    known = None if place.map is None else floor_of(place.map, robot.labels)
    return Estimator(robot, settings, known)


def _starts(runs: Sequence[Any], mine: Sequence[int], floor: FloorMap | None) -> np.ndarray:
    if floor is None:
        return np.zeros((len(mine), 3))
    return np.stack([runs[n][0].pose[0] for n in mine])


class _ReplayRows(eqx.Module):
    """What an estimator hears, row by row of every run; NaN where there is nothing."""

    angle: Float[Array, "run row drive"]
    current: Float[Array, "run row drive"]
    gyro: Float[Array, "run row"]
    dt: Float[Array, "run row"]


@eqx.filter_jit
def _driven(
    estimator: Estimator, start: Float[Array, "run 3"], rows: _ReplayRows
) -> tuple[Array, Array, Array]:
    """Poses, covariances of the place and probabilities of floors under the robot, row by row."""
    nothing = Readings.nothing(estimator.robot.drives)

    def step(state: Any, row: _ReplayRows) -> Any:
        z = replace(nothing, wheel_angle=row.angle, current=row.current, gyro=row.gyro)
        state, seen = estimator.step(state, z, row.dt)
        floors = jnp.mean(seen.surface_probability, axis=0)
        return state, (seen.pose, seen.covariance[:2, :2], floors)

    def one(pose: Array, of_run: _ReplayRows) -> Any:
        return jax.lax.scan(step, estimator.init(pose), of_run)[1]

    return jax.vmap(one)(start, rows)


def replay(
    estimator: Estimator, runs: Sequence[RunSignals], start: np.ndarray
) -> list[PredictedRun]:
    """Estimates of runs from their signals, from poses (run, 3) on.

    The first row is the wheels' first angle, in which no time passes. Steps longer than `LONGEST_S`
    are driven in equal parts.
    """
    parts = [np.ceil(run.dt / LONGEST_S - 1e-9).astype(int).clip(1) for run in runs]
    longest = max(int(part.sum()) for part in parts)
    longest = -(-longest // STEPS) * STEPS + 1
    drives = estimator.robot.drives
    known = [k for k, unseen in enumerate(estimator.robot.unseen) if not unseen]
    out: list[PredictedRun] = []
    for first in range(0, len(runs), TOGETHER):
        some = range(first, min(first + TOGETHER, len(runs)))
        angle = np.full((TOGETHER, longest, drives), np.nan)
        current = np.full((TOGETHER, longest, drives), np.nan)
        gyro, dt = np.full((TOGETHER, longest), np.nan), np.zeros((TOGETHER, longest))
        begin = np.zeros((TOGETHER, 3))
        begin[: len(some)] = start[first : first + TOGETHER]
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
        heard = _ReplayRows(*(jnp.asarray(x) for x in (angle, current, gyro, dt)))
        pose, cov, floors = (np.asarray(x) for x in _driven(estimator, jnp.asarray(begin), heard))
        for n, k in enumerate(some):
            ends = np.cumsum(parts[k])
            path = np.concatenate([begin[n][None], pose[n, ends]])
            under = {estimator.robot.labels[row]: floors[n, ends, row] for row in known}
            said = PredictedRun(
                path=relative_to_start(path),
                end_covariance=turned_covariance(cov[n, ends[-1]], -float(begin[n, 2])),
                floors=under | {NO_FLOOR: 1.0 - sum(under.values())},
            )
            out.append(said)
    return out


def turned_covariance(cov: Float[np.ndarray, "2 2"], angle: float) -> Float[np.ndarray, "2 2"]:
    """Covariance of a plane vector that was turned by an angle [rad]."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return turn @ cov @ turn.T
