"""Samples of one sensor at its own times: the common form of files and bags."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from slipid.support.errors import DataError, bad_data


@dataclass(frozen=True, eq=False)
class SignalSource:
    """Origin of the samples of a signal, for messages.

    Attributes:
        path: the file.
        columns: name of each column of the values, as the file or the message has it.
        lines: row in the file of every sample, or number of the message in its topic, from 1.
        topic: topic of a bag, None for a file of rows.
    """

    path: Path
    columns: tuple[str, ...]
    lines: Int[np.ndarray, " sample"]
    topic: str | None = None

    def error(
        self, found: str, expected: str, sample: int | None = None, column: int | None = None
    ) -> DataError:
        """Return the error about a sample (counted from 0), or about all of them."""
        row = None if sample is None else int(self.lines[sample])
        name = None if column is None or not self.columns else self.columns[column]
        if self.topic is None:
            return bad_data(self.path, found, expected, row=row, column=name)
        where = f"{self.path} topic '{self.topic}'"
        where += "" if row is None else f" message {row}"
        return bad_data(where, found, expected, column=name)

    def part(self, which: slice | np.ndarray) -> "SignalSource":
        """Return the source of some of the samples."""
        return SignalSource(self.path, self.columns, self.lines[which], self.topic)


@dataclass(frozen=True, eq=False)
class Signal:
    """Samples of one channel at the times of its own sensor.

    Attributes:
        time: increasing times on the clock that all signals of a run share [s]; they may count from
            1970.
        values: values in the unit of `CHANNELS` (SI), wheels or drives in the columns.
        source: origin of the samples.
    """

    time: Float[np.ndarray, " sample"]
    values: Float[np.ndarray, "sample column"]
    source: SignalSource

    def part(self, which: slice | np.ndarray) -> "Signal":
        """Return some of the samples."""
        return Signal(self.time[which], self.values[which], self.source.part(which))


def clock_of(signals: Sequence[Signal]) -> Float[np.ndarray, " time"]:
    """Return every time at which one of some signals was sampled, each once [s]."""
    first = signals[0].time
    if all(signal.time is first for signal in signals) and (np.diff(first) > 0).all():
        return first
    return np.unique(np.concatenate([signal.time for signal in signals]))
