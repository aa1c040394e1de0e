"""Coordinates in which a posterior is nearly a standard Gaussian, learnt from draws of it.

A triangular map (Knothe-Rosenblatt) from coordinates x to u:

    shared ones       v = L^-1 (x - m - B s)
    those of a group  w = L^-1 (x - m - B s), widest first
                      v_i = (w_i - a_i(w_1 .. w_i-1, t)) exp(-b_i(w_1 .. w_i-1, t))

with polynomials a and b, s what coordinates before them say, t the part of it that plateaus of the
group say, and a sinh-arcsinh map (Jones and Pewsey 2009, Biometrika 96, eq. 2) of every coordinate
from v to u,

    sinh(tail arcsinh((v - place) / scale) - skew)

A coordinate says x - m; or, on a plateau, where x is the logarithm of a number of which data say no
more than that it is small, that number: x may then be anything far below, and those that follow
stay where they are (other plateaus of its stair follow the logarithm). Groups follow the shared
coordinates and are bent by themselves, so that groups that are independent given the shared ones
stay so. It is one of the maps of Marzouk et al. 2016 (Sampling via measure transport, section 3).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]
Leaf = Any
"""An array of numpy, or of jax where the map is computed with."""
FAR = 4.0
"""Polynomials stay what they are beyond this many stds."""
SQUARED = 5
CUBED = 3
"""Coordinates of a group, the widest first, that polynomials have squares and cubes of."""
MOST_DRAWS = 4000
WORTH = 3.0
"""Nats that a monomial must be worth."""
SKEW = -0.8
"""Coordinates with draws more skewed than this are taken for plateaus. A wrong guess costs pace."""
MOST_VALUE = 3.0
"""Numbers stay what they are beyond exp of this, in units of their median."""
MOST_MONOMIALS = 12
"""Of a coordinate's mean and std."""


@dataclass(frozen=True, eq=False)
class Bend:
    """Polynomials a and b of a group's coordinates.

    Attributes:
        factors: columns whose product each monomial is, from (w, told, 1) (monomial, 3), with told
            what plateaus say.
        shift, scale: coefficients of a and b (coordinate, monomial).
    """

    factors: Leaf
    shift: Leaf
    scale: Leaf

    def monomials(self, w: Matrix, told: Matrix) -> Matrix:
        """Products of columns (row, monomial)."""
        columns = np.clip(np.concatenate([w, told], axis=1), -FAR, FAR)
        columns = np.concatenate([columns, np.ones((len(w), 1))], axis=1)
        return np.asarray(columns[:, self.factors].prod(axis=2))

    def forward(self, w: Matrix, told: Matrix) -> Matrix:
        """From w to v."""
        f = self.monomials(w, told)
        return np.asarray((w - f @ self.shift.T) * np.exp(-f @ self.scale.T))

    @staticmethod
    def none(size: int, plateaus: int) -> "Bend":
        """Of nothing, with all monomials there can be."""
        one, values = size + plateaus, range(size, size + plateaus)
        factors = [(one, one, one)] + [(k, one, one) for k in range(one)]
        squared = [*values, *range(min(SQUARED, size - 1))]
        cubed = [*values, *range(min(CUBED, size - 1))]
        factors += [(*pair, one) for pair in combinations_with_replacement(squared, 2)]
        factors += [(k, k, k) for k in cubed]
        nothing = np.zeros((size, len(factors)))
        return Bend(np.array(factors), nothing, nothing.copy())

    @staticmethod
    def learnt(w: Matrix, told: Matrix, effective: float) -> "Bend":
        """Polynomials for draws that are worth so many independent ones."""
        size = w.shape[1]
        bend = Bend.none(size, told.shape[1])
        f = bend.monomials(w, told)
        reach = np.where(bend.factors >= size, -1, bend.factors).max(axis=1)
        for i in range(size):
            own = np.flatnonzero(reach < i)
            bend.shift[i, own], bend.scale[i, own] = _regression(f[:, own], w[:, i], effective)
        return bend


