"""Combination of an estimator and a controller as one pure function, and its runs on a plant."""

from dataclasses import dataclass
from typing import Generic, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.parameter import as_numbers
from slipid.robot.controller import Controller
from slipid.robot.interface import (
    PERIOD,
    AbstractEstimator,
    Measurement,
    Numbers,
    Pose,
    Readings,
    State,
    StateEstimate,
)
from slipid.robot.supervision import ControllerState
from slipid.robot.trajectory import ROW_PERIOD, Path

DURATION_FACTOR = 2.0
"""Largest duration of a run, as a multiple of the path's duration, to which 10 s are added [1]."""


class ControlLoopState(eqx.Module, Generic[State]):
    """State of a control loop between two steps.

    Attributes:
        estimator: state of the estimator.
        controller: state of the controller.
        time: time of the path [s]; it runs slower than real time while the robot lags.
    """

    estimator: State
    controller: ControllerState
    time: Float[Array, ""]


class ControlLoopOutput(eqx.Module):
    """Output of one step of a control loop; in a run every array has a leading axis of steps.

    Attributes:
        command: wheel speeds [rad/s].
        estimate: output of the estimator.
        time: time of the path [s].
        drives_off: True if wheels do not follow their commands.
        gave_up: True if the robot was stuck and has stopped.
    """

    command: Float[Array, " drive"]
    estimate: StateEstimate
    time: Float[Array, ""]
    drives_off: Bool[Array, ""]
    gave_up: Bool[Array, ""]


class ControlLoop(eqx.Module, Generic[State]):
    """An estimator of any kind and a controller as one pure function."""

    estimator: AbstractEstimator[State]
    controller: Controller

    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> ControlLoopState[State]:
        """Return the state of a robot at rest at a pose [m, m, rad], at the start of its path."""
        estimator, controller = self.estimator.init(pose), self.controller.init()
        return ControlLoopState(estimator, controller, as_numbers(0.0))

    def step(
        self,
        path: Path,
        state: ControlLoopState[State],
        measurement: Measurement | Readings,
        dt: Float[Numbers, ""] | float,
    ) -> tuple[ControlLoopState[State], ControlLoopOutput]:
        """Return the next state, and the output: command, estimate and time of the path."""
        dt = jnp.asarray(dt, dtype=float)
        estimator, estimate = self.estimator.step(state.estimator, measurement, dt)
        time, reference = self.controller.follow(path, state.time, estimate.pose, dt)
        controller, command = self.controller.step(state.controller, reference, estimate, dt)
        flags = controller.drives_off, controller.gave_up
        output = ControlLoopOutput(command, estimate, time, *flags)
        return ControlLoopState(estimator, controller, time), output

    def drive(
        self,
        twist: Float[Numbers, "3"],
        state: ControlLoopState[State],
        measurement: Measurement | Readings,
        dt: Float[Numbers, ""] | float,
    ) -> tuple[ControlLoopState[State], ControlLoopOutput]:
        """Return the next state and the output for a demanded twist instead of a path.

        `twist` is a velocity in the body frame [m/s, m/s, rad/s], such as a `cmd_vel` of ROS. The
        wheel speeds compensate the slip that is expected on the floors under the wheels.
        """
        dt = jnp.asarray(dt, dtype=float)
        estimator, estimate = self.estimator.step(state.estimator, measurement, dt)
        asked = jnp.asarray(twist, dtype=float)
        controller, command = self.controller.drive(state.controller, asked, estimate, dt)
        flags = controller.drives_off, controller.gave_up
        output = ControlLoopOutput(command, estimate, state.time, *flags)
        return ControlLoopState(estimator, controller, state.time), output


