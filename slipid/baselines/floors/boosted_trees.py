"""Gradient-boosted trees: what machine learning off the shelf makes of the same features.

    log l_t = log P(floor | features of the last 0.5, 1 and 2 s up to row t),   all floors as likely
    log p_t = exp(-dt / memory) log p_{t-1} + (dt / apart) log l_t + const

P is that of scikit-learn's `HistGradientBoostingClassifier`, an ensemble of decision trees each of
which is fitted to what those before it left. Rows of a floor weigh as much in all as those of any
other, so that P is a likelihood up to a factor. Tuned by cross-validation: how many leaves a tree
has, and how far rows are apart until they count as two witnesses.

Liberties
- No published system is copied; the features are those of `slipid.baselines.floors.features`.
- Training runs are cut into pieces of `piece_s`, each heard anew, so that trees also see windows
  that have just begun, as they are at the start of what they are judged on.
- Of every few rows one is used for training: neighbours say nearly the same.

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
)
from slipid.baselines.interface import Machine

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingClassifier


@dataclass(frozen=True)
class BoostedTrees(FloorMethod):
    """Gradient-boosted trees on windows, their log probabilities added up.

    Attributes:
        hearing: channels that features are made of.
        leaves: of a tree at most.
        trees: boosting steps, a tree per floor each; rate: of learning.
        apart_s, memory_s: of `accumulated` [s].
        rows_s: rows for training are so far apart [s]; piece_s: lengths they are cut from [s].
        fitted: the ensemble; None before.
    """

    name: str = "boosted_trees"
    hearing: Hearing = Hearing()
    leaves: int = 8
    trees: int = 60
    rate: float = 0.1
    apart_s: float = 1.0
    memory_s: float = 20.0
    rows_s: float = 0.4
    piece_s: float = 8.0
    tuned: bool = True
    fitted: "HistGradientBoostingClassifier | None" = field(default=None, repr=False)

    def candidates(self) -> Sequence["BoostedTrees"]:
        if not self.tuned:
            return (self,)
        return [
            replace(self, leaves=leaves, apart_s=apart)
            for leaves, apart in [(4, 1.0), (16, 1.0), (4, 3.0)]
        ]

    def fit(self, felts: Sequence[Felt], machine: Machine) -> "BoostedTrees":
        from sklearn.ensemble import HistGradientBoostingClassifier
        from threadpoolctl import threadpool_limits

        labels = floors_of(felts)
        rows, floor = self._rows(felts, machine)
        weight = 1.0 / np.array([np.mean(floor == name) for name in labels])
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
            trees.fit(rows, floor, sample_weight=weight[np.searchsorted(labels, floor)])
        return replace(self, labels=labels, fitted=trees)

    def probability(self, felts: Sequence[Felt], machine: Machine) -> list[Beliefs]:
        from threadpoolctl import threadpool_limits

        if self.fitted is None:
            raise ValueError(f"{self.name} was not fitted")
        rows = [features(felt, machine, self.hearing) for felt in felts]
        with threadpool_limits(1):
            log = np.log(np.maximum(self.fitted.predict_proba(np.concatenate(rows)), 1e-4))
        each = np.split(log, np.cumsum([len(r) for r in rows])[:-1])
        return [
            accumulated(mine, felt, self.apart_s, self.memory_s)
            for mine, felt in zip(each, felts, strict=True)
        ]

    @property
    def numbers(self) -> int:
        """Leaves of all trees."""
        return 0 if self.fitted is None else self.trees * len(self.labels) * self.leaves

    def _rows(
        self, felts: Sequence[Felt], machine: Machine
    ) -> tuple[Float[np.ndarray, "row feature"], np.ndarray]:
        """Features and floors of rows for training, in which the robot moves."""
        found, floors = [], []
        for felt in felts:
            every = max(1, round(self.rows_s / max(float(np.median(felt.dt)), 1e-3)))
            for piece in felt.pieces(self.piece_s):
                take = np.flatnonzero(piece.moves)[::every]
                found.append(features(piece, machine, self.hearing)[take])
                floors += [felt.floor] * len(take)
        return np.concatenate(found), np.array(floors)
