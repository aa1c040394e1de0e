"""Study of log files: channels and clock of a file, and properties of a run's files together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from slipid.app.new.file_channels import FileChannel, FileChannels, channels_in, unnamed_channels
from slipid.app.new.robot_questions import RobotAnswers
from slipid.app.new.units import UnitGuess, position_unit, speed_of, time_unit
from slipid.data.reading.table_format import TableFormat, TableNumbers, numbers_of
from slipid.data.reading.units import factor
from slipid.data.wheel_signals import refresh_period

METRES = UnitGuess("m")
_ALIGNED_DRIVES = 2
"""Number of drives up to which all wheels are taken to point ahead."""
_SPARSE = 0.02
"""Share of empty cells above which a channel is slower than the rows of the file [1]."""
CURRENTS = ("current", "motor_torque", "wheel_torque")
SPEEDS = ("wheel_speed", "motor_speed")
ANGLES = ("wheel_angle", "motor_angle")


@dataclass(frozen=True, eq=False)
class FileStudy:
    """Study of one log file.

    Attributes:
        numbers: numbers in the file.
        channels: channels in the file.
        time: time of every row [s]; if no time is logged, the number of the row.
        clock: unit of the time; None if no time is logged.
    """

    numbers: TableNumbers
    channels: FileChannels
    time: Float[np.ndarray, " row"]
    clock: UnitGuess | None

    @property
    def format(self) -> TableFormat:
        """Return the format of the file."""
        return self.numbers.format

    @property
    def usual_step(self) -> float:
        """Return the median time between rows [s]."""
        steps = np.diff(self.time)
        steps = steps[steps > 0]
        return float(np.median(steps)) if len(steps) else 1.0


def study_file(format: TableFormat) -> FileStudy:
    """Return the study of a file; raise `DataError` if its numbers cannot be read."""
    numbers = numbers_of(format)
    columns = channels_in(numbers) if any(format.names) else unnamed_channels(numbers)
    found = columns.get("time")
    if found is None:
        return FileStudy(numbers, columns, np.arange(len(numbers.values), dtype=float), None)
    values = found.values[:, 0]
    clock = UnitGuess(found.unit) if found.unit else time_unit(values)
    return FileStudy(numbers, columns, values * factor(clock.unit, "s"), clock)


def reading_rate(one: FileStudy, found: FileChannel) -> str:
    """Return the rate of a channel's readings in words; empty if it is unknown.

    Empty cells and repeated values are taken into account.
    """
    values, time = found.values[:, 0], one.time
    there = ~np.isnan(values) & ~np.isnan(time)
    if there.sum() < 3 or one.clock is None:
        return ""
    time, values = time[there], values[there]
    steps = np.diff(time)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    empty = 1.0 - float(there.mean())
    often = f"{_rate_text(usual)}, empty in between" if empty > _SPARSE else _rate_text(usual)
    period = refresh_period([(time, values)])
    if period is not None and period > 1.5 * usual:
        return f"{often}; read anew {_rate_text(period)}"
    return often


def _rate_text(period: float) -> str:
    return f"{1.0 / period:.3g} Hz" if period > 0 else ""


@dataclass(frozen=True)
class PoseMotion:
    """Motion of the robot according to its logged pose; arrays are None without a pose.

    Attributes:
        speed: 90 % quantile of the speed [m/s]; None without a pose.
        unit: unit of x and y in the file.
        time: times of the poses [s].
        x, y: positions [m].
        steps: distance of each pose from the previous one [m].
    """

    speed: float | None = None
    unit: UnitGuess = METRES
    time: Float[np.ndarray, " pose"] | None = None
    x: Float[np.ndarray, " pose"] | None = None
    y: Float[np.ndarray, " pose"] | None = None
    steps: Float[np.ndarray, " pose"] | None = None


def pose_motion(one: FileStudy | None) -> PoseMotion:
    """Return the motion according to the pose in a file; it is empty if the file has no pose."""
    if one is None or not one.channels.has_pose:
        return PoseMotion()
    x, y = one.channels.get("pose_x"), one.channels.get("pose_y")
    assert x is not None
    assert y is not None
    px, py = x.values[:, 0], y.values[:, 0]
    if x.unit:
        place = UnitGuess(x.unit)
    elif one.clock is None:
        place = UnitGuess("m", doubt="in which unit?")
    else:
        place = position_unit(one.time, px, py)
    if place.unit in ("pixel", "pixels", "pix", "px") or one.clock is None:
        return PoseMotion(unit=place)
    scale = factor(place.unit, "m")
    there = ~(np.isnan(px) | np.isnan(py) | np.isnan(one.time))
    time, px, py = one.time[there], px[there] * scale, py[there] * scale
    steps = np.append(0.0, np.hypot(np.diff(px), np.diff(py)))
    return PoseMotion(speed_of(time, px, py), place, time, px, py, steps)


def ticks_are_increments(found: FileChannel, one: FileStudy, by_pose: PoseMotion) -> bool | None:
    """Return whether ticks are increments since the previous row; None if it is not clear.

    The path length by the pose is proportional to increments, else to the changes of the ticks.
    """
    values = np.nan_to_num(found.values)
    of_rows, of_changes = (
        np.abs(values).sum(axis=1)[1:],
        np.abs(np.diff(values, axis=0)).sum(axis=1),
    )
    if by_pose.time is not None and by_pose.steps is not None and len(by_pose.time) > 20:
        travelled = np.interp(one.time, by_pose.time, np.cumsum(by_pose.steps))
        width = max(1, len(travelled) // 60)
        sums = [
            _block_sums(row, width) for row in (of_rows, of_changes, np.abs(np.diff(travelled)))
        ]
        if all(float(np.std(part)) > 0 for part in sums):
            rows, changes = (float(np.corrcoef(part, sums[2])[0, 1]) for part in sums[:2])
            if abs(rows - changes) > 0.15:
                return rows > changes
    if not of_changes.any():
        return None
    usual = float(np.median(of_changes[of_changes > 0]))
    most = float(np.abs(values).sum(axis=1).max())
    return False if most > 60 * usual else None


def _block_sums(values: Float[np.ndarray, " row"], width: int) -> Float[np.ndarray, " part"]:
    """Return sums over blocks of `width` rows, which are less noisy than single rows."""
    count = len(values) // width
    return values[: count * width].reshape(count, width).sum(axis=1)


def pose_over_wheel_speed(one: FileStudy, speed: FileChannel, by_pose: PoseMotion) -> float | None:
    """Return the ratio of body speed [m/s] to wheel speed [unit of the file] while wheels turn.

    If wheel speeds are in rad/s and all wheels point ahead, it is the wheel radius [m]; for other
    robots it is close to that. The result is None if poses or wheel speeds are missing.
    """
    if by_pose.time is None or by_pose.x is None or by_pose.y is None or one.clock is None:
        return None
    # If all wheels point ahead, their mean is the signed motion; else the rms is its magnitude.
    ahead = speed.values.shape[1] <= _ALIGNED_DRIVES
    rows = speed.values.mean(axis=1) if ahead else np.sqrt((speed.values**2).mean(axis=1))
    there = ~(np.isnan(rows) | np.isnan(one.time))
    time, rows = one.time[there], rows[there]
    if len(time) < 3:
        return None
    turned = np.append(0.0, np.cumsum(0.5 * (rows[1:] + rows[:-1]) * np.diff(time)))
    start, end = max(time[0], by_pose.time[0]), min(time[-1], by_pose.time[-1])
    if end <= start:
        return None
    edges = np.linspace(start, end, max(2, int(end - start)))
    by_wheels = np.abs(np.diff(np.interp(edges, time, turned)))
    # Distances over long steps are used, since noise of the poses increases their path length.
    x, y = (np.interp(edges, by_pose.time, part) for part in (by_pose.x, by_pose.y))
    chords = np.hypot(np.diff(x), np.diff(y))
    good = by_wheels > 0.3 * by_wheels.max(initial=0.0)
    ratio = float(np.median(chords[good] / by_wheels[good])) if good.any() else 0.0
    return ratio if ratio > 0 else None


def has_sign(current: FileChannel, speed: FileChannel | None) -> bool | None:
    """Return whether currents have a sign; None if no wheel drives backwards to show it."""
    values = current.values[~np.isnan(current.values)]
    most = float(np.abs(values).max(initial=0.0))
    if float(values.min(initial=0.0)) < -0.02 * most:
        return True
    return False if has_magnitudes(current, speed) else None


def has_magnitudes(current: FileChannel, speed: FileChannel | None) -> bool:
    """Return whether currents are positive while wheels drive backwards, as magnitudes are.

    It is False if currents and speeds come from files with different rows, which do not show it.
    """
    if speed is None or speed.values.shape != current.values.shape:
        return False
    backwards = np.nan_to_num(speed.values) < -0.1 * float(np.nanmax(np.abs(speed.values)))
    known = np.nan_to_num(current.values)
    strong, least = (backwards & (k * known > 0.1 * np.abs(known).max()) for k in (1, -1))
    return float(strong.mean()) > max(0.01, 3 * float(least.mean()))


def is_battery_voltage(voltages: Sequence[FileChannel], speed: FileChannel | None) -> bool:
    """Return whether voltages stay high while wheel speeds change, as a battery's voltage does.

    Each run is divided by its 95 % quantile, so that a change of the battery or of its charge
    between runs does not look like the changing voltage of a motor.
    """
    runs = [one.values[~np.isnan(one.values)] for one in voltages]
    high = [float(np.quantile(np.abs(run), 0.95)) if run.size else 0.0 for run in runs]
    values = np.concatenate(
        [run / h for run, h in zip(runs, high, strict=True) if h] or [np.zeros(1)]
    )
    stays_up = float(np.quantile(values, 0.05)) > 0.6
    return stays_up and (speed is None or float(np.nanstd(speed.values)) > 0.0)


def file_with_pose(studies: tuple[FileStudy, ...]) -> FileStudy | None:
    """Return the first file with a pose, or None."""
    return next((one for one in studies if one.channels.has_pose), None)


@dataclass(frozen=True, eq=False)
class RunStudy:
    """Study of all files of a run together.

    Attributes:
        robot: answers about the robot, with defaults for unknown ones.
        main: file with the wheels.
        all: all files of the run.
        others: studies of further runs, for properties that a single run may not show.
    """

    robot: RobotAnswers
    main: FileStudy
    all: tuple[FileStudy, ...]
    others: tuple["RunStudy", ...] = ()

    @cached_property
    def by_pose(self) -> PoseMotion:
        """Return the motion according to the pose."""
        return pose_motion(file_with_pose(self.all))

    def find(self, *channels: str) -> FileChannel | None:
        """Return the first of some channels that is in one of the files, or None."""
        found = (one.channels.get(name) for name in channels for one in self.all)
        return next((one for one in found if one is not None), None)

    @property
    def runs(self) -> tuple["RunStudy", ...]:
        """Return this run and the others."""
        return (self, *self.others)

    @cached_property
    def pose_over_wheel_speed(self) -> float | None:
        """Return the median over all runs of the ratio of body speed to wheel speed, or None."""
        found = []
        for run in self.runs:
            speed = run.main.channels.first(*SPEEDS)
            angle = run.main.channels.first(*ANGLES)
            if speed is None and angle is not None and run.main.clock is not None:
                rates = np.gradient(angle.values, run.main.time, axis=0)
                speed = replace(angle, values=rates)
            ratio = None if speed is None else pose_over_wheel_speed(run.main, speed, run.by_pose)
            found += [ratio] if ratio is not None else []
        return float(np.median(found)) if found else None

    @property
    def has_sign(self) -> bool | None:
        """Return whether currents have a sign in some run; None if no run shows it."""
        signs = [
            has_sign(current, run.find(*SPEEDS))
            for run in self.runs
            if (current := run.find(*CURRENTS)) is not None
        ]
        return True if True in signs else False if False in signs else None

    @property
    def of_supply(self) -> bool:
        """Return whether currents are those of the supply.

        They are then positive in both directions of the wheels, and negative at times.
        """
        currents = [(run.find(*CURRENTS), run.find(*SPEEDS)) for run in self.runs]
        known = [(current, speed) for current, speed in currents if current is not None]
        both_ways = any(has_magnitudes(current, speed) for current, speed in known)
        return both_ways and any(np.nanmin(current.values) < 0.0 for current, _ in known)

    @property
    def radius(self) -> float | None:
        """Return the wheel radius [m] if the user gave it, else None."""
        taken = "wheel_radius_m" in self.robot.defaults
        return None if taken else self.robot.wheel_radius_m
