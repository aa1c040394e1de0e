"""Rows of a motor's records, cut into segments for `slipid.infer.bench.simulation`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.infer.bench.motor import BenchRecord
from slipid.infer.bench.simulation import CONTEXT, Inputs

MOST_ROWS = 20_000
"""Number of rows of a motor above which neighbouring rows are averaged."""
SEGMENTS = 64
"""Approximate number of segments of a fit."""
SMOOTH_ROWS = 4
"""Number of rows before and after a row between which the voltmeter's noise is averaged."""
QUIET_PART, QUIET_NOISE = 0.25, 0.3186
"""Quantile of second differences from which the noise is estimated, and that of a Gaussian."""
NOISE_STDS, MOST_NOISE = 3.0, 0.005
"""Difference of voltages that counts as noise [std], and largest noise relative to the range."""
GAP_RATIO = 3.5
"""Step between rows, in median steps, at which a record is cut in two."""
EXCERPTS = 5
"""Number of parts of a record in an excerpt."""
UNDRIVEN_S = 0.5
"""Approximate duration of segments without a voltage [s]."""
JUMP_STDS, JUMP_RATIO = 6.0, 0.01
"""Step of the voltage between rows above which it counts as a jump [robust std of steps], and
relative to the range of the voltage; both are exceeded."""
START_ROWS = 5
"""Number of rows whose median speed is the speed at the start of a record."""


