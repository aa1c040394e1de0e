"""Swapped or reversed wheels, found by comparing measured wheel motion with what it should be."""

from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log, bad_data
from slipid.data.signal import interpolate

_DOUBT, _DOUBT_OF_POSE = 0.05, 0.3
"""Relative misfit from which the declared order is doubted. Speed loops keep below the first; what
a slipping robot's pose says of its wheels may be off by the second."""
_BETTER = 0.25
"""Another order must have less than this share of the declared one's misfit to be believed."""


class WheelOrder(NamedTuple):
    """The order and signs of wheels that fit best, beside the declared ones.

    Attributes:
        order: for each wheel, the position its motion is found at, from 0.
        signs: +1, or -1 where it counts backwards.
        misfit: of this order, sum of squares relative to the reference's.
        misfit_as_declared: of the order in the log.
        doubt: misfit from which the declared order is doubted.
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    misfit: float
    misfit_as_declared: float
    doubt: float = _DOUBT

    @property
    def is_swapped(self) -> bool:
        """Whether the declared order is wrong beyond doubt."""
        doubtful = self.misfit_as_declared > self.doubt
        return doubtful and self.misfit < _BETTER * self.misfit_as_declared


def best_wheel_order(
    measured: Float[np.ndarray, "time wheel"],
    reference: Float[np.ndarray, "time wheel"],
    *,
    fit_gain: bool = False,
) -> WheelOrder:
    """Order and signs of the wheels in which the measured steps come closest to the reference.

        misfit = sum_i |m_order(i) sign_i - g ref_i|^2 / sum_i |g ref_i|^2

    Only the products of every pair enter, so that all orders of six wheels cost nothing.

    Args:
        measured: any measure of wheel motion, such as the angle turned in a step.
        reference: the same for where the wheels should have gone.
        fit_gain: fit g instead of 1, where the reference is known up to a factor (slip, scale).
    """
    products = measured.T @ reference
    norm, reference_norm = float(np.sum(measured**2)), float(np.sum(reference**2))
    wheels = range(products.shape[0])
    if not norm > 0 or not reference_norm > 0:
        return WheelOrder(tuple(wheels), (1,) * len(wheels), 0.0, 0.0)

    def misfit(along: float) -> float:
        gain = norm / along if fit_gain and along > 0 else 1.0
        return norm / (gain**2 * reference_norm) - 2.0 * along / (gain * reference_norm) + 1.0

    best = max(permutations(wheels), key=lambda p: float(np.abs(products[p, wheels]).sum()))
    along = products[best, wheels]
    return WheelOrder(
        order=best,
        signs=tuple(-1 if value < 0 else 1 for value in along),
        misfit=misfit(float(np.abs(along).sum())),
        misfit_as_declared=misfit(float(np.trace(products))),
        doubt=_DOUBT_OF_POSE if fit_gain else _DOUBT,
    )


def check_wheel_order(
    log: Log, rim_from_twist: Float[np.ndarray, "wheel 3"], radius: float
) -> WheelOrder:
    """Refuse a log whose wheels do not stand where the geometry says: w = J xi / r.

    The twist is the commanded one, or that of the pose where no command was logged.

    Args:
        log: the run.
        rim_from_twist: J, rim speed of each wheel per body twist.
        radius: of the wheels, r [m].

    Raises:
        DataError: names the order and signs that fit.
    """
    edges = step_edges(log.time)
    measured = np.diff(interpolate(log.time, log.wheel_angle, edges), axis=0)
    if log.twist_command is not None:
        steps = integrated_steps(log.time, log.twist_command, edges)
    elif log.pose is not None:
        steps = _pose_steps(interpolate(log.time, log.pose, edges))
    else:
        wheels = tuple(range(log.wheels))
        return WheelOrder(wheels, (1,) * log.wheels, 0.0, 0.0)
    reference = steps @ rim_from_twist.T / radius
    found = best_wheel_order(measured, reference, fit_gain=log.twist_command is None)
    if found.is_swapped:
        raise bad_data(
            log.path,
            f"the wheels do not move as the geometry says (misfit {found.misfit_as_declared:.2g})",
            f"wheel columns in the order {describe(found)}, which fits to {found.misfit:.2g}",
        )
    return found


def describe(found: WheelOrder) -> str:
    """Order and signs in words people use: wheels counted from 1."""
    pairs = zip(found.order, found.signs, strict=True)
    return ", ".join(f"{'-' if sign < 0 else ''}{wheel + 1}" for wheel, sign in pairs)


def step_edges(time: Float[np.ndarray, " time"], step: float = 0.5) -> Float[np.ndarray, " edge"]:
    """Edges of steps long enough that delays and jitter do not matter [s]."""
    count = max(2, int((time[-1] - time[0]) / step) + 1)
    return np.linspace(time[0], time[-1], count)


def integrated_steps(
    time: Float[np.ndarray, " time"],
    rate: Float[np.ndarray, "time column"],
    edges: Float[np.ndarray, " edge"],
) -> Float[np.ndarray, "step column"]:
    """Integral of a rate over each step."""
    areas = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    total = np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(areas, axis=0)])
    return np.diff(interpolate(time, total, edges), axis=0)


def _pose_steps(pose: np.ndarray) -> np.ndarray:
    middle = 0.5 * (pose[1:, 2] + pose[:-1, 2])
    dx, dy, turn = np.diff(pose, axis=0).T
    ahead = np.cos(middle) * dx + np.sin(middle) * dy
    left = np.cos(middle) * dy - np.sin(middle) * dx
    return np.stack([ahead, left, turn], axis=1)
