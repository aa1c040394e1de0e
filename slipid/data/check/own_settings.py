"""Limits, noise of sensors, and delays of wheels that the logs of a robot show.

Limits are the highest values that were driven, without the few rows that exceed all others. Noise
is what sensors show while the wheels rest. A quantity of which the logs show too little is left
out. For delays see `slipid.data.wheel_response`.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.log import Log
from slipid.data.wheel_response import wheel_response
from slipid.data.wheel_signals import interpolate, stretches
from slipid.model.geometry import Geometry

HEADROOM = 1.2
"""Limits of wheel speed and voltage over their highest values in the logs [1]: the robot can reach
more than it showed, since slip and slopes need a reserve."""
HALF_WINDOW_S = 0.1
"""Half the time over which wheel speeds and accelerations are differences of angles [s]."""
ROWS = 0.995
"""Fraction of the rows of a run, sorted by size, of which the last one counts as the highest."""
RUNS = 0.9
"""Same for the accelerations of runs: a run that hit something is no measure of the motors."""
STRONG = 0.3
"""Part of a run's largest acceleration from which on the wheels count as accelerating [1]."""
RARE = 0.25
"""The highest speed, or yaw rate, is left out if the wheels turned four times faster in other
motion [1]."""
STILL_M_S, REST_S, SETTLE_S = 0.003, 0.05, 0.2
"""Rim speed below which a wheel rests [m/s]; least time at rest [s]; time after a motion that does
not count as rest, while currents decay [s]."""
QUICK_S = 0.03
"""Half the time over which wheel speeds are differences of angles where rests are looked for [s]:
currents rise soon before the wheels do."""
LEAST_READINGS, LEAST_RESTS = 20, 5
"""Least number of readings from which a std of noise is computed, and of rests for the bias."""
FOLDED = 1.6
"""Ratio of mean to std below which magnitudes are those of noise around 0 [1]; it is 1.3 for such
noise."""
STALE_GAPS, STALE_S = 5.0, (0.2, 1.0)
"""Number of usual gaps between readings after which a wheel is stale, and bounds of that time
[s]."""


def own_settings(logs: Sequence[Log], shape: Geometry) -> dict[str, float]:
    """Return limits, noise and delays that logs show, rounded to 3 digits.

    Keys are paths in robot.json.

    Args:
        logs: the runs; those without motion of wheels are ignored.
        shape: wheels of the robot.
    """
    driven = [log for log in logs if log.wheels and log.samples > 2]
    found = dict(_limits(driven, shape)) | dict(_noise(driven, float(shape.wheel_radius)))
    found = {name: v for name, v in found.items() if np.isfinite(v) and v > 0}
    if (response := wheel_response(driven, shape)) is not None:
        found |= {"actuators.delay_s": response.delay_s, "actuators.lag_s": response.lag_s}
    return {name: float(f"{v:.3g}") for name, v in found.items()}


def _limits(logs: Sequence[Log], shape: Geometry) -> Iterator[tuple[str, float]]:
    radius = float(shape.wheel_radius)
    to_body = np.asarray(shape.pseudo_inverse()) * radius
    lever = max(float(np.abs(np.asarray(shape.forward())[:, 2]).max()), 1e-9)
    most: dict[str, list[float]] = {"speed": [], "yaw_rate": [], "wheel_speed": []}
    accelerations: list[float] = []
    for log in logs:
        turn, change = _rates(log, HALF_WINDOW_S)
        twist = turn @ to_body.T
        fast = np.abs(turn).max(axis=1)
        most["wheel_speed"].append(float(np.quantile(fast, ROWS)))
        most["speed"].append(float(np.quantile(np.hypot(twist[:, 0], twist[:, 1]), ROWS)))
        most["yaw_rate"].append(float(np.quantile(np.abs(_yaw_rate(log, twist[:, 2])), ROWS)))
        strong = radius * np.abs(change).max(axis=1)
        if strong.max() > 0:
            accelerations.append(float(np.quantile(strong[strong > STRONG * strong.max()], 0.9)))
    if not logs:
        return
    top = {name: max(values) for name, values in most.items()}
    rim = radius * top["wheel_speed"]
    yield "limits.wheel_speed", HEADROOM * top["wheel_speed"]
    if top["speed"] > RARE * rim:
        yield "limits.speed", top["speed"]
    if lever * top["yaw_rate"] > RARE * rim:
        yield "limits.yaw_rate", top["yaw_rate"]
    if accelerations:
        yield "limits.acceleration", float(np.quantile(accelerations, RUNS))
    supply = _highest(log.bus_voltage for log in logs)
    of_motors = HEADROOM * _highest(log.voltage for log in logs)
    yield "limits.voltage", supply if np.isfinite(supply) else of_motors


def _highest(channels: Iterable[np.ndarray | None]) -> float:
    """Return the highest magnitude of a channel in any run; nan if no run has it."""
    logged = [np.abs(values[np.isfinite(values)]) for values in channels if values is not None]
    return max((float(np.quantile(x, ROWS)) for x in logged if len(x)), default=np.nan)


