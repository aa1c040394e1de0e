"""What is done to every coordinate by itself: plateaus, sinh-arcsinh warps, types of arrays.

Plateaus are logarithms of numbers of which data say no more than that they are small.
"""

from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]
Leaf = Array | np.ndarray
"""An array of numpy while a map is learnt, of jax where the way back is computed."""
A = TypeVar("A", Array, np.ndarray)
"""Either of them; what comes out is what went in."""
SKEW = -0.8
"""Coordinates with draws more skewed than this are taken for plateaus; a wrong guess costs pace."""
MOST_VALUE = 3.0
"""Numbers stay what they are beyond exp of this, in units of their median."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Values:
    """What coordinates say to those that follow: themselves, or numbers they are logarithms of.

    Plateau is 1 where it is the number; these have a stair of their own, which the others of their
    kind and group follow. The middle is the median less the mean; mean and std are of the number,
    in units of its median.
    """

    plateau: Leaf
    middle: Leaf
    mean: Leaf
    std: Leaf

    def said(self, about: A) -> A:
        """What coordinates say, from all of them less their means."""
        xp = about.__array_namespace__()
        value = (xp.exp(xp.clip(about - self.middle, None, MOST_VALUE)) - self.mean) / self.std
        return xp.where(self.plateau > 0, value, about)

    def slope(self) -> Vector:
        """Derivative of what is said by the coordinate, in the middle."""
        return np.where(self.plateau > 0, 1.0 / self.std, 1.0)

    @staticmethod
    def none(size: int) -> "Values":
        """Coordinates none of which is on a plateau."""
        zero = np.zeros(size)
        return Values(zero, zero, zero, zero + 1.0)

    @staticmethod
    def learnt(about: Matrix) -> "Values":
        """Plateaus of draws less their means: they are where the way down is long."""
        skew = (about**3).mean(axis=0) / about.std(axis=0) ** 3
        middle = np.median(about, axis=0)
        value = np.exp(np.minimum(about - middle, MOST_VALUE))
        return Values((skew < SKEW) * 1.0, middle, value.mean(axis=0), value.std(axis=0))


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
