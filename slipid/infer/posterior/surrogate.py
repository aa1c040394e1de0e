"""Surrogate of a log density: a polynomial for the residual vector of each group.

The log likelihood of a group is c - |y|^2 / 2 with residuals y and a remainder c that are smooth
functions of the coordinates x. Its surrogate has polynomials for c and for the few linear
combinations of y that differ between plausible x (principal components). A value or slope of the
surrogate takes a small part of the time of an exact density.

The inputs of the polynomials are standardised. For the logarithm x of a positive parameter p, the
input is p / (p + q), with q at the upper end of its plausible values: residuals are nearly linear
in a small drag or creep, and nearly linear in the inverse of a large one. Where two parameters are
so large that only their quotient matters, the quotient is an input as well. With w the inputs of
positive parameters that are known worst, t all inputs, and v = (t, all products of two elements of
w), each polynomial has all terms of

    a + b t + v^T C v,

that is, up to the fourth degree in w and up to the second in the other inputs.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement, pairwise
from math import comb
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Matrix = Float[np.ndarray, "_ _"]
Numbers = TypeVar("Numbers", Array, np.ndarray)
"""Array of JAX, or of NumPy, for which JAX compiles nothing."""
MOST_COMPONENTS, SPARE = 64, 16
"""Largest number of principal components of the residuals of a group, and number of which their
number is a multiple, so that surrogates share compiled functions; spare ones are zero."""
LEAST_VARIANCE = 1e-4
"""Variance of a component below which it is left out."""
MOST_WIDE = 8
"""Largest number of inputs that have terms of up to the fourth degree."""
UPPER_END = 1.0
"""Distance of log q above the mean of x [std]."""
PLAUSIBLE = 12.0
"""Loss of log density, beyond the usual one, up to which a row is plausible."""
MARGIN, EDGE = 0.5, 0.05
"""Margin around the range of plausible rows, and width of its edge, as fractions of the range.

Beyond, polynomials may have modes that do not exist."""
RIDGE = 1e-8
"""Ridge penalty of the polynomials' coefficients, for features of unit mean square."""
DISTANCE = 10.0
"""Loss of log density over which the weight of a row falls."""
LEAST_WEIGHT, FURTHEST = 1e-4, 1e4
"""Weight of a row that is far from the best one, and loss beyond which a row is not used."""


class PolynomialInputs(NamedTuple):
    """Inputs of the polynomials of one group, as functions of the coordinates x.

    Attributes:
        at: index of the coordinate of each input.
        less: index of the coordinate that is subtracted, for the logarithm of a quotient; else -1.
        positive: True for logarithms of positive parameters.
        reference: log q of a positive parameter; a value that is subtracted from others.
        mean, std: mean and std over the rows that the surrogate was fitted to.
        low, high: range of the coordinate over plausible rows, with a margin.
        wide: pairs of indices of inputs whose products are inputs, too.
    """

    at: Int[np.ndarray, " input"]
    less: Int[np.ndarray, " input"]
    positive: Bool[np.ndarray, " input"]
    reference: Float[np.ndarray, " input"]
    mean: Float[np.ndarray, " input"]
    std: Float[np.ndarray, " input"]
    low: Float[np.ndarray, " input"]
    high: Float[np.ndarray, " input"]
    wide: Int[np.ndarray, "2 pair"]

    def logarithms(self, x: Numbers) -> Numbers:
        """Return the coordinates of all inputs, or their differences for quotients."""
        xp = np if isinstance(x, np.ndarray) else jnp
        return x[:, self.at] - xp.where(self.less >= 0, x[:, self.less], 0.0)

    def plain(self, x: Numbers) -> Numbers:
        """Return the inputs before they are standardised (walker, input)."""
        xp = np if isinstance(x, np.ndarray) else jnp
        off = self.logarithms(x) - self.reference
        return xp.where(self.positive, 0.5 + 0.5 * xp.tanh(0.5 * off), off)

    def all(self, x: Numbers) -> Numbers:
        """Return the vectors v (walker, v)."""
        xp = np if isinstance(x, np.ndarray) else jnp
        t = (self.plain(x) - self.mean) / self.std
        return xp.concatenate([t, t[:, self.wide[0]] * t[:, self.wide[1]]], axis=1)

    def outside(self, x: Array) -> Float[Array, " walker"]:
        """Return half the squared distance outside the range, in units of `EDGE` of the range."""
        own = self.logarithms(x)
        beyond = own - jnp.clip(own, self.low, self.high)
        return 0.5 * jnp.sum((beyond / (EDGE * (self.high - self.low))) ** 2, axis=1)


