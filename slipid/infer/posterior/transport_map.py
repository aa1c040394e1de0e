"""Transport map: coordinates in which a posterior is nearly a standard Gaussian, learnt from draws.

The map is triangular (Knothe-Rosenblatt) and leads from coordinates x to u, through v:

    shared coordinates      v = L^-1 (x - m)
    coordinates of a group  w = L^-1 (x - m - B s), those with the largest variance first
                            v_i = (w_i - a_i(w_1 .. w_i-1)) exp(-b_i(w_1 .. w_i-1))

with the mean m, Cholesky factors L of (conditional) covariances, regression coefficients B on the
shared coordinates, s the shared part of x - m, and polynomials a and b. A sinh-arcsinh map (Jones
and Pewsey 2009, Biometrika 96, eq. 2) leads from v to u, coordinate by coordinate:

    sinh(tail arcsinh((v - place) / scale) - skew)

The map of a group depends on the shared coordinates and on the group itself only, so that groups
that are independent given the shared coordinates remain independent. Triangular maps of this kind
are described by Marzouk et al. 2016 (Sampling via measure transport, section 3).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.optimize import minimize

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]
Leaf = Array | np.ndarray
"""A NumPy array while a map is learnt, a JAX array in the inverse map."""
POLYNOMIAL_LIMIT = 4.0
"""Magnitude of a whitened coordinate w above which polynomials are constant [std]."""
SQUARED_COORDINATES = 5
"""Number of coordinates of a group, with the largest variances, whose squares and products are
monomials."""
CUBED_COORDINATES = 3
"""Number of coordinates of a group, with the largest variances, whose cubes are monomials."""
LEAST_GAIN_NATS = 3.0
"""Smallest gain in log likelihood for which a monomial is included [nat]."""
MOST_MONOMIALS = 12
"""Largest number of monomials added for a coordinate, in its mean and log std together."""
MOST_DRAWS = 4000
"""Largest number of draws from which a map is learnt."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Warp:
    """Sinh-arcsinh map of every coordinate; skew 0 and tail 1 make it linear.

    Attributes:
        place: centre of the map, in units of v.
        scale: width of the nearly linear range around the centre, in units of v.
        skew: asymmetry, positive if the upper tail of v is the longer one.
        tail: above 1 if the tails of v are lighter than those of a Gaussian.
    """

    place: Leaf
    scale: Leaf
    skew: Leaf
    tail: Leaf

    def forward(self, v: Matrix) -> Matrix:
        """Return the coordinates u of v."""
        inner = self.tail * np.arcsinh((v - self.place) / self.scale)
        return np.asarray(np.sinh(inner - self.skew))

    def back(self, u: Leaf) -> Array:
        """Return the coordinates v of u."""
        inner = (jnp.arcsinh(u) + self.skew) / self.tail
        return jnp.asarray(self.place + self.scale * jnp.sinh(inner))

    def log_slope(self, u: Leaf) -> Array:
        """Return log dv/du of every coordinate."""
        inner = jnp.abs((jnp.arcsinh(u) + self.skew) / self.tail)
        cosh = inner + jnp.log1p(jnp.exp(-2 * inner)) - np.log(2)  # without overflow
        return jnp.log(self.scale / self.tail) + cosh - 0.5 * jnp.log1p(u**2)

    @staticmethod
    def none(size: int) -> "Warp":
        """Return the identity map."""
        one, zero = np.ones(size), np.zeros(size)
        return Warp(zero, one, zero, one)

    @staticmethod
    def learnt(draws: Matrix) -> "Warp":
        """Return the map fitted to draws by (slightly penalised) likelihood, column by column."""
        return Warp(*np.array([_sinh_arcsinh(column) for column in draws.T]).T)


