"""Division of runs into segments of several windows each; the likelihood is a sum over segments."""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.runs import Runs, first_row
from slipid.data.wheel_signals import interpolate
from slipid.support.errors import DataError

NORMAL_STD = 0.6827
"""Probability that a normally distributed variable is within one std of its mean [1]."""
UNREAD_VARIANCE = 1e6
"""Variance assigned to the mean of a window without any reading [A^2] or [V^2]; it is large enough
that the mean has practically no weight."""
FRICTION_SPEED = 0.2
"""Wheel speed over which the friction of a motor changes its sign, as in `slipid.model.motor`
[rad/s]."""
SPEED_S = 0.16
"""Time over which the speed of a wheel is averaged [s]; shorter means would show the uneven updates
of the encoder."""
PerWindow = Float[np.ndarray, "window wheel"]


@dataclass(frozen=True, eq=False)
class Windows:
    """Segments of K successive windows; a short run is one segment, a long run has several.

    Attributes:
        run: index of the run of each segment (segment,).
        surface, load, session: name of the surface, load set-up and session of each segment.
        start: time in its run at which each segment starts [s] (segment,).
        dt: duration of each window [s] (segment, window).
        turn: rotation of each wheel in the window [rad] (segment, window, wheel) if the camera lags
            by `lag`.
        speed_change: wheel speed at the window's end less that at its start [rad/s], so that
            d turn / d lag = -speed_change.
        direction: sign of the motion of each wheel, averaged over the window: the mean of
            tanh(w / w0) with the wheel speed w and w0 = `FRICTION_SPEED`. It is 0 for a wheel at
            rest, and 0.5 for one that turns forward during half of the window. If `current` is a
            mean of magnitudes, it is the mean of |tanh(w / w0)| with the sign of `turn`.
        pose: pose at the edges of the windows (segment, window + 1, 3), as logged.
        current: mean of the signed current or of its magnitude [A]; zeros if not logged.
        voltage: mean voltage [V]; zeros if not logged.
        current_var: variance of the mean current due to the ammeter's noise [A^2];
            `UNREAD_VARIANCE` where no current was read in the window.
        voltage_var: variance of the mean voltage due to missing readings [V^2]; `UNREAD_VARIANCE`
            where no voltage was read in the window.
        has_current: True if all runs have logged currents.
        has_voltage: True if all runs have logged voltages.
        current_is_signed: False if `current` is a mean of magnitudes.
        lag: assumed lag of the camera behind the encoders [s].
        parts: number of windows from one measured pose to the next; poses at the edges between them
            are interpolated.
    """

    run: Int[np.ndarray, " segment"]
    surface: tuple[str, ...]
    load: tuple[str, ...]
    session: tuple[str, ...]
    start: Float[np.ndarray, " segment"]
    dt: Float[np.ndarray, "segment window"]
    turn: Float[np.ndarray, "segment window wheel"]
    speed_change: Float[np.ndarray, "segment window wheel"]
    direction: Float[np.ndarray, "segment window wheel"]
    pose: Float[np.ndarray, "segment edge 3"]
    current: Float[np.ndarray, "segment window wheel"]
    voltage: Float[np.ndarray, "segment window wheel"]
    current_var: Float[np.ndarray, "segment window wheel"]
    voltage_var: Float[np.ndarray, "segment window wheel"]
    has_current: bool
    has_voltage: bool
    current_is_signed: bool
    lag: float
    parts: int = 1

    def __len__(self) -> int:
        return len(self.run)

    def segments(self, index: Int[np.ndarray, " some"]) -> "Windows":
        """Return the segments with the given indices, in the given order."""
        kept = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                kept[field.name] = value[index]
            elif isinstance(value, tuple):
                kept[field.name] = tuple(value[i] for i in index)
        return replace(self, **kept)

    def at_lag(self, lag: float) -> "Windows":
        """Return the same windows for another lag of the camera [s], to first order in the lag."""
        return replace(self, turn=self.turn - (lag - self.lag) * self.speed_change, lag=lag)


