"""Whitened innovations of measured poses, given the motion that kinematics predict.

The body pose g = (x, y, heading) of a run follows the predicted motion, with an effect of the run
and with process noise, and the pose sensor measures some of its coordinates:

    g_(k+1) = g_k * (D_k + e d_k + noise),   z_k = h(g_k) + noise,   h(g) = g * (p, psi)

with D_k the predicted motion from pose k to pose k + 1, d_k its length, e the run's constant errors
along and across the direction of travel and in yaw per distance, p the place of the sensor on the
body and psi its yaw. The variance of the noise grows with d_k. An extended Kalman filter turns the
measurements into innovations. Divided by their standard deviations they are independent, so that
the sum of their squares is that of the likelihood of all poses of the run. Poses may lack
coordinates: positions without headings (GPS), headings without positions (compass), or poses only
at the ends of a run. The start of every run is free.

Source: innovations form of the likelihood, Schweppe 1965, IEEE Transactions on Information Theory.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.data.runs import Runs
from slipid.data.wheel_signals import interpolate, refresh_period
from slipid.model.kinematics import Steering, rolled
from slipid.support.errors import DataError

POSE_PERIOD_S, LONGEST_PERIOD_S, REFRESHES = 0.2, 1.0, 4
"""Shortest time between two poses that are used [s]. It is longer, but at most the second number,
where wheel turns are integrals of speeds that are read less often than rows are logged: this number
of their refresh periods. Between two readings the turns are not known."""
LONGEST_GAP_S = 0.8
"""Time between poses above which rows without a pose are added, so that the motion between them is
computed in short steps [s]."""
MOST_POSES, LEAST_POSES, ALL_POSES = 300, 20, 12_000
"""Largest number of poses of a run that are used, number to which it is reduced if there are many
runs, and number of poses of all runs at which the reduction begins."""
SUBSTEP_S, MOST_SUBSTEPS = 0.05, 4
"""Length of the steps in which the motion between two poses is computed [s], and the largest number
of such steps."""
LAG_STEP_S = 0.005
"""Half the step of the derivative of wheel turns with respect to the lag [s]."""
UNKNOWN_HEADING_STD = 0.5
"""Std of the start heading of a run without headings, which is found by aligning paths [rad]."""
UNKNOWN_PLACE_STD = 1e3
"""Std of the start position of a run without positions [m]."""


class PoseTracks(NamedTuple):
    """Poses of runs, and the wheel turns between them, in arrays that are filled up with nan.

    Arrays have a few common sizes, so that few are compiled for; runs that fill them have no pose.

    Attributes:
        run: index of the run of each track; tracks that only fill the arrays come last and have
            none.
        pose: logged poses [m, m, rad]; nan where a coordinate is unknown.
        turn: wheel turns in the steps between poses at the lag `lag` [rad]; a robot that steers has
            two more columns (see `slipid.model.kinematics.rolled`).
        turn_slope: their derivative with respect to the lag [rad/s].
        far: distance between poses, with which errors of the motion grow [m].
        lag: lag of the poses for which the turns were computed [s].
    """

    run: Int[np.ndarray, " run"]
    pose: Float[np.ndarray, "track pose 3"]
    turn: Float[np.ndarray, "track gap step column"]
    turn_slope: Float[np.ndarray, "track gap step column"]
    far: Float[np.ndarray, "track gap"]
    lag: float

    def subset(self, tracks: Int[np.ndarray, " some"]) -> "PoseTracks":
        """Return some of the tracks."""
        fill = _size(len(tracks)) - len(tracks)
        rows = np.concatenate([tracks, np.full(fill, tracks[0])])
        pose = self.pose[rows]
        pose[len(tracks) :] = np.nan
        turn, slope, far = self.turn[rows], self.turn_slope[rows], self.far[rows]
        return PoseTracks(self.run[tracks], pose, turn, slope, far, self.lag)


def pose_tracks(
    data: Runs,
    lag: float,
    nominal: Float[np.ndarray, "3 drive"],
    arm: float,
    steering: Steering | None = None,
    runs: Int[np.ndarray, " some"] | None = None,
) -> PoseTracks:
    """Return the poses of runs whose true times, earlier by `lag` [s], have wheel angles.

    Args:
        data: the runs.
        lag: lag of the poses behind the wheels [s].
        nominal: matrix from wheel turns [rad] to body increments by which distances are computed.
        arm: distance that a yaw of 1 rad counts as [m].
        steering: numbers of a robot that steers by which distances are computed; else None.
        runs: indices of the runs, None for all.

    Raises:
        DataError: no run has two such poses.
    """
    every = range(len(data)) if runs is None else runs.tolist()
    most = int(np.clip(ALL_POSES // len(every), LEAST_POSES, MOST_POSES))
    period = _pose_period(data)
    picked = {k: _picked(data, k, lag, most, period) for k in every}
    rows = {k: _without_gaps(data, k, some, most) for k, some in picked.items()}
    kept = [k for k, some in picked.items() if len(some) > 1]
    if not kept:
        raise DataError(
            f"{data.logs[0].name}: no two different poses during the record of the wheels, in "
            "this run and in all others; expected runs in which the robot drives and has poses"
        )
    count, tracks = _size(max(len(rows[k]) for k in kept) - 1), _size(len(kept))
    time = np.zeros((tracks, count + 1))
    pose = np.full((tracks, count + 1, 3), np.nan)
    for n, k in enumerate(kept):
        size = len(rows[k])
        time[n, :size] = data.time[data.rows(k)][rows[k]]
        time[n, size:] = time[n, size - 1]
        posed = np.isin(rows[k], picked[k])
        pose[n, :size][posed] = data.pose[data.rows(k)][picked[k]]
    between = np.diff(time, axis=1)
    steps = _size(int(np.clip(np.median(between[between > 0]) / SUBSTEP_S, 1, MOST_SUBSTEPS)))
    part = np.arange(steps) / steps
    at = (time[:, :-1, None] + between[..., None] * part).reshape(tracks, -1)
    at = np.concatenate([at, time[:, -1:]], axis=1)

    columns = [data.wheel_angle[data.rows(k)] if steering is None else data.turned(k) for k in kept]

    def turned(lag: float) -> np.ndarray:
        out = np.zeros((tracks, count, steps, columns[0].shape[1]))
        for n, k in enumerate(kept):
            angle = interpolate(data.time[data.rows(k)], columns[n], at[n] - lag)
            out[n] = np.diff(angle, axis=0).reshape(out[n].shape)
        return out

    turn = turned(lag)
    slope = (turned(lag + LAG_STEP_S) - turned(lag - LAG_STEP_S)) / (2 * LAG_STEP_S)
    step = rolled(nominal, turn, steering).sum(axis=2)
    far = np.hypot(step[..., 0], step[..., 1]) + arm * np.abs(step[..., 2])
    return PoseTracks(np.array(kept), pose, turn, slope, far, lag)


def _size(count: int) -> int:
    """Return the power of two that is at least `count`."""
    return 1 << max(count - 1, 0).bit_length()


def _pose_period(data: Runs) -> float:
    """Return the shortest time between two poses that are used [s]."""
    speeds = [
        (log.time, log.wheel_speed[:, 0])
        for log in data.logs
        if log.wheel_speed is not None and log.wheel_reading.channel.endswith("speed")
    ]
    refreshed = refresh_period(speeds) or 0.0
    return float(np.clip(REFRESHES * refreshed, POSE_PERIOD_S, LONGEST_PERIOD_S))


def _picked(data: Runs, run: int, lag: float, most: int, period: float) -> Int[np.ndarray, " pose"]:
    """Return the rows of a run whose poses are used: at most `most`, every `period` [s] or so."""
    rows = data.rows(run)
    time, fresh = data.time[rows], np.flatnonzero(data.fresh[rows])
    fresh = fresh[np.isfinite(data.pose[rows][fresh]).any(axis=1)]
    if len(fresh) < 3:
        return fresh  # poses of a robot at rest, before and after its run
    true_time = time[fresh] - lag
    fresh = fresh[(true_time >= time[0] - 1e-9) & (true_time <= time[-1] + 1e-9)]
    if len(fresh) < 3:
        return fresh
    t = time[fresh]
    count = int(min(np.floor((t[-1] - t[0]) / period) + 1, most))
    at = np.searchsorted(t, np.linspace(t[0], t[-1], max(count, 2)) - 1e-9)
    return fresh[np.unique(at.clip(0, len(t) - 1))]


def _without_gaps(
    data: Runs, run: int, picked: Int[np.ndarray, " pose"], most: int
) -> Int[np.ndarray, " row"]:
    """Return picked rows of a run, with further rows where they are far apart in time."""
    time = data.time[data.rows(run)]
    t = time[picked]
    if len(t) < 2:
        return picked
    longest = max(LONGEST_GAP_S, (t[-1] - t[0]) / most)
    counts = np.ceil(np.diff(t) / longest - 1e-6).astype(int)
    between = [
        np.linspace(*ends, count, endpoint=False)[1:]
        for ends, count in zip(pairwise(t), counts, strict=True)
    ]
    added = np.searchsorted(time, np.concatenate(between)).clip(0, len(time) - 1)
    return np.union1d(picked, added)


class Motion(NamedTuple):
    """Numbers by which poses of a run are predicted; with a leading axis for several tracks.

    Attributes:
        matrix: matrix from wheel turns [rad] to body increments [m, m, rad].
        place: place of the pose sensor ahead and to the left of the body's origin [m].
        yaw: heading of the sensor less that of the body [rad].
        scale: true over logged length [1].
        lag: lag of the poses less the lag of the tracks [s].
        steering: numbers of a robot that steers; else None.
    """

    matrix: Any
    place: Any
    yaw: Any
    scale: Any
    lag: Any
    steering: Steering | None = None


class Innovations(NamedTuple):
    """Whitened innovations, zero where nothing was measured, and their log variances.

    Attributes:
        white: innovations divided by their stds [1].
        log_variance: sum of the logarithms of their variances over each run.
    """

    white: Float[Array, "track gap 3"]
    log_variance: Float[Array, " track"]


def moved(
    matrix: Float[Array, "3 drive"],
    turn: Float[Array, "gap step column"],
    steering: Steering | None,
) -> Float[Array, "gap 3"]:
    """Return the motion of the body between poses, relative to its pose before [m, m, rad].

    Each step is an arc.
    """
    step = rolled(matrix, turn, steering)
    yaw = jnp.cumsum(step[..., 2], axis=-1)
    middle, chord = yaw - 0.5 * step[..., 2], jnp.sinc(step[..., 2] / (2 * jnp.pi))
    c, s = jnp.cos(middle) * chord, jnp.sin(middle) * chord
    x = (c * step[..., 0] - s * step[..., 1]).sum(axis=-1)
    y = (s * step[..., 0] + c * step[..., 1]).sum(axis=-1)
    return jnp.stack([x, y, yaw[..., -1]], axis=-1)


def _innovations(
    numbers: Motion, reference: Motion, log_noise: Any, track: tuple[Any, ...]
) -> Innovations:
    """Return the innovations of one track; the filter's gains are those along `reference`.

    `log_noise` are the logarithms of the variances of positions [m^2], headings [rad^2], of process
    noise along, across and in yaw per distance, and of effects along, across and in yaw.
    """
    pose, turn, slope, far, start_heading = track
    known = jnp.isfinite(pose)
    z = jnp.where(known, pose, 0.0)
    noise = jnp.exp(log_noise)
    measured = jnp.stack([noise[0], noise[0], noise[1]])

    def start(n: Motion) -> tuple[Array, Array]:
        """Return the state (pose, effect) at the first pose, and the place's offset."""
        heading = jnp.where(known[0, 2], z[0, 2], start_heading) - n.yaw
        offset = _rotated(heading, n.place)
        place = jnp.where(known[0, :2].all(), n.scale * z[0, :2], 0.0) - offset
        return jnp.concatenate([place, heading[None], jnp.zeros(3)]), offset

    def steps(n: Motion) -> Array:
        return moved(n.matrix, turn + n.lag * slope, n.steering)

    state, _ = start(numbers)
    at, offset = start(reference)
    lever = jnp.stack([offset[1], -offset[0], jnp.ones(()), *jnp.zeros((3,))])
    turn_var = jnp.where(known[0, 2], noise[1], UNKNOWN_HEADING_STD**2)
    place_var = jnp.where(known[0, :2].all(), reference.scale**2 * noise[0], UNKNOWN_PLACE_STD**2)
    cov = turn_var * jnp.outer(lever, lever) + jnp.diag(
        jnp.concatenate([place_var[None], place_var[None], jnp.zeros(1), noise[5:8]])
    )

    def gap(n: Motion, state: Array, z: Array) -> Array:
        place = (state[:2] + _rotated(state[2], n.place)) / n.scale
        return jnp.concatenate([z[:2] - place, (z[2] - state[2] - n.yaw)[None]])

    def one(carry: tuple, row: tuple) -> tuple:
        state, at, cov = carry
        step, at_step, z, known, far = row
        f, q = _slope(at, at_step, far, noise[2:5])
        state, at = _advanced(state, step, far), _advanced(at, at_step, far)
        cov = f @ cov @ f.T + q
        off, off_at = gap(numbers, state, z), gap(reference, at, z)
        ox, oy = _rotated(at[2], reference.place)
        s = 1 / reference.scale
        h = jnp.array([[s, 0, -oy * s, 0, 0, 0], [0, s, ox * s, 0, 0, 0], [0, 0, 1, 0, 0, 0]])
        change, change_at, white, log = jnp.zeros(6), jnp.zeros(6), [], jnp.zeros(())
        for axis in range(3):
            seen, ph = known[axis], cov @ h[axis]
            variance = jnp.where(seen, h[axis] @ ph + measured[axis], 1.0)
            std = jnp.sqrt(variance)
            gain = jnp.where(seen, ph / std, 0.0)
            w = jnp.where(seen, off[axis] - h[axis] @ change, 0.0) / std
            w_at = jnp.where(seen, off_at[axis] - h[axis] @ change_at, 0.0) / std
            change, change_at = change + gain * w, change_at + gain * w_at
            cov = cov - jnp.outer(gain, gain)
            white.append(w)
            log += jnp.log(variance)
        return (state + change, at + change_at, cov), (jnp.stack(white), log)

    rows = steps(numbers), steps(reference), z[1:], known[1:], far
    _, (white, log) = jax.lax.scan(one, (state, at, cov), rows)
    return Innovations(white, log.sum())


