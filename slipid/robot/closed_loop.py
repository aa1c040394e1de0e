"""An estimator and a controller as one pure function, and what becomes of a path on a plant."""

from dataclasses import dataclass
from typing import Generic, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.robot.controller import Controller, ControllerState
from slipid.robot.interface import (
    AbstractEstimator,
    Measurement,
    Numbers,
    Pose,
    Readings,
    State,
    StateEstimate,
)
from slipid.robot.trajectory import Path

PERIOD = 0.05
"""Between commands [s]."""
LONGEST = 2.0
"""Times the path's own duration after which a run is given up."""


class ControlLoopState(eqx.Module, Generic[State]):
    """What a pilot keeps: state of its estimator, of its controller, time of the path [s]."""

    seen: State
    held: ControllerState
    time: Float[Array, ""]


class ControlLoopOutput(eqx.Module):
    """What a pilot says after a step: wheel speeds [rad/s], an estimate, time of the path [s].

    `given_up` says that the robot was stuck and has stopped for good.

    Runs have leading axes in front of every array.
    """

    command: Float[Array, " wheel"]
    estimate: StateEstimate
    time: Float[Array, ""]
    given_up: Bool[Array, ""]


class ControlLoop(eqx.Module, Generic[State]):
    """An estimator of any kind and a controller as one pure function."""

    estimator: AbstractEstimator[State]
    controller: Controller

    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> ControlLoopState[State]:
        """State of a robot at rest at a pose [m, m, rad], at the start of its path."""
        seen = self.estimator.init(jnp.asarray(pose, dtype=float))
        return ControlLoopState(seen, self.controller.init(), jnp.zeros(()))

    def step(
        self,
        path: Path,
        state: ControlLoopState[State],
        measurement: Measurement | Readings,
        dt: Float[Numbers, ""] | float,
    ) -> tuple[ControlLoopState[State], ControlLoopOutput]:
        """Next state, and what is commanded and believed."""
        dt = jnp.asarray(dt, dtype=float)
        seen, estimate = self.estimator.step(state.seen, measurement, dt)
        here = jnp.where(jnp.isfinite(estimate.pose), estimate.pose, 1e3)
        time, reference = path.follow(state.time, here, dt, self.controller.gains.preview)
        held, command = self.controller.step(state.held, reference, estimate, dt)
        return ControlLoopState(seen, held, time), ControlLoopOutput(
            command, estimate, time, held.given_up
        )


