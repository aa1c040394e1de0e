"""Floor classifiers learned from window features: a Gaussian per floor, and boosted trees.

Gaussian per floor. This is a simple baseline, which needs ten lines of code.

    x ~ N(m_floor, S_floor),   S_floor = (1 - a) (floor's covariance) + a (mean over all floors)
    log p_t = log p_{t-1} + (dt / apart) log N(x_t; m_floor, S_floor) + const

x are the standardised features of a window; missing features are replaced by the mean. p_t is the
probability of a floor after row t, dt the duration of the row, `apart` the time between independent
rows. a = 1 is linear discriminant analysis, a = 0 quadratic. Tuned by cross-validation: a.

Liberties of the Gaussian
- It follows no particular published system. A ridge is added to every covariance, since features
  are correlated.
- Only one window length, `window_s`, is used: features of nested windows are nearly the same.

Source: Friedman 1989, Journal of the American Statistical Association 84(405), for the mixture of
the covariances.

Gradient-boosted trees. This is off-the-shelf machine learning on the same features.

    log l_t = log P(floor | x_t) - log P(floor),   x_t: features of the last 0.5, 1 and 2 s
    log p_t = exp(-dt / memory) log p_{t-1} + (dt / apart) log l_t + const

P(floor | x) is the output of scikit-learn's `HistGradientBoostingClassifier`, an ensemble of
decision trees each of which is fitted to the residuals of those before it; P(floor) is the
frequency of a floor in the training rows. Tuned by cross-validation: leaves per tree.

Trees also learn the driving style on each floor: if the robot drove fast on asphalt only, a high
speed means asphalt whatever the motor currents are. Two more rows show how much the driving style
contributes. `boosted_trees_driving` uses only the wheel speeds. `boosted_trees_felt` removes the
driving style,

    log l_t = log P(floor | x_t) - log P(floor | features of the wheel speeds only)

so that l_t is the likelihood of currents and turning given the wheel speeds, up to a factor: the
quantity that a model of the robot provides. `boosted_trees_vibration` also uses the acceleration,
which slipid does not.

Liberties of the trees
- They follow no particular published system; the features are those of
  `slipid.lab.systems.floors.interface`.
- Training runs start anew every `restart_s`, so that trees are also trained on windows that have
  just begun, as at the start of the evaluated stretches.
- Training rows are `rows_s` apart: neighbouring rows carry nearly the same information.
- Settings that are not tuned, and those of the additional rows, are the best of six that were tried
  on the same runs of `borealtc` on which they are evaluated.

Source: Friedman 2001, Annals of Statistics 29(5), for boosting; Ke et al. 2017, NeurIPS, for trees
on histograms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from slipid.lab.systems.floors.interface import (
    DEFAULT_CHANNELS,
    Beliefs,
    Features,
    FloorChannel,
    FloorClassifier,
    FloorSignals,
    accumulated,
    features,
    floors_of,
    training_rows,
)
from slipid.lab.systems.one_thread import one_thread
from slipid.predict.slip_model import RobotSpec

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingClassifier

LogLikelihood = Float[np.ndarray, "row floor"]
LOWEST_PROBABILITY = 1e-4
"""Lower limit of the probability of a floor in one row."""
SPEEDS_ONLY: frozenset[FloorChannel] = frozenset()
"""No channel besides the wheel speeds, to learn floors from the driving style."""


@dataclass(frozen=True, eq=False)
class FloorGaussians:
    """Gaussian of every floor in standardised features.

    Attributes:
        middle: mean of each feature over all training rows.
        scale: standard deviation of each feature over all training rows.
        mean: mean of the standardised features on each floor.
        root: inverse of the Cholesky factor of each floor's covariance.
        log_volume: logarithm of the determinant of each Cholesky factor.
    """

    middle: Float[np.ndarray, " feature"]
    scale: Float[np.ndarray, " feature"]
    mean: Float[np.ndarray, "floor feature"]
    root: Float[np.ndarray, "floor feature feature"]
    log_volume: Float[np.ndarray, " floor"]

    def comparable(self, rows: Features) -> Features:
        """Return standardised features; 0 where a channel has no value."""
        return np.asarray(np.nan_to_num((rows - self.middle) / self.scale, nan=0.0))

    def log_likelihood(self, rows: Features) -> LogLikelihood:
        """Return the log likelihood of features on every floor, up to a constant."""
        off = self.comparable(rows)[:, None, :] - self.mean
        white = np.einsum("fab,rfb->rfa", self.root, off)
        return np.asarray(-0.5 * (white**2).sum(axis=2) - self.log_volume)


@dataclass(frozen=True)
class GaussianClassifier(FloorClassifier):
    """Floor classifier with a Gaussian per floor, whose likelihoods are accumulated over rows.

    Attributes:
        shared: weight a of the mean covariance of all floors.
        ridge: variance added to every covariance of standardised features.
        window_s: length of the windows [s].
        apart_s: time between independent rows, see `accumulated` [s].
        restart_s: time after which training runs start anew [s].
        fitted: the Gaussians; None before a fit.
    """

    name: str = "gaussian"
    shared: float = 0.5
    ridge: float = 0.02
    window_s: float = 1.0
    apart_s: float = 1.0
    restart_s: float = 8.0
    fitted: FloorGaussians | None = field(default=None, repr=False)

    def candidates(self) -> Sequence["GaussianClassifier"]:
        return [replace(self, shared=shared) for shared in (0.0, 0.3, 1.0)]

    def fit(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> "GaussianClassifier":
        labels = floors_of(runs)
        rows, floor = training_rows(runs, lambda run: self._features(run, spec, self.restart_s))
        middle, scale = np.nanmean(rows, axis=0), np.maximum(np.nanstd(rows, axis=0), 1e-9)
        comparable = np.nan_to_num((rows - middle) / scale, nan=0.0)
        groups = [comparable[floor == name] for name in labels]
        mean = np.stack([group.mean(axis=0) for group in groups])
        own = np.stack([np.cov(group.T, bias=True) for group in groups])
        covariance = (1 - self.shared) * own + self.shared * own.mean(axis=0)
        factor = np.linalg.cholesky(covariance + self.ridge * np.eye(len(middle)))
        log_volume = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        fitted = FloorGaussians(middle, scale, mean, np.linalg.inv(factor), log_volume)
        return replace(self, labels=labels, fitted=fitted)

    def probability(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if self.fitted is None:
            raise ValueError(f"{self.name} was not fitted; expected a call of `fit` before")
        logs = [self.fitted.log_likelihood(self._features(run, spec)) for run in runs]
        return [accumulated(log, run, self.apart_s) for log, run in zip(logs, runs, strict=True)]

    @property
    def numbers(self) -> int:
        if self.fitted is None:
            return 0
        floors, count = self.fitted.mean.shape
        return floors * (count + count * (count + 1) // 2)

    def _features(self, run: FloorSignals, spec: RobotSpec, restart_s: float = np.inf) -> Features:
        """Return the features of each row over one window, without the time since the start."""
        return features(run, spec, windows_s=(self.window_s,), restart_s=restart_s)[:, 1:]


@dataclass(frozen=True, eq=False)
class TreeEnsemble:
    """Boosted trees that give floor probabilities from the features of some channels.

    Attributes:
        channels: channels of the features.
        trees: scikit-learn's ensemble.
        frequency: frequency of each floor among the training rows.
    """

    channels: frozenset[FloorChannel]
    trees: "HistGradientBoostingClassifier"
    frequency: Float[np.ndarray, " floor"]

    def log_likelihood(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> LogLikelihood:
        """Return the log likelihood of every floor in each row, up to a constant for each row.

        The rows of all runs are concatenated.
        """
        rows = np.concatenate([features(run, spec, self.channels) for run in runs])
        with one_thread():
            probability = self.trees.predict_proba(rows)
        return np.asarray(
            np.log(np.maximum(probability, LOWEST_PROBABILITY)) - np.log(self.frequency)
        )


@dataclass(frozen=True)
class BoostedTreesClassifier(FloorClassifier):
    """Floor classifier with boosted trees, whose log likelihoods are accumulated over rows.

    Attributes:
        channels: channels of the features.
        without_driving: True if the log likelihood from only the wheel speeds is subtracted.
        leaves: largest number of leaves of a tree.
        trees: number of boosting steps, each of which adds one tree per floor.
        rate: learning rate.
        apart_s: time between independent rows, see `accumulated` [s].
        memory_s: time constant of the evidence, see `accumulated` [s].
        rows_s: time between training rows [s].
        restart_s: time after which training runs start anew [s].
        tuned: True if cross-validation picks the settings.
        fitted: the fitted ensemble and, if `without_driving`, the one that is subtracted.
    """

    name: str = "boosted_trees"
    channels: frozenset[FloorChannel] = DEFAULT_CHANNELS
    without_driving: bool = False
    leaves: int = 4
    trees: int = 60
    rate: float = 0.1
    apart_s: float = 1.0
    memory_s: float = 20.0
    rows_s: float = 0.4
    restart_s: float = 8.0
    tuned: bool = True
    fitted: tuple[TreeEnsemble, ...] = field(default=(), repr=False)

    def candidates(self) -> Sequence["BoostedTreesClassifier"]:
        return [replace(self, leaves=n) for n in (4, 12)] if self.tuned else [self]

    def fit(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> "BoostedTreesClassifier":
        channels = [self.channels, SPEEDS_ONLY] if self.without_driving else [self.channels]
        fitted = tuple(self._ensemble(runs, spec, each) for each in channels)
        return replace(self, labels=floors_of(runs), fitted=fitted)

    def probability(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if not self.fitted:
            raise ValueError(f"{self.name} was not fitted; expected a call of `fit` before")
        log = self.fitted[0].log_likelihood(runs, spec)
        for other in self.fitted[1:]:
            log = log - other.log_likelihood(runs, spec)
        each = np.split(log, np.cumsum([len(run) for run in runs])[:-1])
        return [
            accumulated(of_run, run, self.apart_s, self.memory_s)
            for of_run, run in zip(each, runs, strict=True)
        ]

    @property
    def numbers(self) -> int:
        """Largest possible number of leaves of all trees, taken as the number of parameters."""
        return len(self.fitted) * self.trees * len(self.labels) * self.leaves

    def _ensemble(
        self, runs: Sequence[FloorSignals], spec: RobotSpec, channels: frozenset[FloorChannel]
    ) -> TreeEnsemble:
        from sklearn.ensemble import HistGradientBoostingClassifier

        rows, floor = training_rows(
            runs, lambda run: features(run, spec, channels, restart_s=self.restart_s), self.rows_s
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
        with one_thread():
            trees.fit(rows, floor)
        frequency = np.array([np.mean(floor == name) for name in floors_of(runs)])
        return TreeEnsemble(channels, trees, frequency)


def tree_classifiers() -> list[BoostedTreesClassifier]:
    """Return the tuned trees, and variants that show the effects of driving style and vibration."""
    trees = BoostedTreesClassifier()
    fixed = replace(trees, tuned=False)
    return [
        trees,
        replace(fixed, name="boosted_trees_felt", without_driving=True),
        replace(fixed, name="boosted_trees_driving", channels=SPEEDS_ONLY),
        replace(fixed, name="boosted_trees_vibration", channels=DEFAULT_CHANNELS | {"vibration"}),
    ]
