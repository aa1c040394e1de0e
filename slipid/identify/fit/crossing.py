"""Runs over several floors in short windows, each wheel on one floor: residuals, their scatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from slipid.data.floor_map import FloorMap
from slipid.data.runs import Runs
from slipid.data.windows import Windows, windows
from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.noise import travel
from slipid.identify.fit.variances import DEGREES
from slipid.model.robot import Robot
from slipid.search_space import Space
from slipid.support.errors import DataError

WINDOW = 0.25
"""Length of a window [s]: short against the time a wheel stays on a patch."""
LEAST_SPEED = 0.04
"""Speed of the fastest rim below which a window says nothing [m/s]."""
MOST_ACCELERATION = 0.6
"""Of a rim: beyond it the balance of forces is not that of rest [m/s^2]."""
TOGETHER = 256
"""Windows whose residuals are found in one call."""
CHANNELS = ("along", "across", "yaw")
"""The first columns of the residuals; those after them are currents of wheels."""


@dataclass(frozen=True, eq=False)
class Crossing:
    """Windows of runs over several floors, one per piece; runs are (name, sha256).

    The floor is that under each wheel all the while, by number in the robot's stack, the place a
    window's number in its run, gaps counted.
    """

    windows: Windows
    floor: Int[np.ndarray, "piece wheel"]
    place: Int[np.ndarray, " piece"]
    runs: tuple[tuple[str, str], ...]

    def of(self, picked: Bool[np.ndarray, " piece"]) -> "Crossing":
        windows = self.windows.pieces(np.flatnonzero(picked))
        return Crossing(windows, self.floor[picked], self.place[picked], self.runs)


def crossing(data: Runs, floor: FloorMap, robot: Robot) -> Crossing:
    """Windows of runs whose poses are in the frame of a map, in which no wheel changes floors.

    Where wheels stand is read through the camera of the fitted robot, which knows every surface of
    the map and every load of the runs.
    """
    radius, lag = float(robot.geometry.wheel_radius), float(robot.camera.lag)
    w = windows(data, radius, lag, per_piece=1, longest=WINDOW)
    number = np.array([robot.surface_index(name) for name in floor.surfaces])
    under = number[floor.at(wheel_places(robot, w))]
    found = Crossing(
        windows=w,
        floor=under[:, 1],
        place=np.arange(len(w)) - np.searchsorted(w.run, w.run),
        runs=tuple((log.name, log.sha256) for log in data.logs),
    )
    stays = (under == under[:, 1:2]).all(axis=(1, 2))
    found = found.of(stays & _steady(w, radius))
    if not len(found.windows):
        raise DataError(
            f"{data.logs[0].name} and the other runs over several floors: no {WINDOW:g} s in which "
            "wheels turn evenly and each keeps to its floor; expected larger patches or slower runs"
        )
    return found


def wheel_places(robot: Robot, w: Windows) -> Float[np.ndarray, "piece time wheel 2"]:
    """Wheel centres at start, middle and end of one window per piece [m], by the camera."""
    edges = np.asarray(jax.vmap(jax.vmap(robot.camera.corrected))(jnp.asarray(w.pose)))
    pose = np.stack([edges[:, 0], edges.mean(axis=1), edges[:, 1]], axis=1)
    yaw = np.array([float(robot.camera.yaw(robot.session_index(s))) for s in w.session])
    heading = pose[..., 2] - yaw[:, None]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([c, -s, s, c], -1).reshape(*c.shape, 2, 2)
    place = np.asarray(robot.geometry.place) * float(robot.geometry.base_radius)
    from_marker = place - np.asarray(robot.camera.marker_place)
    return np.asarray(pose[..., None, :2] + np.einsum("ntij,wj->ntwi", turn, from_marker))


def _steady(w: Windows, radius: float) -> Bool[np.ndarray, " piece"]:
    """Windows in which wheels turn, about evenly, and no camera frames are missing."""
    rim, jump = radius * w.turn[:, 0] / w.dt, radius * w.faster[:, 0] / w.dt
    moves = np.abs(rim).max(axis=1) >= LEAST_SPEED
    even = np.abs(jump).max(axis=1) <= MOST_ACCELERATION
    return np.asarray(moves & even & (w.dt[:, 0] < 2 * WINDOW))


@dataclass(frozen=True, eq=False)
class Pieces:
    """Where windows come from: run, place in it, and whether its currents were logged."""

    run: Int[np.ndarray, " window"]
    place: Int[np.ndarray, " window"]
    has_current: Bool[np.ndarray, " window"]


class Evidence:
    """Residuals of all windows, and how they scatter.

    Rows are windows, columns along, across [m/s], yaw [rad/s] and the current of each wheel [A];
    a set without currents has none there.
    """

    def __init__(self, space: Space, sets: Sequence[Crossing]):
        self.space, self.sets = space, sets
        first = np.cumsum([0, *(len(s.runs) for s in sets)])
        has = [np.full(len(s.windows), s.windows.has_current) for s in sets]
        self.pieces = Pieces(
            run=np.concatenate([s.windows.run + k for s, k in zip(sets, first, strict=False)]),
            place=np.concatenate([s.place for s in sets]),
            has_current=np.concatenate(has),
        )
        self.chunks = [chunk for s in sets for chunk in _chunks(s, space.template)]

    def linear(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (window, channel) and their slope by the search vector (.., free)."""
        parts = [_linear(self.space, jnp.asarray(z), b, u) for b, u, _ in self.chunks]
        return self._joined(0, parts), self._joined(1, parts)

    def residual(self, z: np.ndarray) -> np.ndarray:
        parts = [(_residual(self.space, jnp.asarray(z), b, u),) for b, u, _ in self.chunks]
        return self._joined(0, parts)

    def _joined(self, k: int, parts: Sequence[Sequence[Array]]) -> np.ndarray:
        kept = [np.asarray(p[k])[:count] for p, (*_, count) in zip(parts, self.chunks, strict=True)]
        return np.concatenate(kept)


