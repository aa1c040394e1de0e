"""Which chain of transforms leads from one frame to another."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from slipid.data.reading.bag.messages.kinds import Message
from slipid.data.reading.bag.messages.meanings import listed
from slipid.data.reading.bag.messages.picks import Edge, Located, edges_of
from slipid.data.reading.bag.messages.shape import Shape
from slipid.data.reading.bag.messages.streams import TopicStreams, topic_error
from slipid.data.reading.bag.storage.opened import OpenBag
from slipid.data.reading.bag.transforms import Link
from slipid.support.errors import near


def chain_of(
    bag: OpenBag, messages: Mapping[str, Message], frame: str, child: str
) -> tuple[Link, ...]:
    """Transforms that lead from a frame to another, found in as few messages as tell it.

    Args:
        bag: the bag.
        messages: type of each topic that holds transforms.
        frame: where the chain starts.
        child: where it ends.

    Raises:
        DataError: no chain leads there; the message lists the frames.
    """
    seen = _Seen()
    streams = {
        topic: TopicStreams(bag.path, topic, message, [seen], cdr=bag.cdr)
        for topic, message in messages.items()
    }
    frame, child = frame.lstrip("/"), child.lstrip("/")
    for batch in bag.batches(tuple(messages)):
        streams[batch.topic].add(batch)
        if links := _links(seen.parent, frame, child):
            return links
    frames = sorted({*seen.parent.keys(), *seen.parent.values()})
    where = ", ".join(messages)
    for name in (frame, child):
        if name not in frames:
            found, expected = f"no frame '{name}'{near(name, frames)}", f"one of {listed(frames)}"
            raise topic_error(bag.path, where, found, expected)
    found = f"no transforms lead from '{frame}' to '{child}'"
    pairs = listed(f"{parent} -> {name}" for name, parent in sorted(seen.parent.items()))
    raise topic_error(bag.path, where, found, f"two frames of one tree ({pairs})")


@dataclass(eq=False)
class _Seen:
    """A pick of nothing, which remembers the parent of every frame that it comes across."""

    parent: dict[str, str] = field(default_factory=dict)
    columns: tuple[str, ...] = ()

    def located(self, shape: Shape) -> tuple[Located, ...]:
        for edge in edges_of(shape):
            self.parent.setdefault(edge.child, edge.parent)
        return ()


def _links(parent: Mapping[str, str], frame: str, child: str) -> tuple[Link, ...]:
    """The chain, empty while it is not known."""
    up, down = _ancestors(parent, frame), _ancestors(parent, child)
    common = next((name for name in down if name in up), None)
    if common is None or frame == child:
        return ()
    rise, fall = up[: up.index(common)], down[: down.index(common)]
    return (
        *(Link(Edge(parent[name], name), True) for name in rise),
        *(Link(Edge(parent[name], name), False) for name in reversed(fall)),
    )


def _ancestors(parent: Mapping[str, str], name: str) -> list[str]:
    """A frame, its parent, and so on; no frame twice."""
    names = [name]
    while (above := parent.get(names[-1])) is not None and above not in names:
        names.append(above)
    return names
