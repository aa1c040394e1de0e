"""Boosted trees over all that the robot measures: slip as a sum of many small decision trees.

Each component of the body's slip ratio in windows of half a second (see `features`) is

    f_0 + rate (tree_1 + tree_2 + ... ),    every tree least squares of what those before left over

with inputs in at most 255 bins and trees grown leaf by leaf. Beyond the inputs that were seen they
say what they say of the nearest.

Tuned: learning rate and leaves of a tree, of which there are sixty.

Liberties:
    - Not a published slip system: what anyone would try first on a table of numbers.
    - Three sets of trees that know nothing of each other; no shrinkage but the rate; no stopping
      before all trees are there.
    - Windows are drawn with a chance in proportion to how much they count, and then count alike.

Source: Friedman 2001, Greedy function approximation: a gradient boosting machine, Annals of
Statistics 29(5); the binning of Ke and others 2017, LightGBM, NeurIPS, as scikit-learn has it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from slipid.baselines.motion.features import Lessons, Regressor, Windows, with_slip
from slipid.identify.compare.slip_model import Channel, Heard, Machine, Run, Said, SlipModel

FEWEST = 20
"""Windows in a leaf at least."""
SEED = 0


@dataclass(frozen=True)
class Boosting:
    """How trees are added up."""

    rate: float
    leaves: int
    trees: int


CANDIDATES = (
    Boosting(0.1, 8, 60),
    Boosting(0.05, 8, 60),
    Boosting(0.2, 4, 60),
    Boosting(0.1, 4, 60),
)


@final
@dataclass(frozen=True, eq=False)
class BoostedTrees(SlipModel):
    """Boosted trees for each component of the slip.

    Attributes:
        boosting: how trees are added up.
        channels: beside the encoders, that inputs are of.
        each: scikit-learn's trees of each component.
        windows: how many they were fitted to.
    """

    name: str = "boosted_trees"
    boosting: Boosting = CANDIDATES[0]
    channels: frozenset[Channel] = frozenset()
    each: tuple[Regressor, ...] = ()
    windows: int = 0

    def candidates(self) -> Sequence["BoostedTrees"]:
        return [replace(self, boosting=boosting) for boosting in CANDIDATES]

    def fit(self, runs: Sequence[Run], machine: Machine) -> "BoostedTrees":
        from sklearn.ensemble import HistGradientBoostingRegressor
        from threadpoolctl import threadpool_limits

        seen, how = Lessons.of(runs, machine), self.boosting
        # scikit-learn takes ten times as long for bins of weighted inputs
        chance = np.random.default_rng(SEED).uniform(size=len(seen.weight))
        kept = chance <= seen.weight / seen.weight.max()
        # threads that wait for each other are slower than one where another job runs
        with threadpool_limits(1):
            each = tuple(
                HistGradientBoostingRegressor(
                    learning_rate=how.rate,
                    max_iter=how.trees,
                    max_leaf_nodes=how.leaves,
                    min_samples_leaf=FEWEST,
                    early_stopping=False,
                    random_state=SEED,
                ).fit(seen.inputs[kept], ratio)
                for ratio in seen.ratio[kept].T
            )
        return replace(self, channels=seen.channels, each=each, windows=int(kept.sum()))

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        from threadpoolctl import threadpool_limits

        if not self.each:
            raise ValueError(f"{self.name}: predict before fit")
        windows = Windows.of(runs, machine)
        inputs = windows.inputs(machine, self.channels)
        with threadpool_limits(1):
            ratio = np.stack([trees.predict(inputs) for trees in self.each], axis=1)
        return with_slip(runs, windows, ratio, machine)

    @property
    def numbers(self) -> int:
        """Leaves and thresholds at most; trees of few windows have fewer."""
        leaves = min(self.boosting.leaves, max(1, self.windows // FEWEST))
        return len(self.each) * self.boosting.trees * (2 * leaves - 1)