def _chunks(s: Crossing, robot: Robot) -> list[tuple[lk.Batch, Array, int]]:
    """Batches of one size, with directions of travel and how many of their windows count."""
    out = []
    for first in range(0, len(s.windows), TOGETHER):
        some = np.minimum(np.arange(first, first + TOGETHER), len(s.windows) - 1)
        w, count = s.windows.pieces(some), min(TOGETHER, len(s.windows) - first)
        u = jnp.asarray(travel(w, robot)[1][:, 0])
        out.append((lk.batch(w, robot, s.floor[some]), u, count))
    return out


@eqx.filter_jit
def _residual(space: Space, z: Array, b: lk.Batch, u: Array) -> Float[Array, "piece channel"]:
    """Predicted less measured speeds along and across the way, yaw rates and currents."""
    robot = space.tree(z)
    p = lk.predict(robot, b)
    rate = lk.motion_residual(robot, b, p) / b.dt
    along = u[:, 0] * rate[:, 0] + u[:, 1] * rate[:, 1]
    across = u[:, 0] * rate[:, 1] - u[:, 1] * rate[:, 0]
    amps = jnp.zeros_like(b.current)
    if b.has_current:
        amps = lk.predicted_current(robot, b, p.felt) - b.current
    return jnp.concatenate([jnp.stack([along, across, rate[:, 2]], axis=1), amps[:, 0]], axis=1)


@eqx.filter_jit
def _linear(space: Space, z: Array, b: lk.Batch, u: Array) -> tuple[Array, Array]:
    return lk.with_slope(lambda x: _residual(space, x, b, u), z)


