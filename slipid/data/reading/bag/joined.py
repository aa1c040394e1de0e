"""Rows of numbers from one or several topics as the samples of one channel."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.data.reading.bag.clock import clock, seconds, timed
from slipid.data.reading.bag.layout import BagLayout
from slipid.data.reading.bag.messages.streams import Stream
from slipid.data.reading.signal import Source

ABSURD = 1e30
"""No sensor gives a number as large, in whatever unit: the bag is damaged."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Numbers of a channel as they are in the messages, at their times [s]."""

    time: Float[np.ndarray, " sample"]
    values: Float[np.ndarray, "sample column"]
    source: Source


def samples_of(stream: Stream, layout: BagLayout, notes: list[str]) -> Samples:
    """Rows of one stream that have every number, ordered in time.

    Raises:
        DataError: there are none, numbers are not finite, or the clock jumps.
    """
    stream = timed(finite(stream, layout, notes), layout, notes)
    whole = np.all(~stream.absent, axis=1)
    if not whole.all():
        notes.append(
            f"topic {stream.topic}: {(~whole).sum()} messages without all of "
            f"{', '.join(stream.columns)} left out"
        )
        stream = stream.part(whole)
    return _samples(stream, layout)


def side_by_side(
    streams: Sequence[Stream], layout: BagLayout, notes: list[str], *, by_name: bool
) -> Samples:
    """Columns that lie in several topics, or in messages that have some of them only.

    They are laid side by side at the times of the first column; the others are interpolated
    linearly there, and times that they do not span are left out.

    Args:
        streams: which hold the columns.
        layout: what the bag is read by.
        notes: which more are added to.
        by_name: whether the streams have the same columns, of which each is taken from the first
            that fills it in; else all columns of all streams are wanted.

    Raises:
        DataError: as `samples_of`, or no time is common to the columns.
    """
    ordered = [timed(finite(one, layout, notes), layout, notes) for one in streams]
    columns = _columns(ordered, layout, by_name)
    first = columns[0]
    inside = np.ones(len(first.time), dtype=bool)
    for other in columns[1:]:
        inside &= (first.time >= other.time[0]) & (first.time <= other.time[-1])
    time = first.time[inside]
    values = [np.interp(time, one.time, one.values[:, 0]) for one in columns]
    topics = ", ".join(dict.fromkeys(str(one.source.topic) for one in columns))
    names = tuple(one.source.columns[0] for one in columns)
    source = Source(first.source.path, names, first.source.lines[inside], topics)
    if not len(time):
        raise source.error("its columns share no time", "columns that were recorded together")
    gap = max(float(np.diff(one.time).max(initial=0.0)) for one in columns)
    notes.append(
        f"topics {topics}: {', '.join(names[1:])} came at other times than {names[0]} and were "
        f"interpolated to them (longest gap {gap:.3g} s)"
    )
    return Samples(time, np.column_stack(values), source)


def _columns(streams: Sequence[Stream], layout: BagLayout, by_name: bool) -> list[Samples]:
    """Each column for itself."""
    pairs = [(stream, j) for stream in streams for j in range(len(stream.columns))]
    if by_name:
        # every stream has a column for every joint, in which most of them are empty
        having = [(stream, j) for stream, j in pairs if not stream.absent[:, j].all()]
        owner = {j: stream for stream, j in reversed(having)}
        pairs = [(owner[j], j) for j in sorted(owner)]
    columns = []
    for stream, j in pairs:
        one = stream.part(~stream.absent[:, j])
        source = Source(one.path, (one.columns[j],), one.number, one.topic)
        columns.append(Samples(seconds(clock(one, layout)), one.values[:, [j]], source))
    return columns


def mostly_whole(stream: Stream) -> bool:
    """Whether about all rows that have one of the numbers have all of them."""
    whole = int((~stream.absent.any(axis=1)).sum())
    return whole >= 0.5 * int((~stream.absent).sum(axis=0).max(initial=0))


def finite(stream: Stream, layout: BagLayout, notes: list[str]) -> Stream:
    """Rows without NaN, where the layout lets these be left out; refuses all that is no number."""
    bad = ~np.all(np.abs(stream.values) < ABSURD, axis=1)
    if not bad.any():
        return stream
    rows = np.flatnonzero(bad)
    numbers = stream.values[rows[0]]
    j = int(np.argmin(np.abs(numbers) < ABSURD))
    if bad.all() or not layout.drop_nan or not np.isnan(stream.values[rows]).any(axis=1).all():
        found = f"{stream.columns[j]} is {numbers[j]:.3g} here, the first of {len(rows)} such"
        found += f" among {len(bad)} messages"
        expected = "numbers; to leave out messages with nan say: drop_nan = true"
        if bad.all():
            expected = "numbers; does the driver fill this field in?"
        raise stream.error(found, expected, int(rows[0]))
    column = stream.columns[j]
    notes.append(
        f"topic {stream.topic}: {len(rows)} messages without a number in {column} left out"
    )
    return stream.part(~bad)


def _samples(stream: Stream, layout: BagLayout) -> Samples:
    source = Source(stream.path, stream.columns, stream.number, stream.topic)
    return Samples(seconds(clock(stream, layout)), stream.values, source)