class GroupSurrogate(NamedTuple):
    """Surrogate of the log likelihood of one group.

    Attributes:
        inputs: inputs of the polynomials.
        constant, linear, square: a, b and C of every component of y, and of c as the last one. The
            component is the second index of `square`, since its product with v then takes a sixth
            of the time that it takes with the component first.
        rest: sum of squares of the residuals that no component describes, less twice the mean c.
    """

    inputs: PolynomialInputs
    constant: Float[np.ndarray, " component"]
    linear: Float[np.ndarray, "component v"]
    square: Float[np.ndarray, "v component v"]
    rest: Float[np.ndarray, ""]

    def with_slope(self, x: Array, bounded: Array | float) -> "ValueAndSlope":
        """Return the approximate log likelihood of every walker, and its slope.

        Polynomials are evaluated in single precision, which is fast and precise to 1e-4. The
        factor `bounded` is 1 to reduce the value outside the range of plausible rows, else 0.
        """
        v, onto_x = jax.vjp(lambda x: self.inputs.all(x).astype(jnp.float32), x)
        constant, linear, square = (
            jnp.asarray(part, jnp.float32) for part in (self.constant, self.linear, self.square)
        )
        bent = jnp.einsum("wb,bqa->wqa", v, square)
        y = constant + jnp.einsum("wqa,wa->wq", linear + bent, v)
        value = y[:, -1] - 0.5 * jnp.sum(y[:, :-1] ** 2, axis=1)
        by_y = jnp.concatenate([-y[:, :-1], jnp.ones_like(y[:, -1:])], axis=1)
        by_v = jnp.einsum("wq,wqa->wa", by_y, linear + 2 * bent)  # as C is symmetric
        outside, back = jax.vjp(lambda x: bounded * self.inputs.outside(x), x)
        slope = onto_x(by_v)[0] - back(jnp.ones_like(outside))[0]
        return ValueAndSlope(value - 0.5 * self.rest - outside, slope)


class ValueAndSlope(NamedTuple):
    """Values of a function for every walker, and their derivatives by its coordinates."""

    value: Float[Array, "walker *term"]
    slope: Float[Array, "walker size"]


class Surrogate(NamedTuple):
    """Surrogate of a log density, and the Gaussian with which Hamiltonian moves are scaled.

    Attributes:
        groups: surrogate of every group.
        group: group of every coordinate, -1 for coordinates that groups share.
        prior_mean, prior_std, link, link_centre: Gaussian prior, as in `blocks.LogDensity`.
        centre: mean of the Gaussian.
        root: square root of its covariance. A coordinate of a group depends on the standard
            coordinates of its own group and on those that groups share, not on those of others.
    """

    groups: tuple[GroupSurrogate, ...]
    group: Int[np.ndarray, " size"]
    prior_mean: Float[np.ndarray, " size"]
    prior_std: Float[np.ndarray, " size"]
    link: Matrix
    link_centre: Float[np.ndarray, " size"]
    centre: Float[np.ndarray, " size"]
    root: Matrix

    def with_slope(self, x: Array, bounded: Array | float = 0.0) -> ValueAndSlope:
        """Return the approximate terms of the log density, and the slope of their sum.

        There is one term per group, then the shared term. `bounded` is that of `GroupSurrogate`.
        """
        own = self.group[:, None] == np.append(np.arange(len(self.groups)), -1)
        pull = (x - self.prior_mean) / self.prior_std
        of_groups = [g.with_slope(x, bounded) for g in self.groups]
        terms = -0.5 * pull**2 @ own.astype(float)
        terms = terms.at[:, :-1].add(jnp.stack([of.value for of in of_groups], axis=1))
        linked = (x - self.link_centre) @ self.link.T
        terms = terms.at[:, -1].add(-0.5 * jnp.sum(linked**2, axis=1))
        of_prior = -pull / self.prior_std - linked @ self.link
        return ValueAndSlope(terms, sum((of.slope for of in of_groups), of_prior))

    def value(self, x: Matrix) -> Float[np.ndarray, " walker"]:
        """Return the approximate log density of every walker."""
        return np.asarray(_value(self, x))

    @staticmethod
    def of_leaves(leaves: Sequence[np.ndarray], groups: int) -> "Surrogate":
        """Return the surrogate whose arrays `jax.tree.leaves` has listed."""
        count = len(PolynomialInputs._fields), len(GroupSurrogate._fields) - 1
        ends = np.cumsum([0, *count * groups]).tolist()
        parts = [leaves[a:b] for a, b in pairwise(ends)]
        each = [
            GroupSurrogate(PolynomialInputs(*inputs), *rest)
            for inputs, rest in zip(parts[::2], parts[1::2], strict=True)
        ]
        return Surrogate(tuple(each), *leaves[ends[-1] :])


