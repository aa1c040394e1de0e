"""A small neural network over all that the robot measures.

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

from slipid.baselines.motion.features import Lessons, Regressor, Scale, Windows, with_slip
from slipid.identify.compare.slip_model import Channel, Heard, Machine, Run, Said, SlipModel

PASSES = 60
"""Through all windows, at most."""
PATIENCE = 6
"""Passes without gain after which it stops."""
FEWEST = 20
"""Windows below which none are left out to stop in time."""
SEED = 0


@dataclass(frozen=True)
class Shape:
    """Sizes of the hidden layers, and how much large weights cost."""

    hidden: tuple[int, ...]
    alpha: float


CANDIDATES = (Shape((32,), 1e-3), Shape((16,), 1e-1), Shape((16,), 1.0), Shape((32,), 1.0))


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
    shape: Shape = CANDIDATES[0]
    channels: frozenset[Channel] = frozenset()
    inputs: Scale | None = None
    outputs: Scale | None = None
    network: Regressor | None = None

    def candidates(self) -> Sequence["NeuralNetwork"]:
        return [replace(self, shape=shape) for shape in CANDIDATES]

    def fit(self, runs: Sequence[Run], machine: Machine) -> "NeuralNetwork":
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPRegressor
        from threadpoolctl import threadpool_limits

        seen = Lessons.of(runs, machine)
        inputs, outputs = Scale.of(seen.inputs), Scale.of(seen.ratio)
        network = MLPRegressor(
            hidden_layer_sizes=self.shape.hidden,
            alpha=self.shape.alpha,
            learning_rate_init=5e-3,
            max_iter=PASSES,
            early_stopping=len(seen.inputs) >= FEWEST,
            n_iter_no_change=PATIENCE,
            random_state=SEED,
        )
        with threadpool_limits(1), warnings.catch_warnings():
            # so many passes are what it is given: the end of them is as good as stopping early
            warnings.simplefilter("ignore", ConvergenceWarning)
            x, y = inputs.scaled(seen.inputs), outputs.scaled(seen.ratio)
            network.fit(x, y, sample_weight=seen.weight)
        return replace(
            self, channels=seen.channels, inputs=inputs, outputs=outputs, network=network
        )

    def predict(self, runs: Sequence[Heard], machine: Machine) -> list[Said]:
        if self.network is None or self.inputs is None or self.outputs is None:
            raise ValueError(f"{self.name}: predict before fit")
        windows = Windows.of(runs, machine)
        inputs = self.inputs.scaled(windows.inputs(machine, self.channels))
        ratio = self.outputs.back(self.network.predict(inputs))
        ratio = ratio.clip(self.outputs.low, self.outputs.high)
        return with_slip(runs, windows, ratio, machine)

    @property
    def numbers(self) -> int:
        """Weights and biases."""
        if self.network is None or self.inputs is None:
            return 0
        sizes = [len(self.inputs.mean), *self.shape.hidden, 3]
        return sum((a + 1) * b for a, b in pairwise(sizes))