Between = Literal["held", "straight", "jumps"]
"""Form of a voltage between rows: held, straight, or straight except for large steps."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of all records of a motor in segments: row k is the end of step k of its segment.

    Attributes:
        inputs: voltages and steps.
        current: current of each row, or its magnitude; 0 if it was not logged [A].
        speed: shaft speed of each row [rad/s].
        voltage: voltage of each row [V].
        used: True for rows, False for steps that only fill a segment.
        record: index of the record of each row.
        time: time of each row since the start of its record [s].
        start: state at the start of each segment, from measurements.
        first: True for segments that begin a record, or follow a gap in it.
        signed: False if currents are magnitudes.
        has_current: True if the current was logged.
    """

    inputs: Inputs
    current: Float[np.ndarray, "segment step"]
    speed: Float[np.ndarray, "segment step"]
    voltage: Float[np.ndarray, "segment step"]
    used: Bool[np.ndarray, "segment step"]
    record: Int[np.ndarray, "segment step"]
    time: Float[np.ndarray, "segment step"]
    start: Float[np.ndarray, "segment 2"]
    first: Bool[np.ndarray, " segment"]
    signed: bool
    has_current: bool

    @property
    def period(self) -> float:
        """Median time between rows [s]."""
        return self.inputs.period

    def between(self, form: "Between") -> "Rows":
        """Return the same rows with another form of the voltage between them."""
        padded = self.inputs.voltage
        straight = np.full(padded.shape, float(form != "held"))
        if form == "jumps":
            step = np.abs(np.diff(padded, axis=1, append=padded[:, -1:]))
            inner = np.abs(np.diff(self.voltage, axis=1))
            usual = 1.4826 * float(np.median(inner))
            straight[step > max(JUMP_STDS * usual, JUMP_RATIO * float(np.ptp(self.voltage)))] = 0.0
        shifted = float(form == "straight")
        return replace(self, inputs=self.inputs._replace(straight=straight, shifted=shifted))

    def continued(
        self, ends: Float[np.ndarray, "segment *n"], starts: Float[np.ndarray, "segment *n"]
    ) -> Float[np.ndarray, "segment *n"]:
        """Return what each segment starts from: its predecessor's end, or its own start."""
        out = np.roll(ends, 1, axis=0)
        out[self.first] = starts[self.first]
        return out

    def moved(
        self,
        x: Float[np.ndarray, "segment step *n"],
        start: Float[np.ndarray, "segment *n"],
        rows: int,
    ) -> Float[np.ndarray, "segment step *n"]:
        """Return what stood some rows before, or after if negative; `start` precedes a segment.

        What would be from before the start of a record, or after its end, is that at its start or
        its end.
        """
        count = x.shape[1]
        runs = np.cumsum(self.first) - 1
        first = np.flatnonzero(self.first)
        line = np.concatenate([start[:, None], x], axis=1)
        row = np.arange(1, count + 1) + count * np.arange(len(x))[:, None] - rows
        low = count * first[runs][:, None]
        high = count * np.append(first[1:], len(x))[runs][:, None]
        row = np.clip(row, low, high)
        # Row 0 of a run is its start; row k count of it is the last of segment k - 1.
        segment = np.where(row > low, (row - 1) // count, first[runs][:, None])
        return np.asarray(line[segment, np.where(row > low, (row - 1) % count + 1, 0)])


def rows_of(records: Sequence[BenchRecord], warm_up: float = 0.0) -> Rows:
    """Return the rows of records, of which all or none have voltages, and likewise currents.

    A part `warm_up` of each record, at its start, is simulated but not used.

    Without voltages the current drives the motor. The motor then hardly forgets its speed, so that
    every segment starts from the measured one.
    """
    driven = records[0].voltage is not None
    total = sum(len(r.time) for r in records)
    thinned = [_averaged(r, -(-total // MOST_ROWS)) for r in records]
    runs = [(k, run) for k, r in enumerate(thinned) for run in _without_gaps(r)]
    period = float(np.median(np.concatenate([np.diff(r.time) for r in thinned])))
    rows = sum(len(r.time) for _, r in runs)
    count = _segment_length(rows / SEGMENTS if driven else UNDRIVEN_S / period)
    middle = np.mean([r.time[-1] for r in thinned]) / 2
    parts = [_segments(k, r, thinned[k].time[0], count) for k, r in runs]
    table = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    for k, r in enumerate(thinned):
        early = table["time"] < warm_up * (r.time[-1] - r.time[0])
        table["used"] &= ~(early & (table["record"] == k))
    missing = -len(table["speed"]) % (SEGMENTS // 2)
    table = {
        name: np.concatenate([x, np.repeat(x[-1:], missing, axis=0)]) for name, x in table.items()
    }
    if missing:
        table["used"][-missing:] = False
        table["step"][-missing:] = 0.0
        table["first"][-missing:] = True
    padded = table.pop("padded")
    return Rows(
        inputs=Inputs(
            table.pop("step"),
            table["time"] - middle,
            padded,
            straight=np.zeros_like(padded),
            shifted=0.0,
            driven=float(driven),
            period=period,
        ),
        **table,
        signed=all(r.signed for r in records),
        has_current=all(r.current is not None for r in records),
    )


def excerpt(records: Sequence[BenchRecord], rows: int) -> list[BenchRecord]:
    """Return about a number of rows of records, in several parts of each record.

    Each part is where the voltage varies most, or the speed if there is none.
    """
    total = sum(len(r.time) for r in records)
    if total <= 1.5 * rows:
        return list(records)
    out = []
    for r in records:
        count = int(len(r.time) * rows / total / EXCERPTS)
        for k in range(EXCERPTS if count > 2 * START_ROWS else 0):
            part = r.part(k * len(r.time) // EXCERPTS, (k + 1) * len(r.time) // EXCERPTS)
            first = _most_varied(part.speed if part.voltage is None else part.voltage, count)
            out.append(part.part(first, first + count))
    return out or list(records)


def _most_varied(x: Float[np.ndarray, " row"], count: int) -> int:
    """Return the first one of a number of consecutive rows with the largest variance."""
    sums, squares = (np.cumsum(np.append(0.0, y)) for y in (x, x**2))
    mean, square = ((c[count:] - c[:-count]) / count for c in (sums, squares))
    return int(np.argmax(square - mean**2))


def _averaged(r: BenchRecord, block: int) -> BenchRecord:
    """Return a record with the means of blocks of rows."""
    if block < 2:
        return r
    count = len(r.time) // block
    return r.mapped(lambda x: x[: count * block].reshape(count, block).mean(axis=1))


def _without_noise(voltage: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    """Return a voltage with the noise of its meter averaged between rows of similar voltage.

    A simulation would pass the noise on, and delays and inductances that suppress it would fit
    best.
    The filter is bilateral (Tomasi and Manduchi 1998), so that steps stay.
    """
    bent = np.abs(np.diff(voltage, 2)) / np.sqrt(6)
    quiet = float(np.quantile(bent, QUIET_PART)) / QUIET_NOISE
    scale = NOISE_STDS * min(quiet, MOST_NOISE * float(np.ptp(voltage)))
    if scale <= 0:
        return voltage
    total, weights = np.zeros_like(voltage), np.zeros_like(voltage)
    padded = np.pad(voltage, SMOOTH_ROWS, mode="reflect")
    for k in range(2 * SMOOTH_ROWS + 1):
        moved = padded[k : k + len(voltage)]
        mirrored = padded[2 * SMOOTH_ROWS - k : 2 * SMOOTH_ROWS - k + len(voltage)]
        far = np.maximum(np.abs(moved - voltage), np.abs(mirrored - voltage))
        weight = np.exp(-0.5 * (far / scale) ** 2)
        total, weights = total + weight * moved, weights + weight
    return np.asarray(total / weights)


def _without_gaps(r: BenchRecord) -> list[BenchRecord]:
    """Return the parts of a record between gaps in time; parts of a few rows are left out."""
    step = np.diff(r.time)
    ends = [0, *(np.flatnonzero(step > GAP_RATIO * np.median(step)) + 1).tolist(), len(r.time)]
    return [r.part(a, b) for a, b in pairwise(ends) if b - a > START_ROWS]


def _segment_length(rows: float) -> int:
    """Return a length of at least some rows, of few values so that compiled programs are reused."""
    length = 16
    while length < rows:
        length = round(length * 1.25) if length % 5 else length * 6 // 5
    return length


def _segments(record: int, r: BenchRecord, began: float, count: int) -> dict[str, np.ndarray]:
    """Return the segments of a record without gaps, each channel with the axes segment and step."""
    steps = len(r.time) - 1
    number = -(-steps // count)
    fill = number * count - steps

    def cut(x: np.ndarray, value: float | bool | None = None) -> np.ndarray:
        last = x[-1] if value is None else value
        return np.append(x[1:], np.full(fill, last)).reshape(number, count)

    amps = np.zeros(len(r.time)) if r.current is None else r.current
    driven = amps if r.voltage is None else _without_noise(r.voltage)
    padded = np.pad(driven, (CONTEXT, CONTEXT + fill), mode="edge")
    window = count + 1 + 2 * CONTEXT
    starts = np.arange(number) * count
    around = np.clip(starts[:, None] + np.arange(START_ROWS) - START_ROWS // 2, 0, steps)
    speed = np.median(r.speed[around], axis=1)
    return {
        "step": np.pad(np.diff(r.time), (0, fill)).reshape(number, count),
        "padded": np.stack([padded[k : k + window] for k in starts]),
        "current": cut(amps if r.signed else np.abs(amps)),
        "speed": cut(r.speed),
        "voltage": cut(driven),
        "used": cut(np.ones(len(r.time), bool), False),
        "record": np.full((number, count), record),
        "time": cut(r.time - began),
        "start": np.stack([amps[starts], speed], 1),
        "first": (starts == 0) | (r.voltage is None),
    }