def _sinh_arcsinh(x: Vector) -> tuple[float, float, float, float]:
    middle, width = float(np.median(x)), float(x.std())
    t = (x - middle) / width

    def loss(q: np.ndarray) -> float:
        inner = np.arcsinh((t - q[0]) / np.exp(q[1]))
        y = np.exp(q[3]) * inner - q[2]
        density = -0.5 * np.sinh(y) ** 2 + np.log(np.cosh(y)) + q[3] - q[1]
        spread = np.mean(density - 0.5 * np.log1p(((t - q[0]) / np.exp(q[1])) ** 2))
        return float(-spread + 1e-2 * (q @ q))

    with np.errstate(over="ignore", invalid="ignore"):
        q = minimize(loss, np.zeros(4), method="BFGS").x
    return middle + width * q[0], width * float(np.exp(q[1])), q[2], float(np.exp(q[3]))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Transport:
    """Map of vectors x (row, size) to u (row, size), and its inverse, one coordinate per step.

    The inverse works on a matrix with a column for each w_i, one for each x_i - m_i, and a column
    of ones. Step i sets the columns of w_i and x_i - m_i, which are zero before:

        w_i = f_i . shift_i + exp(f_i . scale_i) v_i,   x_i - m_i = columns . slope_i

    with monomials f_i. Arrays have fixed shapes, so that XLA compiles the inverse once, although
    groups and monomials differ between maps.

    Attributes:
        mean: m, mean of x.
        last: map from v to u.
        order: index of each step's coordinate.
        slope: weights of the columns in x_i - m_i.
        root: log dx_i / dw_i of each step.
        factors: columns whose product is each monomial (step, monomial, 3).
        shift: coefficients of the mean of w_i.
        scale: coefficients of the log std of w_i.
    """

    mean: Leaf
    last: Warp
    order: Leaf
    slope: Leaf
    root: Leaf
    factors: Leaf
    shift: Leaf
    scale: Leaf

    @property
    def steps(self) -> "_Step":
        """Arrays of the steps: order, slope, root, factors, shift, scale."""
        return self.order, self.slope, self.root, self.factors, self.shift, self.scale

    def forward(self, x: Matrix) -> Matrix:
        """Return the coordinates u of x."""
        size, v = x.shape[1], np.empty_like(x)
        columns = np.concatenate([np.zeros_like(x), x - self.mean, np.ones((len(x), 1))], axis=1)
        for i, slope, root, factors, shift, scale in zip(*self.steps, strict=True):
            f = np.clip(columns[:, factors], -POLYNOMIAL_LIMIT, POLYNOMIAL_LIMIT).prod(axis=2)
            w = (columns[:, size + i] - columns @ slope) * np.exp(-root)
            v[:, i] = (w - f @ shift) * np.exp(-f @ scale)
            columns[:, i] = w
        return self.last.forward(v)

    def placed(self, u: Matrix) -> tuple[Matrix, Matrix]:
        """Return the coordinates x of u, and the terms (row, size) that add up to log |dx/du|."""
        x, log = _placed(self._on_device, u)
        return np.array(x), np.array(log)

    def pulled_back(self, u: Matrix, slope: Callable[[Matrix], Matrix]) -> Matrix:
        """Return the gradient of log |dx/du| + f(x) with respect to u, given `slope` = df/dx."""
        return np.array(_pulled(self._on_device, u, slope(self.placed(u)[0])))

    @cached_property
    def _on_device(self) -> "Transport":
        """The map with its arrays copied to the device once, not in every call."""
        with jax.ensure_compile_time_eval():  # a cached property must not contain tracers
            on_device: Transport = jax.device_put(self)
            return on_device


_Step = tuple[Leaf, Leaf, Leaf, Leaf, Leaf, Leaf]


