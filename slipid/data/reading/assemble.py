"""From the signals of one run to its log: one clock, and on it what every sensor said when.

The clock has every time at which something was measured. Wheels move on evenly between two readings
of their own; what else was not measured at a time is what was measured last, and marked as stale:
nothing counts twice, and nothing is invented.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.align.clock import Clock, best_clock
from slipid.data.align.regression import MotionPair
from slipid.data.log import Log
from slipid.data.reading.checks import Unsteady
from slipid.data.reading.layout import SensorLayout
from slipid.data.reading.signal import Signal, clock_of
from slipid.data.wheel_signals import integral, readings
from slipid.support.errors import bad_data

EPOCH = 1e6
"""Time from which on it is taken to count from 1970 and not from the start of the robot [s]."""
TURNS = ("wheel_ticks", "wheel_angle", "motor_angle", "wheel_speed", "motor_speed")
"""Channels that tell how far the wheels turned, the first that is there counts."""


@dataclass(frozen=True)
class Identity:
    """What a run is called and where it comes from; attributes as of `Log`."""

    name: str
    path: Path
    sha256: str
    surface: str | None
    load: str
    pose_clock: Clock | None = None


def assembled(
    signals: Mapping[str, Signal],
    layout: SensorLayout,
    identity: Identity,
    notes: tuple[str, ...] = (),
) -> Log:
    """The log of one run from its signals, by the names of their channels.

    Raises:
        DataError: the wheels were not measured for a while, or a channel has no value at all.
    """
    if not signals:
        found = "no column of anything but the time is known"
        raise bad_data(identity.path, found, "columns of the wheels and of the pose")
    turns = next((name for name in TURNS if name in signals), None)
    clock = clock_of(list(signals.values()))
    if turns is not None:
        first, last = signals[turns].time[[0, -1]]
        inside = (clock >= first) & (clock <= last)
        clock = clock if inside.all() else clock[inside]
        _check_gaps(signals[turns], layout)
    said = list(notes)
    held = {name: _held(signal, clock) for name, signal in signals.items()}
    angle = _angle(turns, signals, layout, clock, said)
    pose, fresh = _pose(signals, clock)
    start = clock[0] if clock[0] > EPOCH else 0.0
    return Log(
        **vars(identity),
        time=clock - start,
        wheel_angle=angle,
        wheel_speed=_at_wheel(held, layout, "speed"),
        wheel_speed_command=_at_wheel(held, layout, "speed_command"),
        twist_command=_twist(held, len(clock)),
        current=_current(held, layout),
        current_fresh=_fresh(signals, clock, ("current", "motor_torque", "wheel_torque")),
        current_is_signed=layout.current_is_signed,
        voltage=_voltage(held),
        voltage_fresh=_fresh(signals, clock, ("voltage", "duty")),
        duty=held.get("duty"),
        bus_voltage=held["bus_voltage"][:, 0] if "bus_voltage" in held else None,
        gyro=held["gyro"][:, 0] if "gyro" in held else None,
        pose=pose,
        pose_fresh=fresh,
        notes=tuple(said),
    )


def _check_gaps(signal: Signal, layout: SensorLayout) -> None:
    """Refuse wheels that were not measured for a while: nobody knows how they turned then."""
    for column in range(signal.values.shape[1]):
        there = np.flatnonzero(~np.isnan(signal.values[:, column]))
        steps = np.diff(signal.time[there])
        if not len(steps):
            raise signal.source.error("no values", "the motion of every wheel", column=column)
        usual = float(np.median(steps))
        bad = np.flatnonzero((steps > 20 * usual) & (steps > layout.max_gap))
        if len(bad):
            at = int(bad[0])
            raise signal.source.error(
                f"no value for {steps[at]:.3g} s",
                f"one about every {usual:.3g} s, and none missing for {layout.max_gap:g} s",
                sample=int(there[at]) + 1,
                column=column,
            )


def _held(signal: Signal, clock: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time column"]:
    """What was measured last at every time; before the first reading that one."""
    if signal.time is clock and not np.isnan(signal.values).any():
        return signal.values.copy()
    out = np.empty((len(clock), signal.values.shape[1]))
    for k, column in enumerate(signal.values.T):
        there = ~np.isnan(column)
        if not there.any():
            raise signal.source.error("no values", "at least one number", column=k)
        at = np.searchsorted(signal.time[there], clock, side="right") - 1
        out[:, k] = column[there][at.clip(0)]
    return out


def _fresh(
    signals: Mapping[str, Signal], clock: Float[np.ndarray, " time"], names: tuple[str, ...]
) -> Bool[np.ndarray, "time column"] | None:
    """Where the first of some channels that is there was measured; None where it always was."""
    name = next((name for name in names if name in signals), None)
    if name is None:
        return None
    signal = signals[name]
    if signal.time is clock and not np.isnan(signal.values).any():
        return None
    out = np.zeros((len(clock), signal.values.shape[1]), dtype=bool)
    inside = (signal.time >= clock[0]) & (signal.time <= clock[-1])
    rows = np.searchsorted(clock, signal.time[inside])
    out[rows] = ~np.isnan(signal.values[inside])
    return None if out.all() else out


def _angle(
    name: str | None,
    signals: Mapping[str, Signal],
    layout: SensorLayout,
    clock: Float[np.ndarray, " time"],
    notes: list[str],
) -> Float[np.ndarray, "time wheel"]:
    """Cumulative angle at the wheel: from ticks, else angles, else the integral of the speed."""
    if name is None:
        return np.zeros((len(clock), 0))
    signal, columns, slow = signals[name], [], 0
    for values in signal.values.T:
        there = ~np.isnan(values)
        time, values = signal.time[there], values[there]
        if name == "wheel_ticks":
            values = _ticks(values, layout, notes)
        elif name.endswith("speed"):
            read = readings(time, values)
            slow += not read.all()
            time, values = time[read], values[read]
            values = integral(time, values[:, None])[:, 0]
        columns.append(np.interp(clock, time, values))
    if name.endswith("speed"):
        notes.append("wheel angle integrated from the reported speed")
    if slow:
        notes.append("wheel speeds refresh slower than rows: each reading counts once")
    angle = np.stack(columns, axis=1) * _per_wheel(name, layout)
    return angle - angle[0]


def _per_wheel(name: str, layout: SensorLayout) -> float:
    """Angle of a wheel per tick, or per angle of what was measured."""
    if name == "wheel_ticks":
        return 2.0 * np.pi / (float(layout.ticks_per_revolution or 1.0) * layout.gear_ratio)
    return 1.0 / layout.gear_ratio if name.startswith("motor") else 1.0


def _ticks(
    ticks: Float[np.ndarray, " sample"], layout: SensorLayout, notes: list[str]
) -> Float[np.ndarray, " sample"]:
    """Cumulative ticks, without the wrap-around of a counter of `tick_bits` bits."""
    if layout.ticks_are_increments:
        return np.cumsum(ticks)
    period = 2.0**layout.tick_bits
    steps = np.diff(ticks)
    if np.abs(steps).max(initial=0.0) <= 0.5 * period:
        return ticks
    said = f"tick counter wrapped around at {layout.tick_bits} bits and was continued"
    if said not in notes:
        notes.append(said)
    return ticks - period * np.concatenate([[0.0], np.cumsum(np.round(steps / period))])


def _at_wheel(held: Mapping[str, np.ndarray], layout: SensorLayout, what: str) -> np.ndarray | None:
    if f"wheel_{what}" in held:
        return held[f"wheel_{what}"]
    if f"motor_{what}" in held:
        return held[f"motor_{what}"] / layout.gear_ratio
    return None


def _current(held: Mapping[str, np.ndarray], layout: SensorLayout) -> np.ndarray | None:
    """As logged, else the torque that a driver reports over its constant."""
    if "current" in held:
        return held["current"]
    for name, ratio in (("motor_torque", 1.0), ("wheel_torque", layout.gear_ratio)):
        if name in held:
            return held[name] / (ratio * float(layout.torque_constant or 1.0))
    return None


def _voltage(held: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """As logged, else the duty cycle of the bus voltage where both were."""
    if "voltage" not in held and {"duty", "bus_voltage"} <= held.keys():
        return held["duty"] * held["bus_voltage"]
    return held.get("voltage")


def _twist(held: Mapping[str, np.ndarray], rows: int) -> np.ndarray | None:
    names = [f"twist_command_{axis}" for axis in ("x", "y", "yaw")]
    if not held.keys() & set(names):
        return None
    return np.concatenate([held.get(name, np.zeros((rows, 1))) for name in names], axis=1)


def _pose(
    signals: Mapping[str, Signal], clock: Float[np.ndarray, " time"]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Pose with the heading unwrapped, and at which times it is a new one."""
    if "pose_x" not in signals:
        return None, None
    turned = heading(signals)
    parts = (signals["pose_x"], signals["pose_y"], turned)
    times = clock_of(parts)
    samples = np.full((len(times), 3), np.nan)
    for k, part in enumerate(parts):
        samples[np.searchsorted(times, part.time), k] = part.values[:, 0]
    whole = ~np.isnan(samples).any(axis=1) & (times >= clock[0]) & (times <= clock[-1])
    times, samples = times[whole], samples[whole]
    if not len(times):
        raise signals["pose_x"].source.error(
            "no pose while the wheels were measured", "clocks that agree: both from the same start"
        )
    samples[:, 2] = np.unwrap(samples[:, 2])
    new = np.ones(len(times), dtype=bool)
    new[1:] = np.any(np.diff(samples, axis=0) != 0, axis=1)
    rows = np.searchsorted(clock, times)
    fresh = np.zeros(len(clock), dtype=bool)
    fresh[rows] = new
    last = np.searchsorted(times, clock, side="right") - 1
    return samples[last.clip(0)], fresh


