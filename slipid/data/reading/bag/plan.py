"""What a layout wants of a bag: for each channel the topics, and the numbers in their messages."""

from dataclasses import dataclass
from itertools import islice

from slipid.data.reading.bag.definitions import Message, definition_of
from slipid.data.reading.bag.layout import GROUPS, BagLayout, TopicChannel
from slipid.data.reading.bag.meanings import (
    Unfit,
    channel_meaning,
    fits,
    group_meaning,
    is_transforms,
    listed,
)
from slipid.data.reading.bag.opened import OpenBag, StoredTopic
from slipid.data.reading.bag.shape import (
    MessageShape,
    Pick,
    TransformPick,
    edges_of,
    shape_of,
    steps_of,
)
from slipid.data.reading.bag.streams import topic_error
from slipid.data.reading.bag.transforms import STATIC, Link, chain_of
from slipid.support.errors import DataError, bad_data, did_you_mean


@dataclass(frozen=True, eq=False)
class Wanted:
    """Numbers of the messages of one topic."""

    topic: str
    message: Message
    pick: Pick


@dataclass(frozen=True, eq=False)
class ChannelPlan:
    """Where the numbers of a channel, or of a pose or a twist, come from.

    Attributes:
        channel: its name in the layout.
        spec: what the layout says of it.
        unit: of the numbers; empty for a pose or a twist, which are in SI.
        wanted: the numbers, topic by topic.
        links: chain of transforms that a pose is composed of; empty otherwise.
    """

    channel: str
    spec: TopicChannel
    unit: str
    wanted: tuple[Wanted, ...]
    links: tuple[Link, ...] = ()


def plan(bag: OpenBag, layout: BagLayout) -> tuple[ChannelPlan, ...]:
    """Plan of every channel of a layout.

    Raises:
        DataError: a topic is missing or empty, its messages do not serve the channel, or no
            definition of them is found.
    """
    return tuple(_planned(bag, layout, name, spec) for name, spec in layout.topics.items())


def _planned(bag: OpenBag, layout: BagLayout, channel: str, spec: TopicChannel) -> ChannelPlan:
    wanted, unit = [], ""
    for name in spec.topics:
        message = message_of(bag, layout, name, channel)
        transforms = is_transforms(message)
        if channel == "pose" and (spec.frame is not None or transforms):
            if not transforms:
                found = f"messages of type {message.name} with frame and child"
                raise topic_error(bag.path, name, found, "tf2_msgs/TFMessage, or neither")
            return _transformed(bag, layout, spec, name, message)
        try:
            if channel in GROUPS:
                meaning = group_meaning(channel, spec, message)
            else:
                meaning = channel_meaning(channel, spec, message, layout.joints)
        except Unfit as error:
            expected = error.expected
            if "joints are named" in error.found:
                shapes = first_shapes(bag, name, message, 10)
                there = [joint for one in shapes for joint in one.texts(steps_of("name"))]
                expected += f" (there are: {listed(dict.fromkeys(there))})"
            raise topic_error(bag.path, name, error.found, expected) from None
        unit = meaning.unit
        wanted.append(Wanted(name, message, meaning.pick))
    return ChannelPlan(channel, spec, unit, tuple(wanted))


def _transformed(
    bag: OpenBag, layout: BagLayout, spec: TopicChannel, topic: str, message: Message
) -> ChannelPlan:
    """Plan of a pose from transforms, with those of the static topic beside."""
    messages = {topic: message}
    static = topic + STATIC
    if static in bag.topics and bag.topics[static].count:
        messages[static] = message_of(bag, layout, static, "pose")
    if spec.frame is None or spec.child is None:
        shape = next(iter(first_shapes(bag, topic, message, 1)))
        pairs = listed(f"{edge.parent} -> {edge.child}" for edge in edges_of(shape))
        expected = f"frame and child, the frames that the pose is between ({pairs})"
        raise topic_error(bag.path, topic, "transforms, without saying which", expected)
    links = chain_of(bag, messages, spec.frame, spec.child)
    wanted = (
        Wanted(name, messages[name], TransformPick(link.edge))
        for name in messages
        for link in links
    )
    return ChannelPlan("pose", spec, "", tuple(wanted), links)


def message_of(bag: OpenBag, layout: BagLayout, name: str, channel: str) -> Message:
    """Type of a topic's messages; DataError where the topic is missing or empty."""
    topic = bag.topics.get(name)
    if topic is None:
        found = f"no topic '{name}' for {channel}{did_you_mean(name, bag.topics)}"
        raise bad_data(bag.path, found, _one_of(bag, layout, channel))
    if not topic.count:
        found = f"no message in the topic, which holds {channel}"
        raise topic_error(bag.path, name, found, "a topic that was recorded; was its driver on?")
    if " and " in topic.type:
        found = f"messages of several types ({topic.type})"
        raise topic_error(bag.path, name, found, "one type; record them under two names")
    return definition_of(bag.path, name, topic.type, topic.carried, layout.definitions)


def _one_of(bag: OpenBag, layout: BagLayout, channel: str) -> str:
    """Topics that would serve a channel, else every topic."""

    def serves(topic: StoredTopic) -> bool:
        try:
            where = (bag.path, topic.name, topic.type, topic.carried, layout.definitions)
            return fits(channel, definition_of(*where))
        except DataError:
            return False

    fitting = [topic.name for topic in bag.topics.values() if serves(topic)]
    if fitting:
        return f"one of {listed(fitting)}, which hold such messages"
    return f"one of {listed(bag.topics)}"


def first_shapes(
    bag: OpenBag, topic: str, message: Message, count: int
) -> tuple[MessageShape, ...]:
    """Shapes of the first messages of a topic."""
    raws = islice(bag.messages((topic,)), count)
    try:
        return tuple(shape_of(raw.data, message, cdr=bag.cdr) for raw in raws)
    except ValueError as error:
        expected = "messages as their definition says; is the bag damaged?"
        raise topic_error(bag.path, topic, f"no {message.name}: {error}", expected) from error