def _rates(
    log: Log, half: float
) -> tuple[Float[np.ndarray, "row wheel"], Float[np.ndarray, "row wheel"]]:
    """Return wheel speeds [rad/s] and accelerations [rad/s^2] as differences of wheel angles.

    The differences are those over `half` a window [s], or a row if that is longer.
    """
    half = max(half, float(np.median(np.diff(log.time))))
    before, now, after = (
        interpolate(log.time, log.wheel_angle, log.time + shift) for shift in (-half, 0.0, half)
    )
    change = (after - 2 * now + before) / half**2
    # beyond the ends the angle is constant, which would count as a sudden stop
    inside = (log.time > log.time[0] + half) & (log.time < log.time[-1] - half)
    return (after - before) / (2 * half), np.where(inside[:, None], change, 0.0)


def _yaw_rate(log: Log, by_wheels: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    """Return the yaw rate by the gyro; without one by the headings, or else by the wheels [rad/s].

    Wheels that scrub in turns show more than the body turns.
    """
    if log.gyro is not None and np.isfinite(log.gyro).all():
        return log.gyro
    if log.pose is None or log.pose_fresh is None:
        return by_wheels
    known = log.pose_fresh & np.isfinite(log.pose[:, 2])
    if known.sum() < 3:
        return by_wheels
    half = 2.5 * HALF_WINDOW_S
    time, heading = log.time[known], log.pose[known, 2]
    ends = (np.interp(log.time + shift, time, heading) for shift in (half, -half))
    return (next(ends) - next(ends)) / (2 * half)


def _noise(logs: Sequence[Log], radius: float) -> Iterator[tuple[str, float]]:
    rests = [(log, rest) for log in logs for rest in _rests(log, radius)]
    yield from _noise_of_meters(logs, rests)
    yield from _noise_of_gyro([log.gyro[rest] for log, rest in rests if log.gyro is not None])
    if logs:
        usual, longest = gaps(logs)
        yield "sensors.stale_s", float(np.clip(max(STALE_GAPS * usual, 1.2 * longest), *STALE_S))


def _noise_of_meters(
    logs: Sequence[Log], rests: Sequence[tuple[Log, np.ndarray]]
) -> Iterator[tuple[str, float]]:
    for name, channel in (("ammeter_std_a", "current"), ("voltmeter_std_v", "voltage")):
        parts = [
            column[fresh]
            for log, rest in rests
            for column, fresh in _columns(log, channel, rest)
            if fresh.sum() > 2
        ]
        magnitudes = channel == "current" and not all(log.current_is_signed for log in logs)
        if not (channel == "current" and any(log.current_is_torque for log in logs)):
            yield f"sensors.{name}", _std(parts, magnitudes)


def _noise_of_gyro(rests: Sequence[Float[np.ndarray, "_"]]) -> Iterator[tuple[str, float]]:
    parts = [part for rest in rests if len(part := rest[np.isfinite(rest)]) > 2]
    std = _std(parts, magnitudes=False)
    yield "sensors.gyro_std", std
    if len(parts) >= LEAST_RESTS:
        # the mean of a rest is the bias and the mean of its noise
        of_noise = np.mean([std**2 / len(part) for part in parts])
        squared = np.mean([part.mean() ** 2 for part in parts]) - of_noise
        yield "sensors.gyro_bias_std", float(np.sqrt(max(squared, 0.0)))


def gaps(logs: Sequence[Log]) -> tuple[float, float]:
    """Return the usual gap between rows of logs, and the longest, without the few longer ones [s].

    Rows are those with a reading of any sensor.
    """
    steps = np.concatenate([np.diff(log.time) for log in logs if log.samples > 1])
    return float(np.median(steps)), float(np.quantile(steps, ROWS))


def _rests(log: Log, radius: float) -> Iterator[Bool[np.ndarray, " row"]]:
    """Yield the rows of every rest, in which no wheel turns, without the time after a motion."""
    still = radius * np.abs(_rates(log, QUICK_S)[0]).max(axis=1) < STILL_M_S
    for start, end in stretches(still).tolist():
        begin = log.time[start] + (SETTLE_S if start else 0.0)
        rows = np.zeros(log.samples, bool)
        rows[start:end] = log.time[start:end] >= begin
        if log.time[end - 1] - begin >= REST_S:
            yield rows


def _columns(
    log: Log, channel: str, rest: Bool[np.ndarray, " row"]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the readings of each motor, and whether each is a new and finite one in a rest."""
    values, fresh = getattr(log, channel), getattr(log, f"{channel}_fresh")
    if values is None:
        return
    for k, column in enumerate(values.T):
        new = rest if fresh is None else rest & fresh[:, k]
        yield column, new & np.isfinite(column)


def _std(parts: Sequence[Float[np.ndarray, "_"]], magnitudes: bool) -> float:
    """Return the std of noise around the mean of each part; nan if there are too few readings.

    Magnitudes of noise around 0 have their mean above 0, and count as readings around 0.
    """
    if sum(map(len, parts)) < LEAST_READINGS:
        return float("nan")
    whole = np.concatenate(parts)
    if magnitudes and whole.mean() < FOLDED * whole.std():
        return float(np.sqrt(np.mean(whole**2)))
    squares = sum(float(np.sum((part - part.mean()) ** 2)) for part in parts)
    return float(np.sqrt(squares / (len(whole) - len(parts))))
