"""Transport map: coordinates in which a posterior is nearly a standard Gaussian, learnt from draws.

It is a triangular map (Knothe-Rosenblatt) from coordinates x to u, through v:

    shared coordinates      v = L^-1 (x - m)
    coordinates of a group  w = L^-1 (x - m - B s), those with the largest variance first
                            v_i = (w_i - a_i(w_1 .. w_i-1)) exp(-b_i(w_1 .. w_i-1))

with the mean m, Cholesky factors L of (conditional) covariances, regression coefficients B on the
shared coordinates, s the shared part of x - m, and polynomials a and b. A sinh-arcsinh map (Jones
and Pewsey 2009, Biometrika 96, eq. 2) leads from v to u, coordinate by coordinate:

    sinh(tail arcsinh((v - place) / scale) - skew)

The map of a group depends on the shared coordinates and on the group itself only, so that groups
that are independent given the shared coordinates remain independent. It is one of the maps of
Marzouk et al. 2016 (Sampling via measure transport, section 3).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.optimize import minimize

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]
Leaf = Array | np.ndarray
"""A NumPy array while a map is learnt, a JAX array in the inverse map."""
A = TypeVar("A", Array, np.ndarray)
"""Either kind of array; the result has the kind of the argument."""
FAR = 4.0
"""Size of a whitened coordinate w beyond which polynomials are constant [std]."""
SQUARED = 5
"""Number of coordinates of a group, with the largest variances, whose squares and products are
monomials."""
CUBED = 3
"""Number of coordinates of a group, with the largest variances, whose cubes are monomials."""
WORTH = 3.0
"""Smallest gain in log likelihood for which a monomial is included [nat]."""
MOST_MONOMIALS = 12
"""Largest number of monomials added for a coordinate, in its mean and log std together."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Warp:
    """Sinh-arcsinh map of every coordinate; skew 0 and tail 1 make it linear.

    Attributes:
        place: location.
        scale: width.
        skew: asymmetry.
        tail: lightness of the tails.
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

    def log_slope(self, u: A) -> A:
        """Return log dv/du of every coordinate."""
        xp = u.__array_namespace__()
        inner = xp.abs((xp.asinh(u) + self.skew) / self.tail)
        cosh = inner + xp.log1p(xp.exp(-2 * inner)) - np.log(2)  # without overflow
        return xp.log(self.scale / self.tail) + cosh - 0.5 * xp.log1p(u**2)

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


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Polynomials a and b of a group's coordinates.

    Attributes:
        factors: indices of the three columns of (w, 1) whose product is the monomial.
        shift: coefficients of a, by coordinate and monomial.
        scale: coefficients of b.
    """

    factors: Int[np.ndarray, "monomial 3"]
    shift: Float[np.ndarray, "coordinate monomial"]
    scale: Float[np.ndarray, "coordinate monomial"]

    def monomials(self, w: Matrix) -> Matrix:
        """Return the values of the monomials (row, monomial)."""
        columns = np.concatenate([np.clip(w, -FAR, FAR), np.ones((len(w), 1))], axis=1)
        return np.asarray(columns[:, self.factors].prod(axis=2))

    def forward(self, w: Matrix) -> Matrix:
        """Return the coordinates v of w."""
        f = self.monomials(w)
        return np.asarray((w - f @ self.shift.T) * np.exp(-f @ self.scale.T))

    @staticmethod
    def none(size: int) -> "Polynomials":
        """Return polynomials that are zero, with all possible monomials."""
        one = size  # the column of ones
        factors = [(one, one, one)] + [(k, one, one) for k in range(size)]
        squared, cubed = range(min(SQUARED, size - 1)), range(min(CUBED, size - 1))
        factors += [(*pair, one) for pair in combinations_with_replacement(squared, 2)]
        factors += [(k, k, k) for k in cubed]
        nothing = np.zeros((size, len(factors)))
        return Polynomials(np.array(factors), nothing, nothing.copy())

    @staticmethod
    def learnt(w: Matrix, effective: float) -> "Polynomials":
        """Return polynomials fitted to draws that count as `effective` independent ones."""
        size = w.shape[1]
        bend = Polynomials.none(size)
        f = bend.monomials(w)
        reach = np.where(bend.factors >= size, -1, bend.factors).max(axis=1)
        for i in range(size):
            own = np.flatnonzero(reach < i)
            bend.shift[i, own], bend.scale[i, own] = _regression(f[:, own], w[:, i], effective)
        return bend


