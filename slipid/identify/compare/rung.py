"""The interface of every slip model below the force balance; motion of wheels, body and marker."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.windows import Windows
from slipid.identify.fit.likelihood import measured, seen
from slipid.model.robot import Robot

Number = TypeVar("Number")
Increments = Float[np.ndarray, "piece window 3"]
_seen, _measured = jax.jit(seen), jax.jit(measured)


@dataclass(frozen=True)
class Rung(abc.ABC):
    """A model that turns wheel motion into marker increments, in corrected metres.

    The state is the fitted numbers of each floor, with the name enough to build the rung again.
    """

    name: str
    state: dict[str, np.ndarray] = field(default_factory=dict, kw_only=True)

    @abc.abstractmethod
    def fit(self, w: Windows, robot: Robot) -> "Rung":
        """The rung fitted to these windows, floor by floor."""

    @abc.abstractmethod
    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        """Body twist of every window (piece, window, 3) [m/s, m/s, rad/s]."""

    def increments(self, w: Windows, robot: Robot) -> Increments:
        return as_increments(self.twist(w, robot), w, robot)

    def series(self, surface: str, load: str) -> str:
        """Key in `state` of the numbers that speak of a floor and load set-up.

        Raises:
            ValueError: no such floor was fitted.
        """
        of_floor(self.state, surface)
        return surface

    def stiffness(self, w: Windows, robot: Robot) -> dict[str, np.ndarray]:
        """What holds the fitted numbers besides the data: precision of each key's flat numbers."""
        return {}


def of_floor(floors: Mapping[str, Number], name: str) -> Number:
    """What is kept for a floor.

    Raises:
        ValueError: no such floor was fitted.
    """
    if name not in floors:
        raise ValueError(f"no surface '{name}'; identified: {', '.join(floors)}")
    return floors[name]


def as_increments(twist: np.ndarray, w: Windows, robot: Robot) -> Increments:
    """Marker increments [m, m, rad] of body twists (piece, window, 3)."""
    session = jnp.asarray([robot.session_index(s) for s in w.session])
    return np.asarray(_seen(robot, jnp.asarray(twist), jnp.asarray(w.dt), session))


def body_twist(w: Windows, robot: Robot) -> np.ndarray:
    """Measured body twist of every window: yaw and place of the marker taken out, over dt."""
    moved = np.asarray(_measured(robot, jnp.asarray(w.pose)))
    yaw = moved[..., 2]
    psi = np.array([float(robot.camera.yaw(robot.session_index(s))) for s in w.session])[:, None]
    chord = turned(psi, moved[..., :2])
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), chord.shape)
    chord -= turned(yaw, place) - place
    # a chord is the arc times sinc, and points half the turn away from its start
    arc = turned(-0.5 * yaw, chord) / np.sinc(yaw / (2 * np.pi))[..., None]
    return np.concatenate([arc, yaw[..., None]], -1) / w.dt[..., None]


def rims(w: Windows, robot: Robot) -> tuple[Float[np.ndarray, "3 wheel"], np.ndarray]:
    """J^+ r, from wheel speeds to the twist without slip, and the wheel speeds [rad/s]."""
    j = np.asarray(robot.geometry.inverse()) * float(robot.geometry.wheel_radius)
    return j, w.turn / w.dt[..., None]


def turned(angle: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Plane vectors (..., 2), each turned by its angle (...)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def sideways(v: np.ndarray) -> np.ndarray:
    """Plane vectors (..., 2), each turned by a quarter to the left."""
    return np.stack([-v[..., 1], v[..., 0]], -1)