def windows(
    data: Runs,
    wheel_radius: float,
    lag: float = 0.0,
    per_segment: int = 4,
    longest: float = 6.0,
    parts: int = 1,
) -> Windows:
    """Return the runs divided into segments of `per_segment` windows, from their first motion on.

    Args:
        data: the runs.
        wheel_radius: radius of the wheels [m]; it only determines where motion starts.
        lag: lag of the camera behind the encoders [s].
        per_segment: number of windows in each segment.
        longest: largest duration of a window [s]; longer runs have more segments.
        parts: number of equal parts into which every window is divided in turn.

    Raises:
        DataError: no wheel of a run moves by `MOVED_M`, or a run has too few poses for its windows,
            or poses that lack a coordinate.
    """
    each = [_edges(data, k, wheel_radius, lag, per_segment, longest) for k in range(len(data))]
    run = [k for k, segments in enumerate(each) for _ in segments]
    noise = ammeter_variance(data)
    segments = [
        _cut(data, k, edges, lag, noise[k], parts) for k, cuts in enumerate(each) for edges in cuts
    ]
    together = {name: np.stack([segment[name] for segment in segments]) for name in segments[0]}
    logs = [data.logs[k] for k in run]
    return Windows(
        run=np.asarray(run),
        surface=tuple(data.surface[k] for k in run),
        load=tuple(log.load for log in logs),
        session=tuple(data.session[k] for k in run),
        **together,
        has_current=data.current is not None,
        has_voltage=data.voltage is not None,
        current_is_signed=data.current_is_signed,
        lag=lag,
        parts=parts,
    )


DURATIONS_S, STEADY = (6.0, 3.0, 1.5, 0.75), 0.04
"""Durations of windows [s], and largest deviation of wheel angles from constant speeds in a window,
as a fraction of their turn [1]."""
MOST_STEADY_RUNS = 24
"""Largest number of runs from which the duration of windows is chosen."""


def steady_duration(data: Runs) -> float:
    """Return the longest duration over which wheels keep nearly constant speeds [s].

    A window has one body twist: a longer one would average over turns and straight parts.
    """
    some = np.unique(np.linspace(0, len(data) - 1, MOST_STEADY_RUNS).round().astype(int))
    for duration in DURATIONS_S[:-1]:
        bent, whole = 0.0, 0.0
        for k in some.tolist():
            rows = data.rows(k)
            t, angle = data.time[rows], data.wheel_angle[rows]
            edges = np.arange(t[0], t[-1], duration)
            if len(edges) > 1:
                line = interpolate(edges, interpolate(t, angle, edges), t)
                bent += float(np.abs(angle - line).mean(axis=0).max()) * (len(edges) - 1)
                whole += float(
                    np.abs(np.diff(interpolate(t, angle, edges), axis=0)).sum(axis=0).max()
                )
        if bent < STEADY * whole:
            return duration
    return DURATIONS_S[-1]


def ammeter_variance(data: Runs) -> Float[np.ndarray, "run wheel"]:
    """Return the variance of a single reading of each ammeter in each run [A^2].

    The estimate uses second differences d_t = x_(t-1) - 2 x_t + x_(t+1). Their variance is six
    times that of white noise, whereas smooth signals are suppressed: a ripple with a period of n
    readings keeps only the fraction (2 - 2 cos(2 pi / n))^2 / 6 of its variance, which is 6 % at
    n = 8. The std of d is estimated by the 68 % quantile of |d|, so that jumps have little weight.

    Limits: ripple with a shorter period, or aliased by slow sampling, counts as noise; repeated
    readings, or smoothing in the motor driver, make the estimate too small; if the resolution of
    the readings is coarser than the noise, the estimated std is a small multiple of the resolution,
    and at least the rounding noise; magnitudes of currents near zero have less noise than signed
    currents.
    """
    out = np.zeros((len(data), data.wheel_angle.shape[1]))
    if data.current is None:
        return out
    amps = data.current if data.current_is_signed else np.abs(data.current)
    for k in range(len(data)):
        rows = data.rows(k)
        live, of_run = data.live[rows], amps[rows]
        fresh = None if data.current_fresh is None else data.current_fresh[rows]
        for wheel in range(out.shape[1]):
            read = slice(None) if fresh is None else fresh[:, wheel]
            out[k, wheel] = _ammeter(of_run[read, wheel], live[read])
    return out


