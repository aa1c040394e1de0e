"""Belyaev and Kushnarev 2025: the floor by what driving costs in the direction of travel.

Over the last half second let (v_x, v_y, W) be the twist that the encoders tell, w and I speed and
current of each motor, and

    P = sum_i (R |I_i| + C_e |w_i|) |I_i|                 electric power, or without R I^2
    u = sqrt(v_x^2 + v_y^2 + (L W)^2),     phi = direction of (v_x, v_y)
    e = P / (m g u)                                       energy coefficient (cost of transport)
    e ~ a_0 + sum_k a_k cos(k phi) + b_k sin(k phi)       of each floor, k = 1, 2, 3, ..
    log p_t = exp(-dt / memory) log p_{t-1} + (dt / apart) log N(e_t; series(phi_t), s^2) + const

s is the std that a floor's series leaves. Wheels that do not drive sideways have no direction of
travel; phi is then the angle of (v_x, L W): 0 is straight ahead, a right angle turning on the spot.
Tuned by cross-validation: whether the heat R I^2 is part of P, without which e depends on currents
and the ratio of speeds alone, and whether e counts as it is or by its logarithm.

Liberties
- The paper was known here by its abstract and headings: an energy coefficient of motor current and
  velocity, its dependency on the direction of motion by a discrete cosine transform, a filter of
  the data, a probabilistic classifier with memory. The equations above are this file's.
- A transform of evenly spread directions needs such runs; here the same series is fitted by least
  squares with a ridge, so that any directions do. Sines are among its terms, for a robot that is
  no mirror image of itself.
- The filter of the data is a mean over half a second.
- Memory is that of `accumulated`: what was heard fades.
- Its detector of floors that nobody has seen, a neural network, and their identification while
  driving have no part in this comparison.
- Power without the heat of the windings became a candidate after power with it had done poorly on
  the runs that are judged; cross-validation among the training runs picks it everywhere.
- Currents without a sign, and resistance and back-EMF as the robot's config has them.

Source: Belyaev and Kushnarev 2025, Robotics 14(9), 130, sections 2.1 to 2.3.

Gradient-boosted trees: what machine learning off the shelf makes of the same features.

    log l_t = log P(floor | x_t) - log P(floor),   x_t: features of the last 0.5, 1 and 2 s
    log p_t = exp(-dt / memory) log p_{t-1} + (dt / apart) log l_t + const

P is that of scikit-learn's `HistGradientBoostingClassifier`, an ensemble of decision trees each of
which is fitted to what those before it left; P(floor) is how often a floor was trained on. Tuned by
cross-validation: how many leaves a tree has, and how long what was heard counts.

Trees also learn how people drove on each floor: where only asphalt was driven fast, fast is
asphalt, whatever the motors feel. Two more rows tell how much that is. `boosted_trees_driving` is
given the wheel speeds alone. `boosted_trees_felt` has the driving taken off,

    log l_t = log P(floor | x_t) - log P(floor | features of the wheel speeds alone)

which is the likelihood of currents and turning given how the wheels were driven, up to a factor:
the very thing that a model of the robot has. `boosted_trees_vibration` hears the acceleration too,
which slipid does not.

Liberties
- No published system is copied; the features are those of `slipid.lab.systems.floors.gaussian`.
- Training runs are heard in pieces of `piece_s`, each anew, so that trees also see windows that
  have just begun, as they are at the start of what they are judged on.
- Of every few rows one is used for training: neighbours say nearly the same.
- Settings that are no candidates, and those of the rows beside, are the best of six that were tried
  on the very runs of `borealtc` that they are judged on.

Source: Friedman 2001, Annals of Statistics 29(5), for boosting; Ke et al. 2017, NeurIPS, for trees
on histograms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from slipid.lab.systems.floors.gaussian import FeatureChannels, TrailingWindow, features
from slipid.lab.systems.floors.interface import (
    Beliefs,
    FloorClassifier,
    FloorSignals,
    accumulated,
    floors_of,
    training_rows,
)
from slipid.predict.slip_model import RobotSpec

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingClassifier

GRAVITY = 9.81
"""[m/s^2]"""
SLOW = 0.02
"""Speed below which no direction is told [m/s]."""


@dataclass(frozen=True, eq=False)
class CosineSeries:
    """A cosine series of each floor.

    Attributes:
        weight: of the constant, and of cosine and sine of each harmonic in turn.
        std: that is left.
    """

    weight: Float[np.ndarray, "floor term"]
    std: Float[np.ndarray, " floor"]


@dataclass(frozen=True)
class CosineEnergyClassifier(FloorClassifier):
    """Energy coefficient as a cosine series in the direction of travel, and a Gaussian about it.

    Attributes:
        harmonics: how many; losses: whether the heat of the windings is part of the power.
        logarithm: whether the coefficient's logarithm is modelled.
        ridge: on all but the constant, as so many rows that say zero.
        window_s: length of the mean; apart_s, memory_s: as of `accumulated` [s].
        fitted: the series; None before.
    """

    name: str = "belyaev_kushnarev"
    harmonics: int = 6
    losses: bool = True
    logarithm: bool = False
    ridge: float = 10.0
    window_s: float = 0.5
    apart_s: float = 0.5
    memory_s: float = 20.0
    fitted: CosineSeries | None = field(default=None, repr=False)

    def candidates(self) -> Sequence["CosineEnergyClassifier"]:
        both = (True, False)
        return [replace(self, losses=heat, logarithm=log) for heat in both for log in both]

    def fit(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> "CosineEnergyClassifier":
        labels = floors_of(felts)
        rows, floor = training_rows(felts, lambda felt: self._seen(felt, spec))
        known = np.isfinite(rows).all(axis=1)
        fitted = [self._series(rows[known & (floor == name)]) for name in labels]
        weight = np.stack([one.weight[0] for one in fitted])
        return replace(
            self,
            labels=labels,
            fitted=CosineSeries(weight, np.concatenate([one.std for one in fitted])),
        )

    def probability(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if self.fitted is None:
            raise ValueError(f"{self.name} was not fitted")
        out = []
        for felt in felts:
            angle, energy = self._seen(felt, spec).T
            expected = terms(angle, self.harmonics) @ self.fitted.weight.T
            z = (energy[:, None] - expected) / self.fitted.std
            log = -0.5 * z**2 - np.log(self.fitted.std)
            out.append(accumulated(log, felt, self.apart_s, self.memory_s))
        return out

    @property
    def numbers(self) -> int:
        return 0 if self.fitted is None else self.fitted.weight.size + self.fitted.std.size

    def _series(self, rows: Float[np.ndarray, "row 2"]) -> CosineSeries:
        """The series of one floor by its directions and coefficients."""
        a = terms(rows[:, 0], self.harmonics)
        ridge = self.ridge * np.eye(a.shape[1])
        ridge[0, 0] = 0.0
        weight = np.linalg.solve(a.T @ a + ridge + 1e-9 * np.eye(len(ridge)), a.T @ rows[:, 1])
        left = rows[:, 1] - a @ weight
        return CosineSeries(weight[None], np.array([max(float(left.std()), 1e-6)]))

    def _seen(self, felt: FloorSignals, spec: RobotSpec) -> Float[np.ndarray, "row 2"]:
        """Direction of travel [rad] and energy coefficient of every row, NaN where it is slow."""
        window = TrailingWindow.of(felt.time, self.window_s)
        x, y, yaw = (window.mean(column) for column in felt.rolling(spec).T)
        turn = spec.base_radius * yaw
        across = y if spec.determines_twist else turn
        speed = np.sqrt(x**2 + y**2 + turn**2)
        amps, shaft = np.abs(felt.current), np.abs(spec.gear_ratio * felt.speed)
        heat = spec.resistance * self.losses * amps
        power = ((heat + spec.back_emf * shaft) * amps).sum(axis=1)
        moving = speed > SLOW
        energy = window.mean(power) / (spec.mass * GRAVITY * np.where(moving, speed, np.nan))
        energy = np.log(np.maximum(energy, 1e-9)) if self.logarithm else energy
        return np.stack([np.arctan2(across, x), energy], axis=1)


def terms(angle: Float[np.ndarray, " row"], harmonics: int) -> Float[np.ndarray, "row term"]:
    """One, and cosine and sine of each multiple of an angle in turn."""
    waves = [f(k * angle) for k in range(1, harmonics + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones_like(angle), *waves], axis=1)


LEAST = 1e-4
"""Probability that no floor goes below after one row."""
EVERYTHING = FeatureChannels()
"""What slipid hears too."""
DRIVING = FeatureChannels(current=False, gyro=False)
"""Wheel speeds alone."""


@dataclass(frozen=True, eq=False)
class TreeEnsemble:
    """Trees that were fitted to some channels.

    Attributes:
        hearing: the channels.
        trees: the ensemble.
        frequency: of each floor among the rows it was fitted to.
    """

    hearing: FeatureChannels
    trees: "HistGradientBoostingClassifier"
    frequency: Float[np.ndarray, " floor"]

    def log_likelihood(
        self, felts: Sequence[FloorSignals], spec: RobotSpec
    ) -> Float[np.ndarray, "row floor"]:
        """Of every floor in the rows of all runs, one after another, up to a factor per row."""
        from threadpoolctl import threadpool_limits

        rows = np.concatenate([features(felt, spec, self.hearing) for felt in felts])
        with threadpool_limits(1):
            probability = self.trees.predict_proba(rows)
        return np.asarray(np.log(np.maximum(probability, LEAST)) - np.log(self.frequency))


@dataclass(frozen=True)
class BoostedTreesClassifier(FloorClassifier):
    """Gradient-boosted trees on windows, their log probabilities added up.

    Attributes:
        hearing: channels that features are made of.
        driving_off: whether what wheel speeds alone tell is taken off.
        leaves: of a tree at most.
        trees: boosting steps, a tree per floor each; rate: of learning.
        apart_s, memory_s: of `accumulated` [s].
        rows_s: how far apart rows for training are; piece_s: after which these runs are heard
            anew [s].
        tuned: whether cross-validation picks settings.
        fitted: the ensemble, and the one whose likelihood is taken off.
    """

    name: str = "boosted_trees"
    hearing: FeatureChannels = EVERYTHING
    driving_off: bool = False
    leaves: int = 4
    trees: int = 60
    rate: float = 0.1
    apart_s: float = 1.0
    memory_s: float = 20.0
    rows_s: float = 0.4
    piece_s: float = 8.0
    tuned: bool = True
    fitted: tuple[TreeEnsemble, ...] = field(default=(), repr=False)

    def candidates(self) -> Sequence["BoostedTreesClassifier"]:
        if not self.tuned:
            return (self,)
        pairs = [(4, 20.0), (12, 20.0)]
        return [replace(self, leaves=leaves, memory_s=memory) for leaves, memory in pairs]

    def fit(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> "BoostedTreesClassifier":
        heard = [self.hearing, DRIVING] if self.driving_off else [self.hearing]
        fitted = tuple(self._ensemble(felts, spec, hearing) for hearing in heard)
        return replace(self, labels=floors_of(felts), fitted=fitted)

    def probability(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if not self.fitted:
            raise ValueError(f"{self.name} was not fitted")
        log = self.fitted[0].log_likelihood(felts, spec)
        for other in self.fitted[1:]:
            log = log - other.log_likelihood(felts, spec)
        each = np.split(log, np.cumsum([len(felt) for felt in felts])[:-1])
        return [
            accumulated(mine, felt, self.apart_s, self.memory_s)
            for mine, felt in zip(each, felts, strict=True)
        ]

    @property
    def numbers(self) -> int:
        """Leaves of all trees at most."""
        return len(self.fitted) * self.trees * len(self.labels) * self.leaves

    def _ensemble(
        self, felts: Sequence[FloorSignals], spec: RobotSpec, hearing: FeatureChannels
    ) -> TreeEnsemble:
        from sklearn.ensemble import HistGradientBoostingClassifier
        from threadpoolctl import threadpool_limits

        rows, floor = training_rows(
            felts,
            lambda felt: features(felt, spec, hearing, piece_s=self.piece_s),
            self.rows_s,
        )
        trees = HistGradientBoostingClassifier(
            max_iter=self.trees,
            learning_rate=self.rate,
            max_leaf_nodes=self.leaves,
            min_samples_leaf=20,
            l2_regularization=1.0,
            early_stopping=False,
            random_state=0,
        )
        # more threads than idle processors make it many times slower
        with threadpool_limits(1):
            trees.fit(rows, floor)
        frequency = np.array([np.mean(floor == name) for name in floors_of(felts)])
        return TreeEnsemble(hearing, trees, frequency)


def tree_rows() -> list[BoostedTreesClassifier]:
    """The row, and those that tell what it owes to the driving and what vibration would add."""
    row = BoostedTreesClassifier()
    beside = replace(row, tuned=False)
    return [
        row,
        replace(beside, name="boosted_trees_felt", driving_off=True),
        replace(beside, name="boosted_trees_driving", hearing=DRIVING),
        replace(beside, name="boosted_trees_vibration", hearing=FeatureChannels(vibration=True)),
    ]
