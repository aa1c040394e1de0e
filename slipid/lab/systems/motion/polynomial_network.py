"""GMDH network: layers of quadratic neurons, added while the error on held-out data falls.

The output of a neuron is  z = w . (1, x1, x2, x1 x2, x1^2, x2^2),  with

    w = argmin  mean_A (z - y)^2 + ridge |w without its constant|^2        on half A of the data

where y is the target. There is a neuron for every pair of inputs. Neurons are ranked by
mean_B (z - y)^2 on half B of the data; the best few are kept, and their outputs are the inputs of
the next layer. Growth ends when the best neuron of a new layer is no better on B than that of the
layer before. The network is that best neuron with all neurons that it depends on.

Both means are quadratic in w, and their coefficients are sums of x_i^a x_j^b (a + b <= 4). A few
matrix products give these sums for all pairs, so that all neurons are solved at once without
forming the terms of each pair.

Source: Ivakhnenko 1971, Polynomial theory of complex systems, IEEE Transactions on Systems, Man,
and Cybernetics 1(4).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

POWERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [2, 0], [0, 2]])
"""Exponents of the first and the second input in a neuron's terms."""
LEAST_GAIN = 1e-3
"""Smallest relative decrease of the mean square error on B by a new layer; less may be chance."""
ROUNDING = 1e-12
"""Mean square error on B up to which growth stops, since it may be rounding error, for outputs of
variance one."""


@dataclass(frozen=True)
class Growth:
    """Settings of a network's growth.

    Attributes:
        ridge: penalty on squared weights, for inputs of variance about one.
        kept: number of neurons of a layer that feed the next one.
        layers: largest number of layers.
    """

    ridge: float
    kept: int
    layers: int


@dataclass(frozen=True, eq=False)
class Layer:
    """Neurons of one layer.

    Attributes:
        inputs: indices of the two inputs of each neuron.
        weight: weight w of each of the neuron's six terms.
    """

    inputs: Int[np.ndarray, "neuron 2"]
    weight: Float[np.ndarray, "neuron 6"]

    def output(self, x: Float[np.ndarray, "row input"]) -> Float[np.ndarray, "row neuron"]:
        """Return the output of every neuron."""
        a, b = x[:, self.inputs[:, 0]], x[:, self.inputs[:, 1]]
        terms = (np.ones_like(a), a, b, a * b, a * a, b * b)
        return np.asarray(sum(w * term for w, term in zip(self.weight.T, terms, strict=True)))

    def only(self, neurons: Int[np.ndarray, " some"]) -> "Layer":
        """Return a layer with only the neurons whose indices are given."""
        return Layer(self.inputs[neurons], self.weight[neurons])


@dataclass(frozen=True, eq=False)
class PolynomialNetwork:
    """A grown network with one output.

    Attributes:
        layers: layers of neurons; the last one has a single neuron.
        errors: mean square error of the best neuron on half B, layer by layer.
    """

    layers: Sequence[Layer]
    errors: Sequence[float]

    def output(self, x: Float[np.ndarray, "row input"]) -> Float[np.ndarray, " row"]:
        """Return the output of the network."""
        for layer in self.layers:
            x = layer.output(x)
        return x[:, 0]

    @property
    def numbers(self) -> int:
        """Number of weights."""
        return sum(layer.weight.size for layer in self.layers)


def grown(
    x: Float[np.ndarray, "row input"],
    y: Float[np.ndarray, " row"],
    weight: Float[np.ndarray, " row"],
    in_a: Bool[np.ndarray, " row"],
    growth: Growth,
) -> PolynomialNetwork:
    """Return a network grown for one target.

    Args:
        x: at least two inputs, each of about mean zero and variance one.
        y: target of about mean zero and variance one.
        weight: weight of each row in all means.
        in_a: True for rows of half A, False for rows of half B. If a half is empty, both halves
            have all rows.
        growth: settings of the growth.
    """
    layers: list[Layer] = []
    errors: list[float] = []
    halves = (in_a, ~in_a) if 0 < in_a.sum() < len(in_a) else (np.ones_like(in_a),) * 2
    while len(layers) < growth.layers and x.shape[1] > 1 and (not errors or errors[-1] > ROUNDING):
        half_a, half_b = (PairMoments.of(x[half], y[half], weight[half]) for half in halves)
        neurons = half_a.solved(growth.ridge)
        error = half_b.errors(neurons.weight)
        best = np.argsort(error, kind="stable")[: growth.kept]
        if errors and error[best[0]] >= (1 - LEAST_GAIN) * errors[-1]:
            break
        layers.append(neurons.only(best))
        errors.append(float(error[best[0]]))
        x = layers[-1].output(x)
    return PolynomialNetwork(pruned(layers), errors)


def pruned(layers: Sequence[Layer]) -> list[Layer]:
    """Return layers reduced to the last layer's first neuron and the neurons it depends on."""
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
    """Means over rows of data from which the neurons of all pairs of inputs are solved and scored.

    Attributes:
        inputs: indices of the two inputs of each pair.
        gram: mean products of a pair's terms with each other.
        moment: mean products of a pair's terms with the target.
        square: mean square of the target.
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
        """Return the means over the rows with inputs x, targets y and these weights."""
        weight = weight / weight.sum()
        pair = np.triu_indices(x.shape[1], 1)
        a, b = (POWERS[:, k, None] + POWERS[None, :, k] for k in (0, 1))
        gram = _products(x, weight, 4)[a, b][:, :, *pair]
        moment = _products(x, weight * y, 2)[POWERS[:, 0], POWERS[:, 1]][:, *pair]
        square = float(weight @ y**2)
        return cls(np.stack(pair, axis=1), np.moveaxis(gram, -1, 0), moment.T, square)

    def solved(self, ridge: float) -> Layer:
        """Return the neuron of every pair of inputs, by least squares with a ridge."""
        # the constant has no penalty
        penalty = np.diag([0.0, *[ridge] * 5])
        weight = np.linalg.solve(self.gram + penalty, self.moment[..., None])[..., 0]
        return Layer(self.inputs, weight)

    def errors(self, weight: Float[np.ndarray, "pair 6"]) -> Float[np.ndarray, " pair"]:
        """Return the mean square error of every pair's neuron with these weights."""
        output = np.einsum("pi,pij,pj->p", weight, self.gram, weight)
        error = self.square - 2 * (weight * self.moment).sum(axis=1) + output
        return np.asarray(error.clip(min=0.0))


def _products(
    x: Float[np.ndarray, "row input"], weight: Float[np.ndarray, " row"], most: int
) -> Float[np.ndarray, "a b input input"]:
    """Return sums of weight x_i^a x_j^b at [a, b, i, j]; NaN for a + b > `most`."""
    inputs = x.shape[1]
    sums = np.full((most + 1, most + 1, inputs, inputs), np.nan)
    powers = [np.ones_like(x)]
    for _ in range(most):
        # repeated multiplication is twenty times as fast as x**k
        powers.append(powers[-1] * x)
    for a in range(most + 1):
        sums[a, 0] = (weight @ powers[a])[:, None]
        sums[0, a] = sums[a, 0].T
        for b in range(1, min(a, most - a) + 1):
            sums[a, b] = (powers[a] * weight[:, None]).T @ powers[b]
            sums[b, a] = sums[a, b].T
    return sums
