"""Two learned slip models from all signals of the robot: boosted trees, a small neural network.

Boosted trees. Each component of the body's slip ratio in windows of half a second (see `features`)
is

    f_0 + rate (tree_1 + tree_2 + ... )

Each tree is a least squares fit to the residuals of the trees before it; `rate` is the learning
rate. Inputs are sorted into at most 255 bins and trees are grown leaf by leaf. Outside the range of
the training inputs, the output is that at the edge of the range.

Tuned: the learning rate and the number of leaves of each of the sixty trees.

Liberties of the trees:
    - They are not a published slip system, but the obvious first method for tabular data.
    - Each component has its own trees; there is no shrinkage but the rate, and no early stopping.
    - Windows are drawn at random in proportion to their weight and then have equal weights.

Source: Friedman 2001, Greedy function approximation: a gradient boosting spec, Annals of
Statistics 29(5); the binning of Ke and others 2017, LightGBM, NeurIPS, as scikit-learn has it.

Neural network. All three components of the slip ratio at once are

    W_n relu(... relu(W_1 x + b_1) ...) + b_n

where x are standardised inputs and the outputs are standardised too. Adam minimises the mean square
error + alpha |W|^2 until the loss stops falling on a tenth of the windows, which are drawn at
random and held out.

Tuned: size of the one hidden layer, and alpha.

Liberties of the network:
    - It is not one published network: those in the literature differ in inputs and sizes from robot
      to robot, and this is what they have in common.
    - Inputs and outputs are clipped to the training range.
    - Windows held out for early stopping are neighbours of training windows.

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
from slipid.lab.systems.one_thread import one_thread
from slipid.predict.slip_model import Channel, PredictedRun, RobotSpec, Run, RunSignals, SlipModel

FEWEST = 20
"""Smallest number of windows in a leaf, and of training windows for early stopping."""
SEED = 0
PASSES = 60
"""Largest number of passes of the network's training through all windows."""
PATIENCE = 6
"""Passes without improvement after which the network's training stops."""


@final
@dataclass(frozen=True, eq=False)
class BoostedTrees(SlipModel):
    """Slip model by boosted trees for each component of the slip ratio.

    Attributes:
        rate: learning rate.
        leaves: largest number of leaves of a tree.
        trees: number of trees of each component.
        channels: channels of the inputs besides the encoders.
        each: scikit-learn's fitted ensemble for each component.
        windows: number of training windows.
    """

    name: str = "boosted_trees"
    rate: float = 0.1
    leaves: int = 8
    trees: int = 60
    channels: frozenset[Channel] = frozenset()
    each: tuple[Regressor, ...] = ()
    windows: int = 0

    def candidates(self) -> Sequence["BoostedTrees"]:
        pairs = (0.1, 8), (0.05, 8), (0.2, 4), (0.1, 4)
        return [replace(self, rate=rate, leaves=leaves) for rate, leaves in pairs]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "BoostedTrees":
        from sklearn.ensemble import HistGradientBoostingRegressor

        examples = SlipExamples.of(runs, spec)
        # rows are drawn by weight, since scikit-learn takes ten times as long to bin weighted rows
        chance = np.random.default_rng(SEED).uniform(size=len(examples.weight))
        kept = chance <= examples.weight / examples.weight.max()
        with one_thread():
            each = tuple(
                HistGradientBoostingRegressor(
                    learning_rate=self.rate,
                    max_iter=self.trees,
                    max_leaf_nodes=self.leaves,
                    min_samples_leaf=FEWEST,
                    early_stopping=False,
                    random_state=SEED,
                ).fit(examples.inputs[kept], ratio)
                for ratio in examples.ratio[kept].T
            )
        return replace(self, channels=examples.channels, each=each, windows=int(kept.sum()))

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if not self.each:
            raise ValueError(f"{self.name}: predict before fit")
        windows = SignalWindows.of(runs, spec)
        inputs = windows.inputs(spec, self.channels)
        with one_thread():
            ratio = np.stack([trees.predict(inputs) for trees in self.each], axis=1)
        return with_slip(runs, windows, ratio, spec)

    @property
    def numbers(self) -> int:
        """Largest possible number of leaf values and thresholds; small trees have fewer."""
        leaves = min(self.leaves, max(1, self.windows // FEWEST))
        return len(self.each) * self.trees * (2 * leaves - 1)


@final
@dataclass(frozen=True, eq=False)
class NeuralNetwork(SlipModel):
    """Slip model by a multilayer perceptron for all components of the slip ratio.

    Attributes:
        hidden: sizes of the hidden layers.
        alpha: penalty on squared weights.
        channels: channels of the inputs besides the encoders.
        inputs: standardisation of the inputs.
        outputs: standardisation of the outputs.
        network: scikit-learn's fitted network.
    """

    name: str = "neural_network"
    hidden: tuple[int, ...] = (32,)
    alpha: float = 1e-3
    channels: frozenset[Channel] = frozenset()
    inputs: Scale | None = None
    outputs: Scale | None = None
    network: Regressor | None = None

    def candidates(self) -> Sequence["NeuralNetwork"]:
        pairs = (32, 1e-3), (16, 1e-1), (16, 1.0), (32, 1.0)
        return [replace(self, hidden=(size,), alpha=alpha) for size, alpha in pairs]

    def fit(self, runs: Sequence[Run], spec: RobotSpec) -> "NeuralNetwork":
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPRegressor

        examples = SlipExamples.of(runs, spec)
        inputs, outputs = Scale.of(examples.inputs), Scale.of(examples.ratio)
        network = MLPRegressor(
            hidden_layer_sizes=self.hidden,
            alpha=self.alpha,
            learning_rate_init=5e-3,
            max_iter=PASSES,
            early_stopping=len(examples.inputs) >= FEWEST,
            n_iter_no_change=PATIENCE,
            random_state=SEED,
        )
        with one_thread(), warnings.catch_warnings():
            # the number of passes is limited on purpose, so reaching the limit needs no warning
            warnings.simplefilter("ignore", ConvergenceWarning)
            x, y = inputs.scaled(examples.inputs), outputs.scaled(examples.ratio)
            network.fit(x, y, sample_weight=examples.weight)
        return replace(
            self, channels=examples.channels, inputs=inputs, outputs=outputs, network=network
        )

    def predict(self, runs: Sequence[RunSignals], spec: RobotSpec) -> list[PredictedRun]:
        if self.network is None or self.inputs is None or self.outputs is None:
            raise ValueError(f"{self.name}: predict before fit")
        windows = SignalWindows.of(runs, spec)
        inputs = self.inputs.scaled(windows.inputs(spec, self.channels))
        ratio = self.outputs.back(self.network.predict(inputs))
        return with_slip(runs, windows, ratio, spec)

    @property
    def numbers(self) -> int:
        """Number of weights and biases."""
        if self.network is None or self.inputs is None:
            return 0
        sizes = [len(self.inputs.mean), *self.hidden, 3]
        return sum((a + 1) * b for a, b in pairwise(sizes))