def _rotated(angle: Array, v: Array) -> Array:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def _travel(step: Array) -> Array:
    """Return the direction of travel in the frame of the pose before; ahead for turns on the spot.

    It counts as known, without a derivative.
    """
    step = jax.lax.stop_gradient(step)
    length = jnp.sqrt(step[0] ** 2 + step[1] ** 2)
    still = length < 1e-9
    return jnp.where(still, jnp.array([1.0, 0.0]), step[:2] / jnp.where(still, 1.0, length))


def _advanced(state: Array, step: Array, far: Array) -> Array:
    """Return the state after a predicted motion and the run's effect on it."""
    x, y = _travel(step)
    along, across, yaw = far * state[3:]
    effect = jnp.stack([x * along - y * across, y * along + x * across])
    place = state[:2] + _rotated(state[2], step[:2] + effect)
    return jnp.concatenate([place, (state[2] + step[2] + yaw)[None], state[3:]])


def _slope(at: Array, step: Array, far: Array, process: Array) -> tuple[Array, Array]:
    """Return the derivative of `_advanced` with respect to the state, and the process noise."""
    x, y = far * _rotated(at[2], _travel(step))
    dx, dy = _advanced(at, step, far)[:2] - at[:2]
    rows = [
        [1.0, 0.0, -dy, x, -y, 0.0],
        [0.0, 1.0, dx, y, x, 0.0],
        [0.0, 0.0, 1.0, 0.0, 0.0, far],
    ]
    slope = jnp.concatenate([jnp.array(rows), jnp.eye(6)[3:]])
    along, across, yaw = process / jnp.maximum(far, 1e-12)
    square = [
        [x * x * along + y * y * across, x * y * (along - across), 0.0],
        [x * y * (along - across), y * y * along + x * x * across, 0.0],
        [0.0, 0.0, yaw * far**2],
    ]
    return slope, jnp.pad(jnp.array(square), (0, 3))