@jax.jit
def _placed(map: Transport, u: Array) -> tuple[Array, Array]:
    rows, size = u.shape
    v = map.last.back(u)

    def step(columns: Array, s: _Step) -> tuple[Array, tuple[Array, Array]]:
        i, slope, root, factors, shift, scale = s
        f = jnp.clip(columns[:, factors], -POLYNOMIAL_LIMIT, POLYNOMIAL_LIMIT).prod(axis=2)
        spread = f @ scale
        columns = columns.at[:, i].set(f @ shift + jnp.exp(spread) * v[:, i])
        about = columns @ slope
        return columns.at[:, size + i].set(about), (about, spread + root)

    start = jnp.zeros((rows, 2 * size + 1)).at[:, -1].set(1.0)
    _, (about, log) = jax.lax.scan(step, start, map.steps)
    there = jnp.zeros_like(u).at[:, map.order].set(about.T)
    return jnp.asarray(map.mean) + there, map.last.log_slope(u).at[:, map.order].add(log.T)


@jax.jit
def _pulled(map: Transport, u: Array, slope: Array) -> Array:
    (_, log), back = jax.vjp(lambda u: _placed(map, u), u)
    (out,) = back((slope, jnp.ones_like(log)))
    return jnp.asarray(out)


def _monomials(
    w: Matrix, effective: float
) -> tuple[Int[np.ndarray, "coordinate monomial 3"], Matrix, Matrix]:
    """Return the polynomials a and b of each coordinate, fitted to draws w of a group.

    The polynomials are given by the factors of their monomials, which are indices of columns of
    (w, 1), and by the coefficients of a and of b. The draws count as `effective` independent draws.
    """
    size = w.shape[1]
    one = size  # the column of ones
    every = [(one, one, one)] + [(k, one, one) for k in range(size)]
    squared, cubed = (
        range(min(SQUARED_COORDINATES, size - 1)),
        range(min(CUBED_COORDINATES, size - 1)),
    )
    every += [(*pair, one) for pair in combinations_with_replacement(squared, 2)]
    every += [(k, k, k) for k in cubed]
    of_each = np.array(every)
    columns = np.concatenate(
        [np.clip(w, -POLYNOMIAL_LIMIT, POLYNOMIAL_LIMIT), np.ones((len(w), 1))], axis=1
    )
    f = columns[:, of_each].prod(axis=2)
    reach = np.where(of_each >= size, -1, of_each).max(axis=1)
    factors = np.full((size, MOST_MONOMIALS + 1, 3), one)
    shift, scale = np.zeros((2, size, MOST_MONOMIALS + 1))
    for i in range(size):
        own = np.flatnonzero(reach < i)
        a, b = _regression(f[:, own], w[:, i], effective)
        used = np.flatnonzero((a != 0) | (b != 0))
        factors[i, : len(used)] = of_each[own[used]]
        shift[i, : len(used)], scale[i, : len(used)] = a[used], b[used]
    return factors, shift, scale


def _regression(f: Matrix, w: Vector, effective: float) -> tuple[Vector, Vector]:
    """Return coefficients of the mean and of the log std of w given monomials f, most of them zero.

    Monomials are included one by one, in order of their score statistics, as long as the next one
    gains more than `LEAST_GAIN_NATS` nats for `effective` independent rows.
    """
    shift, scale, means, spreads = np.zeros(f.shape[1]), np.zeros(f.shape[1]), [0], [0]
    share = effective / len(w)
    for _ in range(MOST_MONOMIALS):
        for _ in range(6):
            weight = np.exp(-2 * f @ scale)
            by = f[:, means].T * weight
            shift[means] = np.linalg.solve(by @ f[:, means], by @ w)
            excess = (w - f @ shift) ** 2 * weight - 1
            # This is a scoring step: each row has the Fisher information 2 about its log std.
            of = f[:, spreads]
            step = np.linalg.solve(2 * of.T @ of, of.T @ excess)
            scale[spreads] += step * min(1.0, 1.0 / (np.abs(of @ step).max() + 1e-9))
        root = np.sqrt(weight)
        of_mean = _scores(f * root[:, None], means, root * (w - f @ shift))
        gains = share * np.stack([0.5 * of_mean, 0.25 * _scores(f, spreads, excess)])
        which, best = np.unravel_index(np.argmax(gains), gains.shape)
        if gains[which, best] < LEAST_GAIN_NATS:
            break
        (means, spreads)[which].append(int(best))
    return shift, scale


