"""Conventions by which a logged pose may be meant, and the body's steps under each."""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from slipid.data.sanity.motion.joined import StepEdges
from slipid.data.wheel_signals import body_increments

Heading = Literal["as_logged", "turned_round", "degrees", "radians", "half_sine"]
"""What the logged heading is: the heading [rad]; its negative; degrees that were taken for radians;
radians that were taken for degrees; sin(heading / 2), the z of a quaternion."""


@dataclass(frozen=True)
class PoseConvention:
    """Convention by which a logged pose is meant.

    Attributes:
        heading: what the logged heading is.
        y_down: whether y has the opposite sign.
        offset: to be added to the heading, in steps of whole degrees [deg].
    """

    heading: Heading = "as_logged"
    y_down: bool = False
    offset: int = 0

    @property
    def bare(self) -> "PoseConvention":
        """The convention without its offset."""
        return replace(self, offset=0)


CONVENTIONS = tuple(
    PoseConvention(heading, down) for heading in get_args(Heading) for down in (False, True)
)
"""Every convention whose steps of the body differ by more than a rotation."""


def rotation(degrees: int) -> Float[np.ndarray, "3 3"]:
    """Rotation of a step of the body about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def body_motion(at: StepEdges, convention: PoseConvention) -> Float[np.ndarray, "step 3"]:
    """Steps ahead [m], to the left [m] and in heading [rad] under a convention without its offset.

    nan where a heading cannot be what the convention says.
    """
    flip = [1.0, -1.0 if convention.y_down else 1.0, 1.0]
    before, after = at.pose_before * flip, at.pose_after * flip
    before[:, 2] = _heading(before[:, 2], convention.heading)
    turned = _heading(after[:, 2], convention.heading) - before[:, 2]
    if convention.heading in ("radians", "half_sine"):  # the reader could not see where it wraps
        turned = np.mod(turned + np.pi, 2 * np.pi) - np.pi
    after[:, 2] = before[:, 2] + turned
    return body_increments(before, after)


def _heading(logged: Float[np.ndarray, " step"], meaning: Heading) -> Float[np.ndarray, " step"]:
    """Heading [rad] that was meant."""
    if meaning == "turned_round":
        return -logged
    if meaning == "degrees":
        return np.radians(logged)
    if meaning == "radians":
        return np.degrees(logged)
    if meaning == "half_sine":
        # beyond: no sine
        return 2 * np.arcsin(np.where(np.abs(logged) <= 1.0 + 1e-3, logged.clip(-1, 1), np.nan))
    return logged
