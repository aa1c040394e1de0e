"""Plateaus: logarithms of numbers of which data say no more than that they are small."""

from dataclasses import dataclass

import jax
import numpy as np

from slipid.identify.posterior.transport.arrays import A, Leaf, Matrix, Vector

SKEW = -0.8
"""Coordinates with draws more skewed than this are taken for plateaus; a wrong guess costs pace."""
MOST_VALUE = 3.0
"""Numbers stay what they are beyond exp of this, in units of their median."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Values:
    """What coordinates say to those that follow: themselves, or numbers they are logarithms of.

    Attributes:
        plateau: 1 where it is the number; these have a stair of their own, which the others of
            their kind and group follow.
        middle: median of each coordinate, less its mean.
        mean, std: mean and std of the number, in units of its median.
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
