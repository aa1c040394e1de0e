"""Design of a control loop around an actuator with a delay and a lag, by its phase margin.

The controller commands a rate u once per period. The wheels follow after the delay T_d with the lag
T_f, and errors integrate the rate w:

    T_f w' + w = u(t - T_d),   heading' = w,   (offset / v)' = heading,   u = -K errors

`SampledPlant` is the exact discrete form of this chain: a command holds for a period, and the delay
need not be a whole number of periods. One integrator stands for the position of a robot that can
drive sideways, for its heading, or for the distance along a path; K is one gain. Two integrators
stand for heading and lateral offset of a robot that drives along a path at the speed v [m/s]; with
the offset divided by v they do not depend on v.

Gains are linear-quadratic: they minimise the sum over all periods of the weighted squares of errors
and of rho u^2 (discrete algebraic Riccati equation). The controller uses only the gains of the
errors, not those of the rate and of commands on their way. The phase margin is therefore that of
the loop with these static gains: the phase of the open loop, above -180 degrees, at the crossover
frequency where its gain is 1. rho is chosen so that this margin is the demanded one. Of all lateral
loops with this margin, that with the largest gain of the offset is chosen.

Anderson and Moore 1990, Optimal Control: Linear Quadratic Methods; Astrom and Wittenmark 1997,
Computer-Controlled Systems, for sampling with a delay; Chu, Fan, Lin and Wang 2004,
"Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations", for the
doubling iteration.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float

LEAST_LAG_S = 1e-6
"""Smallest lag; a smaller one counts as this [s]."""
LOG_RHO = (-20.0, 30.0)
"""Range of the log of rho in which the demanded margin is sought [1]."""
WEIGHT_RATIOS = (4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 14.0, 17.0, 20.0, 25.0, 30.0)
"""Candidates for the weight of the heading in the lateral loop: distances of which an offset counts
like a heading of one radian, as multiples of the distance that the robot drives in the time by
which the actuator responds late [1]."""


@dataclass(frozen=True)
class Actuator:
    """Response of a rate to its command.

    Attributes:
        delay_s: time until a command reaches the wheels [s].
        lag_s: time constant of the wheels' speed control [s].
        period_s: time between two commands [s].
    """

    delay_s: float
    lag_s: float
    period_s: float

    @property
    def late_s(self) -> float:
        """Mean time from a command to the motion that it demands: delay, lag, half a period [s]."""
        return self.delay_s + self.lag_s + 0.5 * self.period_s


@dataclass(frozen=True, eq=False)
class SampledPlant:
    """Discrete model of one or two integrators behind an actuator.

    The state consists of the errors (offset and heading, or one error), the rate, and the commands
    that have not reached the wheels yet, newest first.

    Attributes:
        matrix: state one period later per state.
        column: state one period later per command.
        errors: number of errors, 1 or 2.
        period_s: time between two commands [s].
    """

    matrix: Float[np.ndarray, "state state"]
    column: Float[np.ndarray, "state 1"]
    errors: int
    period_s: float

    @classmethod
    def of(cls, actuator: Actuator, errors: int) -> "SampledPlant":
        """Return the model of one error, or of offset and heading."""
        lag = max(actuator.lag_s, LEAST_LAG_S)
        rates = np.zeros((errors + 2, errors + 2))
        rates[errors - 1, errors] = 1.0
        rates[errors, errors:] = -1.0 / lag, 1.0 / lag
        rates[errors - 2, errors - 1] = errors - 1.0
        period, n = actuator.period_s, errors + 1
        whole, late = divmod(actuator.delay_s, period)
        waiting = int(whole) + 1
        # the older of two commands acts for the first part of a period, the newer one for the rest
        first, rest = exponential(late * rates), exponential((period - late) * rates)
        matrix, column = np.zeros((n + waiting, n + waiting)), np.zeros((n + waiting, 1))
        matrix[:n, :n] = rest[:n, :n] @ first[:n, :n]
        matrix[:n, -1] = rest[:n, :n] @ first[:n, n]
        newer = column[:n, 0] if waiting == 1 else matrix[:n, -2]
        newer += rest[:n, n]
        column[n, 0] = 1.0
        matrix[n + 1 :, n:-1] = np.eye(waiting - 1)
        return cls(matrix, column, errors, period)

    def regulator(
        self, weights: Float[np.ndarray, " error"], rho: float
    ) -> Float[np.ndarray, " error"]:
        """Return the linear-quadratic gains of the errors, for weights of their squares and rho."""
        a, b = self.matrix, self.column
        cost = np.zeros(len(a))
        cost[: self.errors] = weights
        x = riccati(a, b, np.diag(cost), np.array([[rho]]))
        return np.linalg.solve(rho + b.T @ x @ b, b.T @ x @ a)[0, : self.errors]

    def closed(self, gains: Float[np.ndarray, " error"]) -> Float[np.ndarray, "state state"]:
        """Return the matrix of one period of the loop closed with static gains of the errors."""
        row = np.zeros((1, len(self.matrix)))
        row[0, : self.errors] = gains
        return self.matrix - self.column @ row

    def crossover(self, gains: Float[np.ndarray, " error"]) -> tuple[float, float]:
        """Return phase margin [deg] and crossover frequency [Hz] of the loop with static gains.

        The margin is -180 degrees if the closed loop is unstable.
        """
        frequency, basis = self._responses
        loop = basis @ gains
        size = np.log(np.abs(loop))
        stable = np.abs(np.linalg.eigvals(self.closed(gains))).max() < 1
        if size[-1] >= 0 or not stable:
            return -180.0, float(frequency[-1])
        last = max(0, int((size >= 0).sum()) - 1)
        part = float(np.clip(size[last] / (size[last] - size[last + 1]), 0.0, 1.0))
        # phase above -180 degrees; it stays between 0 and 180 degrees in a stable loop
        above = np.unwrap(np.angle(-loop[last : last + 2]))
        margin = (1 - part) * above[0] + part * above[1]
        at = frequency[last] ** (1 - part) * frequency[last + 1] ** part
        return float(np.degrees(margin)), float(at)

    @cached_property
    def _responses(self) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies [Hz], and the response of each error to the command at each of them."""
        frequency = np.geomspace(1e-5, 0.5, 1000) / self.period_s
        z = np.exp(2j * np.pi * frequency * self.period_s)[:, None, None]
        left = z * np.eye(len(self.matrix)) - self.matrix
        states = np.linalg.solve(left, np.broadcast_to(self.column, (*left.shape[:2], 1)))
        return frequency, states[:, : self.errors, 0]


