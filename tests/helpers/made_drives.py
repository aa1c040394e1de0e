"""Paths of robots: x, y [m], heading [rad] at a time [s]."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def round_trip(speed: float = 0.25, turning: float = 0.8) -> Callable[[float], np.ndarray]:
    """Return an ellipse at about a speed [m/s], with a constant turning rate [rad/s]."""

    def pose(t: float) -> np.ndarray:
        a = speed * t / 0.35
        return np.array([0.45 * np.cos(a), 0.3 * np.sin(a), 0.4 + turning * t])

    return pose


def starts_and_stops(t: float) -> np.ndarray:
    """Return the pose after starts at 1 m/s^2 to 0.4 m/s, stops, and turns at 90 deg/s."""
    whole, part = divmod(t, 3.0)
    ramp, speed = 0.4, 0.4
    p = min(part, 1.4)
    path = 0.5 * min(p, ramp) ** 2 + speed * min(max(p - ramp, 0.0), 0.6)
    brake = min(max(p - 1.0, 0.0), ramp)
    path += speed * brake - 0.5 * brake**2
    side = -1.0 if whole % 2 else 1.0
    turn = np.pi / 2 * min(max(part - 1.6, 0.0), 1.0)
    start = -0.2 if side > 0 else 0.2
    return np.array([start + side * path, 0.1, 0.3 + turn + np.pi / 2 * whole])