def _regression(f: Matrix, w: Vector, effective: float) -> tuple[Vector, Vector]:
    """Coefficients of the mean and of the log std of a Gaussian, most of them zero.

    Monomials are taken in one by one, that of the largest score statistic first, while one is worth
    more than `WORTH` nats to as many independent rows as these are.
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
        gains = np.stack(
            [
                0.50 * share * _scores(f * root[:, None], means, root * (w - f @ shift)),
                0.25 * share * _scores(f, spreads, excess),
            ]
        )
        which, best = np.unravel_index(np.argmax(gains), gains.shape)
        if gains[which, best] < WORTH:
            break
        (means, spreads)[which].append(int(best))
    return shift, scale


def _scores(f: Matrix, taken: list[int], left: Vector) -> Vector:
    """Square of what is left along each column, the part of those taken removed from it."""
    others = f - f[:, taken] @ np.linalg.lstsq(f[:, taken], f, rcond=None)[0]
    square = (others**2).sum(axis=0)
    known = square < 1e-6 * (f**2).sum(axis=0)
    return np.where(known, 0.0, (others.T @ left) ** 2 / np.where(known, 1.0, square))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Warp:
    """Sinh-arcsinh map of every coordinate."""

    place: Leaf
    scale: Leaf
    skew: Leaf
    tail: Leaf

    def forward(self, v: Matrix) -> Matrix:
        """From v to u."""
        return np.asarray(
            np.sinh(self.tail * np.arcsinh((v - self.place) / self.scale) - self.skew)
        )

    def back(self, u: Any) -> Any:
        """From u to v."""
        return self.place + self.scale * jnp.sinh((jnp.arcsinh(u) + self.skew) / self.tail)

    def log_slope(self, u: Any) -> Any:
        """Log dv/du of every coordinate."""
        xp = u.__array_namespace__()
        inner = xp.abs((xp.asinh(u) + self.skew) / self.tail)
        cosh = inner + xp.log1p(xp.exp(-2 * inner)) - np.log(2)  # without overflow
        return xp.log(self.scale / self.tail) + cosh - 0.5 * xp.log1p(u**2)

    @staticmethod
    def none(size: int) -> "Warp":
        one, zero = np.ones(size), np.zeros(size)
        return Warp(zero, one, zero, one)

    @staticmethod
    def learnt(draws: Matrix) -> "Warp":
        """Maximum likelihood, column by column."""
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
class Stair:
    """Some coordinates, after those they follow.

    Attributes:
        own, given: places.
        slope: of own ones by what given ones say (given, own).
        root: Cholesky factor of the covariance of what is left.
        bend: of it; None for shared coordinates.
        plateaus: places of those of its group among the given, whose numbers bend it.
    """

    own: Leaf
    given: Leaf
    slope: Leaf
    root: Leaf
    bend: Bend | None
    plateaus: Leaf

    def left(self, about: Matrix, said: Matrix) -> Matrix:
        """What others do not say of own coordinates, by the root; from all less their means."""
        left = about[:, self.own] - said[:, self.given] @ self.slope
        return np.asarray(np.linalg.solve(self.root, left.T).T)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Values:
    """What coordinates say to those that follow: themselves, or numbers they are logarithms of.

    Attributes:
        plateau: 1 where it is the number; these have a stair of their own, which the others of
            their kind and group follow.
        middle: median of each, less its mean.
        mean, std: of the number, in units of its median.
    """

    plateau: Leaf
    middle: Leaf
    mean: Leaf
    std: Leaf

    def said(self, about: Any) -> Any:
        """From all less their means."""
        xp = about.__array_namespace__()
        value = (xp.exp(xp.clip(about - self.middle, None, MOST_VALUE)) - self.mean) / self.std
        return xp.where(self.plateau > 0, value, about)

    def slope(self) -> Vector:
        """Of what is said, in the middle."""
        return np.where(self.plateau > 0, 1.0 / self.std, 1.0)

    @staticmethod
    def none(size: int) -> "Values":
        zero = np.zeros(size)
        return Values(zero, zero, zero, zero + 1.0)

    @staticmethod
    def learnt(about: Matrix) -> "Values":
        """From draws less their means: plateaus are where the way down is long."""
        skew = (about**3).mean(axis=0) / about.std(axis=0) ** 3
        middle = np.median(about, axis=0)
        value = np.exp(np.minimum(about - middle, MOST_VALUE))
        return Values((skew < SKEW) * 1.0, middle, value.mean(axis=0), value.std(axis=0))


@dataclass(frozen=True, eq=False)
class Transport:
    """The whole map, of vectors x (row, size) to and from u (row, size).

    Attributes:
        mean: of x.
        values: what coordinates say to those that follow.
        stairs: from x to v; every coordinate is in one.
        last: from v to u.
    """

    mean: Leaf
    values: Values
    stairs: tuple[Stair, ...]
    last: Warp

    def forward(self, x: Matrix) -> Matrix:
        """From x to u."""
        about = x - self.mean
        said, v = self.values.said(about), np.empty_like(about)
        for s in self.stairs:
            w = s.left(about, said)
            v[:, s.own] = s.bend.forward(w, said[:, s.plateaus]) if s.bend else w
        return self.last.forward(v)

    def placed(self, u: Matrix) -> tuple[Matrix, Matrix]:
        """x, and the part of log |dx/du| of every coordinate (row, size)."""
        x, log = _placed(self._back, u)
        return np.array(x), np.array(log)

    def pull(self, u: Matrix, slope: Callable[[Matrix], Matrix]) -> Matrix:
        """Derivative by u of what has the derivative slope(x) by x, plus that of log |dx/du|."""
        return np.array(_pulled(self._back, u, slope(self.placed(u)[0])))

    @cached_property
    def _back(self) -> "Steps":
        """The way back, where it is computed with."""
        with jax.ensure_compile_time_eval():  # kept, so never a tracer's
            there: Steps = jax.device_put(_steps(self))
        return there


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Steps:
    """The way from u to x, a coordinate at a time, in arrays whose shapes nothing learnt changes.

    So that XLA compiles it once: stairs, plateaus and monomials are others after every look at the
    draws. With columns of all w, of all that is said, zeros until their turn, and of ones:

        w_i = f_i . shift_i + exp(f_i . scale_i) v_i,   x_i - m_i = columns . slope_i

    Attributes:
        mean, values, last: of the map.
        order: of the coordinates.
        slope: of each step by the columns (step, 2 size + 1).
        root: log dx/dw.
        factors: columns whose product each monomial f is (step, term, 3).
        shift, scale: their coefficients (step, term).
    """

    mean: Leaf
    values: Values
    last: Warp
    order: Leaf
    slope: Leaf
    root: Leaf
    factors: Leaf
    shift: Leaf
    scale: Leaf


def _steps(map: Transport) -> Steps:
    size = len(map.mean)
    slope, root = np.zeros((size, 2 * size + 1)), np.zeros(size)
    factors = np.full((size, MOST_MONOMIALS + 1, 3), 2 * size)
    shift, scale = np.zeros((2, size, MOST_MONOMIALS + 1))
    k = 0
    for s in map.stairs:
        columns = np.concatenate([s.own, size + np.asarray(s.plateaus, int), [2 * size]])
        for i in range(len(s.own)):
            slope[k, s.own], slope[k, size + s.given] = s.root[i], s.slope[:, i]
            root[k] = np.log(s.root[i, i])
            if s.bend:
                own = np.flatnonzero((s.bend.shift[i] != 0) | (s.bend.scale[i] != 0))
                factors[k, : len(own)] = columns[s.bend.factors[own]]
                shift[k, : len(own)] = s.bend.shift[i, own]
                scale[k, : len(own)] = s.bend.scale[i, own]
            k += 1
    order = np.concatenate([s.own for s in map.stairs])
    return Steps(map.mean, map.values, map.last, order, slope, root, factors, shift, scale)


@jax.jit
def _placed(map: Steps, u: Array) -> tuple[Array, Array]:
    rows, size = u.shape
    v = map.last.back(u)

    def step(columns: Array, s: Any) -> Any:
        i, slope, root, factors, shift, scale, values = s
        f = jnp.clip(columns[:, factors], -FAR, FAR).prod(axis=2)
        spread = f @ scale
        columns = columns.at[:, i].set(f @ shift + jnp.exp(spread) * v[:, i])
        about = columns @ slope
        return columns.at[:, size + i].set(values.said(about)), (about, spread + root)

    start = jnp.zeros((rows, 2 * size + 1)).at[:, -1].set(1.0)
    values = jax.tree.map(lambda x: x[map.order], map.values)
    steps = (map.order, map.slope, map.root, map.factors, map.shift, map.scale, values)
    _, (about, log) = jax.lax.scan(step, start, steps)
    there = jnp.zeros_like(u).at[:, map.order].set(about.T)
    return map.mean + there, map.last.log_slope(u).at[:, map.order].add(log.T)


@jax.jit
def _pulled(map: Steps, u: Array, slope: Array) -> Array:
    (_, log), back = jax.vjp(lambda u: _placed(map, u), u)
    (out,) = back((slope, jnp.ones_like(log)))
    return jnp.asarray(out)


def gaussian(mean: Vector, covariance: Matrix, group: np.ndarray, kind: np.ndarray) -> Transport:
    """Map of a Gaussian.

    Args:
        group: of each coordinate, -1 where groups share it.
        kind: of each coordinate; of a group's, those of a higher kind follow those of lower ones.
    """
    values = Values.none(len(mean))
    stairs = _stairs(np.tile(covariance, (2, 2)), group, kind, values, covariance)
    return Transport(mean, values, stairs, Warp.none(len(mean)))


def _order(
    group: np.ndarray, kind: np.ndarray, values: Values
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Coordinates of every stair, and those before it that they are given."""
    plateau, found = values.plateau > 0, []
    for g in range(-1, int(group.max()) + 1):
        before = np.flatnonzero(group < 0) if g >= 0 else np.zeros(0, int)
        for k in np.unique(kind):
            for first in (True, False):
                own = np.flatnonzero((group == g) & (kind == k) & (plateau == first))
                if len(own):
                    found.append((own, before))
                    before = np.concatenate([before, own])
    return found