def _regression(f: Matrix, w: Vector, effective: float) -> tuple[Vector, Vector]:
    """Return coefficients of the mean and of the log std of w given monomials f, most of them zero.

    Monomials are included one by one, in order of their score statistics, as long as the next one
    gains more than `WORTH` nats for `effective` independent rows.
    """
    shift, scale, means, spreads = np.zeros(f.shape[1]), np.zeros(f.shape[1]), [0], [0]
    share = effective / len(w)
    for _ in range(MOST_MONOMIALS):
        for _ in range(6):
            weight = np.exp(-2 * f @ scale)
            by = f[:, means].T * weight
            shift[means] = np.linalg.solve(by @ f[:, means], by @ w)
            excess = (w - f @ shift) ** 2 * weight - 1
            # Fisher's information of a log std is 2
            of = f[:, spreads]
            step = np.linalg.solve(2 * of.T @ of, of.T @ excess)
            scale[spreads] += step * min(1.0, 1.0 / (np.abs(of @ step).max() + 1e-9))
        root = np.sqrt(weight)
        of_mean = _scores(f * root[:, None], means, root * (w - f @ shift))
        gains = share * np.stack([0.5 * of_mean, 0.25 * _scores(f, spreads, excess)])
        which, best = np.unravel_index(np.argmax(gains), gains.shape)
        if gains[which, best] < WORTH:
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


MOST_DRAWS = 4000
"""Largest number of draws that a map is learnt from."""


@dataclass(frozen=True, eq=False)
class Stage:
    """Map of the shared coordinates, or of a group's coordinates given the shared ones.

    Attributes:
        own: indices of the mapped coordinates.
        given: indices of the coordinates that they depend on.
        slope: B, regression coefficients of the mapped coordinates on the given ones.
        root: Cholesky factor of the conditional covariance.
        bend: polynomials of the whitened residuals, None for shared coordinates.
    """

    own: Int[np.ndarray, " own"]
    given: Int[np.ndarray, " given"]
    slope: Float[np.ndarray, "given own"]
    root: Float[np.ndarray, "own own"]
    bend: Polynomials | None

    def whitened(self, about: Matrix) -> Matrix:
        """Return the whitened coordinates w of this stage, from all coordinates of x - m."""
        residual = about[:, self.own] - about[:, self.given] @ self.slope
        return np.asarray(np.linalg.solve(self.root, residual.T).T)


@dataclass(frozen=True, eq=False)
class Transport:
    """Map of vectors x (row, size) to u (row, size), and its inverse.

    Attributes:
        mean: m, mean of x.
        stages: maps from x to v; each coordinate is in one of them.
        last: map from v to u.
    """

    mean: Vector
    stages: tuple[Stage, ...]
    last: Warp

    def forward(self, x: Matrix) -> Matrix:
        """Return the coordinates u of x."""
        about = x - self.mean
        v = np.empty_like(about)
        for s in self.stages:
            w = s.whitened(about)
            v[:, s.own] = s.bend.forward(w) if s.bend else w
        return self.last.forward(v)

    def placed(self, u: Matrix) -> tuple[Matrix, Matrix]:
        """Return the coordinates x of u, and log |dx/du| as a sum over coordinates (row, size)."""
        x, log = _placed(self._back, u)
        return np.array(x), np.array(log)

    def pulled_back(self, u: Matrix, slope: Callable[[Matrix], Matrix]) -> Matrix:
        """Return the gradient by u of log |dx/du| + f(x), given the gradient `slope` of f."""
        return np.array(_pulled(self._back, u, slope(self.placed(u)[0])))

    @cached_property
    def _back(self) -> "InverseSteps":
        with jax.ensure_compile_time_eval():  # a cached property must not contain tracers
            return _steps(self)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class InverseSteps:
    """Inverse map from u to x, one coordinate per step, in arrays of fixed shapes.

    Because of the fixed shapes XLA compiles it once, although stages and monomials differ between
    maps. Steps work on a matrix with the columns of all w, of all x - m, which are zero until their
    step, and a column of ones:

        w_i = f_i . shift_i + exp(f_i . scale_i) v_i,   x_i - m_i = columns . slope_i

    Attributes:
        mean: m, mean of x.
        last: map from v to u.
        order: index of each step's coordinate.
        slope: weights of the columns in x_i - m_i.
        root: log dx_i / dw_i of each step.
        factors: columns whose product is each monomial (step, term, 3).
        shift: coefficients of the mean of w_i.
        scale: coefficients of the log std of w_i.
    """

    mean: Array
    last: Warp
    order: Array
    slope: Array
    root: Array
    factors: Array
    shift: Array
    scale: Array


