"""Gradient-boosted trees: what machine learning off the shelf makes of the same features.

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
- No published system is copied; the features are those of `slipid.baselines.floors.features`.
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

from slipid.baselines.floors.features import Hearing, features
from slipid.baselines.floors.interface import (
    Beliefs,
    Felt,
    FloorMethod,
    accumulated,
    floors_of,
    rows_of,
)
from slipid.identify.compare.slip_model import Machine

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingClassifier

LEAST = 1e-4
"""Probability that no floor goes below after one row."""
EVERYTHING = Hearing()
"""What slipid hears too."""
DRIVING = Hearing(current=False, gyro=False)
"""Wheel speeds alone."""


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Trees that were fitted to some channels.

    Attributes:
        hearing: the channels.
        trees: the ensemble.
        frequency: of each floor among the rows it was fitted to.
    """

    hearing: Hearing
    trees: "HistGradientBoostingClassifier"
    frequency: Float[np.ndarray, " floor"]

    def log_likelihood(
        self, felts: Sequence[Felt], machine: Machine
    ) -> Float[np.ndarray, "row floor"]:
        """Of every floor in the rows of all runs, one after another, up to a factor per row."""
        from threadpoolctl import threadpool_limits

        rows = np.concatenate([features(felt, machine, self.hearing) for felt in felts])
        with threadpool_limits(1):
            probability = self.trees.predict_proba(rows)
        return np.asarray(np.log(np.maximum(probability, LEAST)) - np.log(self.frequency))


@dataclass(frozen=True)
class BoostedTrees(FloorMethod):
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
    hearing: Hearing = EVERYTHING
    driving_off: bool = False
    leaves: int = 4
    trees: int = 60
    rate: float = 0.1
    apart_s: float = 1.0
    memory_s: float = 20.0
    rows_s: float = 0.4
    piece_s: float = 8.0
    tuned: bool = True
    fitted: tuple[Ensemble, ...] = field(default=(), repr=False)

    def candidates(self) -> Sequence["BoostedTrees"]:
        if not self.tuned:
            return (self,)
        pairs = [(4, 20.0), (12, 20.0)]
        return [replace(self, leaves=leaves, memory_s=memory) for leaves, memory in pairs]

    def fit(self, felts: Sequence[Felt], machine: Machine) -> "BoostedTrees":
        heard = [self.hearing, DRIVING] if self.driving_off else [self.hearing]
        fitted = tuple(self._ensemble(felts, machine, hearing) for hearing in heard)
        return replace(self, labels=floors_of(felts), fitted=fitted)

    def probability(self, felts: Sequence[Felt], machine: Machine) -> list[Beliefs]:
        if not self.fitted:
            raise ValueError(f"{self.name} was not fitted")
        log = self.fitted[0].log_likelihood(felts, machine)
        for other in self.fitted[1:]:
            log = log - other.log_likelihood(felts, machine)
        each = np.split(log, np.cumsum([len(felt) for felt in felts])[:-1])
        return [
            accumulated(mine, felt, self.apart_s, self.memory_s)
            for mine, felt in zip(each, felts, strict=True)
        ]

    @property
    def numbers(self) -> int:
        """Leaves of all trees at most."""
        return len(self.fitted) * self.trees * len(self.labels) * self.leaves

    def _ensemble(self, felts: Sequence[Felt], machine: Machine, hearing: Hearing) -> Ensemble:
        from sklearn.ensemble import HistGradientBoostingClassifier
        from threadpoolctl import threadpool_limits

        rows, floor = rows_of(
            felts,
            lambda felt: features(felt, machine, hearing, piece_s=self.piece_s),
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
        return Ensemble(hearing, trees, frequency)


def tree_rows() -> list[BoostedTrees]:
    """The row, and those that tell what it owes to the driving and what vibration would add."""
    row = BoostedTrees()
    beside = replace(row, tuned=False)
    return [
        row,
        replace(beside, name="boosted_trees_felt", driving_off=True),
        replace(beside, name="boosted_trees_driving", hearing=DRIVING),
        replace(beside, name="boosted_trees_vibration", hearing=Hearing(vibration=True)),
    ]
