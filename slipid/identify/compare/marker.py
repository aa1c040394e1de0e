"""Motion of the body and of the marker that a camera sees: increments, twists, turned vectors."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.windows import Windows
from slipid.identify.fit.likelihood import measured, seen
from slipid.model.robot import Robot

Increments = Float[np.ndarray, "piece window 3"]
_seen, _measured = jax.jit(seen), jax.jit(measured)


def as_increments(twist: np.ndarray, w: Windows, robot: Robot) -> Increments:
    """Marker increments [m, m, rad] of body twists (piece, window, 3)."""
    session = jnp.asarray([robot.session_index(s) for s in w.session])
    return np.asarray(_seen(robot, jnp.asarray(twist), jnp.asarray(w.dt), session))


def body_twist(w: Windows, robot: Robot) -> np.ndarray:
    """Measured body twist of every window: yaw and place of the marker taken out, over dt."""
    moved = np.asarray(_measured(robot, jnp.asarray(w.pose)))
    yaw = moved[..., 2]
    yaws = {s: float(robot.camera.yaw(robot.session_index(s))) for s in set(w.session)}
    psi = np.array([yaws[s] for s in w.session])[:, None]
    chord = turned(psi, moved[..., :2])
    place = np.broadcast_to(np.asarray(robot.camera.marker_place), chord.shape)
    chord -= turned(yaw, place) - place
    # a chord is the arc times sinc, and points half the turn away from its start
    arc = turned(-0.5 * yaw, chord) / np.sinc(yaw / (2 * np.pi))[..., None]
    return np.concatenate([arc, yaw[..., None]], -1) / w.dt[..., None]


def turned(angle: np.ndarray | float, v: np.ndarray) -> np.ndarray:
    """Plane vectors (..., 2), each turned by its angle (...)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def sideways(v: np.ndarray) -> np.ndarray:
    """Plane vectors (..., 2), each turned by a quarter to the left."""
    return np.stack([-v[..., 1], v[..., 0]], -1)
