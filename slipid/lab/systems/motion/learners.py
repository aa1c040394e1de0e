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

Source: Friedman 2001, Greedy function approximation: a gradient boosting spec, Annals of
Statistics 29(5); the binning of Ke and others 2017, LightGBM, NeurIPS, as scikit-learn has it.

A small neural network over all that the robot measures.

The body's slip ratio in windows of half a second (see `features`), all three components at once, is

    W_n relu(... relu(W_1 x + b_1) ...) + b_n

of standardised inputs and outputs, fitted by Adam to mean square error + alpha |W|^2 until a tenth
of the windows, drawn at random and left out, gain nothing more.

Tuned: size of the one hidden layer, and alpha.

Liberties:
    - Not one published network: those of the literature differ in inputs and sizes from robot to
      robot, and this is their common core.
    - Inputs are clipped to what was seen, outputs likewise.
    - Windows left out to stop in time are neighbours of those learned from.

Source: scikit-learn's multilayer perceptron; Kingma, Ba 2015, Adam, ICLR; early stopping as in
Goodfellow, Bengio, Courville 2016, Deep Learning, MIT Press, section 7.8.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import final

import numpy as np

from slipid.lab.systems.motion.features import (
    Regressor,
    Scale,
    SignalWindows,
    SlipExamples,
    with_slip,
)
from slipid.predict.slip_model import Channel, PredictedRun, RobotSpec, Run, RunSignals, SlipModel

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

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "BoostedTrees":
        from sklearn.ensemble import HistGradientBoostingRegressor
        from threadpoolctl import threadpool_limits

        seen, how = SlipExamples.of(runs, spec), self.boosting
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

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        from threadpoolctl import threadpool_limits

        if not self.each:
            raise ValueError(f"{self.name}: predict before fit")
        windows = SignalWindows.of(runs, spec)
        inputs = windows.inputs(spec, self.channels)
        with threadpool_limits(1):
            ratio = np.stack([trees.predict(inputs) for trees in self.each], axis=1)
        return with_slip(runs, windows, ratio, spec)

    @property
    def numbers(self) -> int:
        """Leaves and thresholds at most; trees of few windows have fewer."""
        leaves = min(self.boosting.leaves, max(1, self.windows // FEWEST))
        return len(self.each) * self.boosting.trees * (2 * leaves - 1)


PASSES = 60
"""Through all windows, at most."""
PATIENCE = 6
"""Passes without gain after which it stops."""
NETWORK_FEWEST = 20
"""Windows below which none are left out to stop in time."""
NETWORK_SEED = 0


@dataclass(frozen=True)
class NetworkShape:
    """Sizes of the hidden layers, and how much large weights cost."""

    hidden: tuple[int, ...]
    alpha: float


NETWORK_CANDIDATES = (
    NetworkShape((32,), 1e-3),
    NetworkShape((16,), 1e-1),
    NetworkShape((16,), 1.0),
    NetworkShape((32,), 1.0),
)


@final
@dataclass(frozen=True, eq=False)
class NeuralNetwork(SlipModel):
    """A multilayer perceptron for the slip.

    Attributes:
        shape: of the network.
        channels: beside the encoders, that inputs are of.
        inputs, outputs: their scales.
        network: scikit-learn's.
    """

    name: str = "neural_network"
    shape: NetworkShape = NETWORK_CANDIDATES[0]
    channels: frozenset[Channel] = frozenset()
    inputs: Scale | None = None
    outputs: Scale | None = None
    network: Regressor | None = None

    def candidates(self) -> Sequence["NeuralNetwork"]:
        return [replace(self, shape=shape) for shape in NETWORK_CANDIDATES]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "NeuralNetwork":
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPRegressor
        from threadpoolctl import threadpool_limits

        seen = SlipExamples.of(runs, spec)
        inputs, outputs = Scale.of(seen.inputs), Scale.of(seen.ratio)
        network = MLPRegressor(
            hidden_layer_sizes=self.shape.hidden,
            alpha=self.shape.alpha,
            learning_rate_init=5e-3,
            max_iter=PASSES,
            early_stopping=len(seen.inputs) >= NETWORK_FEWEST,
            n_iter_no_change=PATIENCE,
            random_state=NETWORK_SEED,
        )
        with threadpool_limits(1), warnings.catch_warnings():
            # so many passes are what it is given: the end of them is as good as stopping early
            warnings.simplefilter("ignore", ConvergenceWarning)
            x, y = inputs.scaled(seen.inputs), outputs.scaled(seen.ratio)
            network.fit(x, y, sample_weight=seen.weight)
        return replace(
            self, channels=seen.channels, inputs=inputs, outputs=outputs, network=network
        )

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if self.network is None or self.inputs is None or self.outputs is None:
            raise ValueError(f"{self.name}: predict before fit")
        windows = SignalWindows.of(runs, spec)
        inputs = self.inputs.scaled(windows.inputs(spec, self.channels))
        ratio = self.outputs.back(self.network.predict(inputs))
        ratio = ratio.clip(self.outputs.low, self.outputs.high)
        return with_slip(runs, windows, ratio, spec)

    @property
    def numbers(self) -> int:
        """Weights and biases."""
        if self.network is None or self.inputs is None:
            return 0
        sizes = [len(self.inputs.mean), *self.shape.hidden, 3]
        return sum((a + 1) * b for a, b in pairwise(sizes))