@jax.jit
def _value(surrogate: Surrogate, x: Array) -> Float[Array, " walker"]:
    return surrogate.with_slope(x).value.sum(axis=1)


class ResidualRows(NamedTuple):
    """Exact residuals y and remainders c of one group at the vectors x."""

    x: Matrix
    y: Matrix
    c: Float[np.ndarray, " row"]

    @property
    def log_likelihood(self) -> Float[np.ndarray, " row"]:
        return np.asarray(self.c - 0.5 * (self.y**2).sum(axis=1))


def group_surrogate(
    rows: ResidualRows,
    of: Int[np.ndarray, "2 input"],
    positive: Bool[np.ndarray, " size"],
    own: int,
) -> GroupSurrogate:
    """Return the surrogate of a group, fitted to exact rows by weighted least squares.

    A row weighs less the further its log likelihood is below the best one, beyond the difference
    that is usual for `own` coordinates.

    Args:
        rows: exact residuals.
        of: `PolynomialInputs.at` and `PolynomialInputs.less`.
        positive: True for coordinates that are logarithms of positive parameters.
        own: number of the group's own coordinates.
    """
    possible = rows.log_likelihood > np.nanmax(rows.log_likelihood) - FURTHEST
    rows = ResidualRows(*(part[possible] for part in rows))
    below = rows.log_likelihood.max() - rows.log_likelihood - 0.5 * own - 3
    weight = np.maximum((1 + np.maximum(below, 0) / DISTANCE) ** -2.0, LEAST_WEIGHT)
    weight /= weight.sum()
    inputs = _inputs(rows.x, weight, of, positive[of[0]])
    least = np.sort(below)[min(2 * own + 1, len(below) - 1)]  # a range needs some rows
    likely = inputs.logarithms(rows.x[below <= max(PLAUSIBLE, least)])
    low, high = likely.min(axis=0), likely.max(axis=0)
    margin = MARGIN * (high - low)
    inputs = inputs._replace(low=low - margin, high=high + margin)
    v, count = inputs.all(rows.x), of.shape[1]
    pairs = _pairs(inputs)
    features = np.concatenate(
        [np.ones((len(v), 1)), v[:, :count], v[:, pairs[0]] * v[:, pairs[1]]], axis=1
    )
    best = rows.y[np.argmax(rows.log_likelihood)]
    span = _components((rows.y - best) * np.sqrt(weight)[:, None])
    middle = rows.c.mean()  # c is small in single precision then
    wanted = np.concatenate([rows.y @ span, rows.c[:, None] - middle], axis=1)
    scale = np.sqrt(weight @ features**2)
    scaled = features / scale * np.sqrt(weight)[:, None]
    normal = scaled.T @ scaled + RIDGE * np.diag(np.arange(len(scale)) > 0)
    coef = np.linalg.solve(normal, scaled.T @ (wanted * np.sqrt(weight)[:, None]))
    coef = (coef / scale[:, None]).T
    linear = np.zeros((len(coef), v.shape[1]))
    linear[:, :count] = coef[:, 1 : count + 1]
    square = np.zeros((v.shape[1], len(coef), v.shape[1]))
    for a, b in (pairs, pairs[::-1]):  # half of each coefficient on either side of the diagonal
        square[a, :, b] += 0.5 * coef[:, count + 1 :].T
    rest = np.sum((best - span @ (span.T @ best)) ** 2) - 2 * middle
    return GroupSurrogate(inputs, coef[:, 0], linear, square, np.asarray(rest))


