"""Encoders corrected by a table over the direction of travel, as a smooth Fourier series.

    (along, across, yaw) = (far, 0, turn) + far sum_k c_k phi_k(angle)

with far [m/s], angle and turn the speed, its direction in the body frame and the yaw rate by the
encoders, and phi = 1, cos angle, sin angle, ..., cos 6 angle, sin 6 angle. The coefficients c by
ridge regression on half-second windows; the k-th harmonic is held down by weight k^4 times the sum
of far^2, the constant not at all.

Tuned: the ridge's weight.

Liberties:
    - It is not published as a system. A table of corrections over the direction of travel is what a
      practitioner would make for an omni robot, and what any model of slip has to beat.
    - Harmonics above the sixth are left out.
    - It knows neither load set-ups nor speeds: runs with all of them are pooled.

Source: slipid's own; the ladder of models that `slipid identify` compares has the same equation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from jaxtyping import Float

from slipid.baselines.interface import Channel, Heard, Machine, Method, Run, Said, Twists
from slipid.baselines.motion.steps import Steps, Windows

HARMONICS = 6
RIDGES = (1e-5, 1e-3, 1e-1, 10.0)
"""Weights of the ridge that are tried."""


@final
@dataclass(frozen=True)
class HeadingLookup(Method):
    """See the head of this module.

    Attributes:
        ridge: weight of the ridge.
        series: c, of (along, across, yaw), [-], [-] and [rad/m].
    """

    name: str = "heading_lookup"
    needs: frozenset[Channel] = field(default=frozenset({"twist"}), kw_only=True)
    ridge: float = 1e-3
    series: Float[np.ndarray, "k 3"] | None = None

    def candidates(self) -> Sequence["HeadingLookup"]:
        return [replace(self, ridge=ridge) for ridge in RIDGES]

    def fit(self, runs: Sequence[Run], machine: Machine) -> "HeadingLookup":
        w = Windows.of(runs)
        rolling = w.means(w.steps.heard.rolling(machine))
        gap = (w.twist - rolling) * w.dt[:, None]
        angle = np.arctan2(rolling[:, 1], rolling[:, 0])
        gap[:, :2] = _turned(-angle, gap[:, :2])
        phi = _features(rolling * w.dt[:, None])
        rough = np.concatenate([[0.0], np.repeat(np.arange(1.0, HARMONICS + 1) ** 4, 2)])
        penalty = self.ridge * np.sum(phi[:, 0] ** 2) * rough
        # a robot that never moved has no direction of travel, and gets no correction
        gram = phi.T @ phi + np.diag(penalty)
        return replace(self, series=np.linalg.lstsq(gram, phi.T @ gap, rcond=None)[0])

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        steps = Steps.of(runs)
        return steps.said(self._twist(steps.heard.rolling(machine)))

    def _twist(self, rolling: Twists) -> Twists:
        if self.series is None:
            raise ValueError(f"{self.name}: not fitted")
        change = _features(rolling) @ self.series
        change[:, :2] = _turned(np.arctan2(rolling[:, 1], rolling[:, 0]), change[:, :2])
        return np.asarray(rolling + change)

    @property
    def numbers(self) -> int:
        return 3 * (1 + 2 * HARMONICS)


def _features(rolling: Float[np.ndarray, "step 3"]) -> Float[np.ndarray, "step k"]:
    """Far phi(angle), from twists by the encoders, or from displacements [m]."""
    far, angle = np.hypot(rolling[:, 0], rolling[:, 1]), np.arctan2(rolling[:, 1], rolling[:, 0])
    waves = [wave(k * angle) for k in range(1, HARMONICS + 1) for wave in (np.cos, np.sin)]
    return np.stack([np.ones_like(angle), *waves], axis=1) * far[:, None]


def _turned(
    angle: Float[np.ndarray, " step"], v: Float[np.ndarray, "step 2"]
) -> Float[np.ndarray, "step 2"]:
    """Vectors, each turned by its angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], axis=1)
