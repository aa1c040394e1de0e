"""Signals of poses and of commanded twists, which one message holds together."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from slipid.data.reading.bag.channels import filled
from slipid.data.reading.bag.clock import clock, seconds, timed
from slipid.data.reading.bag.joined import Samples, finite, samples_of
from slipid.data.reading.bag.layout import GROUPS, BagLayout
from slipid.data.reading.bag.messages.picks import Edge, TransformPick
from slipid.data.reading.bag.messages.streams import Stream
from slipid.data.reading.bag.plan import ChannelPlan
from slipid.data.reading.bag.transforms import STATIC, Moving, composed, heading, tilt
from slipid.data.reading.signal import Signal, Source

TILT_NOTED = np.radians(20.0)
"""Tilt of a robot on a floor that is worth a note: the z axis may not point up."""


def group_signals(
    plan: ChannelPlan, streams: Sequence[Stream], layout: BagLayout, notes: list[str]
) -> dict[str, Signal]:
    """Signals of a pose (x, y, heading without wrap-around) or a twist, by channel.

    Args:
        plan: of the pose or twist.
        streams: of its topics, in the order of the plan.
        layout: what the bag is read by.
        notes: which more are added to.

    Raises:
        DataError: numbers are missing, not finite, or out of time.
    """
    if plan.links:
        samples = _transformed(plan, streams, layout, notes)
    else:
        samples = samples_of(filled(streams[0]), layout, notes)
    values = samples.values
    if plan.channel == "pose":
        values = _planar(samples, notes)
    names = GROUPS[plan.channel]
    # a column each, and all of them at the times of the messages
    return {
        name: Signal(samples.time, values[:, [j]], _column(samples.source, j))
        for j, name in enumerate(names)
    }


def _column(source: Source, j: int) -> Source:
    """Source of one column; a heading may be made of a whole quaternion."""
    names = source.columns
    name = names[min(j, len(names) - 1)]
    if j == 2 and len(names) > 3:
        name = name.rpartition(".")[0]
    return Source(source.path, (name,), source.lines, source.topic)


def _planar(samples: Samples, notes: list[str]) -> Float[np.ndarray, "sample 3"]:
    """Place and heading of x, y and a quaternion, or of x, y and a heading with wrap-around."""
    place = samples.values[:, :2]
    if samples.values.shape[1] == 3:
        return np.column_stack([place, np.unwrap(samples.values[:, 2])])
    rotation = _unit(samples.values[:, 2:], samples.source)
    if (tilted := float(tilt(rotation).max(initial=0.0))) > TILT_NOTED:
        notes.append(
            f"topic {samples.source.topic}: the pose tilts by up to {np.degrees(tilted):.0f} deg; "
            "its heading is about the z axis of the frame: does that point up?"
        )
    return np.column_stack([place, heading(rotation)])


def _transformed(
    plan: ChannelPlan, streams: Sequence[Stream], layout: BagLayout, notes: list[str]
) -> Samples:
    """Place in the plane, and quaternion, of a chain of transforms."""
    moving: dict[Edge, Moving] = {}
    sources: dict[Edge, Source] = {}
    for stream, wanted in zip(streams, plan.wanted, strict=True):
        assert isinstance(wanted.pick, TransformPick)
        # topics that move come first in a plan, and the static one repeats what never changes
        if wanted.pick.edge not in moving and len(stream.number):
            if stream.topic.endswith(STATIC):
                stream = finite(stream.part(np.array([len(stream.number) - 1])), layout, notes)
            else:
                stream = timed(finite(stream, layout, notes), layout, notes)
            source = Source(stream.path, stream.columns, stream.number, stream.topic)
            rotation = _unit(stream.values[:, 3:], source)
            time = seconds(clock(stream, layout))
            moving[wanted.pick.edge] = Moving(time, stream.values[:, :3], rotation)
            sources[wanted.pick.edge] = source
    edge = max(moving, key=lambda edge: len(moving[edge].time))
    source, densest = sources[edge], moving[edge].time
    if len(densest) == 1:
        found = f"every transform from '{plan.spec.frame}' to '{plan.spec.child}' is there once"
        raise source.error(found, "one that changes with time: frames that move")
    whole = composed(plan.links, moving)
    if not len(whole.time):
        found = f"the transforms from '{plan.spec.frame}' to '{plan.spec.child}' share no time"
        raise source.error(found, "transforms that were recorded together")
    lines = source.lines[np.searchsorted(densest, whole.time)]
    columns = (f"{plan.spec.child} in {plan.spec.frame}",)
    values = np.column_stack([whole.translation[:, :2], whole.rotation])
    return Samples(whole.time, values, Source(source.path, columns, lines, source.topic))


def _unit(rotation: Float[np.ndarray, "sample 4"], source: Source) -> Float[np.ndarray, "sample 4"]:
    """Quaternions made of length 1; DataError where they are far from it."""
    length = np.linalg.norm(rotation, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > 0.1)
    if len(wrong):
        found = f"a quaternion of length {length[wrong[0]]:.3g}"
        raise source.error(found, "length 1; is the orientation filled in?", int(wrong[0]))
    return rotation / length[:, None]