def _inputs(
    x: Matrix,
    weight: Float[np.ndarray, " row"],
    of: Int[np.ndarray, "2 input"],
    positive: Bool[np.ndarray, " input"],
) -> PolynomialInputs:
    """Return inputs that have zero mean and unit variance over the rows."""
    zero, one = np.zeros(of.shape[1]), np.ones(of.shape[1])
    none = np.zeros((2, 0), int)
    found = PolynomialInputs(of[0], of[1], positive, zero, zero, one, zero, one, none)
    coordinates = found.logarithms(x)
    middle = weight @ coordinates
    width = np.sqrt(weight @ (coordinates - middle) ** 2)
    # The width of the other coordinates says nothing about how curved the residuals are in them.
    some = np.argsort(-width * positive, kind="stable")[: min(MOST_WIDE, int(positive.sum()))]
    pairs = list(combinations_with_replacement(np.sort(some), 2))
    wide = np.array(pairs, int).reshape(-1, 2).T
    found = found._replace(reference=middle + UPPER_END * width, wide=wide)
    plain = found.plain(x)
    mean = weight @ plain
    return found._replace(mean=mean, std=np.sqrt(weight @ (plain - mean) ** 2))


def term_count(of: Int[np.ndarray, "2 input"], positive: Bool[np.ndarray, " size"]) -> int:
    """Return the number of terms of each polynomial; arguments are those of `group_surrogate`."""
    inputs, wide = of.shape[1], min(MOST_WIDE, int(positive[of[0]].sum()))
    others, products = inputs - wide, wide * (wide + 1) // 2
    third, fourth = comb(wide + 2, 3) + others * products, comb(wide + 3, 4)
    return 1 + inputs + comb(inputs + 1, 2) + third + fourth


def _pairs(inputs: PolynomialInputs) -> Int[np.ndarray, "2 term"]:
    """Return pairs of elements of v, one for each different product of inputs."""
    factors = [(k,) for k in range(len(inputs.at))] + [tuple(p) for p in inputs.wide.T.tolist()]
    terms: dict[tuple[int, ...], tuple[int, int]] = {}
    for a, b in combinations_with_replacement(range(len(factors)), 2):
        terms.setdefault(tuple(sorted(factors[a] + factors[b])), (a, b))
    return np.array(list(terms.values()), int).T


def _components(rows: Matrix) -> Float[np.ndarray, "m component"]:
    """Return the directions of the largest variance, at most `MOST_COMPONENTS` of them.

    Directions of less than `LEAST_VARIANCE` are left out. Source: Halko, Martinsson and Tropp 2011,
    SIAM Review 53(2), algorithm 5.1 after one power iteration.
    """
    start = np.random.default_rng(0).standard_normal((rows.shape[1], 2 * MOST_COMPONENTS))
    basis = np.linalg.qr(rows.T @ (rows @ (rows.T @ (rows @ start))))[0]
    value, inner = np.linalg.eigh((rows @ basis).T @ (rows @ basis))
    found = (basis @ inner * (value > LEAST_VARIANCE))[:, ::-1]
    count = min(int((value > LEAST_VARIANCE).sum()), MOST_COMPONENTS)
    padded = max(SPARE, -(-count // SPARE) * SPARE)
    return np.pad(found[:, :count], ((0, 0), (0, padded - count)))


def gaussian_root(covariance: Matrix, group: Int[np.ndarray, " size"]) -> Matrix:
    """Return a root of a covariance; groups are independent given the coordinates they share."""
    shared = np.flatnonzero(group < 0)
    root = np.zeros_like(covariance)
    root[np.ix_(shared, shared)] = np.linalg.cholesky(covariance[np.ix_(shared, shared)])
    for g in np.unique(group[group >= 0]):
        own = np.flatnonzero(group == g)
        slope = np.linalg.solve(
            covariance[np.ix_(shared, shared)], covariance[np.ix_(shared, own)]
        ).T
        rest = covariance[np.ix_(own, own)] - slope @ covariance[np.ix_(shared, own)]
        root[np.ix_(own, shared)] = slope @ root[np.ix_(shared, shared)]
        root[np.ix_(own, own)] = np.linalg.cholesky(rest)
    return root
