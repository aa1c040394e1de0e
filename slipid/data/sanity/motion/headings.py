"""Ways in which a logged pose may be meant, and the body's steps under each."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from slipid.data.sanity.motion.steps import Edges

Heading = Literal["as_said", "turned_round", "degrees", "radians", "half_sine"]
"""What the logged heading is: the heading [rad]; its negative; degrees that were taken for radians;
radians that were taken for degrees; sin(heading / 2), the z of a quaternion."""
HEADINGS: tuple[Heading, ...] = ("as_said", "turned_round", "degrees", "radians", "half_sine")


@dataclass(frozen=True)
class Frame:
    """How a logged pose is meant.

    Attributes:
        heading: what the logged heading is.
        y_down: whether y has the opposite sign.
        offset: to be added to the heading, in steps of whole degrees [deg].
    """

    heading: Heading = "as_said"
    y_down: bool = False
    offset: int = 0


FRAMES = tuple(Frame(heading, down) for heading in HEADINGS for down in (False, True))
"""Every frame whose steps of the body differ by more than a rotation."""


def body_motion(at: Edges, frame: Frame) -> Float[np.ndarray, "step 3"]:
    """Steps ahead [m], to the left [m] and in heading [rad] under a frame without its offset.

    nan where a heading cannot be what the frame says.
    """
    before, after = _heading(at.pose_before[:, 2], frame), _heading(at.pose_after[:, 2], frame)
    turned = after - before
    if frame.heading in ("radians", "half_sine"):  # the reader could not see where it wraps
        turned = np.mod(turned + np.pi, 2 * np.pi) - np.pi
    middle = before + 0.5 * turned
    dx, dy = (at.pose_after - at.pose_before)[:, :2].T
    dy = -dy if frame.y_down else dy
    ahead = np.cos(middle) * dx + np.sin(middle) * dy
    left = np.cos(middle) * dy - np.sin(middle) * dx
    return np.stack([ahead, left, turned], axis=1)


def _heading(logged: Float[np.ndarray, " step"], frame: Frame) -> Float[np.ndarray, " step"]:
    """Heading [rad] that was meant."""
    if frame.heading == "turned_round":
        return -logged
    if frame.heading == "degrees":
        return np.radians(logged)
    if frame.heading == "radians":
        return np.degrees(logged)
    if frame.heading == "half_sine":
        # beyond: no sine
        return 2 * np.arcsin(np.where(np.abs(logged) <= 1.0 + 1e-3, logged.clip(-1, 1), np.nan))
    return logged
