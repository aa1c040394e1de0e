"""From steps of all channels to the evidence that readings are compared with."""

import numpy as np
from jaxtyping import Float

from slipid.data.sanity.axes.reading import Commanded, Evidence
from slipid.data.sanity.motion.evidence import Products, products, usable
from slipid.data.sanity.motion.headings import FRAMES, Frame, body_motion
from slipid.data.sanity.motion.steps import Edges, Steps


def gather(rolling: Float[np.ndarray, "wheel 3"], at: Edges, moved: Steps, base: float) -> Evidence:
    """Products of all channels.

    Args:
        rolling: J / r, heading in metres at the base radius [rad/m].
        base: base radius [m].
    """
    pose: dict[Frame, Products] = {}
    gyro: dict[Frame, float] = {}
    for frame in FRAMES:
        body = body_motion(at, frame)
        found = products(moved.wheels, body, base)
        if found is None:
            continue
        pose[frame] = found
        if moved.gyro is not None:
            gyro[frame] = _alike(moved.gyro, body, found)
    twist = None if moved.twist is None else products(moved.wheels, moved.twist, base, rounds=0)
    if twist is not None and not np.trace(twist.body) > 0:
        twist = None
    return Evidence(rolling, pose, twist, _commanded(moved), gyro if any(gyro.values()) else None)


def _alike(gyro: np.ndarray, body: np.ndarray, found: Products) -> float:
    """Covariance of gyro and heading over the product of their spreads; 0 where none turns."""
    turned = np.stack([gyro[found.known, 0], body[found.known, 2]])
    (own, both), (_, other) = (turned * found.weight) @ turned.T
    return float(both / np.sqrt(own * other)) if own * other > 0 else 0.0


def _commanded(moved: Steps) -> Commanded | None:
    """Products of turns with commanded ones."""
    if moved.commanded is None:
        return None
    known = usable(moved.wheels, moved.commanded)
    turns, said = moved.wheels[known], moved.commanded[known]
    if not (said**2).sum() > 0:
        return None
    return Commanded(turns.T @ said, float((turns**2).sum()), float((said**2).sum()))