def exponential(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the matrix exponential, by its series after scaling, and squaring."""
    halvings = max(0, int(np.ceil(np.log2(np.abs(matrix).sum(axis=1).max() + 1e-300))) + 3)
    small, term = matrix / 2.0**halvings, np.eye(len(matrix))
    total = term.copy()
    for k in range(1, 13):
        term = term @ small / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def riccati(
    a: Float[np.ndarray, "state state"],
    b: Float[np.ndarray, "state input"],
    q: Float[np.ndarray, "state state"],
    r: Float[np.ndarray, "input input"],
) -> Float[np.ndarray, "state state"]:
    """Return the stabilising solution X of the discrete algebraic Riccati equation.

    X = A' X A - A' X B (R + B' X B)^-1 B' X A + Q, by the doubling iteration of Chu et al. The
    input must reach all unstable states, and Q must weight them.
    """
    g, x, eye = b @ np.linalg.solve(r, b.T), q, np.eye(len(a))
    for _ in range(40):
        inverse = np.linalg.inv(eye + g @ x)
        further = a.T @ x @ inverse @ a
        a, g, x = a @ inverse @ a, g + a @ inverse @ g @ a.T, x + further
        if np.abs(further).max() <= 1e-13 * np.abs(x).max():
            break
    return np.asarray(0.5 * (x + x.T))


@dataclass(frozen=True)
class LoopDesign:
    """Gains of a loop, and how far it is from instability.

    Attributes:
        gains: gain of the one error [1/s], or those of offset over speed [1/s^2] and heading [1/s].
        margin_deg: phase margin [deg].
        bandwidth_hz: crossover frequency of the open loop [Hz].
    """

    gains: tuple[float, ...]
    margin_deg: float
    bandwidth_hz: float


@lru_cache(maxsize=256)
def design(
    actuator: Actuator, margin_deg: float, lateral: bool = False, most: float = np.inf
) -> LoopDesign:
    """Return the loop with a phase margin [deg], or with a larger one if `most` binds.

    Args:
        actuator: response of the rate to its command.
        margin_deg: smallest phase margin.
        lateral: False for a loop with one error, True for offset and heading.
        most: largest gain of the heading or of the one error [1/s].

    Raises:
        ValueError: no gains have this margin.
    """
    plant = SampledPlant.of(actuator, errors=1 + lateral)
    ratios = WEIGHT_RATIOS if lateral else (1.0,)
    each = [np.array([1.0, (k * actuator.late_s) ** 2])[: plant.errors] for k in ratios]
    gains = max((_on_margin(plant, weights, margin_deg, most) for weights in each), key=_first)
    found = LoopDesign(tuple(gains.tolist()), *plant.crossover(gains))
    if found.margin_deg < margin_deg - 0.01:
        raise ValueError(
            f"no gains have a phase margin of {margin_deg:g} deg at a delay of "
            f"{actuator.delay_s:g} s and a lag of {actuator.lag_s:g} s; expected a smaller margin"
        )
    return found


def _first(gains: Float[np.ndarray, " error"]) -> float:
    return float(gains[0])


def _on_margin(
    plant: SampledPlant, weights: Float[np.ndarray, " error"], margin_deg: float, most: float
) -> Float[np.ndarray, " error"]:
    """Return the linear-quadratic gains with the smallest rho that both bounds allow."""
    low, high = LOG_RHO
    for _ in range(40):
        middle = 0.5 * (low + high)
        gains = plant.regulator(weights, float(np.exp(middle)))
        allowed = plant.crossover(gains)[0] >= margin_deg and gains[-1] <= most
        low, high = (low, middle) if allowed else (middle, high)
    return plant.regulator(weights, float(np.exp(high)))
