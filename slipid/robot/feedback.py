"""Feedback gains beside feed-forward gains, designed as SysId of WPILib designs them.

The plant of a motor with the gains kV and kA is x'' = (u - kV x') / kA. Its voltage u holds for a
period. Gains are linear-quadratic: they minimise the sum over all periods of

    (position error / q_p)^2 + (velocity error / q_v)^2 + (u / r)^2

with the largest errors q_p, q_v and the largest voltage r that are acceptable. A loop of the
velocity has the state v, a loop of the position the state (x, v). Measurements that are d late are
compensated: with A, B the plant over a period T and K the gains, K (A - B K)^(d / T) are the gains
for the state a time d ago (Veness, Controls Engineering in FRC, appendix on latency compensation).

Source: SysId and wpimath of WPILib, `FeedbackAnalysis.cpp` and `LinearQuadraticRegulator.h`.
"""

from dataclasses import asdict, dataclass
from math import exp, pi

import numpy as np
from jaxtyping import Float

from slipid.model.feedforward import ORDER, Feedforward
from slipid.robot.loop_design import riccati

SUPPLY_V = 12.0
"""Supply voltage from which SysId derives the largest velocity error [V]."""


@dataclass(frozen=True)
class FeedbackDemand:
    """Demands on a loop; the defaults are those of SysId.

    Attributes:
        velocity_error: largest acceptable velocity error [rad/s].
        position_error: largest acceptable position error, by default 0.1 rotations [rad].
        effort: largest acceptable voltage [V].
        period_s: time between two voltages [s].
        delay_s: time by which measurements are late [s].
    """

    velocity_error: float
    position_error: float = 0.1 * 2 * pi
    effort: float = 7.0
    period_s: float = 0.02
    delay_s: float = 0.0

    @classmethod
    def of(cls, found: Feedforward) -> "FeedbackDemand | None":
        """Return the defaults for a motor, of which the velocity error depends on its top speed.

        It is a quarter of the speed that `SUPPLY_V` reaches. Without such a speed, or without
        inertia, the result is None.
        """
        top = SUPPLY_V - found.kS.value
        if not (top > 0 and found.kV.value > 0 and found.kA.value > 0):
            return None
        return cls(0.25 * top / found.kV.value)


@dataclass(frozen=True)
class FeedbackGains:
    """Feedback gains of a motor.

    Attributes:
        velocity_kP: voltage per velocity error of a velocity loop [V s/rad].
        position_kP: voltage per position error of a position loop [V/rad].
        position_kD: voltage per velocity error of a position loop [V s/rad].
        verdict: the weaker verdict of kV and kA, from which the gains follow.
        demand: demands that the gains were designed for.
    """

    velocity_kP: float
    position_kP: float
    position_kD: float
    verdict: str
    demand: FeedbackDemand

    @classmethod
    def of(cls, found: Feedforward, demand: FeedbackDemand | None = None) -> "FeedbackGains | None":
        """Return the gains of a motor for given demands, by default for those of SysId.

        The result is None for a motor without defaults (`FeedbackDemand.of`).
        """
        usual = FeedbackDemand.of(found)
        if usual is None:
            return None
        wanted = demand or usual
        velocity = velocity_gains(found.kV.value, found.kA.value, wanted)
        position = position_gains(found.kV.value, found.kA.value, wanted)
        verdict = max(found.kV.verdict, found.kA.verdict, key=ORDER.index)
        return cls(float(velocity[0]), float(position[0]), float(position[1]), verdict, wanted)

    @property
    def values(self) -> dict[str, float]:
        """The three gains, keyed by name."""
        return {name: x for name, x in asdict(self).items() if name not in ("verdict", "demand")}


UNITS = {"velocity_kP": "V*s/rad", "position_kP": "V/rad", "position_kD": "V*s/rad"}
"""Units of feedback gains, keyed by name."""


def velocity_gains(kV: float, kA: float, demand: FeedbackDemand) -> Float[np.ndarray, " state"]:
    """Return the gain of a velocity loop [V s/rad]; kV and kA are positive."""
    a, b = _sampled(kV, kA, demand.period_s)
    return _regulator(a[1:, 1:], b[1:], [demand.velocity_error], demand)


def position_gains(kV: float, kA: float, demand: FeedbackDemand) -> Float[np.ndarray, " state"]:
    """Return the gains of a position loop [V/rad, V s/rad]; kV and kA are positive."""
    a, b = _sampled(kV, kA, demand.period_s)
    return _regulator(a, b, [demand.position_error, demand.velocity_error], demand)


def _sampled(
    kV: float, kA: float, period: float
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "2 1"]]:
    """Return the plant over a period: matrix of position and speed, and column of the voltage."""
    left = exp(-kV / kA * period)
    way = kA / kV * (1 - left)
    return np.array([[1, way], [0, left]]), np.array([[(period - way) / kV], [(1 - left) / kV]])


def _regulator(
    a: Float[np.ndarray, "state state"],
    b: Float[np.ndarray, "state 1"],
    errors: list[float],
    demand: FeedbackDemand,
) -> Float[np.ndarray, " state"]:
    """Return the linear-quadratic gains for largest errors, compensated for the delay."""
    effort = np.array([[demand.effort**-2.0]])
    x = riccati(a, b, np.diag(np.array(errors) ** -2.0), effort)
    gains = np.linalg.solve(effort + b.T @ x @ b, b.T @ x @ a)
    roots, vectors = np.linalg.eig((a - b @ gains).astype(complex))
    late = vectors @ np.diag(roots ** (demand.delay_s / demand.period_s)) @ np.linalg.inv(vectors)
    return np.asarray((gains @ late).real[0])
