"""Rungs of kinematics alone: as a config has them, and as practitioners correct them.

With (s, 0, d) the body twist J^+ r w of wheels that do not slip, by the radius and the places that
were measured by hand, and a lag of their own:

    effective_track         v_x = a s            yaw = b d            v_y = -x yaw
    instantaneous_centres   v_x = a s + c d      yaw = b d + e s      v_y = -x yaw
    full_linear             v_x = a s + c d      yaw = b d + e s      v_y = f s - x yaw

a is what the wheels are larger, 1 / b what the track is wider (over a), x the place on the
longitudinal axis about which the robot turns. They are for wheels that do not tell motion sideways:
skid steer and differential drives.

Source: instantaneous centres of rotation, Mandow et al. 2007, IROS, eq. 1 to 5, of which this is
the same five numbers in other words; effective track: the `wheel_separation_multiplier` of ROS.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from slipid.data.windows import Windows
from slipid.identify.compare.rung import Rung, body_twist, of_floor
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot

TERMS = {"effective_track": 3, "instantaneous_centres": 5, "full_linear": 6}
"""How many numbers each has beside its lag."""
LONGEST_LAG = 2.0
"""Lag beyond which the windows' own lag no longer says where a wheel was [s]."""


@dataclass(frozen=True)
class Nominal(Rung):
    """No slip, radius and places as in the config, and no lag: what the user has today."""

    shape: Geometry

    def fit(self, w: Windows, robot: Robot) -> "Nominal":
        return self

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        return _plain(self.shape, w.at_lag(0.0))

    def series(self, surface: str, load: str) -> str:
        return surface


@dataclass(frozen=True)
class Corrected(Rung):
    """Kinematics corrected by least squares, floor by floor; see the head of this module.

    The state of a floor is a, b, x, then c, e, then f, as far as it has them; the lag [s] is last.
    """

    shape: Geometry

    def fit(self, w: Windows, robot: Robot) -> "Corrected":
        scale = np.array([1.0, 1.0, float(robot.geometry.base_radius)])
        state, floors = {}, np.asarray(w.surface)
        for name in dict.fromkeys(w.surface):
            mine = w.pieces(np.flatnonzero(floors == name))
            true, dt = body_twist(mine, robot), mine.dt[..., None]

            def gap(
                numbers: np.ndarray,
                mine: Windows = mine,
                true: np.ndarray = true,
                dt: np.ndarray = dt,
            ) -> np.ndarray:
                found = self._corrected(_plain(self.shape, mine.at_lag(numbers[-1])), numbers)
                return np.asarray(((found - true) * dt * scale).ravel())

            start = np.zeros(TERMS[self.name] + 1)
            start[:2], start[-1] = 1.0, mine.lag
            low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
            low[-1], high[-1] = mine.lag - LONGEST_LAG, mine.lag + LONGEST_LAG
            state[name] = least_squares(gap, start, bounds=(low, high), x_scale="jac").x
        return replace(self, state=state)

    def twist(self, w: Windows, robot: Robot) -> np.ndarray:
        out = np.empty((*w.dt.shape, 3))
        for k, name in enumerate(w.surface):
            numbers = of_floor(self.state, name)
            piece = w.pieces(np.array([k])).at_lag(float(numbers[-1]))
            out[k] = self._corrected(_plain(self.shape, piece), numbers)[0]
        return out

    def _corrected(self, plain: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        a, b, x = numbers[:3]
        c, e = numbers[3:5] if len(numbers) > 5 else (0.0, 0.0)
        f = numbers[5] if len(numbers) > 6 else 0.0
        s, d = plain[..., 0], plain[..., 2]
        yaw = b * d + e * s
        return np.stack([a * s + c * d, f * s - x * yaw, yaw], axis=-1)


def _plain(shape: Geometry, w: Windows) -> np.ndarray:
    """Body twist of every window if nothing slips."""
    back = np.asarray(shape.least()) * float(shape.wheel_radius)
    return np.asarray(w.turn / w.dt[..., None] @ back.T)


def corrected(shape: Geometry) -> list[Rung]:
    """The corrections, unfitted, of wheels that do not tell motion sideways."""
    return [Corrected(name, shape) for name in TERMS]
