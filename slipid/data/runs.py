"""Class `Runs`: a set of runs of different lengths in one set of flat arrays."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.log import Log
from slipid.data.wheel_signals import (
    MOVED_M,
    bridge_stalls,
    first_moved,
    integral,
    read_anew,
    refresh_period,
)
from slipid.support.errors import DataError


@dataclass(frozen=True, eq=False)
class Runs:
    """A set of runs; each array contains the samples of all runs, one run after another.

    Attributes:
        logs: the runs; their arrays are views of the flat arrays below, but a run in which a stall
            was bridged keeps its own raw wheel angles.
        offset: index of the first sample of each run; the last element is the number of samples.
        time: time within the run [s] (sample,).
        wheel_angle: angle of each wheel [rad] (sample, wheel), linear across telemetry stalls.
        steering: steering angle [rad] (sample,), or None if a run has none.
        pose: x [m], y [m], heading [rad], in the scale of the log; nan in coordinates that were not
            measured.
        fresh: False where the row repeats the last camera frame.
        live: False in the rows of a telemetry stall, whose currents are stale.
        current: motor currents [A] (sample, wheel), or None if a run has none.
        voltage: motor voltages [V] (sample, wheel), or None if a run has none.
        current_fresh: False where a current repeats the last reading (sample, wheel), or None.
        voltage_fresh: False where a voltage repeats the last reading (sample, wheel), or None.
        current_is_signed: False if some log has only magnitudes of currents.
        current_is_torque: True if `current` has torques at the wheels [N m].
        session: name of each run's session; within a session the camera's marker was not moved on
            the robot.
        heading: commanded direction of travel of each run [rad]; nan if the robot turns on the spot
            or no command was logged.
        speed: commanded speed of each run [m/s]; nan if no command was logged.
        turn: commanded yaw rate of each run [rad/s]; nan if no command was logged.
        aside: one line about each run that was left out because its poses are unusable.
    """

    logs: tuple[Log, ...]
    offset: Int[np.ndarray, " runs_and_one"]
    time: Float[np.ndarray, " sample"]
    wheel_angle: Float[np.ndarray, "sample wheel"]
    steering: Float[np.ndarray, " sample"] | None
    pose: Float[np.ndarray, "sample 3"]
    fresh: Bool[np.ndarray, " sample"]
    live: Bool[np.ndarray, " sample"]
    current: Float[np.ndarray, "sample wheel"] | None
    voltage: Float[np.ndarray, "sample wheel"] | None
    current_fresh: Bool[np.ndarray, "sample wheel"] | None
    voltage_fresh: Bool[np.ndarray, "sample wheel"] | None
    current_is_signed: bool
    current_is_torque: bool
    session: tuple[str, ...]
    heading: Float[np.ndarray, " run"]
    speed: Float[np.ndarray, " run"]
    turn: Float[np.ndarray, " run"]
    aside: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.logs)

    def __repr__(self) -> str:
        """Return counts and durations by floor and load set-up, the channels, and the sessions."""
        wheels = self.wheel_angle.shape[1]
        lines = [f"{counted(len(self), 'run')} of {counted(wheels, 'drive')}, {_spans(self.logs)}"]
        groups: dict[tuple[str, str], list[Log]] = {}
        for log in self.logs:
            groups.setdefault((log.surface or "unknown floor", log.load), []).append(log)
        rows = [
            f"{floor}, {load}: {counted(len(logs), 'run')}, {_spans(logs)}"
            for (floor, load), logs in sorted(groups.items())
        ]
        sessions = dict(Counter(self.session).most_common())
        each = [f"{name} ({counted(runs, 'run')})" for name, runs in sessions.items()]
        lines += _first(rows, "floors and load set-ups")
        lines.append(f"channels: {', '.join(channels(self.logs))}")
        lines.append(f"{counted(len(sessions), 'session')}:")
        lines += _first(each, "sessions")
        if self.aside:
            lines += [f"{counted(len(self.aside), 'run')} set aside:", *_first(self.aside, "runs")]
        return "\n".join(lines)

    @cached_property
    def surface(self) -> tuple[str, ...]:
        """Name of the floor of each run; `unknown` if its log names none."""
        return tuple(log.surface or "unknown" for log in self.logs)

    def rows(self, run: int) -> slice:
        """Return the slice of the flat arrays that holds one run."""
        return slice(int(self.offset[run]), int(self.offset[run + 1]))

    def turned(self, run: int) -> Float[np.ndarray, "row column"]:
        """Return the wheel angles [rad] of a run.

        If the steering angle is logged, its integral over the mean of the wheel angles [rad^2] and
        the time [s] follow.
        """
        rows = self.rows(run)
        angle = self.wheel_angle[rows]
        if self.steering is None:
            return angle
        steered = integral(angle.mean(axis=1), self.steering[rows, None])
        return np.concatenate([angle, steered, self.time[rows, None]], axis=1)

    def subset(self, keep: Iterable[int] | np.ndarray) -> "Runs":
        """Return the runs with the given indices, in the given order."""
        index = [int(k) for k in keep]
        return collect([self.logs[i] for i in index], [self.session[i] for i in index])

    def __add__(self, other: "Runs") -> "Runs":
        """Return the runs of both sets.

        Raises:
            DataError: a run is in both sets, or the numbers of wheels differ.
        """
        if both := {log.name for log in self.logs} & {log.name for log in other.logs}:
            raise DataError(f"{min(both)}: in both sets of runs; expected every run only once")
        aside = [*self.aside, *other.aside]
        return collect([*self.logs, *other.logs], [*self.session, *other.session], aside)


def collect(
    logs: Sequence[Log], session: Sequence[str] | None = None, aside: Sequence[str] = ()
) -> Runs:
    """Return runs with wheels and poses as one set.

    Args:
        logs: the runs.
        session: name of each run's session; within a session the camera's marker was not moved on
            the robot. By default the runs with the same surface, load set-up and commanded speed
            are one session, since such runs are usually driven one after another.
        aside: one line about each run that was left out because its poses are unusable.

    Raises:
        DataError: there is no run, the numbers of wheels differ, only some runs have torques, or a
            run has no poses.
    """
    if not logs:
        raise DataError("no runs; expected at least one log")
    for log in logs:
        if log.wheels != logs[0].wheels:
            raise DataError(
                f"{log.name}: {log.wheels} wheels; expected {logs[0].wheels}, as in {logs[0].name}"
            )
        if log.current_is_torque != logs[0].current_is_torque:
            raise DataError(
                f"{log.name} and {logs[0].name}: one has torques and the other has none; expected "
                "torques in all runs, or torque_constant [N m/A] in the layout of the torques"
            )
        if log.pose is None:
            raise DataError(
                f"{log.name}: no pose; expected columns of x and y, of a heading, or of all three"
            )
    offset = np.concatenate([[0], np.cumsum([log.samples for log in logs])])
    heading, speed, turn = np.array([_command(log) for log in logs]).T
    bridged = [bridge_stalls(log.time, log.wheel_angle) for log in logs]
    flat: dict[str, np.ndarray] = {}
    for name in ("time", "pose", "current", "voltage", "steering"):
        parts = [getattr(log, name) for log in logs]
        if not any(p is None for p in parts):
            flat[name] = np.concatenate(parts)
    flat["wheel_angle"] = np.concatenate([angle for angle, _ in bridged])
    flat["pose_fresh"] = np.concatenate(
        [np.ones(log.samples, bool) if log.pose_fresh is None else log.pose_fresh for log in logs]
    )

    def view(k: int, log: Log) -> Log:
        """Return a run with views of the flat arrays; one with stalls keeps its wheel angle."""
        views: dict[str, Any] = {n: a[offset[k] : offset[k + 1]] for n, a in flat.items()}
        if bridged[k][0] is not log.wheel_angle:
            del views["wheel_angle"]
        return replace(log, **views)

    return Runs(
        logs=tuple(view(k, log) for k, log in enumerate(logs)),
        offset=offset,
        time=flat["time"],
        wheel_angle=flat["wheel_angle"],
        steering=flat.get("steering"),
        pose=flat["pose"],
        fresh=flat["pose_fresh"],
        live=np.concatenate([~stalled for _, stalled in bridged]),
        current=flat.get("current"),
        voltage=flat.get("voltage"),
        current_fresh=_fresh(logs, "current"),
        voltage_fresh=_fresh(logs, "voltage"),
        current_is_signed=all(log.current_is_signed for log in logs),
        current_is_torque=logs[0].current_is_torque,
        session=tuple(session or (default_session(log) for log in logs)),
        heading=heading,
        speed=speed,
        turn=turn,
        aside=tuple(aside),
    )


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _spans(logs: Sequence[Log]) -> str:
    """Return the total duration of runs, and the shortest and longest duration."""
    seconds = [log.duration for log in logs]
    total = sum(seconds)
    whole = f"{total / 60:.1f} min" if total >= 60 else f"{total:.1f} s"
    if len(seconds) == 1:
        return whole
    return f"{whole} ({min(seconds):.1f} to {max(seconds):.1f} s each)"


_MOST_LINES = 7
"""Largest number of lines of one list in the text of `Runs`."""


def _first(lines: Sequence[str], noun: str) -> list[str]:
    """Return the first lines of a list, indented; the last one counts the omitted ones, if any."""
    shown = lines if len(lines) <= _MOST_LINES else lines[: _MOST_LINES - 1]
    more = len(lines) - len(shown)
    return [*(f"  {line}" for line in shown), *([f"  and {more} more {noun}"] if more else [])]


_CHANNELS = (
    *("wheel_speed", "wheel_speed_command", "twist_command", "current", "voltage"),
    *("duty", "bus_voltage", "gyro", "steering", "pose"),
)
"""Channels of which the logged ones are listed, in this order."""


def channels(logs: Sequence[Log]) -> list[str]:
    """Return the names of the logged channels, with remarks such as "(3 of 5 runs)"."""
    names = []
    for name in _CHANNELS:
        if count := sum(getattr(log, name) is not None for log in logs):
            part = "" if count == len(logs) else f" ({count} of {len(logs)} runs)"
            unsigned = name == "current" and not all(log.current_is_signed for log in logs)
            names.append(f"{name}{part}{' (unsigned)' if unsigned else ''}")
    return names


def _fresh(logs: Sequence[Log], channel: str) -> Bool[np.ndarray, "sample wheel"] | None:
    """Return whether each row of all runs has a new reading of a channel; None if every row has."""
    each = [getattr(log, f"{channel}_fresh") for log in logs]
    if all(fresh is None for fresh in each):
        return None
    shapes = [(log.samples, log.wheels) for log in logs]
    return np.concatenate(
        [np.ones(s, bool) if f is None else f for f, s in zip(each, shapes, strict=True)]
    )


def counted_once(logs: Sequence[Log]) -> list[Log]:
    """Return the logs with `current_fresh` False in rows that only repeat the last current reading.

    The refresh period of each ammeter is estimated from all runs together, because a short run has
    too few changes: an ammeter read once a second changes only six times in six seconds. Voltages
    are not checked: a voltage that is set by a test bench or a program stays constant between its
    steps, although it is read in every row.
    """
    have = [k for k, log in enumerate(logs) if log.current is not None]
    wheels = max((logs[k].wheels for k in have), default=0)
    periods: dict[int, float] = {}
    for wheel in range(wheels):
        some = [logs[k] for k in have if logs[k].wheels > wheel]
        period = refresh_period(_readings(log, _rows_read(log, wheel), wheel) for log in some)
        if period is not None:
            periods[wheel] = period
    out = list(logs)
    for k in have if periods else ():
        before = out[k].current_fresh
        shape = (out[k].samples, out[k].wheels)
        fresh = np.ones(shape, dtype=bool) if before is None else before.copy()
        for wheel, period in periods.items():
            rows = _rows_read(out[k], wheel)
            fresh[rows, wheel] &= read_anew(*_readings(out[k], rows, wheel), period)
        listed = ", ".join(sorted({f"{p:.2g}" for p in periods.values()}))
        note = f"the current is refreshed every {listed} s: repeated values in between are ignored"
        out[k] = replace(out[k], current_fresh=fresh, notes=(*out[k].notes, note))
    return out


def _rows_read(log: Log, wheel: int) -> Int[np.ndarray, " read"]:
    """Return the rows of a run in which the ammeter of one wheel was read."""
    fresh = log.current_fresh
    return np.arange(log.samples) if fresh is None else np.flatnonzero(fresh[:, wheel])


def _readings(log: Log, rows: np.ndarray, wheel: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and currents [A] of the ammeter of one wheel in the given rows."""
    assert log.current is not None
    return log.time[rows], log.current[rows, wheel]


