"""Two learned slip models from all signals of the robot: boosted trees, a small neural network.

Boosted trees. Each component of the body's slip ratio in windows of half a second (see `features`)
is

    f_0 + rate (tree_1 + tree_2 + ... )

Each tree is a least squares fit to the residuals of the trees before it; `rate` is the learning
rate. Inputs are sorted into at most 255 bins and trees are grown leaf by leaf. Outside the range of
the training inputs, the output is that at the edge of the range.

Tuned: the learning rate and the number of leaves of each of the sixty trees.

Liberties of the trees:
    - They are not a published slip system, but a standard method for tabular data.
    - Each component has its own trees; there is no shrinkage but the rate, and no early stopping.
    - Windows are drawn at random in proportion to their weight and then have equal weights.

Source: Friedman 2001, Greedy function approximation: a gradient boosting machine, Annals of
Statistics 29(5); the binning of Ke and others 2017, LightGBM, NeurIPS, as scikit-learn does it.

Neural network. All three components of the slip ratio at once are

    W_n relu(... relu(W_1 x + b_1) ...) + b_n

where x are standardised inputs and the outputs are standardised too. Adam minimises the mean square
error + alpha |W|^2 until the loss stops falling on a tenth of the windows, which are drawn at
random and held out.

Tuned: size of the one hidden layer, and alpha.

Liberties of the network:
    - It is not one published network: networks in the literature differ in inputs and sizes from
      robot to robot, and the form above is what they have in common.
    - Inputs and outputs are clipped to the training range.
    - Windows held out for early stopping are neighbours of training windows.

Source: scikit-learn's multilayer perceptron; Kingma, Ba 2015, Adam, ICLR; early stopping as in
Goodfellow, Bengio, Courville 2016, Deep Learning, MIT Press, section 7.8.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from slipid.lab.systems.motion.features import Inputs, LearnedSlip, Ratios, Scale, SlipExamples

if TYPE_CHECKING:
    from sklearn.neural_network import MLPRegressor

FEWEST_WINDOWS = 20
"""Smallest number of windows in a leaf, and of training windows for early stopping."""
SEED = 0
MOST_PASSES = 60
"""Largest number of passes of the network's training through all windows."""
PATIENCE = 6
"""Passes without improvement after which the network's training stops."""


@final
@dataclass(frozen=True, eq=False)
class BoostedTrees(LearnedSlip):
    """Slip model by boosted trees for each component of the slip ratio.

    Attributes:
        rate: learning rate.
        leaves: largest number of leaves of a tree.
        trees: number of trees of each component.
        windows: number of training windows.
    """

    name: str = "boosted_trees"
    rate: float = 0.1
    leaves: int = 8
    trees: int = 60
    windows: int = 0

    def candidates(self) -> Sequence["BoostedTrees"]:
        pairs = (0.1, 8), (0.05, 8), (0.2, 4), (0.1, 4)
        return [replace(self, rate=rate, leaves=leaves) for rate, leaves in pairs]

    def trained(self, examples: SlipExamples) -> "BoostedTrees":
        from sklearn.ensemble import HistGradientBoostingRegressor
        from sklearn.multioutput import MultiOutputRegressor

        # rows are drawn by weight, since scikit-learn takes ten times as long to bin weighted rows
        chance = np.random.default_rng(SEED).uniform(size=len(examples.weight))
        kept = chance <= examples.weight / examples.weight.max()
        trees = HistGradientBoostingRegressor(
            learning_rate=self.rate,
            max_iter=self.trees,
            max_leaf_nodes=self.leaves,
            min_samples_leaf=FEWEST_WINDOWS,
            early_stopping=False,
            random_state=SEED,
        )
        fitted = MultiOutputRegressor(trees).fit(examples.inputs[kept], examples.ratio[kept])
        return replace(self, regressor=fitted, windows=int(kept.sum()))

    @property
    def numbers(self) -> int:
        """Largest possible number of leaf values and thresholds; small trees have fewer."""
        leaves = min(self.leaves, max(1, self.windows // FEWEST_WINDOWS))
        return 0 if self.regressor is None else 3 * self.trees * (2 * leaves - 1)


@dataclass(frozen=True, eq=False)
class ScaledNetwork:
    """scikit-learn's network with standardised inputs and outputs."""

    inputs: Scale
    outputs: Scale
    network: "MLPRegressor"

    def predict(self, X: Inputs) -> Ratios:
        """Return the slip ratios, clipped to their training range."""
        return self.outputs.back(self.network.predict(self.inputs.scaled(X)))


@final
@dataclass(frozen=True, eq=False)
class NeuralNetwork(LearnedSlip):
    """Slip model by a multilayer perceptron for all components of the slip ratio.

    Attributes:
        hidden: sizes of the hidden layers.
        alpha: penalty on squared weights.
        regressor: the fitted network; None before a fit.
    """

    name: str = "neural_network"
    hidden: tuple[int, ...] = (32,)
    alpha: float = 1e-3
    regressor: ScaledNetwork | None = None

    def candidates(self) -> Sequence["NeuralNetwork"]:
        pairs = (32, 1e-3), (16, 1e-1), (16, 1.0), (32, 1.0)
        return [replace(self, hidden=(size,), alpha=alpha) for size, alpha in pairs]

    def trained(self, examples: SlipExamples) -> "NeuralNetwork":
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPRegressor

        inputs, outputs = Scale.of(examples.inputs), Scale.of(examples.ratio)
        network = MLPRegressor(
            hidden_layer_sizes=self.hidden,
            alpha=self.alpha,
            learning_rate_init=5e-3,
            max_iter=MOST_PASSES,
            early_stopping=len(examples.inputs) >= FEWEST_WINDOWS,
            n_iter_no_change=PATIENCE,
            random_state=SEED,
        )
        with warnings.catch_warnings():
            # The number of passes is limited on purpose, so reaching the limit needs no warning.
            warnings.simplefilter("ignore", ConvergenceWarning)
            x, y = inputs.scaled(examples.inputs), outputs.scaled(examples.ratio)
            network.fit(x, y, sample_weight=examples.weight)
        return replace(self, regressor=ScaledNetwork(inputs, outputs, network))

    @property
    def numbers(self) -> int:
        """Number of weights and biases."""
        if self.regressor is None:
            return 0
        network = self.regressor.network
        return sum(part.size for part in (*network.coefs_, *network.intercepts_))
