"""Kinematics alone: encoders, and what practitioners correct in them by least squares.

With (s, 0, d) the body twist J^+ r w of wheels that do not slip:

    encoder                 v_x = s              yaw = d              v_y as the wheels have it
    effective_track         v_x = a s            yaw = b d            v_y = -x yaw
    instantaneous_centres   v_x = a s + c d      yaw = b d + e s      v_y = -x yaw
    full_linear             v_x = a s + c d      yaw = b d + e s      v_y = f s - x yaw

a is what the wheels are larger, 1 / b what the track is wider (over a), x the place on the
longitudinal axis about which the robot turns [m]; c and e tell a robot whose sides differ. All but
the encoders are for wheels that do not tell motion sideways, skid steer and differential drives:
where wheels do, v_y is not -x yaw. Nothing is tuned.

Liberties:
    - The five numbers of the instantaneous centres are those of Mandow et al. in other words: they
      give the places y_left, y_right, x of three centres and two gains, alpha_left, alpha_right.
    - Least squares in displacement over windows instead of an optimiser over whole paths; the
      effective track of a ROS controller is usually trimmed by hand, and has no place x.
    - Where the lag of the poses behind the wheels is not settled before, it is one number more.

Source: Mandow et al. 2007, "Experimental kinematics for wheeled skid-steer mobile robots", IROS,
eq. 1 to 5; effective track: the `wheel_separation_multiplier` of ROS controllers; encoders of omni
wheels: Indiveri 2009, IEEE Transactions on Robotics 25(1).
"""

from dataclasses import dataclass, replace
from typing import ClassVar, final

import numpy as np
from jaxtyping import Float

from slipid.identify.compare.slip_model import Machine, Twists
from slipid.identify.compare.steps import Steps, TrainingWindows, TwistModel
from slipid.model.geometry import Geometry

TERMS = {"effective_track": 3, "instantaneous_centres": 5, "full_linear": 6}
"""How many numbers each has beside its lag."""
LONGEST_LAG = 2.0
"""Lag beyond which the windows' own lag no longer says where a wheel was [s]."""


@final
@dataclass(frozen=True)
class Encoder(TwistModel):
    """No slip: xi = J^+ r w. Nothing is fitted; every other model is compared with it.

    Attributes:
        shape: sizes to be used instead of the robot's, None for the robot's own.
        lag: of the poses [s], None for that of the steps.
    """

    learns: ClassVar[bool] = False
    name: str = "encoder"
    shape: Geometry | None = None
    lag: float | None = None

    def learn(self, w: TrainingWindows, machine: Machine) -> "Encoder":
        return self

    def twist(self, steps: Steps, machine: Machine) -> Twists:
        at = steps if self.lag is None else steps.at_lag(self.lag)
        return at.heard.rolling(machine if self.shape is None else machine.of_shape(self.shape))


def nominal(shape: Geometry) -> Encoder:
    """No slip, radius and places as in the config, and no lag: what the user has today."""
    return Encoder("nominal", shape, 0.0)


@final
@dataclass(frozen=True)
class Corrected(TwistModel):
    """Kinematics corrected by least squares; see the head of this module.

    The coefficients are a, b, x, then c, e, then f, as far as its name has them; the lag [s] is
    last where steps have one.

    Attributes:
        shape: sizes that are corrected instead of the robot's, None for the robot's own.
    """

    shape: Geometry | None = None

    def learn(self, w: TrainingWindows, machine: Machine) -> "Corrected":
        from scipy.optimize import least_squares

        count, lag = TERMS[self.name], w.steps.lag
        start = np.zeros(count + (w.steps.faster is not None))
        start[:2], start[count:] = 1.0, lag
        low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
        low[count:], high[count:] = lag - LONGEST_LAG, lag + LONGEST_LAG
        scale = w.dt[:, None] * machine.size

        def gap(numbers: np.ndarray) -> np.ndarray:
            found = w.means(replace(self, coefficients=numbers).twist(w.steps, machine))
            return np.asarray(((found - w.twist) * scale).ravel())

        found = least_squares(gap, start, bounds=(low, high), x_scale="jac").x
        return replace(self, coefficients=found)

    def twist(self, steps: Steps, machine: Machine) -> Twists:
        count, numbers = TERMS[self.name], self.known
        if len(numbers) > count:
            steps = steps.at_lag(float(numbers[count]))
        own = machine if self.shape is None else machine.of_shape(self.shape)
        return corrected(steps.heard.rolling(own), numbers[:count])


def corrected(rolling: Twists, numbers: Float[np.ndarray, " number"]) -> Twists:
    """Twists by the encoders, corrected by a, b, x, and if they are there c, e and f."""
    a, b, x, c, e, f = np.pad(numbers, (0, 6 - len(numbers)))
    s, d = rolling[:, 0], rolling[:, 2]
    yaw = b * d + e * s
    return np.stack([a * s + c * d, f * s - x * yaw, yaw], axis=-1)
