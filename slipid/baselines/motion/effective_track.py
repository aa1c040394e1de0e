"""Kinematics of skid steer corrected by least squares: effective track, instantaneous centres.

With (s, 0, d) the body twist by the encoders at the radius and track of the config:

    effective_track         v_x = a s            yaw = b d            v_y = -x yaw
    instantaneous_centres   v_x = a s + c d      yaw = b d + e s      v_y = -x yaw

a is what the wheels are larger, 1 / b what the track is wider (over a), x the place on the
longitudinal axis about which the robot turns [m]; c and e tell a robot whose sides differ. They
are fitted to half-second windows: first those of v_x and of yaw, then x on the corrected yaw.
Nothing is tuned.

They are for drives that do not determine the body's twist. Where drives do, v_y is not -x yaw, and
these rows make no sense: do not run them there (`Machine.determines_twist`).

Liberties:
    - The lag of the wheels behind the poses is not fitted here: the steps are without it already.
    - The five numbers of the instantaneous centres are those of Mandow et al. in other words: they
      give the places y_left, y_right, x of three centres and two gains, alpha_left, alpha_right.
    - Least squares in displacement over windows, in two stages, instead of an optimiser over whole
      paths; the effective track of a ROS controller is usually trimmed by hand.
    - A place x of the effective track: ROS controllers have none.

Source: Mandow et al. 2007, "Experimental kinematics for wheeled skid-steer mobile robots", IROS,
eq. 1 to 5; effective track: the `wheel_separation_multiplier` of ROS controllers.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from slipid.baselines.interface import Heard, Machine, Method, Run, Said, Twists
from slipid.baselines.motion.steps import Steps, Windows, least


@dataclass(frozen=True)
class _Corrected(Method, abc.ABC):
    """What both have in common.

    Attributes:
        ahead: v_x from s and d, [-] and [m].
        yaw: yaw rate from s and d, [1/m] and [-].
        place: x, the point about which the robot turns, ahead of the body's origin [m].
    """

    ahead: Float[np.ndarray, "2"] | None = None
    yaw: Float[np.ndarray, "2"] | None = None
    place: float = 0.0

    @abc.abstractmethod
    def _gains(
        self, said: Float[np.ndarray, "window 2"], moved: Float[np.ndarray, " window"], own: int
    ) -> Float[np.ndarray, "2"]:
        """Gains of s and d, which are `said`, in v_x (`own` is 0) or in the yaw rate (1)."""

    def fit(self, runs: Sequence[Run], machine: Machine) -> "_Corrected":
        w = Windows.of(runs)
        said = w.means(w.steps.heard.rolling(machine))[:, [0, 2]] * w.dt[:, None]
        moved = w.twist * w.dt[:, None]
        ahead, yaw = self._gains(said, moved[:, 0], 0), self._gains(said, moved[:, 2], 1)
        place = least((-said @ yaw)[:, None], moved[:, 1])
        return replace(self, ahead=ahead, yaw=yaw, place=float(place[0]))

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        steps = Steps.of(runs)
        return steps.said(self._twist(steps.heard.rolling(machine)))

    def _twist(self, rolling: Twists) -> Twists:
        if self.ahead is None or self.yaw is None:
            raise ValueError(f"{self.name}: not fitted")
        said = rolling[:, [0, 2]]
        yaw = said @ self.yaw
        return np.stack([said @ self.ahead, -self.place * yaw, yaw], axis=1)


@final
@dataclass(frozen=True)
class EffectiveTrack(_Corrected):
    """Speed and yaw rate have one gain each."""

    name: str = "effective_track"

    def _gains(
        self, said: Float[np.ndarray, "window 2"], moved: Float[np.ndarray, " window"], own: int
    ) -> Float[np.ndarray, "2"]:
        gains = np.zeros(2)
        gains[own] = least(said[:, [own]], moved)[0]
        return gains

    @property
    def numbers(self) -> int:
        return 3


@final
@dataclass(frozen=True)
class InstantaneousCentres(_Corrected):
    """Each side has a gain and a centre of its own: speed and yaw rate both take s and d."""

    name: str = "instantaneous_centres"

    def _gains(
        self, said: Float[np.ndarray, "window 2"], moved: Float[np.ndarray, " window"], own: int
    ) -> Float[np.ndarray, "2"]:
        return least(said, moved)

    @property
    def numbers(self) -> int:
        return 5
