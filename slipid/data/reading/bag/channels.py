"""Signals of single channels: of a number, or of one for each wheel, in SI."""

from collections.abc import Sequence

import numpy as np

from slipid.data.reading.bag.joined import mostly_whole, samples_of, side_by_side
from slipid.data.reading.bag.layout import BagLayout
from slipid.data.reading.bag.messages.meanings import listed
from slipid.data.reading.bag.messages.picks import JointPick
from slipid.data.reading.bag.messages.streams import Stream
from slipid.data.reading.bag.plan import ChannelPlan
from slipid.data.reading.layout import CHANNELS, PER_WHEEL
from slipid.data.reading.signal import Signal
from slipid.data.reading.units import factor
from slipid.support.errors import near


def channel_signal(
    plan: ChannelPlan, streams: Sequence[Stream], layout: BagLayout, notes: list[str]
) -> Signal:
    """Signal of a channel.

    Args:
        plan: of the channel.
        streams: of its topics, in the order of the plan.
        layout: what the bag is read by.
        notes: which more are added to.

    Raises:
        DataError: a joint or a number is missing, not finite, or out of time.
    """
    by_name = isinstance(plan.wanted[0].pick, JointPick)
    if by_name:
        _check_joints(plan, streams)
    else:
        streams = [filled(stream) for stream in streams]
    if len(streams) == 1 and mostly_whole(streams[0]):
        samples = samples_of(streams[0], layout, notes)
    else:
        samples = side_by_side(streams, layout, notes, by_name=by_name)
    columns = samples.values.shape[1]
    scale = np.array(plan.spec.scale)
    if len(scale) not in (1, columns):
        found = f"{plan.channel} has {columns} columns for {len(scale)} scales"
        raise samples.source.error(found, "as many, or one scale for all")
    if plan.channel not in PER_WHEEL and columns != 1:
        found = f"{columns} numbers for {plan.channel}"
        raise samples.source.error(found, "one; name it by its index, such as [0]")
    values = (samples.values * scale + plan.spec.offset) * factor(plan.unit, CHANNELS[plan.channel])
    return Signal(samples.time, values, samples.source)


def filled(stream: Stream) -> Stream:
    """The same stream; DataError where no message has the wanted numbers."""
    if len(stream.number):
        return stream
    found = f"no numbers in {', '.join(stream.columns)} of any message"
    raise stream.error(found, "an array that is filled in, and has the wanted index")


def _check_joints(plan: ChannelPlan, streams: Sequence[Stream]) -> None:
    """Refuse joints that no message has, with the names that are there."""
    picks = [wanted.pick for wanted in plan.wanted if isinstance(wanted.pick, JointPick)]
    seen = list(dict.fromkeys(name for pick in picks for name in pick.seen))
    for j, joint in enumerate(picks[0].joints):
        if joint not in seen:
            found = f"no joint '{joint}'{near(joint, seen)}"
            raise streams[0].error(found, f"one of the names that are there: {listed(seen)}")
        if all(stream.absent[:, j].all() for stream in streams):
            found = f"{picks[0].array} of joint '{joint}' is empty in every message"
            expected = "numbers in it; is another field meant: position, velocity or effort?"
            raise streams[0].error(found, expected)
