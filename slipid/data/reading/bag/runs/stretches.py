"""The runs of a bag by the rule of its layout."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf

import numpy as np

from slipid.data.reading.bag.layout import TURNS, BagLayout, RunRule
from slipid.data.reading.bag.runs.marks import by_topic
from slipid.data.reading.bag.runs.pauses import STILL, by_pauses
from slipid.data.reading.bag.runs.stretch import Stretch
from slipid.data.reading.bag.runs.table import by_table
from slipid.data.reading.bag.storage.opened import OpenBag
from slipid.data.reading.signal import Signal
from slipid.support.errors import bad_data


def stretches_of(
    bag: OpenBag, layout: BagLayout, signals: Mapping[str, Signal], notes: list[str]
) -> tuple[Stretch, ...]:
    """The runs of a bag; all of it where the layout does not say what tells them apart.

    Runs in which a wheel has fewer than two samples are left out, with a note.

    Raises:
        DataError: there is no run, or the topic or the table that tells them is wrong.
    """
    rule = layout.runs
    if rule is None:
        return (Stretch(-inf, inf),)
    first = min(float(signal.time[0]) for signal in signals.values())
    if rule.topic is not None:
        found = by_topic(bag, layout, rule)
    elif rule.pause_s is not None:
        found = by_pauses(layout, signals, rule.pause_s)
    else:
        found = by_table(bag.path, rule, first if rule.from_start else 0.0)
    inside = [one for one in found if _sampled(signals, one)]
    if not inside:
        last = max(float(signal.time[-1]) for signal in signals.values())
        raise bad_data(bag.path, *_none(rule, found, f"from {first:.3f} to {last:.3f} s"))
    if len(inside) < len(found):
        notes.append(f"{len(found) - len(inside)} runs left out in which the wheels were not seen")
    return _named(inside)


def _sampled(signals: Mapping[str, Signal], stretch: Stretch) -> bool:
    """Whether a run has two samples of every signal that tells of motion, or else of any."""
    telling = [signals[name] for name in TURNS if name in signals] or list(signals.values())
    ends = [np.searchsorted(signal.time, (stretch.start, stretch.end)) for signal in telling]
    return all(end - first >= 2 for first, end in ends)


def _none(rule: RunRule, found: Sequence[Stretch], samples: str) -> tuple[str, str]:
    """What was found instead of runs, and what was expected."""
    times = ", ".join(f"{one.start:.3f} to {one.end:.3f} s" for one in found[:3])
    if rule.pause_s is not None:
        return "no run: no wheel moves", f"a wheel that turns by more than {STILL:g} rad"
    if rule.topic is not None and not found:
        between = ", ".join(repr(value) for value in rule.between)
        return (
            f"no run in topic '{rule.topic}'",
            f"a value other than those between runs ({between})",
        )
    if rule.topic is not None:
        found_ = f"no sample in the runs of topic '{rule.topic}' ({times})"
        return found_, f'runs where the samples are, {samples}; perhaps stamp = "received"'
    hint = "" if rule.from_start else "; where times count from the first sample: from_start = true"
    where = f" ({times})" if found else ""
    return f"no run of table {rule.table} lies in the bag{where}", f"times {samples}{hint}"


def _named(found: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """Runs by their names, else by numbers; a single one without a name needs none."""
    if len(found) == 1:
        return tuple(found)
    width = max(2, len(str(len(found))))
    return tuple(
        replace(one, suffix=one.suffix or f"#{k:0{width}d}") for k, one in enumerate(found, start=1)
    )