def _stairs(
    covariance: Matrix, group: np.ndarray, kind: np.ndarray, values: Values, at_mode: Matrix
) -> tuple[Stair, ...]:
    """Of a Gaussian; the coordinates that are widest at the mode come first in a stair.

    A valley has its direction at the mode, where draws are as wide across as they are bent.

    Args:
        covariance: of all coordinates, and of what they say after them.
    """
    stairs = []
    for own, given in _order(group, kind, values):
        own = own[np.argsort(-np.diag(_given(at_mode, own, given)[1]))]
        slope, left = _given(covariance, own, given + len(group))
        plateaus = given[(values.plateau[given] > 0) & (group[given] >= 0)]
        bend = Bend.none(len(own), len(plateaus)) if group[own[0]] >= 0 else None
        stairs.append(Stair(own, given, slope, np.linalg.cholesky(left), bend, plateaus))
    return tuple(stairs)


def _given(covariance: Matrix, own: np.ndarray, given: np.ndarray) -> tuple[Matrix, Matrix]:
    """Slope of own coordinates by given ones, and the covariance of what is left."""
    cross = covariance[np.ix_(given, own)]
    slope = np.linalg.solve(covariance[np.ix_(given, given)], cross)
    return slope, covariance[np.ix_(own, own)] - cross.T @ slope


def learnt(
    draws: Matrix, effective: float, covariance: Matrix, group: np.ndarray, kind: np.ndarray
) -> Transport:
    """Map learnt from draws.

    Args:
        draws: (draw, size).
        effective: number of independent ones that they are worth, about.
        covariance: Laplace; counts as many draws as there are coordinates.
    """
    some = draws[:: max(1, len(draws) // MOST_DRAWS)]
    size, mean = some.shape[1], some.mean(axis=0)
    about = some - mean
    values = Values.learnt(about)
    said = values.said(about)
    steps = np.concatenate([np.ones(size), values.slope()])
    at_mode = np.tile(covariance, (2, 2)) * np.outer(steps, steps)
    both = effective * np.cov(np.concatenate([about, said], axis=1).T) + size * at_mode
    stairs = tuple(
        replace(s, bend=Bend.learnt(s.left(about, said), said[:, s.plateaus], effective))
        if s.bend
        else s
        for s in _stairs(both / (effective + size), group, kind, values, covariance)
    )
    found = Transport(mean, values, stairs, Warp.none(size))
    return replace(found, last=Warp.learnt(found.forward(some)))