def default_session(log: Log) -> str:
    """Return the session name `surface/load/speed` of a run.

    The commanded speed is rounded to 0.01 m/s, and absent if no command was logged.
    """
    _, speed, _ = _command(log)
    parts = [log.surface or "unknown", log.load] + ([f"{speed:.2f}"] if np.isfinite(speed) else [])
    return "/".join(parts)


def _command(log: Log) -> tuple[float, float, float]:
    """Return the direction of travel [rad], speed [m/s] and yaw rate [rad/s] of the median command.

    All are nan if no command was logged; the direction is nan if the robot turns on the spot.
    """
    if log.twist_command is None:
        return np.nan, np.nan, np.nan
    x, y, turn = np.median(log.twist_command, axis=0).tolist()
    speed = float(np.hypot(x, y))
    return float(np.arctan2(y, x)) if speed > 1e-4 else np.nan, speed, turn


def first_row(data: Runs, run: int, wheel_radius: float) -> int:
    """Return the first row of a run in which the rim of some wheel has moved by `MOVED_M`.

    Raises:
        DataError: no rim moves that far in the run.
    """
    first = first_moved(data.wheel_angle[data.rows(run)], wheel_radius)
    if first is None:
        raise DataError(
            f"{data.logs[run].name}: no wheel rim moves by {MOVED_M * 1000:.0f} mm; expected a "
            "run in which the robot drives"
        )
    return first
