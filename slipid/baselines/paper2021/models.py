"""The slip models the 2021 paper stored and the one its robot ran, as named coefficients."""

from dataclasses import dataclass

import numpy as np

CURRENT_SVR = (0.120, 0.566)
"""Figure 2: s = 0.120 + 0.566 I, epsilon-SVR with linear kernel, whole field, motor 1; I in A."""

TORQUE_SVR = (-0.072, 4.888, -5.456)
"""Figure 4: s = -0.072 + 4.888 M - 5.456 M^2, quadratic SVR, motor 1; M in N m at the motor."""


def polynomial(coefficients: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    """Value of a polynomial whose coefficients rise in power: c0 + c1 x + c2 x^2 + ..."""
    return np.polynomial.polynomial.polyval(x, np.asarray(coefficients))


def smooth_current(current: np.ndarray, memory: float = 0.97) -> np.ndarray:
    """Exponentially smoothed current: I~_k = memory I~_(k-1) + (1 - memory) I_k, I~_0 = I_0.

    Started at the first sample, so that a log cut out of a drive has no ramp that never was.

    Args:
        current: logged current [A], shape (time, wheel).
        memory: share kept from one sample to the next [-], 0 <= memory < 1.

    Raises:
        ValueError: if memory is outside [0, 1).
    """
    if not 0.0 <= memory < 1.0:
        raise ValueError(f"memory must lie in [0, 1), got {memory}")
    if len(current) == 0:
        return np.zeros_like(current)
    from scipy.signal import lfilter

    start = memory * current[:1]
    return lfilter([1.0 - memory], [1.0, -memory], current, axis=0, zi=start)[0]


@dataclass(frozen=True, eq=False)
class DeployedModel:
    """Slip of each wheel from its own current, as the paper's robot ran it.

    1 - s_i = a_i I~_i + b_i where the smoothed current I~_i > threshold, else s_i = 0. The authors'
    lines leave [0, 1] beyond 1.55 A, so 1 - s is held inside it: a wheel is never turned backwards.

    Args:
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

    def slip(self, current: np.ndarray) -> np.ndarray:
        """Slip of every wheel [-] over a log's current [A], both (time, wheel)."""
        return self.slip_of_smoothed(smooth_current(np.abs(current), self.memory))

    def slip_of_smoothed(self, current: np.ndarray) -> np.ndarray:
        """Slip [-] at a current that is smoothed already [A], both (sample, wheel)."""
        grip = np.clip(self.gain * current + self.offset, 0.0, 1.0)
        return np.where(current > self.threshold, 1.0 - grip, 0.0)

    def effective_speed(self, wheel_speed: np.ndarray, current: np.ndarray) -> np.ndarray:
        """Wheel speed that moves the robot, w (1 - s) [rad/s], shape (time, wheel)."""
        return wheel_speed * (1.0 - self.slip(current))


DEPLOYED = DeployedModel(
    gain=np.array([-0.639, -0.4559, -0.6294]), offset=np.array([0.988, 0.9678, 0.9913])
)
"""The coefficients on the paper's robot, motors 1, 2, 3."""


def fit_deployed(
    current: np.ndarray, slip: np.ndarray, threshold: float = 0.4, memory: float = 0.97
) -> DeployedModel:
    """The deployed form with its coefficients refitted: least squares of 1 - s on I~ per wheel.

    Only samples above the threshold count, because only there does the form use its line. A wheel
    with fewer than two of them, or without spread in current, keeps the part that can be told: no
    slip (a = 0, b = 1), or the mean alone (a = 0).

    Args:
        current: smoothed current [A], shape (sample, wheel).
        slip: measured slip [-], shape (sample, wheel); samples that are not finite are left out.
        threshold: current below which a wheel is taken not to slip [A].
        memory: kept with the model, for use on logs [-].

    Raises:
        ValueError: if the shapes differ.
    """
    if current.shape != slip.shape or current.ndim != 2:
        raise ValueError(
            f"current and slip must both be (sample, wheel), got {current.shape} and {slip.shape}"
        )
    lines = [_line(i, s, threshold) for i, s in zip(current.T, slip.T, strict=True)]
    gain, offset = np.array(lines).T
    return DeployedModel(gain=gain, offset=offset, threshold=threshold, memory=memory)


def _line(current: np.ndarray, slip: np.ndarray, threshold: float) -> tuple[float, float]:
    use = (current > threshold) & np.isfinite(slip)
    if np.count_nonzero(use) < 2:
        return 0.0, 1.0
    x, y = current[use], 1.0 - slip[use]
    spread = x - x.mean()
    # Equal currents differ by rounding only: a slope through them would be made of that rounding.
    if np.max(np.abs(spread)) < 1e-9 * np.max(np.abs(x)):
        return 0.0, float(y.mean())
    gain = float(spread @ y / (spread @ spread))
    return gain, float(y.mean() - gain * x.mean())
