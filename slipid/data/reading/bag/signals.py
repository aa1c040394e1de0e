"""Signals of channels, poses and twists from the numbers in the messages of topics.

The rows are sorted by time on the clock that the layout selects; of rows with the same time, only
the last is kept.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from slipid.data.reading.bag.layout import BagLayout
from slipid.data.reading.bag.plan import ChannelPlan
from slipid.data.reading.bag.streams import Edge, JointPick, Stream, TransformPick
from slipid.data.reading.bag.transforms import STATIC, TransformSeries, composed, heading, tilt
from slipid.data.reading.layout import GROUPS, PER_WHEEL
from slipid.data.reading.signal import Signal, SignalSource, cumulative_ticks, first_true
from slipid.support.errors import bad_data, did_you_mean, first_names

NOTED_DIFFERENCE_S = 0.5
"""Larger differences between stamps and times of receipt are noted [s]."""
LARGEST_DIFFERENCE_S = 60.0
"""If stamps and times of receipt differ by more, they cannot be combined [s]."""
LARGEST_NUMBER = 1e30
"""Larger magnitudes cannot be measurements in any unit and mean that the bag is damaged."""
TILT_NOTED = np.radians(20.0)
"""A larger tilt of a pose is noted, since the z axis may not point up [rad]."""
_DOWN = ("vehicle_local_position", "vehicle_odometry", "vehicle_visual_odometry")
"""Types of messages of PX4, whose x points north, y east and z down."""
_RECEIVED = 'to use the time of receipt set stamp = "received"'


def cleaned(stream: Stream, layout: BagLayout, notes: list[str]) -> Stream:
    """Return the rows with finite numbers, in the order of their times, without repeated times.

    Of several rows with the same time the last one is kept.

    Raises:
        DataError: numbers are not finite, stamps are zero, or the clock jumps back.
    """
    stream = finite(stream, layout, notes)
    time, name = stream.time, stream.topic.name
    zero = np.flatnonzero(time == 0)
    if len(zero):
        every = len(zero) == len(time)
        found = "every time stamp is zero" if every else "the time stamp is zero"
        expected = (
            f"time stamps that are set; {_RECEIVED}"
            if every
            else f"a time stamp in every message; {_RECEIVED}"
        )
        raise stream.error(found, expected, None if every else int(zero[0]))
    if (np.diff(time) > 0).all():
        return stream
    late = np.maximum.accumulate(time) - time
    if (jump := first_true(late > layout.max_disorder * 1e9)) is not None:
        found = f"the clock jumps back by {late[jump] / 1e9:.3g} s"
        expected = (
            f"messages late by at most max_disorder = {layout.max_disorder:g} s; was the clock "
            f"set, or a second recording appended? Otherwise {_RECEIVED}"
        )
        raise stream.error(found, expected, jump)
    if disordered := int((late > 0).sum()):
        by = f"by up to {late.max() / 1e9:.3g} s"
        notes.append(f"topic {name}: {disordered} messages out of order {by} were sorted")
    order = np.argsort(time, kind="stable")
    last = np.append(np.diff(time[order]) != 0, True)
    if repeated := int((~last).sum()):
        notes.append(
            f"topic {name}: {repeated} messages with the same stamp as another were left out"
        )
    return stream.part(order[last])


def check_clocks(streams: Sequence[Stream], layout: BagLayout, notes: list[str]) -> None:
    """Append a note if stamps and times of receipt are both used and differ.

    The note is appended if the difference exceeds `NOTED_DIFFERENCE_S`.

    Raises:
        DataError: stamps and times of receipt differ by more than `LARGEST_DIFFERENCE_S`.
    """
    used = [one for one in streams if len(one.number) and not one.topic.name.endswith(STATIC)]
    bare = sorted({one.topic.name for one in used if one.delay is None})
    delays = [(one.delay, one.topic.name) for one in used if one.delay is not None]
    if not bare or not delays or layout.stamp == "received":
        return
    apart, topic = max(delays, key=lambda item: abs(item[0]))
    found = (
        f"stamps of {topic} differ by {apart:.3g} s from the time of receipt, which is the only "
        f"time that {', '.join(bare)} has"
    )
    if abs(apart) > LARGEST_DIFFERENCE_S:
        expected = 'one clock for all: set stamp = "received"'
        raise bad_data(used[0].topic.bag.files.path, found, expected)
    if abs(apart) > NOTED_DIFFERENCE_S:
        notes.append(found)


def signal_of(stream: Stream) -> Signal:
    """Return the rows of a stream as a signal, with the numbers as in the messages.

    No unit is converted.
    """
    topic = stream.topic
    source = SignalSource(topic.bag.files.path, stream.columns, stream.number, topic.name)
    seconds, nanoseconds = np.divmod(stream.time, 10**9)
    return Signal(seconds + nanoseconds / 1e9, stream.values, source)


def whole_signal(stream: Stream, notes: list[str]) -> Signal:
    """Return the complete rows of one stream as a signal."""
    whole = np.all(~stream.absent, axis=1)
    if not whole.all():
        notes.append(
            f"topic {stream.topic.name}: {(~whole).sum()} messages without all of "
            f"{', '.join(stream.columns)} left out"
        )
    return signal_of(stream.part(whole))


def side_by_side(streams: Sequence[Stream], notes: list[str], *, by_name: bool) -> Signal:
    """Return a signal whose columns come from different messages.

    The columns are in several topics, or in messages that have only some of the columns. The signal
    has the times of the first column, to which the other columns are interpolated linearly; times
    outside the record of some column are left out.

    Args:
        streams: streams with the columns.
        notes: list to which notes are appended.
        by_name: True if all streams have the same columns, so that each column is taken from the
            first stream with numbers in it; else all columns of all streams are used.

    Raises:
        DataError: the columns share no time.
    """
    pairs = [(stream, j) for stream in streams for j in range(len(stream.columns))]
    if by_name:
        # Every stream has a column for every joint, but most of its columns are empty: each joint
        # is taken from the first stream with numbers for it.
        having = [(stream, j) for stream, j in pairs if not stream.absent[:, j].all()]
        owner = {j: stream for stream, j in reversed(having)}
        pairs = [(owner[j], j) for j in sorted(owner)]
    names = tuple(stream.columns[j] for stream, j in pairs)
    signals = [signal_of(stream.part(~stream.absent[:, j])) for stream, j in pairs]
    first = signals[0]
    inside = np.ones(len(first.time), dtype=bool)
    for other in signals[1:]:
        inside &= (first.time >= other.time[0]) & (first.time <= other.time[-1])
    time, lines = first.time[inside], first.source.lines[inside]
    topics = ", ".join(dict.fromkeys(stream.topic.name for stream, _ in pairs))
    source = SignalSource(first.source.path, names, lines, topics)
    if not len(time):
        raise source.error("its columns share no time", "columns that were recorded together")
    # The columns of plain numbers are all called `data`: then the names of the topics differ.
    called = names if len(set(names)) > 1 else tuple(stream.topic.name for stream, _ in pairs)
    gap = max(float(np.diff(one.time).max(initial=0.0)) for one in signals)
    notes.append(
        f"topics {topics}: {', '.join(called[1:])} were sampled at other times than {called[0]} "
        f"and were interpolated to its times (longest gap {gap:.3g} s)"
    )
    columns = zip(signals, pairs, strict=True)
    values = [np.interp(time, one.time, one.values[:, j]) for one, (_, j) in columns]
    return Signal(time, np.column_stack(values), source)


def mostly_whole(stream: Stream) -> bool:
    """Return whether complete rows are at least half as many as the numbers of any one column."""
    whole = int((~stream.absent.any(axis=1)).sum())
    return whole >= 0.5 * int((~stream.absent).sum(axis=0).max(initial=0))


def finite(stream: Stream, layout: BagLayout, notes: list[str]) -> Stream:
    """Return the rows with finite numbers.

    Rows with NaN are left out, with a note, if the layout sets `drop_nan`.

    Raises:
        DataError: there are other numbers that are not finite, or no row is left.
    """
    bad = ~np.all(np.abs(stream.values) < LARGEST_NUMBER, axis=1)
    if not bad.any():
        return stream
    rows = np.flatnonzero(bad)
    numbers = stream.values[rows[0]]
    j = int(np.argmin(np.abs(numbers) < LARGEST_NUMBER))
    if bad.all() or not layout.drop_nan or not np.isnan(stream.values[rows]).any(axis=1).all():
        found = f"{stream.columns[j]} is {numbers[j]:.3g}, the first of {len(rows)} such values"
        found += f" among {len(bad)} messages"
        expected = "numbers; to leave out messages with nan set drop_nan = true"
        if bad.all():
            expected = "numbers; does the driver fill in this field?"
        raise stream.error(found, expected, int(rows[0]))
    column = stream.columns[j]
    notes.append(
        f"topic {stream.topic.name}: {len(rows)} messages without a number in {column} left out"
    )
    return stream.part(~bad)


def channel_signal(
    plan: ChannelPlan, streams: Sequence[Stream], layout: BagLayout, notes: list[str]
) -> Signal:
    """Return the signal of a channel, in SI units.

    Args:
        plan: plan of the channel.
        streams: streams of its topics, in the order of the plan.
        layout: layout of the bag.
        notes: list to which notes are appended.

    Raises:
        DataError: a joint or a number is missing or not finite, or a clock jumps.
    """
    by_name = isinstance(plan.wanted[0][1], JointPick)
    if by_name:
        _check_joints(plan, streams)
    else:
        streams = [checked_stream(stream) for stream in streams]
    streams = [cleaned(stream, layout, notes) for stream in streams]
    if plan.channel == "wheel_ticks":
        streams = [_counted(stream, layout, notes) for stream in streams]
    if len(streams) == 1 and mostly_whole(streams[0]):
        samples = whole_signal(streams[0], notes)
    else:
        samples = side_by_side(streams, notes, by_name=by_name)
    columns = samples.values.shape[1]
    scale = np.array(plan.spec.scale)
    if len(scale) not in (1, columns):
        found = f"{plan.channel} has {columns} columns, but {len(scale)} scales"
        raise samples.source.error(found, f"{columns} scales, or one scale for all columns")
    if plan.channel not in PER_WHEEL and columns != 1:
        found = f"{columns} numbers for {plan.channel}"
        raise samples.source.error(found, "one number; select it by its index, such as [0]")
    notes += layout.note(plan.channel, plan.unit)
    values = (samples.values * scale + plan.spec.offset) * layout.factor(plan.channel, plan.unit)
    return Signal(samples.time, values, samples.source)


def _counted(stream: Stream, layout: BagLayout, notes: list[str]) -> Stream:
    """Return a stream of tick counters with their cumulative ticks."""
    counts = np.where(stream.absent, np.nan, stream.values)
    return replace(stream, values=np.nan_to_num(cumulative_ticks(counts, layout, notes)))


def checked_stream(stream: Stream) -> Stream:
    """Return the given stream; raise `DataError` if no message has its numbers."""
    if len(stream.number):
        return stream
    found = f"no numbers in {', '.join(stream.columns)} of any message"
    raise stream.error(found, "a non-empty array that has the requested index")


def _check_joints(plan: ChannelPlan, streams: Sequence[Stream]) -> None:
    """Raise `DataError` if a joint is missing from all messages, or never has a number."""
    picks = [pick for _, pick in plan.wanted if isinstance(pick, JointPick)]
    there = list(dict.fromkeys(name for pick in picks for name in pick.names))
    for j, joint in enumerate(picks[0].columns):
        if joint not in there:
            found = f"no joint '{joint}'{did_you_mean(joint, there)}"
            raise streams[0].error(found, f"one of the names in the messages: {first_names(there)}")
        if all(stream.absent[:, j].all() for stream in streams):
            found = f"{picks[0].array} of joint '{joint}' is empty in every message"
            expected = "numbers; is another field meant: position, velocity or effort?"
            raise streams[0].error(found, expected)


def group_signals(
    plan: ChannelPlan, streams: Sequence[Stream], layout: BagLayout, notes: list[str]
) -> dict[str, Signal]:
    """Return the signals of a pose (x, y, heading without wrap-around) or twist, keyed by channel.

    Args:
        plan: plan of the pose or twist.
        streams: streams of its topics, in the order of the plan.
        layout: layout of the bag.
        notes: list to which notes are appended.

    Raises:
        DataError: numbers are missing or not finite, or a clock jumps.
    """
    if plan.links:
        samples = _transformed(plan, streams, layout, notes)
    else:
        samples = whole_signal(cleaned(checked_stream(streams[0]), layout, notes), notes)
    values = _planar(samples, notes) if plan.channel == "pose" else samples.values
    if (topic := streams[0].topic).type in _DOWN:
        values = values * [1.0, -1.0, -1.0]
        notes.append(f"topic {topic.name}: y and heading were reversed, since its z points down")
    # Each signal needs a column name for error messages: a heading that is computed from a
    # quaternion gets the name of the quaternion, and the signals of a composed pose share a name.
    named = samples.source.columns
    if len(named) == 1:
        named *= 3
    elif len(named) > 3:
        named = (*named[:2], named[2].rpartition(".")[0])
    return {
        name: Signal(samples.time, values[:, [j]], replace(samples.source, columns=(named[j],)))
        for j, name in enumerate(GROUPS[plan.channel])
    }


def _planar(samples: Signal, notes: list[str]) -> Float[np.ndarray, "sample 3"]:
    """Return x [m], y [m] and heading [rad] of poses; the heading has no wrap-around.

    The samples have x, y and either a quaternion or a heading. A tilt above `TILT_NOTED` is noted.
    """
    place = samples.values[:, :2]
    if samples.values.shape[1] == 3:
        return np.column_stack([place, np.unwrap(samples.values[:, 2])])
    rotation = _unit(samples.values[:, 2:], samples.source)
    if (tilted := float(tilt(rotation).max(initial=0.0))) > TILT_NOTED:
        notes.append(
            f"topic {samples.source.topic}: the pose tilts by up to {np.degrees(tilted):.0f} deg; "
            "its heading is the rotation about the z axis of the frame: does that axis point up?"
        )
    return np.column_stack([place, heading(rotation)])


def _transformed(
    plan: ChannelPlan, streams: Sequence[Stream], layout: BagLayout, notes: list[str]
) -> Signal:
    """Return the signal of x, y and the quaternion of a pose composed of a chain of transforms."""
    moving: dict[Edge, TransformSeries] = {}
    sources: dict[Edge, SignalSource] = {}
    for stream, (topic, pick) in zip(streams, plan.wanted, strict=True):
        assert isinstance(pick, TransformPick)
        # In a plan, topics of changing transforms come before the static topic, so a changing
        # transform has priority. The static topic repeats constant transforms, so only its last
        # message is used.
        if pick.edge not in moving and len(stream.number):
            if topic.endswith(STATIC):
                stream = finite(stream.part(np.array([len(stream.number) - 1])), layout, notes)
            else:
                stream = cleaned(stream, layout, notes)
            one = signal_of(stream)
            rotation = _unit(one.values[:, 3:], one.source)
            moving[pick.edge] = TransformSeries(one.time, one.values[:, :3], rotation)
            sources[pick.edge] = one.source
    edge = max(moving, key=lambda edge: len(moving[edge].time))
    source, densest = sources[edge], moving[edge].time
    if len(densest) == 1:
        found = (
            f"every transform from '{plan.spec.frame}' to '{plan.spec.child}' was published only "
            "once"
        )
        raise source.error(found, "at least one that changes with time, between frames that move")
    whole = composed(plan.links, moving)
    if not len(whole.time):
        found = (
            f"the transforms from '{plan.spec.frame}' to '{plan.spec.child}' do not overlap in time"
        )
        raise source.error(found, "transforms that were recorded together")
    lines = source.lines[np.searchsorted(densest, whole.time)]
    columns = (f"{plan.spec.child} in {plan.spec.frame}",)
    values = np.column_stack([whole.translation[:, :2], whole.rotation])
    return Signal(whole.time, values, replace(source, columns=columns, lines=lines))


def _unit(
    rotation: Float[np.ndarray, "sample 4"], source: SignalSource
) -> Float[np.ndarray, "sample 4"]:
    """Return quaternions normalised to length 1; raise `DataError` if a length is far from 1."""
    length = np.linalg.norm(rotation, axis=1)
    if (wrong := first_true(np.abs(length - 1.0) > 0.1)) is not None:
        found = f"a quaternion of length {length[wrong]:.3g}"
        raise source.error(found, "length 1; is the orientation filled in?", wrong)
    return rotation / length[:, None]
