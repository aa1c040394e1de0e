"""Open-loop prediction of paths from the first pose, with the uncertainty of their end points.

All poses are in metres as corrected by the fitted camera. A prediction uses only the first of the
measured poses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.data.runs import Runs
from slipid.data.wheel_signals import interpolate
from slipid.data.windows import Windows, windows
from slipid.fitting import likelihood as lk
from slipid.fitting.noise import travel
from slipid.fitting.session_effects import by_axis
from slipid.model import se2
from slipid.model.robot import Robot
from slipid.predict.slip_model import RobotSpec, RunSignals, path_of, turned, turned_left
from slipid.search_space import Space

LONGEST_STEP_S = 0.5
"""Longest step in which the path of a run with steady wheels is predicted [s]."""
MOST_PARTS, SAME_PATH = 32, 5e-4
"""Largest number of parts of a step, and largest difference of the rolled path from that of so many
parts, over the path length [1]."""
Numbers = Array | np.ndarray
RUNS_PER_CALL = 32
"""Number of runs that are predicted in one compiled call."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Predicted and measured paths of runs, all with the same number of steps.

    Attributes:
        run: index of each run.
        predicted: predicted marker poses (x, y in corrected metres, heading [rad]).
        measured: measured marker poses.
    """

    run: np.ndarray
    predicted: Float[np.ndarray, "run edge 3"]
    measured: Float[np.ndarray, "run edge 3"]

    @property
    def gap(self) -> Float[np.ndarray, "run 3"]:
        """Predicted less measured end pose [m, m, rad]."""
        return self.predicted[:, -1] - self.measured[:, -1]


def replay_windows(data: Runs, robot: Robot) -> list[Windows]:
    """Return the runs, each as one segment of short steps, `RUNS_PER_CALL` at a time.

    The number of steps of a run is a power of two, so that few array shapes are compiled. A step
    has one twist. Where wheels change their speeds within steps, the run's steps are divided.
    """
    steps, spec = [], RobotSpec.of(robot)
    for k, log in enumerate(data.logs):
        want = 2 ** int(np.ceil(np.log2(max(log.duration / LONGEST_STEP_S, 16))))
        frames = int(data.fresh[data.rows(k)].sum())
        while want > 1 and want > frames // 3:
            want //= 2
        steps.append(want)
    return whole_runs(
        data, robot, steps, [parts_of_steps(data, k, spec, n) for k, n in enumerate(steps)]
    )


def parts_of_steps(data: Runs, run: int, spec: RobotSpec, steps: int) -> int:
    """Return the number of parts of each step in which a run's wheels are nearly steady."""
    rows = data.rows(run)
    time, angle = data.time[rows], data.turned(run)

    def path(parts: int) -> Float[np.ndarray, "edge 3"]:
        edges = np.linspace(time[0], time[-1], steps * parts + 1)
        turn = np.diff(interpolate(time, angle, edges), axis=0)
        rolled = RunSignals(data.logs[run].name, np.diff(edges), turn)
        return path_of(rolled.rolling(spec), rolled.dt)

    exact, parts = path(MOST_PARTS), 1
    length = float(np.linalg.norm(np.diff(exact[:, :2], axis=0), axis=1).sum())
    while parts < MOST_PARTS:
        gap = path(parts)[::parts, :2] - exact[::MOST_PARTS, :2]
        if float(np.linalg.norm(gap, axis=1).max()) <= SAME_PATH * length:
            break
        parts *= 2
    return parts


def whole_runs(
    data: Runs, robot: Robot, steps: Sequence[int], parts: Sequence[int] | None = None
) -> list[Windows]:
    """Return the runs, each as one segment of a given number of steps, `RUNS_PER_CALL` at a time.

    The last run of an incomplete group is repeated to fill the group, so that few array shapes are
    compiled.

    Args:
        data: the runs.
        robot: robot with the lag of the pose sensor.
        steps: number of steps of each run.
        parts: number of parts of each step, for each run; 1 by default.
    """
    radius, lag = float(robot.geometry.wheel_radius), float(robot.camera.lag)
    shapes, out = list(zip(steps, parts or [1] * len(steps), strict=True)), []
    for shape in sorted(set(shapes)):
        runs = np.array([k for k, own in enumerate(shapes) if own == shape])
        for first in range(0, len(runs), RUNS_PER_CALL):
            some = runs[first : first + RUNS_PER_CALL]
            w = windows(data.subset(some), radius, lag, shape[0], np.inf, shape[1])
            filled = np.minimum(np.arange(RUNS_PER_CALL), len(w) - 1)
            out.append(replace(w, run=some[w.run]).segments(filled))
    return out


@jax.jit
def contact_increments(robot: Robot, b: lk.Batch) -> Float[Array, "segment window 3"]:
    """Return the marker increments of the contact equilibrium."""
    return lk.predict(robot, b).increment


@jax.jit
def chain(start: Float[Array, "segment 3"], step: Float[Array, "segment window 3"]) -> Array:
    """Return the poses from a start pose and body-frame increments (segment, window + 1, 3)."""
    return jax.vmap(se2.chain)(start, step)


