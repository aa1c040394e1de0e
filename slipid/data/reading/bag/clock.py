"""The time of messages: which clock counts, in order, each time once."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from slipid.data.reading.bag.layout import BagLayout
from slipid.data.reading.bag.messages.streams import Stream
from slipid.data.reading.bag.transforms import STATIC
from slipid.support.errors import DataError

APART_NOTED = 0.5
"""Difference between two clocks that is worth a note [s]."""
APART_REFUSED = 60.0
"""Difference between two clocks that makes their times incomparable [s]."""


def timed(stream: Stream, layout: BagLayout, notes: list[str]) -> Stream:
    """Rows of a stream in the order of their time, each time once.

    Raises:
        DataError: stamps are zero, or the clock jumps back.
    """
    time = clock(stream, layout)
    zero = np.flatnonzero(time == 0)
    if len(zero) == len(time):
        expected = 'stamps that count; to use the time of receipt say: stamp = "received"'
        raise stream.error("every time stamp is zero", expected)
    if len(zero):
        expected = 'a stamp in every message; to use the time of receipt say: stamp = "received"'
        raise stream.error("the time stamp is zero", expected, int(zero[0]))
    steps = np.diff(time)
    if (steps > 0).all():
        return stream
    late = np.maximum.accumulate(time) - time
    jumps = np.flatnonzero(late > layout.max_disorder * 1e9)
    if len(jumps):
        found = f"the clock jumps back by {late[jumps[0]] / 1e9:.3g} s"
        expected = (
            f"messages late by at most max_disorder = {layout.max_disorder:g} s; was the clock "
            'set, or a recording added? To use the time of receipt say: stamp = "received"'
        )
        raise stream.error(found, expected, int(jumps[0]))
    if disordered := int((late > 0).sum()):
        notes.append(
            f"topic {stream.topic}: {disordered} messages out of order by up to "
            f"{late.max() / 1e9:.3g} s were sorted"
        )
    order = np.argsort(time, kind="stable")
    # of messages with one stamp the last one stands
    last = np.append(np.diff(time[order]) != 0, True)
    if repeated := int((~last).sum()):
        notes.append(
            f"topic {stream.topic}: {repeated} messages with the stamp of another left out"
        )
    return stream.part(order[last])


def clock(stream: Stream, layout: BagLayout) -> Int[np.ndarray, " row"]:
    """Time of each row on the clock that the layout wants [ns]."""
    if layout.stamp == "header" and stream.stamp is not None:
        return stream.stamp
    return stream.received


def seconds(time: Int[np.ndarray, " row"]) -> np.ndarray:
    """Nanoseconds in seconds, as near as a double is to them."""
    return time // 10**9 + (time % 10**9) / 1e9


def check_clocks(streams: Sequence[Stream], layout: BagLayout, notes: list[str]) -> None:
    """Compare the clock of stamped messages with that of the recorder where both are used.

    Raises:
        DataError: they are so far apart that their times cannot be compared.
    """
    bare, delays = [], {}
    for stream in streams:
        if not len(stream.number) or stream.topic.endswith(STATIC):
            continue
        if stream.stamp is None:
            bare.append(stream)
        else:
            delays[stream.topic] = float(np.median(stream.received - stream.stamp)) / 1e9
    if not bare or not delays or layout.stamp == "received":
        return
    topic = max(delays, key=lambda name: abs(delays[name]))
    apart = delays[topic]
    others = ", ".join(sorted({s.topic for s in bare}))
    if abs(apart) > APART_REFUSED:
        raise DataError(
            f"{bare[0].path}: stamps of {topic} differ by {apart:.3g} s from the time of receipt, "
            f"which is all that {others} has; expected one clock for all: say "
            'stamp = "received"'
        )
    if abs(apart) > APART_NOTED:
        notes.append(
            f"stamps of {topic} differ by {apart:.3g} s from the time of receipt, "
            f"which is all that {others} has"
        )
