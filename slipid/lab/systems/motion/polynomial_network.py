"""A GMDH network grows layers of quadratic neurons of two inputs each while unseen data gain.

A neuron says  z = w . (1, x1, x2, x1 x2, x1^2, x2^2),  with

    w = argmin  mean_A (z - y)^2 + ridge |w without its constant|^2        on half A of the data

Every pair of inputs gets one. They are ranked by mean_B (z - y)^2 on half B, the best few are kept,
and what they say are the inputs of the next layer. Growing ends where the best neuron of a new
layer is no better on B than that of the layer before. The network is that best neuron with all
neurons that it is made of.

Both means are quadratic in w, with sums of x_i^a x_j^b (a + b <= 4) as coefficients. These are
products of few matrices, and all pairs are solved at once without writing down their regressors.

Source: Ivakhnenko 1971, Polynomial theory of complex systems, IEEE Transactions on Systems, Man,
and Cybernetics 1(4).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

POWERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [2, 0], [0, 2]])
"""Exponents of the first and the second input in a neuron's terms."""
GAIN = 1e-3
"""Share of the error on B that a new layer has to remove; less is chance."""
NOTHING = 1e-12
"""Error on B that is nothing but rounding, of outputs of variance about one."""


@dataclass(frozen=True)
class Growth:
    """How a network is grown.

    Attributes:
        ridge: on inputs of variance about one.
        kept: neurons of a layer that the next one is made of.
        layers: at most.
    """

    ridge: float
    kept: int
    layers: int


@dataclass(frozen=True, eq=False)
class Layer:
    """Neurons next to each other.

    Attributes:
        inputs: numbers of the two inputs of each neuron.
        weight: of each neuron's terms.
    """

    inputs: Int[np.ndarray, "neuron 2"]
    weight: Float[np.ndarray, "neuron 6"]

    def output(self, x: Float[np.ndarray, "row input"]) -> Float[np.ndarray, "row neuron"]:
        a, b = x[:, self.inputs[:, 0]], x[:, self.inputs[:, 1]]
        terms = (np.ones_like(a), a, b, a * b, a * a, b * b)
        return np.asarray(sum(w * term for w, term in zip(self.weight.T, terms, strict=True)))

    def only(self, neurons: Int[np.ndarray, " some"]) -> "Layer":
        return Layer(self.inputs[neurons], self.weight[neurons])


@dataclass(frozen=True, eq=False)
class PolynomialNetwork:
    """A grown network with one output.

    Attributes:
        layers: the last one has a single neuron.
        errors: mean square error of the best neuron on B, layer by layer.
    """

    layers: Sequence[Layer]
    errors: Sequence[float]

    def output(self, x: Float[np.ndarray, "row input"]) -> Float[np.ndarray, " row"]:
        for layer in self.layers:
            x = layer.output(x)
        return x[:, 0]

    @property
    def numbers(self) -> int:
        """How many weights it has."""
        return sum(layer.weight.size for layer in self.layers)


def grown(
    x: Float[np.ndarray, "row input"],
    y: Float[np.ndarray, " row"],
    weight: Float[np.ndarray, " row"],
    in_a: Bool[np.ndarray, " row"],
    growth: Growth,
) -> PolynomialNetwork:
    """The network of one output.

    Args:
        x: inputs, two at least, each of about mean zero and variance one.
        y: what it is to say, likewise.
        weight: of each row in all means.
        in_a: rows of half A; the others are half B. Where either is empty, all rows are in both.
        growth: how far it is grown.
    """
    layers: list[Layer] = []
    errors: list[float] = []
    halves = (in_a, ~in_a) if 0 < in_a.sum() < len(in_a) else (np.ones_like(in_a),) * 2
    while len(layers) < growth.layers and x.shape[1] > 1 and (not errors or errors[-1] > NOTHING):
        half_a, half_b = (PairMoments.of(x[half], y[half], weight[half]) for half in halves)
        neurons = half_a.solved(growth.ridge)
        error = half_b.errors(neurons.weight)
        best = np.argsort(error, kind="stable")[: growth.kept]
        if errors and error[best[0]] >= (1 - GAIN) * errors[-1]:
            break
        layers.append(neurons.only(best))
        errors.append(float(error[best[0]]))
        x = layers[-1].output(x)
    return PolynomialNetwork(pruned(layers), errors)


def pruned(layers: Sequence[Layer]) -> list[Layer]:
    """Layers with those neurons alone that the first neuron of the last layer is made of."""
    needed, kept = np.zeros(1, dtype=int), []
    for layer in reversed(layers):
        part = layer.only(needed)
        needed, numbers = np.unique(part.inputs, return_inverse=True)
        kept.append((part, numbers.reshape(part.inputs.shape)))
    kept.reverse()
    first, rest = kept[0][0], [Layer(numbers, part.weight) for part, numbers in kept[1:]]
    return [first, *rest]


@dataclass(frozen=True, eq=False)
class PairMoments:
    """Means over some rows, from which neurons of all pairs of inputs are solved and judged.

    Attributes:
        inputs: both numbers of each pair.
        gram: of a pair's terms.
        moment: of a pair's terms with what is to be said.
        square: mean square of what is to be said.
    """

    inputs: Int[np.ndarray, "pair 2"]
    gram: Float[np.ndarray, "pair 6 6"]
    moment: Float[np.ndarray, "pair 6"]
    square: float

    @classmethod
    def of(
        cls,
        x: Float[np.ndarray, "row input"],
        y: Float[np.ndarray, " row"],
        weight: Float[np.ndarray, " row"],
    ) -> "PairMoments":
        weight = weight / weight.sum()
        pair = np.triu_indices(x.shape[1], 1)
        a, b = (POWERS[:, k, None] + POWERS[None, :, k] for k in (0, 1))
        gram = _products(x, weight, 4)[a, b][:, :, *pair]
        moment = _products(x, weight * y, 2)[POWERS[:, 0], POWERS[:, 1]][:, *pair]
        square = float(weight @ y**2)
        return cls(np.stack(pair, axis=1), np.moveaxis(gram, -1, 0), moment.T, square)

    def solved(self, ridge: float) -> Layer:
        """The neuron of every pair."""
        # the constant is free
        penalty = np.diag([0.0, *[ridge] * 5])
        weight = np.linalg.solve(self.gram + penalty, self.moment[..., None])[..., 0]
        return Layer(self.inputs, weight)

    def errors(self, weight: Float[np.ndarray, "pair 6"]) -> Float[np.ndarray, " pair"]:
        """Mean square error of every pair's neuron."""
        said = np.einsum("pi,pij,pj->p", weight, self.gram, weight)
        error = self.square - 2 * (weight * self.moment).sum(axis=1) + said
        return np.asarray(error.clip(min=0.0))


def _products(
    x: Float[np.ndarray, "row input"], weight: Float[np.ndarray, " row"], most: int
) -> Float[np.ndarray, "a b input input"]:
    """Sums of weight x_i^a x_j^b, at [a, b, i, j], where a + b is at most so much; else nan."""
    inputs = x.shape[1]
    sums = np.full((most + 1, most + 1, inputs, inputs), np.nan)
    powers = [np.ones_like(x)]
    for _ in range(most):
        # twenty times as fast as x**k
        powers.append(powers[-1] * x)
    for a in range(most + 1):
        sums[a, 0] = (weight @ powers[a])[:, None]
        sums[0, a] = sums[a, 0].T
        for b in range(1, min(a, most - a) + 1):
            sums[a, b] = (powers[a] * weight[:, None]).T @ powers[b]
            sums[b, a] = sums[a, b].T
    return sums
