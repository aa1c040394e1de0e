"""Assembly of the signals of one run, each at its own times, into a log with common times.

The log has a row for every time at which something was measured. Wheel angles are interpolated
linearly between their readings; every other channel keeps its latest reading, and repeated readings
are marked as not fresh, so that none is used twice.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.align.clock import Clock, best_clock
from slipid.data.align.regression import MotionPair
from slipid.data.log import Log, WheelReading
from slipid.data.reading.checks import UnusablePose
from slipid.data.reading.layout import GROUPS, TURNS, SensorLayout
from slipid.data.reading.signal import RawRun, Signal, clock_of, first_true
from slipid.data.wheel_signals import integral, readings
from slipid.support.errors import bad_data

_FEWEST_TICKS = 20
"""Least number of different whole numbers for which angles may be ticks."""
EPOCH = 1e6
"""Times above this are counted from 1970, not from the start of the robot [s]."""


def assembled(run: RawRun, layout: SensorLayout) -> Log:
    """Return the log of one run from its signals.

    Raises:
        DataError: there is no channel, the wheels were not measured for too long, or a channel has
            no value at all.
    """
    signals = run.signals
    if not signals:
        found = "no column except that of the time is known"
        raise bad_data(run.identity.path, found, "columns of the wheels and of the pose")
    turns = next((name for name in TURNS if name in signals), None)
    clock = clock_of(list(signals.values()))
    odometry = turns is None and "twist_yaw" in signals
    if (motion := "twist_yaw" if odometry else turns) is not None:
        first, last = signals[motion].time[[0, -1]]
        inside = (clock >= first) & (clock <= last)
        clock = clock if inside.all() else clock[inside]
        _check_gaps(signals[motion], layout)
    remarks = list(run.notes)
    wheels = _of_wheels(signals, layout)
    held = {name: _held(signal, clock) for name, signal in wheels.items()}
    angle = _angle(turns, signals, layout, clock, remarks)
    pose, fresh = _pose(signals, clock)
    start = clock[0] if clock[0] > EPOCH else 0.0
    is_torque = layout.torque_constant is None and "current" in wheels.keys() - signals.keys()
    voltage = None if is_torque else held.get("voltage")
    if voltage is None and not is_torque and {"duty", "bus_voltage"} <= held.keys():
        voltage = held["duty"] * held["bus_voltage"]
    return Log(
        **vars(run.identity),
        time=clock - start,
        wheel_angle=angle,
        wheel_reading=_reading(turns, signals, layout),
        wheel_speed=held.get("wheel_speed"),
        wheel_speed_command=held.get("wheel_speed_command"),
        travel=_travel(signals, clock) if odometry else None,
        twist_command=_twist(held, len(clock)),
        current=held.get("current"),
        current_fresh=_fresh(wheels.get("current"), clock),
        current_is_signed=layout.current_is_signed,
        current_is_torque=is_torque,
        voltage=voltage,
        voltage_fresh=_fresh(wheels.get("voltage", wheels.get("duty")), clock),
        duty=held.get("duty"),
        bus_voltage=held["bus_voltage"][:, 0] if "bus_voltage" in held else None,
        gyro=held["gyro"][:, 0] if "gyro" in held else None,
        steering=_steering(signals.get("steering_angle"), clock),
        pose=pose,
        pose_fresh=fresh,
        notes=tuple(remarks),
    )


def _check_gaps(signal: Signal, layout: SensorLayout) -> None:
    """Raise `DataError` if a wheel was not measured for too long, since its motion is then lost."""
    for column in range(signal.values.shape[1]):
        there = np.flatnonzero(~np.isnan(signal.values[:, column]))
        steps = np.diff(signal.time[there])
        if not len(steps):
            raise signal.source.error("no values", "the motion of every wheel", column=column)
        usual = float(np.median(steps))
        at = first_true((steps > 20 * usual) & (steps > layout.max_gap))
        if at is not None:
            found = f"no value for {steps[at]:.3g} s"
            expected = (
                f"values about every {usual:.3g} s, without gaps of more than max_gap = "
                f"{layout.max_gap:g} s"
            )
            raise signal.source.error(found, expected, sample=int(there[at]) + 1, column=column)


def _held(signal: Signal, clock: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time column"]:
    """Return the latest reading at each time of `clock`; earlier times get the first reading."""
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


def _steering(
    signal: Signal | None, clock: Float[np.ndarray, " time"]
) -> Float[np.ndarray, " time"] | None:
    """Return the steering angle at each time [rad], linear between its readings."""
    if signal is None:
        return None
    there = ~np.isnan(signal.values[:, 0])
    if not there.any():
        raise signal.source.error("no values", "at least one number", column=0)
    return np.interp(clock, signal.time[there], signal.values[there, 0])


def _fresh(
    signal: Signal | None, clock: Float[np.ndarray, " time"]
) -> Bool[np.ndarray, "time column"] | None:
    """Return whether a channel was measured at each time; None if always, or if not logged."""
    if signal is None or (signal.time is clock and not np.isnan(signal.values).any()):
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
    """Return the cumulative angle of each wheel [rad], 0 in the first row.

    The angle is computed from the channel `name`: ticks, angles, or speeds, which are integrated.
    If `name` is None, the result has no columns. Remarks are appended to the notes.
    """
    if name is None:
        return np.zeros((len(clock), 0))
    signal, columns, slow = signals[name], [], 0
    for values in signal.values.T:
        there = ~np.isnan(values)
        time, values = signal.time[there], values[there]
        if name.endswith("speed"):
            read = readings(time, values)
            slow += not read.all()
            time, values = time[read], values[read]
            values = integral(time, values[:, None])[:, 0]
        columns.append(np.interp(clock, time, values))
    if name.endswith("speed"):
        notes.append("wheel angle integrated from the reported speed")
    if slow:
        notes.append(
            "wheel speeds are refreshed less often than rows are logged: each reading is used once"
        )
    angle = np.stack(columns, axis=1) * per_wheel(name, layout)
    return angle - angle[0]


def _reading(name: str | None, signals: Mapping[str, Signal], layout: SensorLayout) -> WheelReading:
    """Return what the angles of the wheels are computed from: the channel `name`."""
    if name is None:
        return WheelReading()
    values = signals[name].values[~np.isnan(signals[name].values)]
    whole = name.endswith("angle") and bool((values == np.round(values)).all())
    whole = whole and len(np.unique(values)) >= _FEWEST_TICKS
    columns = signals[name].source.columns
    return WheelReading(name, layout.gear_ratio, whole, tuple(columns))


def per_wheel(name: str, layout: SensorLayout) -> float:
    """Return the angle of the wheel per tick [rad], or per angle at the measured shaft [1]."""
    if name == "wheel_ticks":
        return 2.0 * np.pi / (float(layout.ticks_per_revolution or 1.0) * layout.gear_ratio)
    return 1.0 / layout.gear_ratio if name.startswith("motor") else 1.0


def _of_wheels(signals: Mapping[str, Signal], layout: SensorLayout) -> dict[str, Signal]:
    """Return the signals, with wheel speeds and currents computed if they were not logged.

    The computed speeds are the motor speeds divided by the gear ratio. The computed currents are
    the motor torques divided by the torque constant; wheel torques are divided by the gear ratio as
    well. Without a torque constant they are the torques at the wheel (`Log.current_is_torque`).
    """
    gear = layout.gear_ratio
    constant = 1.0 / gear if layout.torque_constant is None else float(layout.torque_constant)
    out = dict(signals)
    for name, logged, ratio in (
        ("wheel_speed", "motor_speed", gear),
        ("wheel_speed_command", "motor_speed_command", gear),
        ("current", "motor_torque", constant),
        ("current", "wheel_torque", gear * constant),
    ):
        if name not in out and logged in signals:
            out[name] = replace(signals[logged], values=signals[logged].values / ratio)
    return out


def _twist(held: Mapping[str, np.ndarray], rows: int) -> np.ndarray | None:
    """Return the commanded twist, zero along axes that were not logged; None if none was."""
    names = GROUPS["twist_command"]
    if not held.keys() & set(names):
        return None
    return np.concatenate([held.get(name, np.zeros((rows, 1))) for name in names], axis=1)


def _travel(
    signals: Mapping[str, Signal], clock: Float[np.ndarray, " time"]
) -> Float[np.ndarray, "time 3"]:
    """Return the integrals of the reported twist, zero along axes that were not logged."""
    out = np.zeros((len(clock), 3))
    for k, name in enumerate(GROUPS["twist"]):
        if name in signals:
            there = ~np.isnan(signals[name].values[:, 0])
            time, values = signals[name].time[there], signals[name].values[there]
            out[:, k] = np.interp(clock, time, integral(time, values)[:, 0])
    return out - out[0]


def _pose(
    signals: Mapping[str, Signal], clock: Float[np.ndarray, " time"]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the pose at every time, its heading unwrapped, and whether each row has a new pose.

    Coordinates without a channel are nan.
    """
    parts = {k: signals[name] for k, name in enumerate(GROUPS["pose"]) if name in signals}
    if not parts:
        return None, None
    times, logged = clock_of([*parts.values()]), [*parts]
    samples = np.full((len(times), 3), np.nan)
    for k, part in parts.items():
        samples[np.searchsorted(times, part.time), k] = part.values[:, 0]
    whole = ~np.isnan(samples[:, logged]).any(axis=1) & (times >= clock[0]) & (times <= clock[-1])
    times, samples = times[whole], samples[whole]
    if not len(times):
        raise parts[logged[0]].source.error(
            "no pose while the wheels were measured", "times of both counted from the same start"
        )
    samples[:, 2] = np.unwrap(samples[:, 2])
    new = np.ones(len(times), dtype=bool)
    new[1:] = np.any(np.diff(samples[:, logged], axis=0) != 0, axis=1)
    rows = np.searchsorted(clock, times)
    fresh = np.zeros(len(clock), dtype=bool)
    fresh[rows] = new
    last = np.searchsorted(times, clock, side="right") - 1
    return samples[last.clip(0)], fresh