def _scores(f: Matrix, taken: list[int], residual: Vector) -> Vector:
    """Return the squared projection of the residual on each column of f.

    The part of a column that is orthogonal to the columns `taken` is used; a dependent column has
    the score zero.
    """
    others = f - f[:, taken] @ np.linalg.lstsq(f[:, taken], f, rcond=None)[0]
    square = (others**2).sum(axis=0)
    dependent = square < 1e-6 * (f**2).sum(axis=0)
    return np.where(dependent, 0.0, (others.T @ residual) ** 2 / np.where(dependent, 1.0, square))


def gaussian(
    mean: Vector,
    covariance: Matrix,
    group: Int[np.ndarray, " _"],
    at_mode: Matrix | None = None,
    draws: Matrix | None = None,
    effective: float = 0.0,
) -> Transport:
    """Return the linear map of a Gaussian, or a map with polynomials learnt from `draws`.

    Shared coordinates come first, then group by group. Coordinates with the largest conditional
    variance at the mode come first in a group: at the mode, these coordinates point along a curved
    valley, whereas draws have large variances across the valley as well.

    Args:
        mean: mean of x.
        covariance: covariance of x.
        group: group of each coordinate, -1 if shared.
        at_mode: covariance at the mode, that of the Gaussian by default.
        draws: draws from which the polynomials of groups are learnt.
        effective: number of independent draws that `draws` count as.
    """
    size, shared = len(mean), np.flatnonzero(group < 0)
    slope, root, order = np.zeros((size, 2 * size + 1)), np.zeros(size), np.zeros(0, int)
    factors = np.full((size, MOST_MONOMIALS + 1, 3), 2 * size)
    shift, scale = np.zeros((2, size, MOST_MONOMIALS + 1))
    for g in range(-1, int(group.max()) + 1):
        own, given = np.flatnonzero(group == g), shared if g >= 0 else shared[:0]
        if not len(own):
            continue
        mode = covariance if at_mode is None else at_mode
        own = own[np.argsort(-np.diag(_given(mode, own, given)[1]))]
        by_given, conditional = _given(covariance, own, given)
        lower = np.linalg.cholesky(conditional)
        at = np.arange(len(order), len(order) + len(own))
        order, root[at] = np.append(order, own), np.log(np.diag(lower))
        slope[np.ix_(at, own)], slope[np.ix_(at, size + given)] = lower, by_given.T
        if g >= 0 and draws is not None:
            about = draws - mean
            residual = about[:, own] - about[:, given] @ by_given
            w = np.linalg.solve(lower, residual.T).T
            of_group, shift[at], scale[at] = _monomials(w, effective)
            factors[at] = np.append(own, 2 * size)[of_group]
    return Transport(mean, Warp.none(size), order, slope, root, factors, shift, scale)


def _given(covariance: Matrix, own: np.ndarray, given: np.ndarray) -> tuple[Matrix, Matrix]:
    """Return the regression slopes of `own` on `given`, and the conditional covariance of `own`."""
    cross = covariance[np.ix_(given, own)]
    slope = np.linalg.solve(covariance[np.ix_(given, given)], cross)
    return slope, covariance[np.ix_(own, own)] - cross.T @ slope


def learnt(draws: Matrix, effective: float, covariance: Matrix, group: np.ndarray) -> Transport:
    """Return the map learnt from draws (draw, size), which count as `effective` independent ones.

    The covariance of the draws is averaged with the Laplace covariance, which has the weight of as
    many independent draws as there are coordinates.
    """
    some = draws[:: max(1, len(draws) // MOST_DRAWS)]
    size, mean = some.shape[1], some.mean(axis=0)
    both = (effective * np.cov((some - mean).T) + size * covariance) / (effective + size)
    found = gaussian(mean, both, group, covariance, some, effective)
    return replace(found, last=Warp.learnt(found.forward(some)))