@runtime_checkable
class Plant(Protocol):
    """A real or simulated robot, which receives wheel speeds and returns sensor readings."""

    def reset(self) -> Measurement | Readings:
        """Return the first readings, of the robot at rest."""
        ...

    def step(self, wheel_speed: Float[np.ndarray, " wheel"]) -> Measurement | Readings:
        """Return the readings one control period after a command of these wheel speeds [rad/s]."""
        ...

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad]; they are used only for metrics, not by controllers."""
        ...


@dataclass(frozen=True, eq=False)
class ClosedLoopRun:
    """A closed-loop run, with one row per control period.

    Attributes:
        path: reference path of the robot.
        time: time of each row [s].
        path_time: time of the path at each row [s].
        pose: true pose [m, m, rad].
        command: commanded wheel speeds [rad/s].
        estimate: outputs of the estimator; every array has a leading axis of steps.
        energy: energy used by the motors so far [J]; NaN if the plant does not provide it.
        recovering: True while the controller tries to free a robot that is stuck.
    """

    path: Path
    time: Float[np.ndarray, " step"]
    path_time: Float[np.ndarray, " step"]
    pose: Float[np.ndarray, "step 3"]
    command: Float[np.ndarray, "step wheel"]
    estimate: StateEstimate
    energy: Float[np.ndarray, " step"]
    recovering: Bool[np.ndarray, " step"]

    @property
    def estimated_pose(self) -> Float[np.ndarray, "step 3"]:
        """Estimated poses [m, m, rad]."""
        return np.asarray(self.estimate.pose)


_step = eqx.filter_jit(ControlLoop.step)
"""Compiled step with all parameters and settings as arguments, so that loops of equal structure
share the code."""


def run_closed_loop(
    loop: ControlLoop[State], path: Path, plant: Plant, start: Pose
) -> ClosedLoopRun:
    """Run a control loop on a plant until the path ends, the controller gives up, or time is up.

    The plant is reset first and so starts at rest. For the time limit see `DURATION_FACTOR`.

    Args:
        loop: estimator and controller.
        path: path in world coordinates that begins at `start`.
        plant: the robot.
        start: pose at which the estimator starts [m, m, rad].
    """
    drives = loop.controller.robot.drives
    state, reading, dt = loop.init(start), plant.reset().filled(drives), jnp.asarray(PERIOD)
    rows: list[tuple[float, float, bool, tuple[float, float, float], ControlLoopOutput]] = []
    energy, path_time, time = 0.0, 0.0, 0.0
    gave_up, longest = False, DURATION_FACTOR * path.duration + 10.0
    while path_time < path.duration - 1e-6 and time < longest and not gave_up:
        state, out = _step(loop, path, state, reading, dt)
        path_time, gave_up = float(out.time), bool(out.gave_up)
        recovers = float(state.controller.tried) > 0
        rows.append((time, energy, recovers, plant.pose, out))
        reading = plant.step(np.asarray(out.command)).filled(drives)
        energy += getattr(plant, "power", np.nan) * PERIOD
        time += PERIOD
    times, energies, recovering, poses, outputs = zip(*rows, strict=True)
    run: ControlLoopOutput = jax.tree.map(lambda *x: np.stack([np.asarray(v) for v in x]), *outputs)
    pose = np.array(poses)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return ClosedLoopRun(
        path=path,
        time=np.array(times),
        path_time=np.asarray(run.time),
        pose=pose,
        command=np.asarray(run.command),
        estimate=run.estimate,
        energy=np.array(energies),
        recovering=np.array(recovering),
    )


def _distance_from_line(
    points: Float[np.ndarray, "step 2"], line: Float[np.ndarray, "corner 2"]
) -> Float[np.ndarray, " step"]:
    """Return the distance of each point from a polygonal line [m]."""
    begin, side = line[:-1], np.diff(line, axis=0)
    square = np.maximum((side**2).sum(-1), 1e-18)
    since = points[:, None] - begin
    part = np.clip((since * side).sum(-1) / square, 0.0, 1.0)
    return np.asarray(np.sqrt(((since - part[..., None] * side) ** 2).sum(-1)).min(1))


@dataclass(frozen=True)
class PathMetrics:
    """Errors of a closed-loop run along its path, computed from true poses.

    Attributes:
        along_track_mm: error at the end of every side of a polygon or quarter of a curve, along the
            line from the end of the one before, positive if the robot went too far [mm].
        sides_mm: distance between the ends of consecutive sides or quarters [mm].
        closure_mm: distance from the last pose to the end of the path, plus the path length that
            remained if the controller gave up [mm].
        cross_track_rmse_mm: root mean square over time of the distance from the path [mm].
        heading_error_deg: heading error at the end [deg].
        path_length_mm: length of the path that the robot drove, the 2021 paper's metric [mm].
        energy_j: energy used by the motors [J]; None if the plant does not provide it.
        effort: root mean square change of the commanded wheel speeds per period [rad/s].
        seconds: duration of the run without the rest before the path begins [s].
        finished: True if the path ran to its end within the run.
        recoveries: number of times that the controller began to free a robot that was stuck.
        freed: number of these times after which the robot drove on.
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
    recoveries: int
    freed: int


def path_metrics(run: ClosedLoopRun) -> PathMetrics:
    """Return the errors of a run along its path, computed from true poses.

    Means and the duration are of the rows after the rest with which the path begins.
    """
    path, moves = run.path, np.any(np.asarray(run.path.rows[:, 3:]) != 0, axis=1)
    begins = ROW_PERIOD * max(int(np.argmax(moves)) - 1, 0)
    first = min(int(np.searchsorted(run.path_time, begins)), len(run.pose) - 2)
    p = run.pose
    corners = np.vstack([np.asarray(path.rows[0, :2]), np.asarray(path.corners)])
    sides = np.diff(corners, axis=0)
    sizes = np.hypot(*sides.T)
    at = np.minimum(np.searchsorted(run.path_time, np.asarray(path.marks) - 1e-6), len(p) - 1)
    along = ((p[at, :2] - corners[1:]) * sides).sum(axis=1) / np.maximum(sizes, 1e-9)
    rows = np.asarray(path.rows[:, :2])
    off = _distance_from_line(p[first:, :2], rows[::5] if len(rows) > 5 else rows)
    remaining_mm = 1000 * float(path.remaining(run.path_time[-1]))
    wanted = float(path.rows[-1, 2])
    turned = np.degrees((p[-1, 2] - wanted + np.pi) % (2 * np.pi) - np.pi)
    return PathMetrics(
        along_track_mm=tuple((1000 * along).tolist()),
        sides_mm=tuple((1000 * sizes).tolist()),
        closure_mm=1000 * float(np.hypot(*(p[-1, :2] - rows[-1]))) + remaining_mm,
        cross_track_rmse_mm=1000 * float(np.sqrt((off**2).mean())),
        heading_error_deg=float(turned),
        path_length_mm=1000 * float(np.hypot(*np.diff(p[:, :2], axis=0).T).sum()),
        energy_j=None if np.isnan(run.energy[-1]) else float(run.energy[-1]),
        effort=float(np.sqrt((np.diff(run.command[first:], axis=0) ** 2).mean())),
        seconds=float(run.time[-1] - run.time[first]),
        finished=bool(run.path_time[-1] >= path.duration - 1e-6),
        recoveries=int(np.sum(np.diff(run.recovering.astype(int), prepend=0) > 0)),
        freed=int(np.sum(np.diff(run.recovering.astype(int)) < 0)),
    )
