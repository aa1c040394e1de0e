"""Read a bag: every channel that a layout wants, each at its own times, run by run."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipid.data.reading.bag.clock import check_clocks
from slipid.data.reading.bag.layout import GROUPS, BagLayout
from slipid.data.reading.bag.messages.streams import Stream, TopicStreams
from slipid.data.reading.bag.plan import ChannelPlan, plan
from slipid.data.reading.bag.runs import RunSpan, run_spans
from slipid.data.reading.bag.signals import channel_signal, group_signals
from slipid.data.reading.bag.storage.opened import OpenBag, open_bag
from slipid.data.reading.layout import PER_WHEEL
from slipid.data.reading.signal import Signal
from slipid.support.errors import DataError


@dataclass(frozen=True, eq=False)
class BagRun:
    """One run of a bag.

    Attributes:
        name_suffix: what follows the bag's name: nothing for the only run, else `#03` or `#name`.
        sha256: hash of the bag's files.
        signals: what was recorded, by channel, in the units of `CHANNELS`; a pose as pose_x, pose_y
            and pose_heading (without wrap-around), a twist as twist_command_x, _y and _yaw.
        surface: name of the floor where the bag or the table of runs tells it, else None.
        load: name of the load set-up, likewise.
        notes: what was repaired or left out, one sentence each.
    """

    name_suffix: str
    sha256: str
    signals: dict[str, Signal]
    surface: str | None
    load: str | None
    notes: tuple[str, ...]


def read_bag(path: Path, layout: BagLayout) -> tuple[BagRun, ...]:
    """Every run in a bag.

    Args:
        path: a .bag, .db3 or .mcap file, the folder of a rosbag2, or the metadata.yaml in it.
        layout: which topics hold what.

    Raises:
        DataError: the bag is damaged, or does not hold what the layout says; the message names the
            topic, what is there, and the next step.
    """
    with open_bag(path) as bag, ThreadPoolExecutor(1) as beside:
        # hashing lets other threads run, so that on two cores it takes no time of its own
        sha256 = beside.submit(lambda: bag.files.sha256)
        notes = list(bag.notes)
        signals = _signals(bag, layout, notes)
        stretches = run_spans(bag, layout, signals, notes)
        # two channels of one topic say the same of it
        said = tuple(dict.fromkeys(notes))
        return tuple(_run(signals, one, sha256.result(), said) for one in stretches)


def _run(
    signals: dict[str, Signal], stretch: RunSpan, sha256: str, notes: tuple[str, ...]
) -> BagRun:
    """The part of all signals that lies in one run."""
    parts, without = {}, []
    for name, signal in signals.items():
        first, end = np.searchsorted(signal.time, (stretch.start, stretch.end)).tolist()
        if end > first:
            parts[name] = signal.part(slice(first, end))
        else:
            without.append(name)
    if without:
        notes = (*notes, f"no sample of {', '.join(without)} in this run")
    return BagRun(stretch.suffix, sha256, parts, stretch.surface, stretch.load, notes)


def _signals(bag: OpenBag, layout: BagLayout, notes: list[str]) -> dict[str, Signal]:
    """Every signal that the layout wants, from one pass over the bag."""
    plans = plan(bag, layout)
    collected = _collected(bag, plans)
    signals: dict[str, Signal] = {}
    for one, streams in zip(plans, collected, strict=True):
        if one.channel in GROUPS:
            signals |= group_signals(one, streams, layout, notes)
        else:
            signals[one.channel] = channel_signal(one, streams, layout, notes)
    check_clocks([stream for streams in collected for stream in streams], layout, notes)
    counts = {n: s.values.shape[1] for n, s in signals.items() if n in PER_WHEEL}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{count} in {name}" for name, count in counts.items())
        raise DataError(
            f"{bag.path}: channels disagree on the number of wheels: {listed}; expected the same "
            'of each; name those that count by index (field = ["currents[0]", "currents[1]"])'
        )
    return signals


def _collected(bag: OpenBag, plans: Sequence[ChannelPlan]) -> list[list[Stream]]:
    """Numbers of every plan, topic by topic."""
    topics = {}
    for name in dict.fromkeys(w.topic for one in plans for w in one.wanted):
        wanted = [w for one in plans for w in one.wanted if w.topic == name]
        picks = [one.pick for one in wanted]
        topics[name] = TopicStreams(bag.path, name, wanted[0].message, picks, cdr=bag.cdr)
    for batch in bag.batches(tuple(topics)):
        topics[batch.topic].add(batch)
    return [[topics[w.topic].stream(w.pick) for w in one.wanted] for one in plans]
