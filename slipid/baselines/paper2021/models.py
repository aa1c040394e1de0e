"""The slip models the 2021 paper stored and the one its robot ran, as named coefficients."""

from dataclasses import dataclass

import numpy as np

CURRENT_SVR = (0.120, 0.566)
"""Figure 2: s = 0.120 + 0.566 I, epsilon-SVR with linear kernel, whole field, motor 1; I in A."""

TORQUE_SVR = (-0.072, 4.888, -5.456)
"""Figure 4: s = -0.072 + 4.888 M - 5.456 M^2, quadratic SVR, motor 1; M in N m at the motor."""


@dataclass(frozen=True, eq=False)
class DeployedModel:
    """Slip of each wheel from its own current, as the paper's robot ran it.

    1 - s_i = a_i I~_i + b_i where the smoothed current I~_i > threshold, else s_i = 0. The robot
    smoothed currents from sample to sample, I~_k = memory I~_(k-1) + (1 - memory) I_k; the method
    takes smoothed ones. The authors' lines leave [0, 1] beyond 1.55 A, so 1 - s is held inside it:
    a wheel is never turned backwards.

    Attributes:
        gain: a [1/A], shape (wheel,).
        offset: b [-], shape (wheel,).
        threshold: current below which a wheel is taken not to slip [A].
        memory: share of the smoothed current kept from sample to sample [-].

    Source: Belyaev et al. 2021, section 3, coefficients as deployed.
    """

    gain: np.ndarray
    offset: np.ndarray
    threshold: float = 0.4
    memory: float = 0.97

    def slip_of_smoothed(self, current: np.ndarray) -> np.ndarray:
        """Slip [-] at a current that is smoothed already [A], both (sample, wheel)."""
        grip = np.clip(self.gain * current + self.offset, 0.0, 1.0)
        return np.where(current > self.threshold, 1.0 - grip, 0.0)


DEPLOYED = DeployedModel(
    gain=np.array([-0.639, -0.4559, -0.6294]), offset=np.array([0.988, 0.9678, 0.9913])
)
"""The coefficients on the paper's robot, motors 1, 2, 3."""