def clock_against(run: RawRun, layout: SensorLayout, poses: Mapping[str, Signal]) -> Clock:
    """Return the clock of poses relative to the robot's clock, estimated from the motion.

    Args:
        run: run with the signals of the robot's own file.
        layout: layout of that file.
        poses: signals of the channels of the pose, with times on the clock of the poses.

    Raises:
        UnusablePose: the motion does not determine the offset between the clocks.
    """
    log = assembled(run, layout)
    time = clock_of([*poses.values()])
    pose = np.full((len(time), 3), np.nan)
    for k, name in enumerate(GROUPS["pose"]):
        if name in poses:
            values = poses[name].values[:, 0]
            values = np.unwrap(values) if name == "pose_heading" else values
            pose[:, k] = np.interp(time, poses[name].time, values)
    clock = best_clock(_motion_pairs(log, time, pose))
    if clock is None:
        raise UnusablePose(
            f"{next(iter(poses.values())).source.path}: the motion does not determine the offset "
            f"of its clock from that of the run; expected poses of the same run, with starts, "
            "stops and turns in both, and the correct frame rate of the video"
        )
    # The offset refers to the times of the log, which start at 0 if the robot's clock counts from
    # 1970, so the start that was subtracted is added again.
    turns = next(name for name in (*TURNS, "twist_yaw") if name in run.signals)
    start = float(run.signals[turns].time[0] - log.time[0])
    return replace(clock, offset=clock.offset + start)


def _motion_pairs(
    robot: Log, time: Float[np.ndarray, " pose"], pose: Float[np.ndarray, "pose 3"]
) -> Iterator[MotionPair]:
    """Yield the motion pair of the gyro, if there is one, then that of the wheels.

    The gyro comes first because it turns exactly with the body, whereas wheels slip.
    """
    if robot.gyro is not None and not np.isnan(pose[:, 2]).any():
        yield MotionPair.of_gyro(robot.time, robot.gyro, time, pose)
    turned = robot.wheel_angle if robot.travel is None else robot.travel
    yield MotionPair.of_wheels(robot.time, turned, time, pose)
