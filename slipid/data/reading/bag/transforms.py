"""Transforms between frames over time: chains of them, their composition, heading and tilt."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from slipid.data.reading.bag.opened import BagTopic
from slipid.data.reading.bag.streams import Edge, edges_of
from slipid.data.wheel_signals import interpolate
from slipid.support.errors import did_you_mean, first_names

STATIC = "_static"
"""Suffix of the topic of constant transforms, such as `/tf_static` for `/tf`."""


@dataclass(frozen=True)
class ChainLink:
    """One transform of a chain; it is inverted if the chain leads from its child to its parent."""

    edge: Edge
    inverted: bool


@dataclass(frozen=True, eq=False)
class TransformSeries:
    """A transform over time.

    Attributes:
        time: increasing times [s].
        translation: position of the child in the parent's frame [m].
        rotation: rotation of the child in the parent's frame, as unit quaternions x, y, z, w.
    """

    time: Float[np.ndarray, " sample"]
    translation: Float[np.ndarray, "sample 3"]
    rotation: Float[np.ndarray, "sample 4"]

    def at(self, time: Float[np.ndarray, " time"]) -> "TransformSeries":
        """Return the transform at other times [s].

        Translations are interpolated linearly. Quaternions are interpolated linearly as well, along
        the shorter arc, and then normalised. A single sample is used for all times.
        """
        if len(self.time) == 1:
            rows = np.zeros(len(time), dtype=int)
            return TransformSeries(time, self.translation[rows], self.rotation[rows])
        flips = np.sum(self.rotation[1:] * self.rotation[:-1], axis=1) < 0
        sign = np.where(np.append(0, np.cumsum(flips)) % 2, -1.0, 1.0)
        same_side = self.rotation * sign[:, None]
        translation = interpolate(self.time, self.translation, time)
        rotation = interpolate(self.time, same_side, time)
        return TransformSeries(
            time, translation, rotation / np.linalg.norm(rotation, axis=1)[:, None]
        )

    def inverse(self) -> "TransformSeries":
        """Return the inverse transform."""
        back = Rotation.from_quat(self.rotation).inv()
        return TransformSeries(self.time, -back.apply(self.translation), back.as_quat())

    def then(self, other: "TransformSeries") -> "TransformSeries":
        """Return the composition of this transform with one whose parent is the child of this one.

        Both have the same times.
        """
        first, second = Rotation.from_quat(self.rotation), Rotation.from_quat(other.rotation)
        translation = self.translation + first.apply(other.translation)
        return TransformSeries(self.time, translation, (first * second).as_quat())


def composed(links: Sequence[ChainLink], moving: Mapping[Edge, TransformSeries]) -> TransformSeries:
    """Return the pose of a chain's last frame in its first frame.

    The pose is given at the times of the transform with the most samples, as far as all other
    transforms were recorded at these times.
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
    """Return the yaw angle of unit quaternions x, y, z, w [rad], without wrap-around."""
    x, y, z, w = rotation.T
    return np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def tilt(rotation: Float[np.ndarray, "sample 4"]) -> Float[np.ndarray, " sample"]:
    """Return the angle between the z axis before and after a rotation [rad]."""
    x, y, _, _ = rotation.T
    return np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))


def chain_of(topics: Sequence[BagTopic], frame: str, child: str) -> tuple[ChainLink, ...]:
    """Return the chain of transforms that leads from a frame to another.

    The topics are read, one after another, only until the chain is complete.

    Args:
        topics: topics with transforms.
        frame: first frame of the chain.
        child: last frame of the chain.

    Raises:
        DataError: no chain connects the frames; the message lists the frames in the bag.
    """
    frame, child = frame.lstrip("/"), child.lstrip("/")
    parents: dict[str, str] = {}
    for shape in (shape for topic in topics for shape in topic.shapes()):
        for edge in edges_of(shape):
            parents.setdefault(edge.child, edge.parent)
        if links := _links(parents, frame, child):
            return links
    frames = sorted({*parents, *parents.values()})
    for name in (frame, child):
        if name not in frames:
            found = f"no frame '{name}'{did_you_mean(name, frames)}"
            raise topics[-1].error(found, f"one of {first_names(frames)}")
    found = f"no transforms lead from '{frame}' to '{child}'"
    pairs = first_names(f"{parent} -> {name}" for name, parent in sorted(parents.items()))
    raise topics[-1].error(found, f"two frames of one tree ({pairs})")


def _links(parent: Mapping[str, str], frame: str, child: str) -> tuple[ChainLink, ...]:
    """Return the chain between two frames, empty if the known parents do not connect them.

    `parent` is the parent of each frame.
    """
    up, down = _ancestors(parent, frame), _ancestors(parent, child)
    common = next((name for name in down if name in up), None)
    if common is None or frame == child:
        return ()
    rise, fall = up[: up.index(common)], down[: down.index(common)]
    return (
        *(ChainLink(Edge(parent[name], name), True) for name in rise),
        *(ChainLink(Edge(parent[name], name), False) for name in reversed(fall)),
    )


def _ancestors(parent: Mapping[str, str], name: str) -> list[str]:
    """Return a frame, its parent, the parent's parent and so on, without repetition."""
    names = [name]
    while (above := parent.get(names[-1])) is not None and above not in names:
        names.append(above)
    return names