@dataclass(frozen=True, eq=False)
class Scatter:
    """How residuals scatter: what each counts for.

    The weight is the t weight of a residual's block, 0 where nothing was measured, `expected` its
    mean where the scatter is as found. Variances are of columns, wheels alike; the factor is
    windows over the number they are worth.
    """

    weight: Float[np.ndarray, "window channel"]
    expected: Float[np.ndarray, "window channel"]
    variance: Float[np.ndarray, " channel"]
    factor: Float[np.ndarray, " channel"]

    def counted(self, weight: np.ndarray) -> np.ndarray:
        return np.asarray(weight / (self.variance * self.factor))


def scatter(r: np.ndarray, of: Pieces, factor: np.ndarray | None) -> Scatter:
    """Variances and weights of residuals in turn, from their mean squares, then correlation.

    A factor that is given is kept: which lags count changes by jumps, and steps would not settle.
    """
    motion = np.arange(r.shape[1]) < len(CHANNELS)
    counts = np.where(motion, 1.0, of.has_current[:, None])
    weight, expected = counts.copy(), counts.copy()
    for _ in range(5):
        variance = _pooled(weight * r**2, counts)
        for block in (motion, ~motion):
            m = int(block.sum())
            q = (r[:, block] ** 2 / variance[block]).sum(axis=1)
            t = (DEGREES + m) / (DEGREES + q)
            weight[:, block] = counts[:, block] * t[:, None]
            expected[:, block] = counts[:, block] * (DEGREES + m) / (DEGREES + m + 2)
    scaled = np.where(counts > 0, np.sqrt(weight) * r / np.sqrt(variance), np.nan)
    if factor is not None:
        return Scatter(weight, expected, variance, factor)
    # what a motor's current is off all run long is the motor's: no floor is known better without it
    scaled[:, ~motion] -= _mean_of_runs(scaled[:, ~motion], of.run)
    factor = np.array([_dilution(column, of.run, of.place) for column in scaled.T])
    factor[~motion] = factor[~motion].max(initial=1.0)
    return Scatter(weight, expected, variance, factor)


def _mean_of_runs(x: np.ndarray, run: np.ndarray) -> Float[np.ndarray, "window channel"]:
    """Mean of every column over the run a window is of; nan counts for nothing."""
    there = np.isfinite(x)
    total, count = np.zeros((2, run.max() + 1, x.shape[1]))
    np.add.at(total, run, np.where(there, x, 0.0))
    np.add.at(count, run, there.astype(float))
    return np.asarray((total / np.maximum(count, 1.0))[run])


def _pooled(square: np.ndarray, counts: np.ndarray) -> Float[np.ndarray, " channel"]:
    """Mean squares of the columns; wheels share that of their currents."""
    total, number = square.sum(axis=0), counts.sum(axis=0)
    k = len(CHANNELS)
    total[k:], number[k:] = total[k:].sum(), number[k:].sum()
    return np.asarray(np.maximum(total / np.maximum(number, 1.0), 1e-12))


def _dilution(x: np.ndarray, run: np.ndarray, place: np.ndarray) -> float:
    """Windows over the number of independent ones that tell as much; at least 1.

    1 + 2 sum of the correlations over lags within runs, in pairs of lags while these are positive
    (Geyer 1992, Stat. Sci. 7, section 3.3). Residuals x, nan where nothing was measured, are taken
    about zero: of motion, what a whole run has in common counts as correlation.
    """
    grid = np.full((run.max() + 1, place.max() + 2), np.nan)
    grid[run, place] = x
    if not np.isfinite(grid).any():
        return 1.0
    power, longest = np.nanmean(grid**2), grid.shape[1]

    def correlation(lag: int) -> float:
        pairs = grid[:, lag:] * grid[:, : longest - lag]
        share = np.isfinite(pairs).sum() / np.isfinite(grid).sum()  # few pairs say little
        return float(np.nanmean(pairs) / power * share) if share > 0 else 0.0

    total = -1.0
    for lag in range(0, longest - 1, 2):
        pair = correlation(lag) + correlation(lag + 1)
        if pair <= 0:
            break
        total += 2 * pair
    return max(1.0, total)
