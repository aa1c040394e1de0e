"""Delay and lag of the wheels behind their commands, estimated over all runs of a set.

A command, held until the next one, reaches the speed control after a delay. Its set-point follows
with a limited acceleration, and the wheel with a lag of first order:

    s' = clip((c(t - delay) - s) / h, -a, a),   lag w' + w = s

with c the commanded, s the set-point and w the modelled wheel speed [rad/s], a the acceleration
[rad/s^2] and h the time step. Measured speeds, the increments of the wheel angles over time between
rows, are compared with the mean of k w over the same time; the factor k of each wheel and run
stands for wrong radii and for wheels that the floor slows down. Delay, lag and acceleration are
those of least squares; their covariance is clustered by runs (sandwich), since the model is wrong
somewhere in each run. Before the first row of a log its wheels are assumed to have moved steadily,
so that a command that was given before the log began makes the delay too small.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.model.geometry import Geometry

STEP_S = 0.01
"""Time step of the model [s]."""
MOST_RUNS, LONGEST_RUN_S = 40, 60.0
"""Largest number of compared runs, picked evenly, and time from their start that counts [s]."""
GRID_RUNS = 8
"""Approximate number of runs on which the start of the search is chosen."""
LEAST_RUNS = 3
"""Smallest number of runs with changing commands."""
LONGEST_DELAY_S = 0.6
"""Largest searched delay [s]."""
DELAYS, LAGS = (0.02, 0.08, 0.14, 0.2, 0.3, 0.4, 0.5), (0.02, 0.1, 0.3)
ACCELERATIONS = (0.3, 1.0, 3.0, 30.0)
"""Start values of the search: delays, lags [s], accelerations at the rim of a wheel [m/s^2]."""
LEAST_LAG_S = 1e-4
"""A smaller lag counts as this [s]."""
LOWEST, HIGHEST = (0.0, 0.0, -4.0), (1.0, 2.0, 10.0)
DIFFERENCES = np.array([5e-3, 1e-2, 0.02])
LARGEST_STEP = np.array([0.05, 0.1, 0.5])
"""Bounds of the searched delay [s], lag [s] and log acceleration, differences for derivatives, and
largest step of the search."""
MOST_UNEXPLAINED = 0.2
"""Largest fraction of the square of the measured speeds that the model may leave [1]."""
LARGEST_STD_S, LARGEST_STD = 0.03, 0.15
"""Delay and lag count as known if the std of their sum is below either of these [s], or [1] as a
fraction of the sum; at this fraction the phase of a loop with a margin of 60 degrees is wrong by at
most 4.5 degrees."""
INTERVAL_STDS = 1.645
"""Half width of an interval of 90 % [std]."""


@dataclass(frozen=True)
class WheelResponse:
    """Response of the wheels to commands, from logs.

    Attributes:
        delay_s: time until a command reaches the wheels [s].
        lag_s: time constant of the wheels' speed control [s].
        acceleration: largest acceleration of the rim of a wheel [m/s^2].
        delay_interval90: interval of the delay [s].
        lag_interval90: interval of the lag [s].
        runs: number of compared runs.
        unexplained: fraction of the square of the measured speeds that the model leaves [1].
    """

    delay_s: float
    lag_s: float
    acceleration: float
    delay_interval90: tuple[float, float]
    lag_interval90: tuple[float, float]
    runs: int
    unexplained: float


def wheel_response(logs: Sequence[Log], shape: Geometry) -> WheelResponse | None:
    """Return the response of the wheels; None if logs lack commands or do not determine it.

    `shape` is the geometry by which a commanded twist becomes wheel speeds.
    """
    if len(logs) < LEAST_RUNS or shape.driven is not None:
        return None
    some = np.unique(np.linspace(0, len(logs) - 1, MOST_RUNS).round().astype(int)).tolist()
    matrix, radius = np.asarray(shape.forward()), float(shape.wheel_radius)
    pairs = [_pair(logs[k], matrix / radius) for k in some]
    kept = [pair for pair in pairs if pair is not None]
    if len(kept) < LEAST_RUNS:
        return None
    model = _Model.of(kept)
    slews = np.log(np.array(ACCELERATIONS) / radius)
    grid = np.stack(np.meshgrid(DELAYS, LAGS, slews, indexing="ij"), -1).reshape(-1, 3)
    few = _Model.of(kept[:: max(1, len(kept) // GRID_RUNS)])
    # points of one delay at once: the model's loop over time costs the same for many points
    losses = [few.residuals(part).reshape(len(part), -1) for part in np.split(grid, len(DELAYS))]
    best = grid[int(np.argmin(np.concatenate([(x**2).sum(axis=1) for x in losses])))]
    point = _refined(model, best)
    if point is None:
        return None
    delay, lag, acceleration = float(point[0]), float(point[1]), float(np.exp(point[2]))
    jacobian, off = model.jacobian(point), model.residuals(point[None])[0]
    bread = np.linalg.pinv(np.einsum("prtw,qrtw->pq", jacobian, jacobian))
    scores = np.einsum("prtw,rtw->rp", jacobian, off)
    covariance = bread @ (scores.T @ scores) @ bread * len(kept) / (len(kept) - 1)
    unexplained = float((off**2).sum() / (model.measured**2).sum())
    std = float(np.sqrt(covariance[:2, :2].sum()))
    most = max(LARGEST_STD_S, LARGEST_STD * (delay + lag))
    if unexplained > MOST_UNEXPLAINED or std > most or delay > LONGEST_DELAY_S:
        return None
    reach = INTERVAL_STDS * np.sqrt(np.diag(covariance))

    def interval(value: float, half: float) -> tuple[float, float]:
        return max(0.0, value - half), value + half

    return WheelResponse(
        delay,
        lag,
        acceleration * radius,
        interval(delay, float(reach[0])),
        interval(lag, float(reach[1])),
        len(kept),
        unexplained,
    )


@dataclass(frozen=True, eq=False)
class _Pair:
    """Commands and measured speeds of a run.

    Attributes:
        time: times of the rows from the first one on [s].
        command: commanded wheel speeds, each held until the next row [rad/s].
        angle: wheel angles [rad].
    """

    time: Float[np.ndarray, " row"]
    command: Float[np.ndarray, "row wheel"]
    angle: Float[np.ndarray, "row wheel"]


def _pair(log: Log, matrix: Float[np.ndarray, "wheel 3"]) -> _Pair | None:
    """Return commands and angles of a run; None without commands that change, or without motion."""
    command = log.wheel_speed_command
    if command is None and log.twist_command is not None:
        command = log.twist_command @ matrix.T
    if command is None or log.wheels != len(matrix) or log.samples < 10:
        return None
    time = log.time - log.time[0]
    rows = time <= LONGEST_RUN_S
    time, command, angle = time[rows], command[rows], log.wheel_angle[rows]
    first = (angle[1] - angle[0]) / (time[1] - time[0])
    size = np.abs(command).max()
    changes = np.abs(np.diff(command, axis=0, prepend=first[None])).max()
    if not np.isfinite(command).all() or size == 0 or changes < 0.3 * size:
        return None
    return _Pair(time, command, angle)


@dataclass(frozen=True, eq=False)
class _Model:
    """Modelled speeds of several runs at once, on a common grid of times.

    Attributes:
        pairs: commands and angles of the runs.
        grid: times of the model's steps from the first row on [s].
        start: wheel speeds before the first row [rad/s].
        measured: mean wheel speeds between rows [rad/s]; 0 after the end of a run.
    """

    pairs: Sequence[_Pair]
    grid: Float[np.ndarray, " step"]
    start: Float[np.ndarray, "run wheel"]
    measured: Float[np.ndarray, "run row wheel"]

    @classmethod
    def of(cls, pairs: Sequence[_Pair]) -> "_Model":
        longest = max(float(pair.time[-1]) for pair in pairs)
        most, wheels = max(len(pair.time) for pair in pairs), pairs[0].angle.shape[1]
        measured = np.zeros((len(pairs), most - 1, wheels))
        start = np.zeros((len(pairs), wheels))
        for k, pair in enumerate(pairs):
            speed = np.diff(pair.angle, axis=0) / np.diff(pair.time)[:, None]
            measured[k, : len(speed)] = speed
            start[k] = speed[0]
        return cls(pairs, STEP_S * np.arange(int(longest / STEP_S) + 2), start, measured)

    def residuals(self, points: Float[np.ndarray, "point 3"]) -> np.ndarray:
        """Return measured less modelled speeds (point, run, row, wheel).

        A point is delay [s], lag [s], and the log of the largest acceleration of wheels [rad/s^2].
        """
        runs, wheels = self.start.shape
        shape = (len(points), runs, wheels)
        lag, slew = points[:, 1, None, None], np.exp(points[:, 2, None, None])
        # mean command of each time step, for every point
        mean = np.zeros((len(self.grid) - 1, *shape))
        for p, late in enumerate(points[:, 0]):
            for k, pair in enumerate(self.pairs):
                mean[:, p, k] = np.diff(self._integral(k, pair, self.grid - late), axis=0) / STEP_S
        aim = np.broadcast_to(self.start, shape).copy()
        speed, angle = aim.copy(), np.zeros((len(self.grid), *shape))
        gain = 1 - np.exp(-STEP_S / np.maximum(lag, LEAST_LAG_S))
        for k, wanted in enumerate(mean):
            change = np.clip(wanted - aim, -slew * STEP_S, slew * STEP_S)
            aim = aim + change
            # mean set-point of the step, on the way while the acceleration is limited
            mean_aim = np.where(aim == wanted, aim, aim - 0.5 * change)
            rise = gain * (mean_aim - speed)
            speed = speed + rise
            # the integral of lag w' + w = s
            angle[k + 1] = angle[k] + STEP_S * mean_aim - np.maximum(lag, LEAST_LAG_S) * rise
        out = np.zeros((len(points), *self.measured.shape))
        for k, pair in enumerate(self.pairs):
            rows = len(pair.time) - 1
            place = pair.time / STEP_S
            low = np.minimum(place.astype(int), len(self.grid) - 2)
            part = (place - low)[:, None, None]
            at = (1 - part) * angle[low, :, k] + part * angle[low + 1, :, k]
            modelled = np.diff(at, axis=0) / np.diff(pair.time)[:, None, None]
            own = self.measured[k, :rows, None]
            factor = (modelled * own).sum(axis=0) / np.maximum((modelled**2).sum(axis=0), 1e-12)
            out[:, k, :rows] = np.moveaxis(own - factor * modelled, 0, 1)
        return out

    def _integral(self, k: int, pair: _Pair, times: np.ndarray) -> np.ndarray:
        """Return the integral of a run's command at times (time, wheel) [rad]."""
        held = np.diff(pair.time)[:, None] * pair.command[:-1]
        total = np.concatenate([np.zeros((1, held.shape[1])), np.cumsum(held, axis=0)])
        inside = np.stack([np.interp(times, pair.time, column) for column in total.T], axis=1)
        before = np.minimum(times, 0.0)[:, None] * self.start[k]
        after = np.maximum(times - pair.time[-1], 0.0)[:, None] * pair.command[-1]
        return np.asarray(inside + before + after)

    def jacobian(self, point: Float[np.ndarray, "3"]) -> np.ndarray:
        """Return derivatives of the residuals by the coordinates of a point."""
        plus, minus = point + np.diag(DIFFERENCES), np.maximum(point - np.diag(DIFFERENCES), LOWEST)
        wide = np.diag(plus - minus)[:, None, None, None]
        return np.asarray((self.residuals(plus) - self.residuals(minus)) / wide)


def _refined(model: _Model, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"] | None:
    """Return the point of least squares; None without convergence."""
    damping, loss = 1e-3, float((model.residuals(point[None]) ** 2).sum())
    for _ in range(30):
        jacobian, off = model.jacobian(point), model.residuals(point[None])[0]
        normal = np.einsum("prtw,qrtw->pq", jacobian, jacobian)
        slope = np.einsum("prtw,rtw->p", jacobian, off)
        moved = False
        while not moved and damping < 1e6:
            ridge = damping * np.diag(np.diag(normal) + 1e-12)
            step = np.linalg.solve(normal + ridge, slope).clip(-LARGEST_STEP, LARGEST_STEP)
            new = np.clip(point - step, LOWEST, HIGHEST)
            now = float((model.residuals(new[None]) ** 2).sum())
            moved = now <= loss
            damping = damping / 5 if moved else damping * 5
        if not moved or loss - now <= 1e-6 * loss:
            return new if moved else point
        point, loss = new, now
    return None
