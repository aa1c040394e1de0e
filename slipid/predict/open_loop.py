"""Open loop: from the first pose on, where does a model say the robot went, and how sure is it?

Everything is in the corrected metres of the fitted camera; the measured pose is used once, at the
start.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.runs import Runs
from slipid.data.windows import Windows, windows
from slipid.fit import likelihood as lk
from slipid.fit.noise import travel
from slipid.fit.session_effects import by_axis
from slipid.model.robot import Robot
from slipid.model.se2 import compose
from slipid.predict.slip_model import turned, turned_left
from slipid.search_space import Space

STEP = 0.5
"""Longest step of a replay [s]."""
Numbers = Array | np.ndarray
TOGETHER = 32
"""Runs replayed in one call."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Paths of runs cut into the same number of steps: marker poses in corrected metres."""

    run: np.ndarray
    predicted: Float[np.ndarray, "run edge 3"]
    measured: Float[np.ndarray, "run edge 3"]

    @property
    def gap(self) -> Float[np.ndarray, "run 3"]:
        """Predicted less measured end pose."""
        return self.predicted[:, -1] - self.measured[:, -1]


def replay_windows(data: Runs, robot: Robot) -> list[Windows]:
    """The runs, each as one piece of short steps, `TOGETHER` at a time.

    Numbers of steps are powers of two, so that few shapes are compiled.
    """
    steps = []
    for k, log in enumerate(data.logs):
        want = 2 ** int(np.ceil(np.log2(max(log.duration / STEP, 16))))
        frames = int(data.fresh[data.rows(k)].sum())
        while want > 1 and want > frames // 3:
            want //= 2
        steps.append(want)
    return whole_runs(data, robot, steps)


def whole_runs(data: Runs, robot: Robot, steps: Sequence[int]) -> list[Windows]:
    """The runs, each as one piece of so many steps, `TOGETHER` of as many steps at a time.

    The last runs of a group are repeated to fill it up, so that few shapes are compiled.
    """
    radius, lag = float(robot.geometry.wheel_radius), float(robot.camera.lag)
    out = []
    for count in sorted(set(steps)):
        runs = np.flatnonzero(np.asarray(steps) == count)
        for first in range(0, len(runs), TOGETHER):
            some = runs[first : first + TOGETHER]
            w = windows(data.subset(some), radius, lag, per_segment=count, longest=np.inf)
            filled = np.minimum(np.arange(TOGETHER), len(w) - 1)
            out.append(replace(w, run=some[w.run]).segments(filled))
    return out


@jax.jit
def contact_increments(robot: Robot, b: lk.Batch) -> Float[Array, "piece window 3"]:
    """Marker increments of the contact equilibrium."""
    return lk.predict(robot, b).increment


@jax.jit
def corrected(robot: Robot, pose: Float[Array, "piece edge 3"]) -> Float[Array, "piece edge 3"]:
    """Logged poses in corrected metres."""
    return jax.vmap(jax.vmap(robot.camera.corrected))(pose)


@jax.jit
def chain(start: Float[Array, "piece 3"], step: Float[Array, "piece window 3"]) -> Array:
    """Poses from a start pose and body-frame increments (piece, window + 1, 3)."""

    def one(p: Array, steps: Array) -> Array:
        _, poses = jax.lax.scan(lambda q, d: (compose(q, d),) * 2, p, steps)
        return jnp.concatenate([p[None], poses])

    return jax.vmap(one)(start, step)


def tracks_from_increments(
    robot: Robot, w: Windows, increment: Float[np.ndarray, "piece window 3"]
) -> Tracks:
    """Tracks of a model that gives marker increments."""
    pose = np.asarray(corrected(robot, jnp.asarray(w.pose)))
    path = np.asarray(chain(jnp.asarray(pose[:, 0]), jnp.asarray(increment)))
    return Tracks(w.run, path, pose)


class IncrementCorrection(eqx.Module):
    """What is taken off predicted increments, and its slope by the search vector."""

    moved: Float[Array, "piece window 3"]
    by_number: Float[Array, "piece window 3 free"]


@eqx.filter_jit
def end_jacobian(
    space: Space,
    z: Numbers,
    b: lk.Batch,
    start: Numbers,
    twist: Numbers | None = None,
    corrected: IncrementCorrection | None = None,
) -> Float[Array, "piece 2 free"]:
    """Slope of the ends by the search vector, from given start poses.

    Of the contact equilibrium with its correction, or where the body's twists are given
    (piece, window, 3).
    """

    def end(x: Array) -> Array:
        robot = space.tree(x)
        if twist is None:
            step = contact_increments(robot, b)
            if corrected is not None:
                step -= corrected.moved + corrected.by_number @ (x - jnp.asarray(z))
            return chain(start, step)[:, -1, :2]
        return chain(start, lk.marker_increments(robot, jnp.asarray(twist), b.dt, b.session))[
            :, -1, :2
        ]

    return jax.jacfwd(end)(z)


def end_covariance(
    robot: Robot,
    w: Windows,
    tracks: Tracks,
    variance: Mapping[str, float],
    shared: Float[np.ndarray, "piece 3 3"],
    of_parameters: Float[np.ndarray, "piece 2 2"],
) -> Float[np.ndarray, "piece 2 2"]:
    """Covariance of the gap between predicted and measured end [m^2], scale matrix of a Student t.

    Process noise, the run's own effect and what it shares with others, camera noise at both ends
    and in the start heading, and the parameters' uncertainty, each carried to the end along the
    predicted path.
    """
    far, u = travel(w, robot)
    p = tracks.predicted
    cov = of_parameters.copy()
    lever = turned_left(p[:, -1:, :2] - p[:, 1:, :2])  # what a turn at each step moves
    way = p[:, :-1, 2]
    along, across = turned(way, u), turned(way, turned_left(u))
    process, run = (by_axis(variance, k, w) for k in ("process", "run"))
    axes = np.stack((along, across, lever))
    cov += np.einsum("na,nk,anki,ankj->nij", process, far, axes, axes)
    whole = np.einsum("nk,anki->nai", far, axes)
    effect = shared + run[:, :, None] * np.eye(len(axes))
    cov += np.einsum("nab,nai,nbj->nij", effect, whole, whole)
    turn = turned_left(p[:, -1, :2] - p[:, 0, :2])
    cov += variance["camera.heading"] * turn[:, :, None] * turn[:, None, :]
    cov += 2 * variance["camera.place"] * float(robot.camera.scale) ** 2 * np.eye(2)
    return cov
