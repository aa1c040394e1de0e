"""Whitened innovations of measured poses, given the motion that kinematics predict.

The body pose g = (x, y, heading) of a run follows the predicted motion, with process noise that
grows with the distance, and the pose sensor measures some of its coordinates:

    g_(k+1) = g_k * D_k * noise,   z_k = h(g_k) + noise,   h(g) = g * (p, psi)

with D_k the predicted motion from pose k to pose k + 1, p the place of the sensor on the body and
psi its yaw. An extended Kalman filter turns the measurements into innovations. Divided by their
standard deviations they are independent, so that the sum of their squares is that of the likelihood
of all poses of the run. Poses may lack coordinates: positions without headings (GPS), headings
without positions (compass), or poses only at the ends of a run. The start of every run is free.

Source: innovations form of the likelihood, Schweppe 1965, IEEE Transactions on Information Theory.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.runs import Runs
from slipid.data.wheel_signals import interpolate
from slipid.support.errors import DataError

POSE_PERIOD_S = 0.2
"""Shortest time between two poses that are used [s]."""
MOST_POSES = 300
"""Largest number of poses of a run that are used; those of longer runs are further apart."""
SUBSTEP_S, MOST_SUBSTEPS = 0.05, 12
"""Length of the steps in which the motion between two poses is computed [s], and the largest number
of such steps."""
UNKNOWN_HEADING_STD = 0.5
"""Std of the start heading of a run without headings, which is found by aligning paths [rad]."""
UNKNOWN_PLACE_STD = 1e3
"""Std of the start position of a run without positions [m]."""


@dataclass(frozen=True, eq=False)
class PoseTracks:
    """Poses of runs in arrays of equal length, and the wheel angles between them.

    Attributes:
        data: the runs.
        run: index of each track's run.
        time: times of the poses [s]; the last one is repeated to fill the array.
        pose: logged poses [m, m, rad]; nan where a coordinate is unknown or the array is filled.
        steps: number of steps in which the motion between two poses is computed.
    """

    data: Runs
    run: Int[np.ndarray, " run"]
    time: Float[np.ndarray, "run pose"]
    pose: Float[np.ndarray, "run pose 3"]
    steps: int

    @classmethod
    def of(cls, data: Runs, lag: float) -> "PoseTracks":
        """Return the poses of runs whose true times, earlier by `lag` [s], have wheel angles.

        Raises:
            DataError: no run has two such poses.
        """
        tracks = [_picked(data, k, lag) for k in range(len(data))]
        kept = [k for k, rows in enumerate(tracks) if len(rows) > 1]
        if not kept:
            raise DataError(
                f"{data.logs[0].name}: no two poses with wheel angles at the same time, in this "
                "run and in all others"
            )
        longest = max(len(tracks[k]) for k in kept)
        time = np.empty((len(kept), longest))
        pose = np.full((len(kept), longest, 3), np.nan)
        for n, k in enumerate(kept):
            rows, count = tracks[k], len(tracks[k])
            time[n, :count] = data.time[data.rows(k)][rows]
            time[n, count:] = time[n, count - 1]
            pose[n, :count] = data.pose[data.rows(k)][rows]
        between = np.diff(time, axis=1)
        usual = float(np.median(between[between > 0]))
        steps = int(np.clip(np.ceil(usual / SUBSTEP_S), 1, MOST_SUBSTEPS))
        return cls(data, np.array(kept), time, pose, steps)

    def subset(self, tracks: Int[np.ndarray, " some"]) -> "PoseTracks":
        """Return the tracks with the given indices."""
        return PoseTracks(
            self.data, self.run[tracks], self.time[tracks], self.pose[tracks], self.steps
        )

    def turned(self, lag: float) -> Float[np.ndarray, "run gap step drive"]:
        """Return the wheel turns [rad] in the steps between poses that lag by `lag` [s]."""
        part = np.arange(self.steps) / self.steps
        start, gap = self.time[:, :-1, None], np.diff(self.time, axis=1)[..., None]
        at = np.concatenate(
            [(start + gap * part).reshape(len(self.run), -1), self.time[:, -1:]], axis=1
        )
        angles = []
        for n, k in enumerate(self.run.tolist()):
            rows = self.data.rows(k)
            angle = interpolate(self.data.time[rows], self.data.wheel_angle[rows], at[n] - lag)
            angles.append(np.diff(angle, axis=0))
        shape = len(self.run), self.time.shape[1] - 1, self.steps, -1
        return np.stack(angles).reshape(shape)


def _picked(data: Runs, run: int, lag: float) -> Int[np.ndarray, " pose"]:
    """Return the rows of a run whose poses are used."""
    rows = data.rows(run)
    time, fresh = data.time[rows], np.flatnonzero(data.fresh[rows])
    fresh = fresh[np.isfinite(data.pose[rows][fresh]).any(axis=1)]
    true_time = time[fresh] - lag
    fresh = fresh[(true_time >= time[0] - 1e-9) & (true_time <= time[-1] + 1e-9)]
    if len(fresh) < 3:
        return fresh
    t = time[fresh]
    count = int(min(np.floor((t[-1] - t[0]) / POSE_PERIOD_S) + 1, MOST_POSES))
    at = np.searchsorted(t, np.linspace(t[0], t[-1], max(count, 2)) - 1e-9)
    return fresh[np.unique(at.clip(0, len(t) - 1))]


def moved(
    matrix: Float[np.ndarray, "run 3 drive"], turn: Float[np.ndarray, "run gap step drive"]
) -> Float[np.ndarray, "run gap 3"]:
    """Return the motion of the body between poses, relative to its pose before [m, m, rad].

    `matrix` maps wheel turns to body increments; each step is an arc.
    """
    step = np.einsum("rad,rgsd->rgsa", matrix, turn)
    yaw = np.cumsum(step[..., 2], axis=-1)
    middle, chord = yaw - 0.5 * step[..., 2], np.sinc(step[..., 2] / (2 * np.pi))
    c, s = np.cos(middle) * chord, np.sin(middle) * chord
    x = (c * step[..., 0] - s * step[..., 1]).sum(axis=-1)
    y = (s * step[..., 0] + c * step[..., 1]).sum(axis=-1)
    return np.stack([x, y, yaw[..., -1]], axis=-1)


class Sensor(NamedTuple):
    """The pose sensor on the body, one element for each variant and run.

    Attributes:
        place: place of the sensor ahead and to the left of the body's origin [m].
        yaw: heading of the sensor less that of the body [rad].
        scale: true over logged length [1].
    """

    place: Float[np.ndarray, "variant #run 2"]
    yaw: Float[np.ndarray, "variant #run"]
    scale: Float[np.ndarray, "variant #run"]


class Noise(NamedTuple):
    """Variances of poses and motion, one element for each variant and run.

    Attributes:
        place: variance of logged positions [m^2].
        heading: variance of logged headings [rad^2].
        process: variance of the motion along, across and in yaw per distance [m^2/m, m^2/m,
            rad^2/m].
    """

    place: Float[np.ndarray, "variant #run"]
    heading: Float[np.ndarray, "variant #run"]
    process: Float[np.ndarray, "variant #run 3"]


class Innovations(NamedTuple):
    """Whitened innovations, zero where nothing was measured, and their log variances.

    Attributes:
        white: innovations divided by their stds [1].
        log_variance: sum of the logarithms of their variances over each run.
        count: number of innovations of each run.
    """

    white: Float[np.ndarray, "variant run pose 3"]
    log_variance: Float[np.ndarray, "variant run"]
    count: Int[np.ndarray, " run"]


def innovations(
    pose: Float[np.ndarray, "run pose 3"],
    motion: Float[np.ndarray, "variant run gap 3"],
    sensor: Sensor,
    noise: Noise,
    arm: float,
    start_heading: Float[np.ndarray, " run"],
) -> Innovations:
    """Return the whitened innovations of all runs, for several variants at once.

    If noise has a single variant, the filter's gains are computed along the path of the first
    variant and used for all: then the innovations of all variants are whitened alike, and their
    differences are derivatives of the residuals.

    Args:
        pose: logged poses.
        motion: predicted motion from each pose to the next [m, m, rad].
        sensor: the pose sensor.
        noise: variances.
        arm: distance that a yaw of 1 rad counts as, for process noise [m].
        start_heading: heading of the sensor at the start of runs whose first pose has none [rad].
    """
    known = np.isfinite(pose)
    z = np.where(known, pose, 0.0)
    variants = max(motion.shape[0], noise.place.shape[0], sensor.yaw.shape[0])
    runs, count = pose.shape[:2]
    own = noise.place.shape[0]
    state, cov = _start(z[:, 0], known[:, 0], sensor, noise, start_heading, variants)
    white = np.zeros((variants, runs, count, 3))
    log_variance = np.zeros((own, runs))
    measured = np.stack([noise.place, noise.place, noise.heading])
    px, py, scale = sensor.place[..., 0], sensor.place[..., 1], sensor.scale
    for k in range(1, count):
        step = motion[:, :, k - 1]
        state, cov = _predicted(state, cov, step, noise.process, arm)
        # derivative of the sensor's position with respect to the heading
        c, s = np.cos(state[..., 2]), np.sin(state[..., 2])
        ox, oy = c * px - s * py, s * px + c * py
        gap = np.stack(
            [
                z[:, k, 0] - (state[..., 0] + ox) / scale,
                z[:, k, 1] - (state[..., 1] + oy) / scale,
                z[:, k, 2] - state[..., 2] - sensor.yaw,
            ]
        )
        zero, inverse = np.zeros_like(ox[:own]), (1 / scale + 0 * ox)[:own]
        rows = (
            (inverse, zero, -oy[:own] * inverse),
            (zero, inverse, ox[:own] * inverse),
            (zero, zero, zero + 1.0),
        )
        change = np.zeros_like(state)
        for axis, row in enumerate(rows):
            seen = known[:, k, axis]
            h = np.stack(row, axis=-1)
            ph = np.einsum("brij,brj->bri", cov, h)
            variance = np.where(seen, np.einsum("bri,bri->br", h, ph) + measured[axis], 1.0)
            std = np.sqrt(variance)
            w = np.where(seen, gap[axis] - np.einsum("bri,bri->br", h, change), 0.0) / std
            gain = np.where(seen[:, None], ph / std[..., None], 0.0)
            change = change + gain * w[..., None]
            cov = cov - gain[..., :, None] * gain[..., None, :]
            white[:, :, k, axis] = w
            log_variance += np.where(seen, np.log(variance), 0.0)
        state = state + change
    return Innovations(white, log_variance, known[:, 1:].sum(axis=(1, 2)))


def _start(
    z: np.ndarray,
    known: Bool[np.ndarray, "run 3"],
    sensor: Sensor,
    noise: Noise,
    start_heading: np.ndarray,
    variants: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return body poses (variant, run, 3) and their covariances (.., run, 3, 3) at first poses."""
    has_place, has_heading = known[:, :2].all(axis=1), known[:, 2]
    heading = np.where(has_heading, z[:, 2], start_heading) - sensor.yaw
    c, s = np.cos(heading), np.sin(heading)
    ox = c * sensor.place[..., 0] - s * sensor.place[..., 1]
    oy = s * sensor.place[..., 0] + c * sensor.place[..., 1]
    state = np.empty((variants, len(z), 3))
    state[..., 0] = np.where(has_place, sensor.scale * z[:, 0], 0.0) - ox
    state[..., 1] = np.where(has_place, sensor.scale * z[:, 1], 0.0) - oy
    state[..., 2] = heading
    own = noise.place.shape[0]
    place = np.where(has_place, sensor.scale[:own] ** 2 * noise.place, UNKNOWN_PLACE_STD**2)
    turn = np.where(has_heading, noise.heading, UNKNOWN_HEADING_STD**2)
    lever = np.stack([oy[:own], -ox[:own], np.ones_like(ox[:own])], axis=-1)
    lever = lever + np.zeros((own, len(z), 3))
    cov = (turn + np.zeros((own, len(z))))[..., None, None] * (
        lever[..., :, None] * lever[..., None, :]
    )
    cov[..., 0, 0] += place
    cov[..., 1, 1] += place
    return state, cov