def heading(signals: Mapping[str, Signal]) -> Signal:
    """Heading [rad]: as logged, else that of a quaternion x, y, z, w."""
    if "pose_heading" in signals:
        return signals["pose_heading"]
    turned = signals["pose_quaternion"]
    x, y, z, w = turned.values.T
    size = np.sqrt(x**2 + y**2 + z**2 + w**2)
    bad = np.flatnonzero(np.abs(size - 1.0) > 0.05)
    if len(bad):
        raise turned.source.error(
            f"a quaternion of length {size[bad[0]]:.3g}",
            "x, y, z, w in this order, of length 1",
            sample=int(bad[0]),
        )
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return Signal(turned.time, yaw[:, None], turned.source)


def clock_against(
    robot: Mapping[str, Signal],
    layout: SensorLayout,
    identity: Identity,
    poses: Mapping[str, Signal],
) -> Clock:
    """The clock of poses against that of the robot's signals, from the motion that both saw.

    Args:
        robot: what the robot itself logged, by channel; layout and identity are of its file.
        poses: signals of a pose, by channel, on their own clock.

    Raises:
        Unsteady: the motion does not tell how far the clocks are apart.
    """
    log = assembled(robot, layout, identity)
    parts = (poses["pose_x"], poses["pose_y"], heading(poses))
    time = clock_of(parts)
    columns = [np.interp(time, part.time, part.values[:, 0]) for part in parts[:2]]
    turned = np.unwrap(parts[2].values[:, 0])
    pose = np.column_stack([*columns, np.interp(time, parts[2].time, turned)])
    clock = best_clock(_views(log, time, pose))
    if clock is None:
        raise Unsteady(
            f"{parts[0].source.path}: the motion does not tell its clock from that of {log.name}; "
            "expected poses of this very run, with starts, stops and turns that both saw, and the "
            "frame rate that the video has"
        )
    # a log that counts from 1970 was made to begin at zero
    turns = next(name for name in TURNS if name in robot)
    began = float(robot[turns].time[0] - log.time[0])
    return replace(clock, offset=clock.offset + began)


def _views(
    robot: Log, time: Float[np.ndarray, " pose"], pose: Float[np.ndarray, "pose 3"]
) -> Iterator[MotionPair]:
    """By the gyro where there is one, which turns with the body itself; by the wheels."""
    if robot.gyro is not None:
        yield MotionPair.of_gyro(robot.time, robot.gyro, time, pose)
    yield MotionPair.of_wheels(robot.time, robot.wheel_angle, time, pose)
