"""Checks of every log that is read; each error names the file, the row and what was expected."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.reading.layout import CHANNELS, TURNS, Layout, SensorLayout
from slipid.data.reading.signal import Signal, first_true
from slipid.data.reading.table import Table
from slipid.data.wheel_signals import integral
from slipid.support.errors import DataError, bad_data

MIN_ROWS = 2
"""Least number of rows of a run; fewer rows show no motion."""

LARGEST = 1e18
"""Largest magnitude of a number in a log; greater ones are damaged cells."""
_FARTHEST_M = 1e8
"""Largest coordinate of a pose [m]; an easting or northing of UTM is below 1e7."""
_FASTEST_RAD_S = 1e6
"""Largest usual speed of a wheel [rad/s]; ticks that are read as angles stay below it."""
# Largest possible magnitudes for wheeled robots; above them the unit or the sensor must be wrong.
_LIMITS = {
    "wheel_speed": (1000.0, "rad/s"),
    "wheel_speed_command": (1000.0, "rad/s"),
    "current": (1000.0, "A"),
    "bus_voltage": (1000.0, "V"),
    "duty": (1.5, "(1 is the full supply voltage)"),
    # The voltage comes after bus voltage and duty, since it may be their product: then the error is
    # about the wrong one of these two.
    "voltage": (1000.0, "V"),
    "gyro": (100.0, "rad/s"),
    "steering": (3.2, "rad"),
}


def check_time(table: Table, layout: Layout, time: Float[np.ndarray, " row"]) -> None:
    """Raise `DataError` if time is missing, repeats, goes backwards or jumps."""
    column = str(layout.channels["time"].columns[0]) if "time" in layout.channels else None

    def fail(at: int, found: str, expected: str) -> None:
        raise bad_data(table.path, found, expected, row=int(table.lines[at]), column=column)

    if len(time) < MIN_ROWS:
        fail(0, f"{len(time)} row(s) of numbers", f"at least {MIN_ROWS}")
    if (i := first_true(~np.isfinite(time))) is not None:
        found = "no time" if np.isnan(time[i]) else "an infinite time"
        fail(i, found, "a finite number in every row")
    steps = np.diff(time)
    if (steps == 0).all():
        fail(1, f"the time is {time[0]:g} s in every row", "time that increases")
    if (i := first_true(steps <= 0)) is not None:
        how = "repeats" if steps[i] == 0 else "goes backwards"
        fail(i + 1, f"time {how}: {time[i + 1]:.6g} s after {time[i]:.6g} s", "time that increases")
    usual = float(np.median(steps))
    if (i := first_true((steps > 20 * usual) & (steps > layout.max_gap))) is not None:
        found = f"the clock jumps by {steps[i]:.3g} s from {time[i]:.6g} s"
        fail(i + 1, found, f"steps of about {usual:.3g} s and none above {layout.max_gap:g} s")
    if not 1e-5 < usual < 60.0:
        fail(1, f"rows {usual:.3g} s apart", "10 us to 60 s; is the unit of time right?")


class UnusablePose(DataError):
    """Error about a run whose poses jump, or whose clock offset the motion does not determine.

    Such a run is left out, and the other runs are read.
    """


def check_sizes(signals: Mapping[str, Signal]) -> None:
    """Raise `DataError` if a value is too large after its conversion to SI units."""
    for name, signal in signals.items():
        for i, j in np.argwhere(np.abs(signal.values) > LARGEST)[:1].tolist():
            found = f"a {name} of {signal.values[i, j]:g} {CHANNELS[name]}"
            expected = "a measured number; are unit, scale and offset of the layout right?"
            raise signal.source.error(found, expected, sample=i, column=j)


def check_log(log: Log, signals: Mapping[str, Signal], layout: SensorLayout) -> None:
    """Raise `DataError` if a log has impossible magnitudes, signs or jumps, or a stuck channel.

    Args:
        log: the log.
        signals: signals from which the log was assembled, for the origin of a wrong value.
        layout: layout of the log's file.

    Raises:
        UnusablePose: the pose jumps.
    """
    for name, (limit, unit) in _LIMITS.items():
        values = getattr(log, name)
        if values is not None and np.abs(values).max(initial=0.0) > limit:
            i, j = _first(np.abs(values) > limit)
            value = values[i, j] if values.ndim == 2 else values[i]
            found = f"{name} of {value:.4g} {unit}"
            expected = f"at most {limit:g}; is the unit of the column right?"
            raise _at(log, signals, name, i, j, found, expected)
    if log.current is not None and not log.current_is_signed and log.current.min() < 0:
        i, j = _first(log.current < 0)
        found = f"a negative current ({log.current[i, j]:.4g} A)"
        expected = "magnitudes only, as declared in the layout (current_is_signed = false)"
        raise _at(log, signals, "current", i, j, found, expected)
    _check_wheels(log, signals, layout)
    if log.pose is not None:
        _check_pose(log, signals, layout)


def _check_wheels(log: Log, signals: Mapping[str, Signal], layout: SensorLayout) -> None:
    """Raise `DataError` if a wheel turns impossibly fast, or never turns although commanded to."""
    if not log.wheels:
        return
    rates = np.abs(np.diff(log.wheel_angle, axis=0)) / np.diff(log.time)[:, None]
    # In correct logs, the jump after a telemetry stall is about ten times the usual wheel speed;
    # the jump of a restarted counter is about a hundred times it.
    usual = float(np.quantile(rates, 0.99))
    if usual > _FASTEST_RAD_S:
        i, j = _first(rates > _FASTEST_RAD_S)
        found = f"the wheel turns {rates[i, j]:.4g} rad/s"
        expected = (
            f"at most {_FASTEST_RAD_S:g}; are unit, scale, ticks_per_revolution and gear_ratio of "
            "the layout right?"
        )
        raise _at(log, signals, "wheel", i + 1, j, found, expected)
    limit = max(30.0, 20.0 * usual)
    if rates.max() > limit:
        i, j = _first(rates > limit)
        found = f"the wheel turns {rates[i, j]:.4g} rad/s here"
        expected = (
            f"at most {limit:.3g}; does the counter restart, or wrap at {layout.tick_bits} bits?"
        )
        raise _at(log, signals, "wheel", i + 1, j, found, expected)
    command = log.wheel_speed_command
    if command is None:
        return
    # A wheel is dead if it was commanded to turn by more than 1 rad and its angle never changes.
    commanded = np.abs(integral(log.time, command)[-1])
    still = np.ptp(log.wheel_angle, axis=0) == 0
    if (dead := first_true(still & (commanded > 1.0))) is not None:
        found = f"constant, though the wheel was commanded to turn {commanded[dead]:.3g} rad"
        raise _at(log, signals, "wheel", None, dead, found, "a wheel that turns when commanded")


def _check_pose(log: Log, signals: Mapping[str, Signal], layout: SensorLayout) -> None:
    """Raise `UnusablePose` if a pose jumps, `DataError` if it is constant while wheels turn."""
    assert log.pose is not None
    assert log.pose_fresh is not None
    rows = np.flatnonzero(log.pose_fresh)
    pose = log.pose[rows]
    if (np.abs(pose[:, :2]) > _FARTHEST_M).any():
        i, j = _first(np.abs(pose[:, :2]) > _FARTHEST_M)
        found = f"a coordinate of {pose[i, j]:.4g} m"
        expected = f"at most {_FARTHEST_M:g}; is the unit of the column right?"
        raise _at(log, signals, ("pose_x", "pose_y")[j], int(rows[i]), 0, found, expected)
    steps = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    turns, most = np.degrees(np.abs(np.diff(pose[:, 2]))), np.degrees(layout.max_heading_jump)
    steps, turns = np.nan_to_num(steps), np.nan_to_num(turns)  # of coordinates without a sensor
    for column, what, jumps, limit, unit in (
        ("pose_x", "pose", steps, layout.max_pose_jump, "m"),
        ("pose_heading", "heading", turns, most, "deg"),
    ):
        if jumps.max(initial=0.0) > limit:
            i = int(np.argmax(jumps > limit))
            found = f"the {what} jumps by {jumps[i]:.3g} {unit}"
            key = "max_pose_jump" if unit == "m" else "max_heading_jump"
            expected = (
                f"at most {limit:.3g} {unit} between poses; another marker, or wrong unit? If "
                f"poses are rare, raise {key} of the layout"
            )
            raise UnusablePose(str(_at(log, signals, column, int(rows[i + 1]), 0, found, expected)))
    turned = np.ptp(log.wheel_angle, axis=0).max(initial=0.0)
    placed = not np.isnan(pose[0, 0])  # a heading may stay constant while the robot drives ahead
    if placed and turned > 2.0 and np.nanmax(np.ptp(pose, axis=0)) == 0:
        found = f"the pose is constant while a wheel turns {turned:.3g} rad"
        expected = "a pose that changes: was the marker visible?"
        raise _at(log, signals, "pose_x", None, 0, found, expected)


def _first(mask: np.ndarray) -> tuple[int, int]:
    """Return the row and column of the first True; the column is 0 if there are no columns."""
    at = np.argwhere(mask)[0]
    return int(at[0]), int(at[1]) if len(at) > 1 else 0


_NAMES = {
    "wheel": TURNS,
    "wheel_speed": ("wheel_speed", "motor_speed"),
    "wheel_speed_command": ("wheel_speed_command", "motor_speed_command"),
    "current": ("current", "motor_torque", "wheel_torque"),
    "voltage": ("voltage", "duty"),
    "steering": ("steering_angle",),
}
"""Channels of a file from which a channel of the log may be computed, keyed by the channel of the
log."""


def _at(
    log: Log,
    signals: Mapping[str, Signal],
    name: str,
    i: int | None,
    j: int,
    found: str,
    expected: str,
) -> DataError:
    """Return the error about a value of the log, with the row and column of the file it came from.

    Args:
        log: the log.
        signals: signals from which the log was assembled.
        name: channel of the log.
        i: row of the log, or None for an error about all rows.
        j: column of the channel.
        found: description of what is wrong.
        expected: what was expected instead.
    """
    signal = next((signals[n] for n in _NAMES.get(name, (name,)) if n in signals), None)
    if signal is None:
        return bad_data(log.path, found, expected)
    sample = None
    if i is not None:
        since = log.time[i] + (signal.time[0] - log.time[0] if signal.time[0] > 1e6 else 0.0)
        sample = max(int(np.searchsorted(signal.time, since + 1e-9, side="right")) - 1, 0)
    return signal.source.error(found, expected, sample=sample, column=j)
