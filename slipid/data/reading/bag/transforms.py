"""Transforms over time: the chain from one frame to another, its composition and heading."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from slipid.data.reading.bag.definitions import Message
from slipid.data.reading.bag.meanings import listed
from slipid.data.reading.bag.opened import OpenBag
from slipid.data.reading.bag.shape import Edge, Located, MessageShape, edges_of
from slipid.data.reading.bag.streams import TopicStreams, topic_error
from slipid.support.errors import did_you_mean

STATIC = "_static"
"""End of the topic's name beside `/tf` that holds transforms which never change."""


@dataclass(frozen=True)
class Link:
    """One transform of a chain, and whether the chain goes through it from child to parent."""

    edge: Edge
    inverted: bool


@dataclass(frozen=True, eq=False)
class Moving:
    """A transform over time.

    Attributes:
        time: [s], increasing.
        translation: [m].
        rotation: unit quaternions x, y, z, w.
    """

    time: Float[np.ndarray, " sample"]
    translation: Float[np.ndarray, "sample 3"]
    rotation: Float[np.ndarray, "sample 4"]

    def at(self, time: Float[np.ndarray, " time"]) -> "Moving":
        """Between the samples: linear, and along the short arc; one sample counts for all times."""
        if len(self.time) == 1:
            rows = np.zeros(len(time), dtype=int)
            return Moving(time, self.translation[rows], self.rotation[rows])
        flips = np.sum(self.rotation[1:] * self.rotation[:-1], axis=1) < 0
        sign = np.where(np.append(0, np.cumsum(flips)) % 2, -1.0, 1.0)
        same_side = self.rotation * sign[:, None]
        translation, rotation = (
            np.column_stack([np.interp(time, self.time, column) for column in values.T])
            for values in (self.translation, same_side)
        )
        return Moving(time, translation, rotation / np.linalg.norm(rotation, axis=1)[:, None])

    def inverse(self) -> "Moving":
        """The transform the other way."""
        back = self.rotation * [-1.0, -1.0, -1.0, 1.0]
        return Moving(self.time, -_rotated(back, self.translation), back)

    def then(self, other: "Moving") -> "Moving":
        """Composition with a transform from this one's child on, at the same times."""
        translation = self.translation + _rotated(self.rotation, other.translation)
        return Moving(self.time, translation, _product(self.rotation, other.rotation))


def composed(links: Sequence[Link], moving: Mapping[Edge, Moving]) -> Moving:
    """Pose of the last frame of a chain in the first, at the times of its densest transform.

    Times that some other transform does not span are left out.
    """
    densest = max((moving[link.edge] for link in links), key=lambda one: len(one.time))
    time = densest.time
    for one in moving.values():
        if len(one.time) > 1:
            time = time[(time >= one.time[0]) & (time <= one.time[-1])]
    whole = None
    for link in links:
        one = moving[link.edge].at(time)
        one = one.inverse() if link.inverted else one
        whole = one if whole is None else whole.then(one)
    assert whole is not None
    return whole


def heading(rotation: Float[np.ndarray, "sample 4"]) -> Float[np.ndarray, " sample"]:
    """Turn about the vertical of unit quaternions x, y, z, w [rad], without wrap-around."""
    x, y, z, w = rotation.T
    return np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def tilt(rotation: Float[np.ndarray, "sample 4"]) -> Float[np.ndarray, " sample"]:
    """Angle between the vertical and the turned vertical [rad]."""
    x, y, _, _ = rotation.T
    return np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))


def _rotated(
    rotation: Float[np.ndarray, "sample 4"], vector: Float[np.ndarray, "sample 3"]
) -> Float[np.ndarray, "sample 3"]:
    axis, w = rotation[:, :3], rotation[:, 3:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + w * twice + np.cross(axis, twice)


def _product(
    one: Float[np.ndarray, "sample 4"], other: Float[np.ndarray, "sample 4"]
) -> Float[np.ndarray, "sample 4"]:
    a, b = one[:, :3], other[:, :3]
    axis = one[:, 3:] * b + other[:, 3:] * a + np.cross(a, b)
    w = one[:, 3] * other[:, 3] - np.sum(a * b, axis=1)
    return np.column_stack([axis, w])


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
    seen = _FrameParents()
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
            found, expected = (
                f"no frame '{name}'{did_you_mean(name, frames)}",
                f"one of {listed(frames)}",
            )
            raise topic_error(bag.path, where, found, expected)
    found = f"no transforms lead from '{frame}' to '{child}'"
    pairs = listed(f"{parent} -> {name}" for name, parent in sorted(seen.parent.items()))
    raise topic_error(bag.path, where, found, f"two frames of one tree ({pairs})")


@dataclass(eq=False)
class _FrameParents:
    """A pick of nothing, which remembers the parent of every frame that it comes across."""

    parent: dict[str, str] = field(default_factory=dict)
    columns: tuple[str, ...] = ()

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
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