@runtime_checkable
class Plant(Protocol):
    """A robot that takes wheel speeds and gives back what its sensors read."""

    def reset(self) -> Measurement | Readings:
        """First readings, of the robot at rest."""
        ...

    def step(self, wheel_speed: Float[np.ndarray, " wheel"]) -> Measurement | Readings:
        """Readings one control period later, with these wheel speeds commanded [rad/s]."""
        ...

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad]; for the judge, no controller sees it."""
        ...


@dataclass(frozen=True, eq=False)
class ClosedLoopRun:
    """One closed-loop run, a row per period.

    Attributes:
        path: what was asked.
        time: [s]; own: time of the path [s].
        pose: true [m, m, rad]; command: wheel speeds [rad/s].
        estimate: all that was estimated, a leading axis of steps on every array.
        energy: of the motors until then [J]; NaN where the plant does not know.
    """

    path: Path
    time: Float[np.ndarray, " step"]
    own: Float[np.ndarray, " step"]
    pose: Float[np.ndarray, "step 3"]
    command: Float[np.ndarray, "step wheel"]
    estimate: StateEstimate
    energy: Float[np.ndarray, " step"]

    @property
    def believed(self) -> Float[np.ndarray, "step 3"]:
        """Estimated poses [m, m, rad]."""
        return np.asarray(self.estimate.pose)


_step = eqx.filter_jit(ControlLoop.step)
"""The step with its numbers as arguments: compiled once for all pilots and starts alike."""


def run_closed_loop(
    pilot: ControlLoop[State], path: Path, plant: Plant, start: Pose
) -> ClosedLoopRun:
    """Run a pilot on a plant at rest until its path is over.

    It also ends when the pilot gives up. The path is as it lies for the start, where the pilot
    believes it stands [m, m, rad].
    """
    wheels = pilot.controller.robot.wheels
    state, reading, dt = pilot.init(start), plant.reset().filled(wheels), jnp.asarray(PERIOD)
    rows: list[tuple[float, float, tuple[float, float, float], ControlLoopOutput]] = []
    energy, own, begun = 0.0, 0.0, 0.0
    helpless, longest = False, LONGEST * path.duration + 10.0
    while own < path.duration - 1e-6 and begun < longest and not helpless:
        state, out = _step(pilot, path, state, reading, dt)
        own, helpless = float(out.time), bool(out.given_up)
        rows.append((begun, energy, plant.pose, out))
        reading = plant.step(np.asarray(out.command)).filled(wheels)
        energy += getattr(plant, "power", np.nan) * PERIOD
        begun += PERIOD
    time, spent, poses, said = zip(*rows, strict=True)
    every: ControlLoopOutput = jax.tree.map(lambda *x: np.stack([np.asarray(v) for v in x]), *said)
    pose = np.array(poses)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return ClosedLoopRun(
        path=path,
        time=np.array(time),
        own=np.asarray(every.time),
        pose=pose,
        command=np.asarray(every.command),
        estimate=every.estimate,
        energy=np.array(spent),
    )


def _from_line(
    places: Float[np.ndarray, "step 2"], line: Float[np.ndarray, "point 2"]
) -> Float[np.ndarray, " step"]:
    """Distance of places from a line through points [m]."""
    begin, side = line[:-1], np.diff(line, axis=0)
    square = np.maximum((side**2).sum(-1), 1e-18)
    since = places[:, None] - begin
    part = np.clip((since * side).sum(-1) / square, 0.0, 1.0)
    return np.asarray(np.sqrt(((since - part[..., None] * side) ** 2).sum(-1)).min(1))


@dataclass(frozen=True)
class PathMetrics:
    """What became of a path, from true poses.

    Attributes:
        along_track_mm: travelled less wanted at the end of every side, or quarter of a curve.
        sides_mm: what was wanted, straight from one end to the next.
        closure_mm: from the end to where it should be, and what was left of the way where the run
            was given up.
        cross_track_rmse_mm: distance from the path as a line, over time.
        heading_error_deg: at the end.
        path_length_mm: the 2021 paper's metric.
        energy_j: of the motors; None where the plant does not know.
        effort: rms of the change of wheel speed commands [rad/s].
        seconds: that it took.
        finished: whether the path's end was reached.
    """

    along_track_mm: tuple[float, ...]
    sides_mm: tuple[float, ...]
    closure_mm: float
    cross_track_rmse_mm: float
    heading_error_deg: float
    path_length_mm: float
    energy_j: float | None
    effort: float
    seconds: float
    finished: bool


def path_metrics(course: ClosedLoopRun) -> PathMetrics:
    """What became of a path, from true poses."""
    p, path = course.pose, course.path
    corners = np.vstack([np.asarray(path.rows[0, :2]), np.asarray(path.corners)])
    sides = np.diff(corners, axis=0)
    sizes = np.hypot(*sides.T)
    at = np.minimum(np.searchsorted(course.own, np.asarray(path.marks) - 1e-6), len(p) - 1)
    along = ((p[at, :2] - corners[1:]) * sides).sum(axis=1) / np.maximum(sizes, 1e-9)
    rows = np.asarray(path.rows[:, :2])
    near = _from_line(p[:, :2], rows[::5] if len(rows) > 5 else rows)
    left_mm = 1000 * float(path.left(course.own[-1]))
    wanted = float(path.rows[-1, 2])
    turned = np.degrees((p[-1, 2] - wanted + np.pi) % (2 * np.pi) - np.pi)
    return PathMetrics(
        along_track_mm=tuple((1000 * along).tolist()),
        sides_mm=tuple((1000 * sizes).tolist()),
        closure_mm=1000 * float(np.hypot(*(p[-1, :2] - corners[-1]))) + left_mm,
        cross_track_rmse_mm=1000 * float(np.sqrt((near**2).mean())),
        heading_error_deg=float(turned),
        path_length_mm=1000 * float(np.hypot(*np.diff(p[:, :2], axis=0).T).sum()),
        energy_j=None if np.isnan(course.energy[-1]) else float(course.energy[-1]),
        effort=float(np.sqrt((np.diff(course.command, axis=0) ** 2).mean())),
        seconds=float(course.time[-1]),
        finished=bool(course.own[-1] >= path.duration - 1e-6),
    )
