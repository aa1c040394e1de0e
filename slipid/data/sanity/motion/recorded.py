"""The channels of all runs on one clock, so that each is read at any time by one interpolation."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from slipid.data.log import Log
from slipid.data.runs import Runs
from slipid.data.wheel_signals import integral, interpolate


@dataclass(frozen=True, eq=False)
class Flat:
    """One channel of all runs, end to end on the clock of `Recorded`.

    Attributes:
        time: on that clock [s], increasing.
        value: one column per wheel or axis; nan in runs that lack the channel.
    """

    time: Float[np.ndarray, " row"]
    value: Float[np.ndarray, "row column"]

    def at(self, when: Float[np.ndarray, " at"]) -> Float[np.ndarray, "at column"]:
        """Values at other times of the clock [s], linear in between."""
        return interpolate(self.time, self.value, when)


@dataclass(frozen=True, eq=False)
class Recorded:
    """What all runs recorded, run after run on one clock with pauses in between.

    Attributes:
        names: of the runs.
        begin: when each run's poses and encoders begin (run,) [s].
        end: when they end (run,) [s].
        row: usual time between rows of each run (run,) [s].
        angle: angle of each wheel [rad].
        pose: x [m], y [m], heading [rad] where it is fresh.
        reported: integral of the reported wheel speeds [rad], or None.
        commanded: integral of the commanded wheel speeds [rad], or None.
        twist: integral of the commanded twist in the body's axes [m, m, rad], or None.
        gyro: integral of the yaw rate [rad], or None.
        current: of each motor [A], or None.
        voltage: of each motor [V], or None.
        bus: voltage of the battery [V], or None.
        current_is_signed: False where some run has magnitudes only.
    """

    names: tuple[str, ...]
    begin: Float[np.ndarray, " run"]
    end: Float[np.ndarray, " run"]
    row: Float[np.ndarray, " run"]
    angle: Flat
    pose: Flat
    reported: Flat | None
    commanded: Flat | None
    twist: Flat | None
    gyro: Flat | None
    current: Flat | None
    voltage: Flat | None
    bus: Flat | None
    current_is_signed: bool

    @property
    def wheels(self) -> int:
        """Number of wheels."""
        return self.angle.value.shape[1]

    def runs_of(self, when: Float[np.ndarray, " at"]) -> Int[np.ndarray, " at"]:
        """Run that each time of the clock belongs to."""
        return np.searchsorted(self.begin, when + 1e-9, side="right") - 1


def recorded(data: Runs) -> Recorded:
    """Channels of runs on one clock; with a second between them."""
    first = np.array([log.time[0] for log in data.logs])
    length = np.array([log.duration for log in data.logs])
    starts = np.concatenate([[0.0], np.cumsum(length + 1.0)])[:-1]
    shift = np.repeat(starts - first, np.diff(data.offset))
    time = data.time + shift
    # a pose holds to both ends of its run: nothing is drawn between runs
    fresh = data.fresh.copy()
    fresh[data.offset[:-1]] = fresh[data.offset[1:] - 1] = True

    def channel(of: Callable[[Log], np.ndarray | None]) -> Flat | None:
        return _joined(time, data, of)

    return Recorded(
        names=tuple(log.name for log in data.logs),
        begin=starts,
        end=starts + length,
        row=np.array([float(np.median(np.diff(log.time))) for log in data.logs]),
        angle=Flat(time, data.wheel_angle),
        pose=Flat(time[fresh], data.pose[fresh]),
        reported=channel(lambda log: _summed(log, log.wheel_speed)),
        commanded=channel(lambda log: _summed(log, log.wheel_speed_command)),
        twist=channel(lambda log: _summed(log, log.twist_command)),
        gyro=channel(lambda log: _summed(log, log.gyro)),
        current=channel(lambda log: log.current),
        voltage=channel(lambda log: log.voltage),
        bus=channel(lambda log: _column(log.bus_voltage)),
        current_is_signed=data.current_is_signed,
    )


def _joined(
    time: Float[np.ndarray, " row"], data: Runs, of: Callable[[Log], np.ndarray | None]
) -> Flat | None:
    """A channel of all runs, nan where a run lacks it; None where every run does."""
    parts = [of(log) for log in data.logs]
    columns = next((part.shape[1] for part in parts if part is not None), None)
    if columns is None:
        return None
    filled = [
        np.full((log.samples, columns), np.nan) if part is None else part
        for log, part in zip(data.logs, parts, strict=True)
    ]
    return Flat(time, np.concatenate(filled))


def _summed(log: Log, rate: np.ndarray | None) -> np.ndarray | None:
    """Integral of a rate over a run."""
    return None if rate is None else integral(log.time, np.asarray(rate).reshape(log.samples, -1))


def _column(values: np.ndarray | None) -> np.ndarray | None:
    return None if values is None else values[:, None]
