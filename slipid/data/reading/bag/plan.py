"""Plan of reading a bag: for each channel its topics, and the numbers in their messages."""

from dataclasses import dataclass
from itertools import islice

from slipid.data.reading.bag.definitions import MessageType, definition_of
from slipid.data.reading.bag.layout import GROUPS, BagLayout, TopicChannel
from slipid.data.reading.bag.meanings import (
    UnsuitableType,
    channel_meaning,
    first_names,
    fits,
    group_meaning,
    is_transforms,
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
from slipid.data.reading.bag.transforms import STATIC, ChainLink, chain_of
from slipid.support.errors import DataError, bad_data, did_you_mean


@dataclass(frozen=True, eq=False)
class TopicPick:
    """Numbers of the messages of one topic."""

    topic: str
    message: MessageType
    pick: Pick


@dataclass(frozen=True, eq=False)
class ChannelPlan:
    """Source of the numbers of a channel, or of a pose or a twist.

    Attributes:
        channel: its name in the layout.
        spec: its section of the layout.
        unit: unit of the numbers; empty for a pose or a twist, which are in SI.
        wanted: the numbers, topic by topic.
        links: chain of transforms that a pose is composed of; empty otherwise.
    """

    channel: str
    spec: TopicChannel
    unit: str
    wanted: tuple[TopicPick, ...]
    links: tuple[ChainLink, ...] = ()


def plan(bag: OpenBag, layout: BagLayout) -> tuple[ChannelPlan, ...]:
    """Return the plan of every channel of a layout.

    Raises:
        DataError: a topic is missing or empty, its messages do not fit the channel, or no
            definition of them is found.
    """
    return tuple(_planned(bag, layout, name, spec) for name, spec in layout.topics.items())


def _planned(bag: OpenBag, layout: BagLayout, channel: str, spec: TopicChannel) -> ChannelPlan:
    """Return the plan of one channel."""
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
        except UnsuitableType as error:
            expected = error.expected
            if "joints are named" in error.found:
                shapes = first_shapes(bag, name, message, 10)
                there = [joint for one in shapes for joint in one.texts(steps_of("name"))]
                expected += f" (there are: {first_names(dict.fromkeys(there))})"
            raise topic_error(bag.path, name, error.found, expected) from None
        unit = meaning.unit
        wanted.append(TopicPick(name, message, meaning.pick))
    return ChannelPlan(channel, spec, unit, tuple(wanted))


def _transformed(
    bag: OpenBag, layout: BagLayout, spec: TopicChannel, topic: str, message: MessageType
) -> ChannelPlan:
    """Return the plan of a pose from transforms, with those of the static topic."""
    messages = {topic: message}
    static = topic + STATIC
    if static in bag.topics and bag.topics[static].count:
        messages[static] = message_of(bag, layout, static, "pose")
    if spec.frame is None or spec.child is None:
        shape = next(iter(first_shapes(bag, topic, message, 1)))
        pairs = first_names(f"{edge.parent} -> {edge.child}" for edge in edges_of(shape))
        expected = f"frame and child, the frames that the pose is between ({pairs})"
        raise topic_error(bag.path, topic, "transforms, without saying which", expected)
    links = chain_of(bag, messages, spec.frame, spec.child)
    wanted = (
        TopicPick(name, messages[name], TransformPick(link.edge))
        for name in messages
        for link in links
    )
    return ChannelPlan("pose", spec, "", tuple(wanted), links)


def message_of(bag: OpenBag, layout: BagLayout, name: str, channel: str) -> MessageType:
    """Return the type of a topic's messages; `DataError` where the topic is missing or empty."""
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
    """Return the topics that fit a channel, else every topic, for error messages."""

    def serves(topic: StoredTopic) -> bool:
        try:
            where = (bag.path, topic.name, topic.type, topic.carried, layout.definitions)
            return fits(channel, definition_of(*where))
        except DataError:
            return False

    fitting = [topic.name for topic in bag.topics.values() if serves(topic)]
    if fitting:
        return f"one of {first_names(fitting)}, which hold such messages"
    return f"one of {first_names(bag.topics)}"


def first_shapes(
    bag: OpenBag, topic: str, message: MessageType, count: int
) -> tuple[MessageShape, ...]:
    """Return the shapes of the first messages of a topic."""
    raws = islice(bag.messages((topic,)), count)
    try:
        return tuple(shape_of(raw.data, message, cdr=bag.cdr) for raw in raws)
    except ValueError as error:
        expected = "messages as their definition says; is the bag damaged?"
        raise topic_error(bag.path, topic, f"no {message.name}: {error}", expected) from error
