"""Swapped or reversed wheels, found by comparing how they move with how they should."""

from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_DOUBT = 0.05
"""Relative misfit from which the declared order is doubted; speed loops keep below it."""
_BETTER = 0.25
"""Another order must have less than this share of the declared one's misfit to be believed."""


class WheelOrder(NamedTuple):
    """The order and signs of wheels that fit best, beside the declared ones.

    Attributes:
        order: position at which the motion of each wheel is found, from 0.
        signs: +1, or -1 where it counts backwards.
        misfit: sum of squares that this order leaves over, relative to the reference's.
        misfit_as_declared: the same for the order in the log.
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    misfit: float
    misfit_as_declared: float

    @property
    def is_swapped(self) -> bool:
        """Whether the declared order is wrong beyond doubt."""
        return self.misfit_as_declared > _DOUBT and self.misfit < _BETTER * self.misfit_as_declared


def best_wheel_order(
    measured: Float[np.ndarray, "time wheel"],
    reference: Float[np.ndarray, "time wheel"],
) -> WheelOrder:
    """Order and signs of the wheels in which the measured steps come closest to the reference.

        misfit = sum_i |m_order(i) sign_i - ref_i|^2 / sum_i |ref_i|^2

    Only the products of every pair enter, so that all orders of six wheels cost nothing. Steps are
    in any measure of wheel motion, such as the angle turned.
    """
    products = measured.T @ reference
    norm, reference_norm = float(np.sum(measured**2)), float(np.sum(reference**2))
    wheels = range(products.shape[0])
    if not norm > 0 or not reference_norm > 0:
        return WheelOrder(tuple(wheels), (1,) * len(wheels), 0.0, 0.0)

    def misfit(along: float) -> float:
        return norm / reference_norm - 2.0 * along / reference_norm + 1.0

    best = max(permutations(wheels), key=lambda p: float(np.abs(products[p, wheels]).sum()))
    along = products[best, wheels]
    return WheelOrder(
        order=best,
        signs=tuple(-1 if value < 0 else 1 for value in along),
        misfit=misfit(float(np.abs(along).sum())),
        misfit_as_declared=misfit(float(np.trace(products))),
    )


def describe(found: WheelOrder) -> str:
    """Order and signs as people write them, wheels counted from 1: `3, -1, 2`."""
    pairs = zip(found.order, found.signs, strict=True)
    return ", ".join(f"{'-' if sign < 0 else ''}{wheel + 1}" for wheel, sign in pairs)