Tracks = tuple[Array | np.ndarray, ...]
"""Poses, turns, their slopes, distances and start headings of all tracks."""


@jax.jit
def innovations(
    numbers: Motion, reference: Motion, log_noise: Array | np.ndarray, tracks: Tracks
) -> Innovations:
    """Return the innovations of all tracks, with filter gains along the path of `reference`.

    `log_noise` (track, 8) are the logarithms of the variances of positions [m^2] and headings
    [rad^2], of process noise along, across and in yaw per distance, and of a run's effects along,
    across and in yaw per distance.
    """
    return jax.vmap(_innovations)(numbers, reference, log_noise, tracks)


@jax.jit
def linear_innovations(
    numbers: Motion, log_noise: Array | np.ndarray, tracks: Tracks
) -> tuple[Float[Array, "track gap 3"], Motion]:
    """Return the whitened innovations of all tracks and their derivative with respect to `numbers`.

    The derivative has the form of `numbers`, with leading axes (track, gap, 3).
    """

    def one(numbers: Motion, log_noise: Array, track: Tracks) -> tuple[Array, Motion]:
        def white(n: Motion) -> tuple[Array, Array]:
            return (_innovations(n, numbers, log_noise, track).white,) * 2

        slope, value = jax.jacfwd(white, has_aux=True)(numbers)
        return value, slope

    return jax.vmap(one)(numbers, jnp.asarray(log_noise), tracks)