def tracks_from_increments(
    robot: Robot, w: Windows, increment: Float[np.ndarray, "segment window 3"]
) -> Tracks:
    """Return the tracks of a model that predicts marker increments."""
    pose = np.asarray(lk.corrected(robot, jnp.asarray(w.pose)))
    path = np.asarray(chain(jnp.asarray(pose[:, 0]), jnp.asarray(increment)))
    return Tracks(w.run, path, pose)


@eqx.filter_jit
def end_jacobian(
    space: Space,
    z: Numbers,
    b: lk.Batch,
    start: Numbers,
    twist: Numbers | None = None,
    effects: tuple[Numbers, Numbers] | None = None,
) -> Float[Array, "segment 2 free"]:
    """Return the derivative of end points with respect to the search vector, for fixed start poses.

    The path follows body twists (segment, window, 3) if `twist` is given, else the contact
    equilibrium. `effects`, if given, holds the increments by expected shared effects (segment,
    window, 3) [m, m, rad], which are subtracted, and their derivative with respect to the search
    vector.
    """
    return jax.jacfwd(lambda x: _path(space, x, z, b, start, twist, effects)[:, -1, :2])(z)


@eqx.filter_jit
def path_jacobian(
    space: Space, z: Numbers, b: lk.Batch, start: Numbers, effects: tuple[Numbers, Numbers]
) -> Float[Array, "segment edge 3 free"]:
    """Return the derivative of all poses of the contact equilibrium's paths.

    Arguments are those of `end_jacobian`.
    """
    return jax.jacfwd(lambda x: _path(space, x, z, b, start, None, effects))(z)


def _path(
    space: Space,
    x: Array,
    z: Numbers,
    b: lk.Batch,
    start: Numbers,
    twist: Numbers | None,
    effects: tuple[Numbers, Numbers] | None,
) -> Float[Array, "segment edge 3"]:
    """Return the poses at the search vector `x`; `effects` are known at `z`."""
    robot = space.tree(x)
    if twist is not None:
        step = lk.marker_increments(robot, jnp.asarray(twist), b.dt, b.session)
    else:
        step = contact_increments(robot, b)
    if effects is not None:
        mean, slope = effects
        step -= mean + slope @ (x - jnp.asarray(z))
    return chain(start, step)


def end_covariance(
    robot: Robot,
    w: Windows,
    tracks: Tracks,
    variance: Mapping[str, float],
    shared: Float[np.ndarray, "segment 3 3"],
    of_parameters: Float[np.ndarray, "segment 2 2"],
) -> Float[np.ndarray, "segment 2 2"]:
    """Return the scale matrices of the Student t of predicted less measured end points [m^2].

    See `path_covariance`; `of_parameters` is the covariance of the end points due to uncertain
    parameters.
    """
    p, last = tracks.predicted, tracks.predicted.shape[1] - 1
    found = path_covariance(robot, w, p, variance, shared, [last], p[:, [last], :2])
    return of_parameters + found[:, 0]


def path_covariance(
    robot: Robot,
    w: Windows,
    predicted: Float[np.ndarray, "segment edge 3"],
    variance: Mapping[str, float],
    shared: Float[np.ndarray, "segment 3 3"],
    edges: Sequence[int] | Int[np.ndarray, " picked"],
    point: Float[np.ndarray, "segment picked 2"],
    motion: tuple[np.ndarray, np.ndarray] | None = None,
) -> Float[np.ndarray, "segment picked 2 2"]:
    """Return the scale matrices of predicted less measured positions, for known parameters [m^2].

    The matrices include process noise, the individual run effect, shared effects, and camera noise
    of the first and of the later position and of the start heading; each is propagated along the
    predicted path.

    Args:
        robot: robot with the camera and the geometry.
        w: whole runs, one segment each.
        predicted: predicted marker poses at the edges of the windows.
        variance: variances of the noise components, keyed by name.
        shared: covariance of the shared effects along, across and in yaw.
        edges: indices of the edges at which the position is predicted.
        point: predicted position at these edges, that of the marker or of another point of the
            robot [m].
        motion: distance and direction of every window, by default those by the encoders.
    """
    far, u = motion or travel(w, robot)
    heading, begin = predicted[:, :-1, 2], predicted[:, 0, :2]
    along, across = turned(heading, u), turned(heading, turned_left(u))
    process, run = (by_axis(variance, k, w) for k in ("process", "run"))
    effect = shared + run[:, :, None] * np.eye(3)
    of_place = 2 * variance["camera.place"] * float(robot.camera.scale) ** 2 * np.eye(2)
    out = np.empty((len(w), len(edges), 2, 2))
    for k, end in enumerate(edges):
        # Vector by which the position shifts per radian of yaw in each step.
        lever = turned_left(point[:, [k]] - predicted[:, 1 : end + 1, :2])
        axes, steps = np.stack((along[:, :end], across[:, :end], lever)), far[:, :end]
        whole = np.einsum("nk,anki->nai", steps, axes)
        turn = turned_left(point[:, k] - begin)
        out[:, k] = np.einsum("na,nk,anki,ankj->nij", process, steps, axes, axes)
        out[:, k] += np.einsum("nab,nai,nbj->nij", effect, whole, whole)
        out[:, k] += variance["camera.heading"] * turn[:, :, None] * turn[:, None, :]
        out[:, k] += of_place
    return out
