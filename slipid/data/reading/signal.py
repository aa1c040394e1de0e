"""Samples of one channel at the times of its sensor, and runs made of such channels."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.data.align.clock import Clock
from slipid.data.reading.layout import SensorLayout
from slipid.support.errors import DataError, bad_data


@dataclass(frozen=True, eq=False)
class SignalSource:
    """Origin of the samples of a signal, for messages.

    Attributes:
        path: path of the file.
        columns: name of each column of the values, as in the file or the message.
        lines: row of every sample in the file, or number of its message in the topic, from 1.
        topic: topic of the bag, or None for a file of rows.
    """

    path: Path
    columns: tuple[str, ...]
    lines: Int[np.ndarray, " sample"]
    topic: str | None = None

    def error(
        self, found: str, expected: str, sample: int | None = None, column: int | None = None
    ) -> DataError:
        """Return the error about one sample, or about all samples if `sample` is None.

        Args:
            found: what is wrong.
            expected: what was expected instead.
            sample: index of the sample from 0, or None.
            column: index of the column from 0, or None for an error about all columns.
        """
        row = None if sample is None else int(self.lines[sample])
        name = None if column is None or not self.columns else self.columns[column]
        if self.topic is None:
            return bad_data(self.path, found, expected, row=row, column=name)
        where = f"{self.path} topic '{self.topic}'"
        where += "" if row is None else f" message {row}"
        return bad_data(where, found, expected, column=name)

    def part(self, which: slice | np.ndarray) -> "SignalSource":
        """Return the source of the selected samples."""
        return SignalSource(self.path, self.columns, self.lines[which], self.topic)


@dataclass(frozen=True, eq=False)
class Signal:
    """Samples of one channel at the times of its own sensor.

    Attributes:
        time: increasing times on the clock that all signals of a run share [s]; they may count from
            1970.
        values: values in the SI unit of the channel (see `CHANNELS`), with a column for each wheel
            or drive, or a single column.
        source: origin of the samples.
    """

    time: Float[np.ndarray, " sample"]
    values: Float[np.ndarray, "sample column"]
    source: SignalSource

    def part(self, which: slice | np.ndarray) -> "Signal":
        """Return the selected samples."""
        return Signal(self.time[which], self.values[which], self.source.part(which))


@dataclass(frozen=True)
class Identity:
    """Name and origin of a run; the attributes are those of `Log`."""

    name: str
    path: Path
    sha256: str
    surface: str | None
    load: str
    pose_clock: Clock | None = None


@dataclass(frozen=True)
class RawRun:
    """A run whose signals were read, before they are assembled into a log.

    Attributes:
        identity: name and origin of the run.
        signals: signals by channel, in the units of `CHANNELS`.
        notes: repairs and omissions, one sentence each.
    """

    identity: Identity
    signals: dict[str, Signal]
    notes: tuple[str, ...] = ()


def clock_of(signals: Sequence[Signal]) -> Float[np.ndarray, " time"]:
    """Return the sorted, unique times at which any of the signals was sampled [s]."""
    first = signals[0].time
    if all(signal.time is first for signal in signals) and (np.diff(first) > 0).all():
        return first
    return np.unique(np.concatenate([signal.time for signal in signals]))


def first_true(mask: Bool[np.ndarray, " _"]) -> int | None:
    """Return the index of the first True, or None if there is none."""
    return int(np.argmax(mask)) if mask.any() else None


def cumulative_ticks(
    ticks: Float[np.ndarray, "row column"], layout: SensorLayout, notes: list[str]
) -> Float[np.ndarray, "row column"]:
    """Return the cumulative ticks of each wheel; cells that are NaN stay so.

    Increments are summed; the wrap-around of a counter of `tick_bits` bits is removed, with a note.
    The ticks must be those that the counter showed, since interpolated ones do not tell where it
    wrapped around.
    """
    period = 2.0**layout.tick_bits
    out = ticks.copy()
    for k, column in enumerate(ticks.T):
        there = ~np.isnan(column)
        counts = column[there]
        if layout.ticks_are_increments:
            out[there, k] = np.cumsum(counts)
        elif np.abs(steps := np.diff(counts)).max(initial=0.0) > 0.5 * period:
            out[there, k] -= period * np.concatenate([[0.0], np.cumsum(np.round(steps / period))])
            note = f"the wrap-around of the tick counter at {layout.tick_bits} bits was removed"
            notes += [] if note in notes else [note]
    return out


def heading(turned: Signal) -> Signal:
    """Return the yaw angle [rad] of quaternions x, y, z, w.

    Raises:
        DataError: the length of a quaternion is not close to 1.
    """
    x, y, z, w = turned.values.T
    size = np.sqrt(x**2 + y**2 + z**2 + w**2)
    if (bad := first_true(np.abs(size - 1.0) > 0.05)) is not None:
        found = f"a quaternion of length {size[bad]:.3g}"
        raise turned.source.error(found, "x, y, z, w in this order, of length 1", sample=bad)
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
    return Signal(turned.time, yaw[:, None], turned.source)