def _steps(map: Transport) -> InverseSteps:
    size = len(map.mean)
    slope, root = np.zeros((size, 2 * size + 1)), np.zeros(size)
    factors = np.full((size, MOST_MONOMIALS + 1, 3), 2 * size)
    shift, scale = np.zeros((2, size, MOST_MONOMIALS + 1))
    k = 0
    for s in map.stages:
        columns = np.append(s.own, 2 * size)
        for i in range(len(s.own)):
            slope[k, s.own], slope[k, size + s.given] = s.root[i], s.slope[:, i]
            root[k] = np.log(s.root[i, i])
            if s.bend:
                own = np.flatnonzero((s.bend.shift[i] != 0) | (s.bend.scale[i] != 0))
                factors[k, : len(own)] = columns[s.bend.factors[own]]
                shift[k, : len(own)] = s.bend.shift[i, own]
                scale[k, : len(own)] = s.bend.scale[i, own]
            k += 1
    order = np.concatenate([s.own for s in map.stages])
    # copied to the device once, not in every call
    arrays = (map.mean, map.last, order, slope, root, factors, shift, scale)
    return InverseSteps(*jax.device_put(arrays))


_Step = tuple[Array, Array, Array, Array, Array, Array]
"""One step of `InverseSteps`: order, slope, root, factors, shift, scale."""


@jax.jit
def _placed(map: InverseSteps, u: Array) -> tuple[Array, Array]:
    rows, size = u.shape
    v = map.last.back(u)

    def step(columns: Array, s: _Step) -> tuple[Array, tuple[Array, Array]]:
        i, slope, root, factors, shift, scale = s
        f = jnp.clip(columns[:, factors], -FAR, FAR).prod(axis=2)
        spread = f @ scale
        columns = columns.at[:, i].set(f @ shift + jnp.exp(spread) * v[:, i])
        about = columns @ slope
        return columns.at[:, size + i].set(about), (about, spread + root)

    start = jnp.zeros((rows, 2 * size + 1)).at[:, -1].set(1.0)
    steps = (map.order, map.slope, map.root, map.factors, map.shift, map.scale)
    _, (about, log) = jax.lax.scan(step, start, steps)
    there = jnp.zeros_like(u).at[:, map.order].set(about.T)
    return map.mean + there, map.last.log_slope(u).at[:, map.order].add(log.T)


@jax.jit
def _pulled(map: InverseSteps, u: Array, slope: Array) -> Array:
    (_, log), back = jax.vjp(lambda u: _placed(map, u), u)
    (out,) = back((slope, jnp.ones_like(log)))
    return jnp.asarray(out)


def gaussian(mean: Vector, covariance: Matrix, group: np.ndarray) -> Transport:
    """Return the linear map of a Gaussian; `group` holds each coordinate's group, -1 if shared."""
    return Transport(mean, _stages(covariance, group, covariance), Warp.none(len(mean)))


def _stages(covariance: Matrix, group: np.ndarray, at_mode: Matrix) -> tuple[Stage, ...]:
    """Return the stages of a Gaussian, shared coordinates first, then group by group.

    Coordinates with the largest conditional variance at the mode come first in a stage: at the mode
    these are the ones along a curved valley, whereas draws have large variances across it as well.
    """
    stages, shared = [], np.flatnonzero(group < 0)
    for g in range(-1, int(group.max()) + 1):
        own, given = np.flatnonzero(group == g), shared if g >= 0 else shared[:0]
        if not len(own):
            continue
        own = own[np.argsort(-np.diag(_given(at_mode, own, given)[1]))]
        slope, conditional = _given(covariance, own, given)
        bend = Polynomials.none(len(own)) if g >= 0 else None
        stages.append(Stage(own, given, slope, np.linalg.cholesky(conditional), bend))
    return tuple(stages)


def _given(covariance: Matrix, own: np.ndarray, given: np.ndarray) -> tuple[Matrix, Matrix]:
    """Return the slope of own coordinates by given ones, and their conditional covariance."""
    cross = covariance[np.ix_(given, own)]
    slope = np.linalg.solve(covariance[np.ix_(given, given)], cross)
    return slope, covariance[np.ix_(own, own)] - cross.T @ slope


def learnt(draws: Matrix, effective: float, covariance: Matrix, group: np.ndarray) -> Transport:
    """Return the map learnt from draws (draw, size), which count as `effective` independent ones.

    The Laplace covariance is averaged in, with the weight of as many draws as there are
    coordinates.
    """
    some = draws[:: max(1, len(draws) // MOST_DRAWS)]
    size, mean = some.shape[1], some.mean(axis=0)
    about, stages = some - mean, []
    both = (effective * np.cov(about.T) + size * covariance) / (effective + size)
    for s in _stages(both, group, covariance):
        bend = Polynomials.learnt(s.whitened(about), effective) if s.bend else None
        stages.append(replace(s, bend=bend))
    found = Transport(mean, tuple(stages), Warp.none(size))
    return replace(found, last=Warp.learnt(found.forward(some)))