def _predicted(
    state: np.ndarray, cov: np.ndarray, step: np.ndarray, process: np.ndarray, arm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return states and covariances after a predicted motion."""
    c, s = np.cos(state[..., 2]), np.sin(state[..., 2])
    dx, dy = c * step[..., 0] - s * step[..., 1], s * step[..., 0] + c * step[..., 1]
    new = np.stack([state[..., 0] + dx, state[..., 1] + dy, state[..., 2] + step[..., 2]], axis=-1)
    own = cov.shape[0]
    f = np.zeros_like(cov)
    f[..., 0, 0] = f[..., 1, 1] = f[..., 2, 2] = 1.0
    f[..., 0, 2], f[..., 1, 2] = -dy[:own], dx[:own]
    first = step[:own] if step.shape[0] >= own else step
    far = np.hypot(first[..., 0], first[..., 1]) + arm * np.abs(first[..., 2])
    middle = state[:own, :, 2] + 0.5 * first[..., 2]
    c, s = np.cos(middle), np.sin(middle)
    along, across, yaw = (process[..., a] * far for a in range(3))
    q = np.zeros_like(cov)
    q[..., 0, 0] = c * c * along + s * s * across
    q[..., 1, 1] = s * s * along + c * c * across
    q[..., 0, 1] = q[..., 1, 0] = c * s * (along - across)
    q[..., 2, 2] = yaw
    return new, f @ cov @ np.swapaxes(f, -1, -2) + q


def aligned_headings(
    pose: Float[np.ndarray, "run pose 3"], motion: Float[np.ndarray, "run gap 3"]
) -> Float[np.ndarray, " run"]:
    """Return the body's heading at the start of every run that aligns its path with its positions.

    Paths are aligned by rotation and translation (Procrustes). Where a run has fewer than two
    positions the result is zero.
    """
    yaw = np.concatenate([np.zeros((len(pose), 1)), np.cumsum(motion[..., 2], axis=1)], axis=1)
    step = (motion[..., 0] + 1j * motion[..., 1]) * np.exp(1j * yaw[:, :-1])
    path = np.concatenate([np.zeros((len(pose), 1)), np.cumsum(step, axis=1)], axis=1)
    seen = np.isfinite(pose[..., :2]).all(axis=-1)
    place = np.where(seen, pose[..., 0] + 1j * pose[..., 1], 0.0)
    number = np.maximum(seen.sum(axis=1), 1)[:, None]
    path = np.where(seen, path - (path * seen).sum(axis=1, keepdims=True) / number, 0.0)
    place = np.where(seen, place - place.sum(axis=1, keepdims=True) / number, 0.0)
    return np.asarray(np.angle((place * path.conj()).sum(axis=1)))
