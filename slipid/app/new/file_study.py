"""Study of log files: channels and clock of a file, and properties of a run's files together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from slipid.app.new.file_channels import (
    FileChannel,
    FileKind,
    channels_in,
    unnamed_channels,
)
from slipid.app.new.units import UnitGuess, position_unit, time_unit, usual_step
from slipid.data.reading.layout import TURNS
from slipid.data.reading.table_format import TableFormat, TableNumbers, numbers_of
from slipid.data.reading.units import factor
from slipid.data.wheel_signals import refresh_period

PIXELS = ("pixel", "pixels", "pix", "px")
_ALIGNED_DRIVES = 2
"""Largest number of drives for which all wheels are assumed to point ahead."""
_SPARSE = 0.02
"""Fraction of empty cells above which a channel is slower than the rows of the file [1]."""
CURRENTS = ("current", "motor_torque", "wheel_torque")
SPEEDS = ("wheel_speed", "motor_speed")
ANGLES = ("wheel_angle", "motor_angle")


@dataclass(frozen=True, eq=False)
class FileStudy:
    """Study of one log file.

    Attributes:
        numbers: numbers in the file.
        found: channels in the file.
        unused: names of the other columns.
        notes: remarks for the user.
        time: time of every row [s]; if no time is logged, the number of the row.
        clock: unit of the time; None if no time is logged.
    """

    numbers: TableNumbers
    found: Sequence[FileChannel]
    unused: Sequence[str]
    notes: Sequence[str]
    time: Float[np.ndarray, " row"]
    clock: UnitGuess | None

    @property
    def format(self) -> TableFormat:
        """Return the format of the file."""
        return self.numbers.format

    @property
    def wheels(self) -> int:
        """Return the number of wheels, or drives, with columns in the file."""
        turns = self.find(*TURNS)
        return len(turns.columns) if turns else 0

    @property
    def has_place(self) -> bool:
        """Return whether the file has positions: x and y."""
        return bool(self.find("pose_x") and self.find("pose_y"))

    @property
    def has_heading(self) -> bool:
        """Return whether the file has a heading or a quaternion."""
        return self.find("pose_heading", "pose_quaternion") is not None

    @property
    def has_whole_pose(self) -> bool:
        """Return whether the file has positions, and a heading or a quaternion."""
        return self.has_place and self.has_heading

    def find(self, *channels: str) -> FileChannel | None:
        """Return the first of some channels that the file has, or None if it has none of them."""
        return first_of(channels, [self])

    def channel(self, name: str) -> FileChannel:
        """Return a channel that the file has."""
        return next(one for one in self.found if one.channel == name)

    def without(self, names: frozenset[str]) -> "FileStudy":
        """Return the study without the channels in `names`, which come from another file."""
        kept = [one for one in self.found if one.channel not in names]
        again = sorted(one.channel for one in self.found if one.channel in names)
        note = f"Also here, but read from the other file: {', '.join(again)}."
        return replace(self, found=kept, notes=[*self.notes, note] if again else self.notes)


def first_of(channels: Sequence[str], files: Sequence[FileStudy]) -> FileChannel | None:
    """Return the first of some channels that is in one of the files, or None."""
    found = (
        one for name in channels for file in files for one in file.found if one.channel == name
    )
    return next(found, None)


def study_file(format: TableFormat) -> FileStudy:
    """Return the study of a file; raise `DataError` if its numbers cannot be read."""
    numbers = numbers_of(format)
    channels = channels_in(numbers) if any(format.names) else unnamed_channels(numbers)
    one = FileStudy(numbers, *channels, np.arange(len(numbers.values), dtype=float), None)
    if (found := one.find("time")) is None:
        return one
    values = found.values[:, 0]
    clock = UnitGuess(found.unit) if found.unit else time_unit(values)
    return replace(one, time=values * factor(clock.unit, "s"), clock=clock)


def reading_rate(one: FileStudy, found: FileChannel) -> str:
    """Return the rate of a channel's readings in words; empty if it is unknown.

    Empty cells and repeated values are taken into account.
    """
    values, time = found.values[:, 0], one.time
    there = ~np.isnan(values) & ~np.isnan(time)
    if there.sum() < 3 or one.clock is None:
        return ""
    time, values = time[there], values[there]
    usual = usual_step(time)
    empty = ", empty in between" if 1.0 - float(there.mean()) > _SPARSE else ""
    rate, period = f"{1 / usual:.3g} Hz{empty}", refresh_period([(time, values)])
    if period is not None and period > 1.5 * usual:
        return f"{rate}; read anew {1 / period:.3g} Hz"
    return rate


def pose_path(
    one: FileStudy | None,
) -> tuple[UnitGuess, Float[np.ndarray, "3 pose"] | None]:
    """Return the unit of the positions in a file, and the time [s], x and y [m] of each pose.

    Times and positions are None if the file has no positions or no time, or if positions are in
    pixels.
    """
    if one is None or not one.has_place:
        return UnitGuess("m"), None
    logged = one.channel("pose_x").unit
    x, y = (one.channel(name).values[:, 0] for name in ("pose_x", "pose_y"))
    if logged:
        unit = UnitGuess(logged)
    elif one.clock is None:
        unit = UnitGuess("m", doubt="in which unit?")
    else:
        unit = position_unit(one.time, x, y)
    if unit.unit in PIXELS or one.clock is None:
        return unit, None
    scale = factor(unit.unit, "m")
    path = np.stack([one.time, x * scale, y * scale])
    return unit, path[:, ~np.isnan(path).any(axis=0)]


def ticks_are_increments(found: FileChannel, run: "RunStudy") -> bool | None:
    """Return whether ticks are increments since the previous row; None if it is not clear.

    If the ticks are increments, the distance that the pose moves in a row is proportional to the
    ticks in the row; else it is proportional to the change of the ticks from the previous row.
    """
    values, path, time = np.nan_to_num(found.values), run.path, run.main.time
    of_rows = np.abs(values).sum(axis=1)[1:]
    of_changes = np.abs(np.diff(values, axis=0)).sum(axis=1)
    if path is not None and path.shape[1] > 20:
        steps = np.hypot(*np.diff(path[1:]))
        travelled = np.interp(time, path[0], np.append(0.0, np.cumsum(steps)))
        width = max(1, len(travelled) // 60)
        signals = (of_rows, of_changes, np.abs(np.diff(travelled)))
        sums = np.stack([_block_sums(row, width) for row in signals])
        if (sums.std(axis=1) > 0).all():
            rows, changes = np.corrcoef(sums)[:2, 2]
            if abs(rows - changes) > 0.15:
                return bool(rows > changes)
    if not of_changes.any():
        return None
    usual = float(np.median(of_changes[of_changes > 0]))
    most = float(np.abs(values).sum(axis=1).max())
    return False if most > 60 * usual else None


def _block_sums(values: Float[np.ndarray, " row"], width: int) -> Float[np.ndarray, " part"]:
    """Return sums over blocks of `width` rows, which are less noisy than single rows."""
    count = len(values) // width
    return values[: count * width].reshape(count, width).sum(axis=1)


def pose_over_wheel_speed(
    one: FileStudy,
    wheels: Float[np.ndarray, "row column"],
    path: Float[np.ndarray, "3 pose"] | None,
) -> float | None:
    """Return the ratio of body speed [m/s] to wheel speed [unit of the file] while wheels turn.

    If wheel speeds are in rad/s and all wheels point ahead, the ratio is the wheel radius [m]; for
    other robots it is close to the radius. The result is None if poses or wheel speeds are missing.
    """
    if path is None or one.clock is None:
        return None
    # If all wheels point ahead, their mean is the signed motion; else the rms is its magnitude.
    ahead = wheels.shape[1] <= _ALIGNED_DRIVES
    rows = wheels.mean(axis=1) if ahead else np.sqrt((wheels**2).mean(axis=1))
    there = ~(np.isnan(rows) | np.isnan(one.time))
    time, rows = one.time[there], rows[there]
    if len(time) < 3:
        return None
    turned = np.append(0.0, np.cumsum(0.5 * (rows[1:] + rows[:-1]) * np.diff(time)))
    start, end = max(time[0], path[0, 0]), min(time[-1], path[0, -1])
    if end <= start:
        return None
    edges = np.linspace(start, end, max(2, int(end - start)))
    by_wheels = np.abs(np.diff(np.interp(edges, time, turned)))
    # Distances over long steps are used, since noise of the poses increases their path length.
    chords = np.hypot(*(np.diff(np.interp(edges, path[0], part)) for part in path[1:]))
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

    The result is False if currents and speeds come from files with different rows, since they
    cannot be compared then.
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


def file_with_pose(studies: Sequence[FileStudy]) -> FileStudy | None:
    """Return a file with positions and headings, else one with either of them, or None."""
    posed = [one for one in studies if one.has_place or one.has_heading]
    return max(posed, key=lambda one: 2 * one.has_place + one.has_heading, default=None)


@dataclass(frozen=True, eq=False)
class RunStudy:
    """Study of all files of a run together.

    Attributes:
        kind: kind of the files with the wheels, one for each run.
        main: study of the file with the wheels.
        beside: name of each further file of the run, as in `Layout.beside`, and its study.
        others: studies of further runs, for properties that a single run may not show.
    """

    kind: FileKind
    main: FileStudy
    beside: tuple[tuple[str, FileStudy], ...] = ()
    others: tuple["RunStudy", ...] = ()

    @property
    def all(self) -> tuple[FileStudy, ...]:
        """Return the studies of all files of the run."""
        return (self.main, *(one for _, one in self.beside))

    @property
    def has_pose(self) -> bool:
        """Return whether a file of the run has poses, perhaps without positions or headings."""
        return file_with_pose(self.all) is not None

    @property
    def has_whole_pose(self) -> bool:
        """Return whether a file of the run has positions and headings."""
        return any(one.has_whole_pose for one in self.all)

    @property
    def complete(self) -> bool:
        """Return whether the run has wheels and a pose."""
        return self.has_pose and any(one.wheels for one in self.all)

    @cached_property
    def place_unit(self) -> UnitGuess:
        """Return the unit of the positions of the pose."""
        return pose_path(file_with_pose(self.all))[0]

    @cached_property
    def path(self) -> Float[np.ndarray, "3 pose"] | None:
        """Return the time [s], x and y [m] of each pose; None if they are unknown."""
        return pose_path(file_with_pose(self.all))[1]

    def find(self, *channels: str) -> FileChannel | None:
        """Return the first of some channels that is in one of the files, or None."""
        return first_of(channels, self.all)

    @property
    def runs(self) -> tuple["RunStudy", ...]:
        """Return this run and the runs in `others`."""
        return (self, *self.others)

    @cached_property
    def pose_over_wheel_speed(self) -> float | None:
        """Return the median over all runs of the ratio of body speed to wheel speed, or None."""
        found = []
        for run in self.runs:
            one, speed, angle = run.main, run.main.find(*SPEEDS), run.main.find(*ANGLES)
            if speed is not None:
                found.append(pose_over_wheel_speed(one, speed.values, run.path))
            elif angle is not None and one.clock is not None:
                rates = np.gradient(angle.values, one.time, axis=0)
                found.append(pose_over_wheel_speed(one, rates, run.path))
        known = [ratio for ratio in found if ratio is not None]
        return float(np.median(known)) if known else None

    @property
    def currents(self) -> list[tuple[FileChannel, FileChannel | None]]:
        """Return the currents and wheel speeds of each run with currents."""
        found = [(run.find(*CURRENTS), run.find(*SPEEDS)) for run in self.runs]
        return [(current, speed) for current, speed in found if current is not None]

    @property
    def has_sign(self) -> bool | None:
        """Return whether currents have a sign in some run; None if no run shows it."""
        signs = [has_sign(current, speed) for current, speed in self.currents]
        return True if True in signs else False if False in signs else None

    @property
    def of_supply(self) -> bool:
        """Return whether currents are those of the supply.

        Supply currents are positive in both directions of the wheels, and negative at times.
        """
        both_ways = any(has_magnitudes(*known) for known in self.currents)
        return both_ways and any(np.nanmin(current.values) < 0.0 for current, _ in self.currents)