@jax.jit
def loss_of_noise(
    numbers: Motion, log_noise: Array | np.ndarray, tracks: Tracks
) -> tuple[Float[Array, " track"], Float[Array, "track 8"]]:
    """Return minus twice the log likelihood of every track, and its derivative.

    The derivative is with respect to `log_noise`.
    """

    def one(log_noise: Array, numbers: Motion, track: Tracks) -> tuple[Array, Array]:
        def loss(v: Array) -> tuple[Array, Array]:
            at = _innovations(numbers, numbers, v, track)
            return ((at.white**2).sum() + at.log_variance,) * 2

        slope, value = jax.jacfwd(loss, has_aux=True)(log_noise)
        return value, slope

    return jax.vmap(one)(jnp.asarray(log_noise), numbers, tracks)


@jax.jit
def start_headings(
    matrix: Float[Array, "track 3 drive"],
    pose: Float[Array, "track pose 3"],
    turn: Float[Array, "track gap step column"],
    steering: Steering | None = None,
) -> Float[Array, " track"]:
    """Return the body's heading at the start of every track that aligns its path with its poses.

    Predicted and measured positions are aligned by a rotation and a translation (Procrustes). With
    fewer than two positions, the result is zero.
    """

    def one(matrix: Array, pose: Array, turn: Array, steering: Steering | None) -> Array:
        motion = moved(matrix, turn, steering)
        yaw = jnp.concatenate([jnp.zeros(1), jnp.cumsum(motion[:, 2])])
        step = (motion[:, 0] + 1j * motion[:, 1]) * jnp.exp(1j * yaw[:-1])
        path = jnp.concatenate([jnp.zeros(1), jnp.cumsum(step)])
        seen = jnp.isfinite(pose[:, :2]).all(axis=1)
        place = jnp.where(seen, pose[:, 0] + 1j * pose[:, 1], 0.0)
        count = jnp.maximum(seen.sum(), 1)
        path = jnp.where(seen, path - (path * seen).sum() / count, 0.0)
        place = jnp.where(seen, place - place.sum() / count, 0.0)
        return jnp.angle((place * path.conj()).sum())

    return jax.vmap(one)(matrix, pose, turn, steering)


@jax.jit
def sensor_yaw(
    matrix: Float[Array, "track 3 drive"],
    pose: Float[Array, "track pose 3"],
    turn: Float[Array, "track gap step column"],
    steering: Steering | None = None,
) -> Float[Array, ""]:
    """Return the heading of the pose sensor less that of the body, from directions of travel."""
    motion = jax.vmap(moved)(matrix, turn, steering)
    seen = jnp.diff(pose[..., 0] + 1j * pose[..., 1], axis=1) * jnp.exp(-1j * pose[:, :-1, 2])
    return -jnp.angle(jnp.nansum(seen * (motion[..., 0] - 1j * motion[..., 1])))
