"""What a transport map is made of: warps of single coordinates, bends by others."""

from dataclasses import dataclass
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
"""An array of numpy while a map is learnt, of jax where the way back is computed."""
A = TypeVar("A", Array, np.ndarray)
"""Either of them; what comes out is what went in."""
FAR = 4.0
"""Polynomials stay what they are beyond this many stds."""
SQUARED = 5
"""Coordinates of a group, the widest first, whose squares and products are monomials."""
CUBED = 3
"""Coordinates of a group, the widest first, whose cubes are monomials."""
WORTH = 3.0
"""Gain in log likelihood [nats] that a monomial must bring to be taken in."""
MOST_MONOMIALS = 12
"""Largest number of monomials in the mean and in the log std of a coordinate."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Warp:
    """Sinh-arcsinh map of every coordinate: middle, width, lean (skew), lightness of tails.

    Skew 0 and tail 1 make a straight line.
    """

    place: Leaf
    scale: Leaf
    skew: Leaf
    tail: Leaf

    def forward(self, v: Matrix) -> Matrix:
        """The way from v to u."""
        inner = self.tail * np.arcsinh((v - self.place) / self.scale)
        return np.asarray(np.sinh(inner - self.skew))

    def back(self, u: Leaf) -> Array:
        """The way from u to v."""
        inner = (jnp.arcsinh(u) + self.skew) / self.tail
        return jnp.asarray(self.place + self.scale * jnp.sinh(inner))

    def log_slope(self, u: A) -> A:
        """Log dv/du of every coordinate."""
        xp = u.__array_namespace__()
        inner = xp.abs((xp.asinh(u) + self.skew) / self.tail)
        cosh = inner + xp.log1p(xp.exp(-2 * inner)) - np.log(2)  # without overflow
        return xp.log(self.scale / self.tail) + cosh - 0.5 * xp.log1p(u**2)

    @staticmethod
    def none(size: int) -> "Warp":
        """A map that changes nothing."""
        one, zero = np.ones(size), np.zeros(size)
        return Warp(zero, one, zero, one)

    @staticmethod
    def learnt(draws: Matrix) -> "Warp":
        """Map by maximum likelihood, column by column."""
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
class Bend:
    """Polynomials a (shift) and b (scale) of a group's coordinates.

    Factors are the columns whose product each monomial is, from (w, 1).
    """

    factors: Int[np.ndarray, "monomial 3"]
    shift: Float[np.ndarray, "coordinate monomial"]
    scale: Float[np.ndarray, "coordinate monomial"]

    def monomials(self, w: Matrix) -> Matrix:
        """Products of columns (row, monomial)."""
        columns = np.concatenate([np.clip(w, -FAR, FAR), np.ones((len(w), 1))], axis=1)
        return np.asarray(columns[:, self.factors].prod(axis=2))

    def forward(self, w: Matrix) -> Matrix:
        """The way from w to v."""
        f = self.monomials(w)
        return np.asarray((w - f @ self.shift.T) * np.exp(-f @ self.scale.T))

    @staticmethod
    def none(size: int) -> "Bend":
        """No bend, with all monomials that there can be."""
        one = size  # the column of ones
        factors = [(one, one, one)] + [(k, one, one) for k in range(size)]
        squared, cubed = range(min(SQUARED, size - 1)), range(min(CUBED, size - 1))
        factors += [(*pair, one) for pair in combinations_with_replacement(squared, 2)]
        factors += [(k, k, k) for k in cubed]
        nothing = np.zeros((size, len(factors)))
        return Bend(np.array(factors), nothing, nothing.copy())

    @staticmethod
    def learnt(w: Matrix, effective: float) -> "Bend":
        """Polynomials for draws that are worth so many independent ones."""
        size = w.shape[1]
        bend = Bend.none(size)
        f = bend.monomials(w)
        reach = np.where(bend.factors >= size, -1, bend.factors).max(axis=1)
        for i in range(size):
            own = np.flatnonzero(reach < i)
            bend.shift[i, own], bend.scale[i, own] = _regression(f[:, own], w[:, i], effective)
        return bend


def _regression(f: Matrix, w: Vector, effective: float) -> tuple[Vector, Vector]:
    """Coefficients of the mean and of the log std of a Gaussian, most of them zero.

    Monomials are taken in one by one, the one with the largest score statistic first, as long as
    one is worth more than `WORTH` nats to so many independent rows.
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


def _scores(f: Matrix, taken: list[int], left: Vector) -> Vector:
    """Squared length of what is left along each column, less what columns taken say of it."""
    others = f - f[:, taken] @ np.linalg.lstsq(f[:, taken], f, rcond=None)[0]
    square = (others**2).sum(axis=0)
    known = square < 1e-6 * (f**2).sum(axis=0)
    return np.where(known, 0.0, (others.T @ left) ** 2 / np.where(known, 1.0, square))
