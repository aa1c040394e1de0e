"""Sinh-arcsinh map of single coordinates (Jones and Pewsey 2009, Biometrika 96, eq. 2)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.optimize import minimize

from slipid.identify.posterior.transport.arrays import A, Leaf, Matrix, Vector


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Warp:
    """Sinh-arcsinh map of every coordinate.

    Attributes:
        place, scale: where its middle lies and how wide it is.
        skew, tail: how far it leans and how light its tails are; 0 and 1 for a straight line.
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
