"""Which numbers of a message are wanted: by paths, by names of joints, by frames of a transform."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from slipid.data.reading.bag.messages.shape import BytePlace, MessageShape, PathStep, steps_of

STAMPS = ("header.stamp", "stamp")
"""Where messages that have a time of their own keep it."""
POSITION = ("translation.x", "translation.y", "translation.z")
ROTATION = ("rotation.x", "rotation.y", "rotation.z", "rotation.w")


@dataclass(frozen=True)
class Located:
    """Where the wanted numbers lie in messages of one shape.

    Attributes:
        seconds: of the message's own time, and `nanoseconds`; None where it has none.
        numbers: the wanted ones in order, None for one that is not in these messages.
    """

    seconds: BytePlace | None
    nanoseconds: BytePlace | None
    numbers: tuple[BytePlace | None, ...]


@runtime_checkable
class Pick(Protocol):
    """What is wanted of the messages of a topic: one row of numbers a message, or none, or more."""

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        """The rows in messages of a shape."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Name of each number in a row; may be empty before a message was seen."""


@dataclass(eq=False)
class FieldPick:
    """Numbers by the paths of their fields; an array without an index counts with all elements.

    Attributes:
        paths: of the fields.
        names: name of each number, as the first message has them.
    """

    paths: tuple[str, ...]
    names: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        return self.names or self.paths

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        numbers: list[BytePlace] = []
        names: list[str] = []
        for path in self.paths:
            places = shape.places(steps_of(path))
            numbers += places
            names += [path] if len(places) == 1 else [f"{path}[{k}]" for k in range(len(places))]
        if not numbers:
            return ()
        self.names = self.names or tuple(names)
        return (_located(shape, (), numbers),)


@dataclass(eq=False)
class JointPick:
    """Numbers of joints by name, from messages like JointState.

    Attributes:
        joints: names of the wanted ones, in the order of the columns.
        array: which array holds the numbers: `position`, `velocity` or `effort`.
        names: every name that was in some message.
    """

    joints: tuple[str, ...]
    array: str
    names: dict[str, None] = field(default_factory=dict)

    @property
    def columns(self) -> tuple[str, ...]:
        return self.joints

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        names = shape.texts((PathStep("name"),))
        self.names.update(dict.fromkeys(names))
        places = shape.places((PathStep(self.array),))
        # an array may be left empty; of any other length it says nothing of the names
        have = dict(zip(names, places, strict=True)) if len(places) == len(names) else {}
        numbers = [have.get(joint) for joint in self.joints]
        if not any(numbers):
            return ()
        return (_located(shape, (), numbers),)


@dataclass(frozen=True)
class Edge:
    """A transform as messages name it: the pose of frame `child` in frame `parent`."""

    parent: str
    child: str


@dataclass(frozen=True, eq=False)
class TransformPick:
    """Translation and rotation of one edge in messages that hold several (TFMessage)."""

    edge: Edge

    @property
    def columns(self) -> tuple[str, ...]:
        return (*POSITION, *ROTATION)

    def located(self, shape: MessageShape) -> tuple[Located, ...]:
        rows = []
        for k, edge in enumerate(edges_of(shape)):
            if edge == self.edge:
                first = (PathStep("transforms", k),)
                paths = [(*first, *steps_of(f"transform.{name}")) for name in self.columns]
                numbers = [place for path in paths for place in shape.places(path)]
                rows.append(_located(shape, first, numbers))
        return tuple(rows)


def edges_of(shape: MessageShape) -> tuple[Edge, ...]:
    """Every transform of a TFMessage, names without the slash that ROS 1 once began them with."""
    parents = shape.texts(steps_of("transforms.header.frame_id"))
    children = shape.texts(steps_of("transforms.child_frame_id"))
    pairs = zip(parents, children, strict=True)
    return tuple(Edge(parent.lstrip("/"), child.lstrip("/")) for parent, child in pairs)


def _located(
    shape: MessageShape, first: tuple[PathStep, ...], numbers: Sequence[BytePlace | None]
) -> Located:
    """With the time of the message, or of the part of it that `first` leads to."""
    for stamp in STAMPS:
        whole, part = (
            shape.places((*first, *steps_of(f"{stamp}.{unit}"))) for unit in ("sec", "nanosec")
        )
        if len(whole) == len(part) == 1:
            return Located(whole[0], part[0], tuple(numbers))
    return Located(None, None, tuple(numbers))
