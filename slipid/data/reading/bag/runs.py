"""Begin and end of the runs in a bag, which are separated by a topic, by pauses or by a table."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from math import inf
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pydantic import FiniteFloat

from slipid.data.log import Log
from slipid.data.reading.assemble import per_wheel
from slipid.data.reading.bag.layout import BagLayout, RunRule
from slipid.data.reading.bag.opened import BagTopic, OpenBag
from slipid.data.reading.bag.plan import topic_of
from slipid.data.reading.bag.shape import MessageShape, without_indices
from slipid.data.reading.bag.streams import Located
from slipid.data.reading.layout import TURNS
from slipid.data.reading.signal import Signal
from slipid.data.reading.table import named_rows
from slipid.support.errors import bad_data, did_you_mean
from slipid.support.toml_file import Section, checked

LEAST_MOTION = 0.02
"""A wheel counts as moving above this change of angle [rad] or this speed [rad/s]."""
PAUSE_S = 1.0
"""Least pause between runs that `slipid new` proposes for a bag with one long drive [s]."""
_Mark = tuple[str | float, str | None, str | None]
"""Value of the field that separates runs, and names of the surface and the load set-up, if any."""


@dataclass(frozen=True)
class RunSpan:
    """Interval of time of one run.

    Attributes:
        start: time at which the run starts [s].
        end: time at which the run has ended [s].
        suffix: text that is appended to the name of the bag to name the run; empty if the run is
            not named.
        surface: name of the surface, or None.
        load: name of the load set-up, or None.
    """

    start: float
    end: float
    suffix: str = ""
    surface: str | None = None
    load: str | None = None


def run_spans(
    bag: OpenBag, layout: BagLayout, signals: Mapping[str, Signal], notes: list[str]
) -> tuple[RunSpan, ...]:
    """Return the runs in a bag; if the layout has no rule, the whole bag is one run.

    Runs in which the wheels have fewer than two samples are left out, with a note. A run that has
    no name gets a number, unless it is the only run.

    Raises:
        DataError: there is no run, or the topic or the table of runs is wrong.
    """
    rule = layout.runs
    if rule is None:
        return (RunSpan(-inf, inf),)
    first = min(float(signal.time[0]) for signal in signals.values())
    if rule.topic is not None:
        found = by_topic(bag, layout, rule)
    elif rule.pause_s is not None:
        found = by_pauses(layout, signals, rule.pause_s)
    else:
        found = by_table(bag.files.path, rule, first if rule.from_start else 0.0)
    inside = [one for one in found if _sampled(signals, one)]
    if not inside:
        last = max(float(signal.time[-1]) for signal in signals.values())
        raise bad_data(bag.files.path, *_none(rule, found, f"from {first:.3f} to {last:.3f} s"))
    if len(inside) < len(found):
        notes.append(f"{len(found) - len(inside)} runs without samples of the wheels were left out")
    width = 0 if len(inside) == 1 else max(2, len(str(len(inside))))
    numbers = (f"#{k:0{width}d}" if width else "" for k in range(1, len(inside) + 1))
    return tuple(
        replace(one, suffix=one.suffix or number)
        for one, number in zip(inside, numbers, strict=True)
    )


def _sampled(signals: Mapping[str, Signal], span: RunSpan) -> bool:
    """Return whether every signal of the wheels has two samples in a run.

    If there is no signal of the wheels, every signal must have two samples in the run.
    """
    moving = [signals[name] for name in TURNS if name in signals] or list(signals.values())
    ends = [np.searchsorted(signal.time, (span.start, span.end)) for signal in moving]
    return all(end - first >= 2 for first, end in ends)


def _none(rule: RunRule, found: Sequence[RunSpan], samples: str) -> tuple[str, str]:
    """Return both parts of the error that no run is usable: what was found, what was expected."""
    times = ", ".join(f"{one.start:.3f} to {one.end:.3f} s" for one in found[:3])
    if rule.pause_s is not None:
        return "no run: no wheel moves", f"a wheel that turns by more than {LEAST_MOTION:g} rad"
    if rule.topic is not None and not found:
        between = ", ".join(map(repr, rule.between))
        expected = f"a value other than those between runs ({between})"
        return f"no run in topic '{rule.topic}'", expected
    if rule.topic is not None:
        expected = (
            f'runs within the times of the samples, {samples}; perhaps stamp = "received" is needed'
        )
        return f"no sample in the runs of topic '{rule.topic}' ({times})", expected
    hint = (
        ""
        if rule.from_start
        else "; if its times are counted from the first sample, set from_start = true"
    )
    where = f" ({times})" if found else ""
    return f"no run of table {rule.table} lies in the bag{where}", f"times {samples}{hint}"


def by_pauses(layout: BagLayout, signals: Mapping[str, Signal], pause_s: float) -> list[RunSpan]:
    """Return the runs between pauses, each extended by half of the shortest pause at both ends.

    Args:
        layout: layout with the settings of the encoders.
        signals: signals by channel; one of `TURNS` is among them.
        pause_s: shortest time without motion between two runs [s].
    """
    moves = _moves(layout, signals)
    if not len(moves):
        return []
    cuts = np.flatnonzero(np.diff(moves) > pause_s)
    firsts, lasts = moves[[0, *(cuts + 1)]], moves[[*cuts, len(moves) - 1]]
    rest = 0.5 * pause_s
    ends = zip((firsts - rest).tolist(), (lasts + rest).tolist(), strict=True)
    return [RunSpan(first, last) for first, last in ends]


def _moves(layout: BagLayout, signals: Mapping[str, Signal]) -> Float[np.ndarray, " move"]:
    """Return the times at which some wheel moves [s]."""
    name = next(name for name in TURNS if name in signals)
    time, values = signals[name].time, signals[name].values * per_wheel(name, layout)
    if name.endswith("_speed"):
        return time[(np.abs(values) > LEAST_MOTION).any(axis=1)]
    moved = {row for column in values.T for row in _moved(column)}
    return time[sorted(moved)]


def _moved(angle: Float[np.ndarray, " sample"]) -> list[int]:
    """Return the indices of the samples in which an angle [rad] has moved.

    The angle has moved if it differs by more than `LEAST_MOTION` from its value in the last sample
    that was returned, or in the first sample. Therefore noise, or an encoder that alternates
    between two ticks, does not count as motion.
    """
    found, held = [], float(angle[0])
    changed = np.flatnonzero(np.diff(angle)) + 1
    for row, value in zip(changed.tolist(), angle[changed].tolist(), strict=True):
        if abs(value - held) > LEAST_MOTION:
            held = value
            found.append(row)
    return found


def runs_between_pauses(log: Log, pause_s: float) -> int:
    """Return the number of runs in a log if pauses longer than `pause_s` [s] separate runs."""
    turned = np.abs(np.diff(log.wheel_angle, axis=0)) > LEAST_MOTION * np.diff(log.time)[:, None]
    moves = log.time[1:][turned.any(axis=1)]
    return int((np.diff(moves) > pause_s).sum()) + 1 if len(moves) else 0


class _RunRow(Section):
    """One row of a table of runs: begin and end [s], and optional names."""

    start: FiniteFloat
    end: FiniteFloat
    surface: str = ""
    load: str = ""
    name: str = ""
    bag: str = ""


def by_table(path: Path, rule: RunRule, zero: float) -> list[RunSpan]:
    """Return the runs that a CSV table lists.

    Args:
        path: the bag; rows whose column `bag` names another bag are left out.
        rule: rule with the name of the table.
        zero: time on the bag's clock at which the times of the table are 0 [s].

    Raises:
        DataError: the table is missing or wrong; the message names the row.
    """
    file = path.parent / str(rule.table)
    found = []
    _, rows = named_rows(file, "a CSV table of runs with the columns start and end")
    for line, cells in rows:
        row = checked(f"{file} row {line}", {k: v for k, v in cells.items() if k}, _RunRow)
        if row.bag not in ("", path.name, path.stem):
            continue
        if not row.start < row.end:
            times = f"a run from {row.start:g} to {row.end:g} s"
            raise bad_data(file, times, "start before end", row=line)
        suffix = f"#{row.name}" if row.name else ""
        names = suffix, row.surface or None, row.load or None
        found.append(RunSpan(zero + row.start, zero + row.end, *names))
    return found


def by_topic(bag: OpenBag, layout: BagLayout, rule: RunRule) -> list[RunSpan]:
    """Return a run for each interval in which the value of the topic stays the same.

    Intervals with one of the values `rule.between` are not runs.

    Raises:
        DataError: the topic or a field is missing.
    """
    topic = topic_of(bag, str(rule.topic), "runs")
    paths = topic.message.paths
    for path in (rule.field, rule.surface, rule.load):
        if path is not None and without_indices(path) not in paths:
            found = f"no field '{path}' in {topic.type}{did_you_mean(path, paths)}"
            raise topic.error(found, f"one of {', '.join(paths)}")
    marks = sorted(_marks(topic, layout, rule), key=lambda mark: mark[0])
    changed = [next(same) for _, same in groupby(marks, key=lambda mark: mark[1])]
    ends = [*(time for time, _ in changed[1:]), inf]
    return [
        RunSpan(start, end, "", surface, load)
        for (start, (value, surface, load)), end in zip(changed, ends, strict=False)
        if value not in rule.between
    ]


def _marks(topic: BagTopic, layout: BagLayout, rule: RunRule) -> Iterator[tuple[float, _Mark]]:
    """Yield the time [s] and the content of every message of the topic that separates runs."""
    for number, (received, data) in enumerate(topic.messages(), start=1):
        block = np.frombuffer(data, np.uint8)[None]
        shape = topic.shape(data, number)
        texts, places = shape.texts(rule.field), shape.places(rule.field)
        if not texts and not places:
            raise topic.error(f"no value in field '{rule.field}'", "a value in it", number)
        value = texts[0] if texts else float(places[0].of(block)[0])
        surface, load = (_text(shape, path) for path in (rule.surface, rule.load))
        stamp = Located.of(shape).stamp(block) if layout.stamp == "header" else None
        time = received if stamp is None else int(stamp[0])
        yield time / 1e9, (value, surface, load)


def _text(shape: MessageShape, path: str | None) -> str | None:
    """Return the string at a path in a message; None if it is empty, or if there is no path."""
    return next(iter(shape.texts(path) if path else ()), None) or None