def _ammeter(amps: Float[np.ndarray, " reading"], live: Bool[np.ndarray, " reading"]) -> float:
    """Return the variance of a single reading of one ammeter in one run [A^2].

    The variance is at least that of rounding to the smallest step between readings, step^2 / 12.
    """
    curvature = np.abs(np.diff(amps, 2))[live[:-2] & live[1:-1] & live[2:]]
    if not len(curvature):
        return 0.0
    step = np.abs(np.diff(amps))
    rounding = float((step[step > 0] ** 2).min(initial=np.inf)) / 12
    noise = float(np.quantile(curvature, NORMAL_STD)) ** 2 / 6
    return max(noise, rounding if np.isfinite(rounding) else 0.0)


def _edges(
    data: Runs, run: int, radius: float, lag: float, per_segment: int, longest: float
) -> list[np.ndarray]:
    """Return, for each segment of a run, the rows at the edges of its windows.

    Each of these rows has a new pose. The true time of this pose is earlier by the lag, and lies
    within the record of the wheels.
    """
    first, time = first_row(data, run, radius), data.time[data.rows(run)]
    fresh = np.flatnonzero(data.fresh[data.rows(run)])
    if sentence := incomplete_poses(data, run):
        raise DataError(
            f"{sentence}. Kinematics alone can be calibrated: slipid identify --only calibration, "
            "or slipid.calibrate"
        )
    shown = time[fresh] - lag
    fresh = fresh[(fresh >= first) & (shown >= time[0] - 1e-9) & (shown <= time[-1] + 1e-9)]
    if len(fresh) < per_segment + 1:
        raise DataError(
            f"{data.logs[run].name}: {len(fresh)} poses after the robot started to move; expected "
            f"at least {per_segment + 1}"
        )
    t = data.time[data.rows(run)][fresh]
    segments = max(1, int(np.ceil((t[-1] - t[0]) / (per_segment * longest) - 1e-9)))
    count = min(segments * per_segment, (len(fresh) - 1) // per_segment * per_segment)
    at = np.linspace(t[0], t[-1], count + 1)
    picked = np.searchsorted(t, at - 1e-12).clip(0, len(t) - 1)
    earlier = (picked - 1).clip(0)
    picked = np.where(np.abs(t[earlier] - at) < np.abs(t[picked] - at), earlier, picked)
    if (np.diff(picked) <= 0).any():
        picked = np.linspace(0, len(fresh) - 1, count + 1).round().astype(int)
    rows = fresh[picked]
    return [rows[k : k + per_segment + 1] for k in range(0, count, per_segment)]


def incomplete_poses(data: Runs, run: int) -> str | None:
    """Return a sentence if poses of a run lack a coordinate, or are at most two; else None."""
    pose = data.pose[data.rows(run)][data.fresh[data.rows(run)]]
    lacking = np.isnan(pose).any(axis=0)
    what = "without headings" if lacking[2] else "without positions" if lacking.any() else ""
    if not what and len(pose) > 2:
        return None
    return (
        f"{data.logs[run].name}: poses {what or f'in {len(pose)} rows only'}; expected x, y and "
        "heading during the run, which a fit of motors and contact needs"
    )


def _cut(
    data: Runs,
    run: int,
    edges: np.ndarray,
    lag: float,
    noise: Float[np.ndarray, " wheel"],
    parts: int,
) -> dict[str, np.ndarray]:
    """Return the arrays of `Windows` for one segment, keyed by the name of the attribute.

    Args:
        data: the runs.
        run: index of the segment's run.
        edges: rows of the run at the edges of the windows.
        lag: lag of the camera behind the encoders [s].
        noise: variance of a single reading of each ammeter [A^2].
        parts: number of equal parts of each window.
    """
    rows = data.rows(run)
    t, angle = data.time[rows], data.turned(run)
    part = np.arange(parts * (len(edges) - 1) + 1) / parts
    logged = np.column_stack([t, data.pose[rows]])[edges]
    shown, *pose = interpolate(np.arange(1.0 * len(edges)), logged, part).T
    at = shown - lag
    half = SPEED_S / 2
    turned, ahead, behind = (interpolate(t, angle, when) for when in (at, at + half, at - half))
    span = np.clip(at + half, t[0], t[-1]) - np.clip(at - half, t[0], t[-1])
    speed = (ahead - behind) / np.maximum(span, 1e-3)[:, None]
    amps = None if data.current is None else data.current[rows]
    if amps is not None and not data.current_is_signed:
        amps = np.abs(amps)
    volts = None if data.voltage is None else data.voltage[rows]

    def meter(
        values: np.ndarray | None, fresh: np.ndarray | None, noise: np.ndarray | float
    ) -> tuple[PerWindow, PerWindow]:
        """Return the mean of a current or voltage in each window, and the variance of the mean."""
        if values is None:
            zero = np.zeros((len(at) - 1, angle.shape[1]))
            return zero, zero
        read = None if fresh is None else fresh[rows]
        mean, count, missed = _mean(t, values, data.live[rows], read, at)
        return mean, np.where(count > 0, noise / np.maximum(count, 1) + missed, UNREAD_VARIANCE)

    mean_current, current_var = meter(amps, data.current_fresh, noise)
    mean_voltage, voltage_var = meter(volts, data.voltage_fresh, 0.0)
    turn = np.diff(turned, axis=0)
    direction = _direction(t, angle, data.live[rows], at, data.current_is_signed)
    return {
        "start": np.asarray(t[edges[0]]),
        "dt": np.diff(shown),
        "turn": turn,
        "speed_change": np.diff(speed, axis=0),
        "direction": direction if data.current_is_signed else direction * np.sign(turn),
        "pose": np.stack(pose, axis=-1),
        "current": mean_current,
        "voltage": mean_voltage,
        "current_var": current_var,
        "voltage_var": voltage_var,
    }


def _direction(
    time: Float[np.ndarray, " row"],
    angle: Float[np.ndarray, "row wheel"],
    live: Bool[np.ndarray, " row"],
    at: Float[np.ndarray, " edge"],
    signed: bool,
) -> PerWindow:
    """Return the sign of the motion of each wheel, averaged over each window.

    The result is sum_k p_k tanh(w_k / w0) over forward and backward motion k, where p_k is the
    share of the time in this motion, w_k the mean speed in it, and w0 = `FRICTION_SPEED`; a mean of
    the tanh of every row's speed would be too small at low speeds, because rows show the steps of
    the encoder. In a row a wheel moves if it turns in the same direction just before and just after
    the row. Arguments as in `_mean`; if not `signed`, the result is the sum of the magnitudes.
    """
    before, after = _speeds(time, angle)
    total = np.zeros((len(at) - 1, angle.shape[1]))
    for moves in (np.minimum(before, after) > 0, np.maximum(before, after) < 0):
        share, _, _ = _mean(time, moves.astype(float), live, None, at)
        speed, _, _ = _mean(time, moves * 0.5 * (before + after), live, None, at)
        part = share * np.tanh(speed / np.maximum(share, 1e-9) / FRICTION_SPEED)
        total += part if signed else np.abs(part)
    return total


def _speeds(
    time: Float[np.ndarray, " row"], angle: Float[np.ndarray, "row wheel"]
) -> tuple[Float[np.ndarray, "row wheel"], Float[np.ndarray, "row wheel"]]:
    """Return the mean wheel speeds just before and just after every row [rad/s].

    The means are over `SPEED_S`, or over the time in which a wheel at `FRICTION_SPEED` turns by the
    smallest step between readings of its encoder, if this is longer. Near the ends of a run, where
    only one of the means is known, it stands for both.
    """
    before, after = np.empty_like(angle), np.empty_like(angle)
    for k, column in enumerate(angle.T):
        step = np.abs(np.diff(column))
        finest = float(np.min(step, where=step > 1e-9, initial=np.inf))
        length = finest / FRICTION_SPEED if np.isfinite(finest) else 0.0
        length = min(max(SPEED_S, length), 0.5 * float(time[-1] - time[0]))
        ahead, behind = (np.interp(time + s, time, column) for s in (length, -length))
        after[:, k], before[:, k] = (ahead - column) / length, (column - behind) / length
        last, first = time + length > time[-1], time - length < time[0]
        after[last, k], before[first, k] = before[last, k], after[first, k]
    return before, after


def _mean(
    time: Float[np.ndarray, " row"],
    x: Float[np.ndarray, "row wheel"],
    live: Bool[np.ndarray, " row"],
    fresh: Bool[np.ndarray, "row wheel"] | None,
    at: Float[np.ndarray, " edge"],
) -> tuple[PerWindow, PerWindow, PerWindow]:
    """Return each window's time average, its number of readings, and the average's variance.

    Each row is weighted by the time from the middle between it and the previous row to the middle
    between it and the next row. (A plain mean over the rows in a window would be biased, because
    its first row comes after the edge: while a robot speeds up, mean voltages would be too high.)
    Between the readings of a slow meter the signal is assumed to be linear. If it really jumped
    from one reading to the next at an unknown time in between, the mean over that time has an error
    whose std is the difference of the two readings divided by sqrt(12); the returned variance is
    due to these errors. Rows of telemetry stalls are left out, except in windows that have no other
    rows.

    Args:
        time: times of the rows [s].
        x: current [A] or voltage [V] of each wheel's motor.
        live: False in the rows of a telemetry stall.
        fresh: True for values that were read in their row; None if all were.
        at: times of the window edges, on the same clock as `time` [s].
    """
    bounds = np.concatenate([time[:1], 0.5 * (time[1:] + time[:-1]), time[-1:]])
    cell = np.diff(bounds)[:, None]

    def total(values: np.ndarray) -> np.ndarray:
        summed = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
        return np.diff(interpolate(bounds, summed, at), axis=0)

    read = np.broadcast_to(live[:, None], x.shape)
    missed = np.zeros(x.shape)
    if fresh is not None:
        read = read & fresh
        each = [_between(time, x[:, k], read[:, k]) for k in range(x.shape[1])]
        x, missed = (np.stack(column, axis=-1) for column in zip(*each, strict=True))
    weight = cell * live[:, None]
    seconds = total(weight)
    moving = seconds > 1e-9
    safe = np.where(moving, seconds, 1.0)
    mean = np.where(moving, total(x * weight) / safe, total(x * cell) / total(cell))
    count = np.where(moving, total(read.astype(float)), 0.0)
    return mean, count, total(missed * weight) / safe**2


def _between(
    time: Float[np.ndarray, " row"], x: Float[np.ndarray, " row"], read: Bool[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, " row"], Float[np.ndarray, " row"]]:
    """Return a signal interpolated between its readings, and the variance rate of possible jumps.

    In the rows between two readings that differ by d and are a time T [s] apart, the rate is
    d^2 T / 12; it is 0 between readings in successive rows. Its integral over T is the variance of
    the signal's integral if the signal jumped once between the readings, at an unknown time.
    """
    if not read.any():
        return x, np.zeros_like(x)
    at = np.flatnonzero(read)
    rows, seconds = np.diff(at), np.diff(time[at])
    missed = np.zeros_like(x)
    missed[at[0] : at[-1]] = np.repeat(np.diff(x[at]) ** 2 * seconds / 12 * (rows > 1), rows)
    return np.interp(time, time[read], x[read]), missed
