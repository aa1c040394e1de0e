"""Fisher information of sets of runs, and the choice of the most informative runs.

As in the fit, motion residuals determine the motion parameters m; currents and voltages determine
the electric parameters e given the motion. Let J be the whitened Jacobian of the motion residuals
with respect to m, and E and C those of currents and voltages with respect to e and to m. Then

    M = M0 + sum J^T J,   O = O0 + sum E^T E,   X = X0 + sum E^T C
    cov(m) = M^-1,   e = e(m) - L (m - m^),  L = O^-1 X,   cov(e) = O^-1 + L M^-1 L^T

with M0, O0 and X0 from earlier runs and priors, and sums over the new runs. If no currents are
logged, all parameters count as m. The criterion to be minimised is tr(G cov G^T), where
the matrix G selects the quantities of interest (Fedorov 1972; Atkinson, Donev and Tobias 2007,
Optimum Experimental Designs, sections 10 and 12: c- and A-optimality, exchange).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

UNLIMITED_REPEATS = 1e3
"""Number of repetitions of every candidate run that represents unlimited driving."""


class RunJacobians(NamedTuple):
    """Whitened Jacobians of runs.

    Attributes:
        motion: matrix J, the derivative of motion residuals with respect to the motion parameters.
        electric: matrix E, the derivative of currents and voltages with respect to the electric
            parameters; k is 0 if no currents are logged.
        carried: matrix C, the derivative of currents and voltages with respect to the motion
            parameters.
    """

    motion: Float[np.ndarray, "run m motion"]
    electric: Float[np.ndarray, "run k electric"]
    carried: Float[np.ndarray, "run k motion"]

    def pick(self, index: Sequence[int] | np.ndarray) -> "RunJacobians":
        """Return some runs in the given order; a run may occur several times."""
        return RunJacobians(*(part[np.asarray(index, int)] for part in self))

    def joined(self, *others: "RunJacobians") -> "RunJacobians":
        return RunJacobians(*map(np.concatenate, zip(self, *others, strict=True)))


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information about all parameters, as the matrices of the module docstring.

    Attributes:
        is_electric: mask of the electric parameters.
        motion: matrix M, the information about the motion parameters.
        own: matrix O, the information about the electric parameters given the motion.
        cross: matrix X, which relates errors of electric parameters to those of motion parameters.
    """

    is_electric: Bool[np.ndarray, " free"]
    motion: Float[np.ndarray, "motion motion"]
    own: Float[np.ndarray, "electric electric"]
    cross: Float[np.ndarray, "electric motion"]

    def plus(self, rows: RunJacobians, times: float = 1.0) -> "Information":
        """Return the information after adding these runs `times` times; `times` -1 removes them."""
        # The number of rows is given, as reshape(-1, ...) would fail for arrays without columns.
        j, e, c = (x.reshape(x.shape[0] * x.shape[1], x.shape[2]) for x in rows)
        return Information(
            self.is_electric,
            self.motion + times * (j.T @ j),
            self.own + times * (e.T @ e),
            self.cross + times * (e.T @ c),
        )

    @cached_property
    def of_motion(self) -> Float[np.ndarray, "motion motion"]:
        """Covariance of the motion parameters."""
        return _inverse(self.motion)

    @cached_property
    def covariance(self) -> Float[np.ndarray, "free free"]:
        e, m = np.flatnonzero(self.is_electric), np.flatnonzero(~self.is_electric)
        lean = np.linalg.solve(self.own, self.cross)
        out = np.empty((len(self.is_electric),) * 2)
        out[np.ix_(m, m)] = self.of_motion
        out[np.ix_(e, m)] = -lean @ self.of_motion
        out[np.ix_(m, e)] = out[np.ix_(e, m)].T
        out[np.ix_(e, e)] = _inverse(self.own) + lean @ self.of_motion @ lean.T
        return out

    def criterion(self, goal: Float[np.ndarray, "k free"]) -> float:
        """Return tr(G cov G^T) for the matrix G of a goal."""
        return float(np.einsum("ki,ij,kj->", goal, self.covariance, goal))

    def after_each(
        self, rows: RunJacobians, goal: Float[np.ndarray, "k free"]
    ) -> Float[np.ndarray, " run"]:
        """Return the criterion after one more run, for every candidate.

        With Woodbury's identity (M + J^T J)^-1 = M^-1 - W^T (1 + W J^T)^-1 W, W = J M^-1, the
        inverted matrix has one row per residual of a run instead of one per parameter.
        """
        of_motion, of_electric = goal[:, ~self.is_electric], goal[:, self.is_electric]
        rest: np.ndarray | float = 0.0
        lean = of_motion
        if of_electric.any():
            e = rows.electric.transpose(0, 2, 1)
            own, cross = self.own + e @ rows.electric, self.cross + e @ rows.carried
            part = np.linalg.inv(own) @ of_electric.T
            rest = np.einsum("ke,nek->n", of_electric, part)
            lean = of_motion - part.transpose(0, 2, 1) @ cross
        square = np.swapaxes(lean, -1, -2) @ lean
        w = rows.motion @ self.of_motion
        s = w @ rows.motion.transpose(0, 2, 1) + np.eye(rows.motion.shape[1])
        gain = np.einsum("nii->n", np.linalg.solve(s, (w @ square) @ w.transpose(0, 2, 1)))
        before = np.einsum("ij,...ij->...", self.of_motion, square)
        return np.asarray(before + rest - gain)


def information_of(
    covariance: Float[np.ndarray, "free free"], is_electric: Bool[np.ndarray, " free"]
) -> Information:
    """Return the information that corresponds to a given covariance of all parameters."""
    e, m = np.flatnonzero(is_electric), np.flatnonzero(~is_electric)
    of_motion = covariance[np.ix_(m, m)]
    motion = _inverse(of_motion)
    lean = -covariance[np.ix_(e, m)] @ motion
    own = _inverse(covariance[np.ix_(e, e)] - lean @ of_motion @ lean.T)
    return Information(np.asarray(is_electric, bool), motion, own, own @ lean)


def criterion_path(
    start: Information,
    rows: RunJacobians,
    goal: np.ndarray,
    order: Sequence[int] | np.ndarray,
    at: Sequence[int] | None = None,
) -> list[float]:
    """Return the values of the criterion as runs are added in a given order.

    Args:
        start: information before the first run.
        rows: Jacobians of the runs.
        goal: matrix G of the criterion.
        order: indices of the runs.
        at: numbers of added runs at which the criterion is returned; by default 0, 1, 2, ... all.
    """
    counts = range(len(order) + 1) if at is None else at
    found, now, done = [], start, 0
    for count in counts:
        now, done = now.plus(rows.pick(order[done:count])), count
        found.append(now.criterion(goal))
    return found


def greedy(
    start: Information, rows: RunJacobians, goal: np.ndarray, most: int, target: float = 0.0
) -> tuple[list[int], list[float]]:
    """Choose at most `most` runs one by one, each time the run that reduces the criterion most.

    A run may be chosen repeatedly. The choice stops once the criterion has fallen to the target.

    Returns:
        indices of the runs, and the criterion before the first and after each of them.
    """
    now, chosen, found = start, [], [start.criterion(goal)]
    while len(chosen) < most and found[-1] > target:
        best = int(np.argmin(now.after_each(rows, goal)))
        now = now.plus(rows.pick([best]))
        chosen.append(best)
        found.append(now.criterion(goal))
    return chosen, found


def exchanged(
    start: Information, rows: RunJacobians, goal: np.ndarray, chosen: Sequence[int]
) -> list[int]:
    """Replace each chosen run by the best candidate, and return the runs, the most useful first."""
    kept = list(chosen)
    for k in range(len(kept)):
        others = start.plus(rows.pick(kept[:k] + kept[k + 1 :]))
        each = others.after_each(rows, goal)
        best = int(np.argmin(each))
        if each[best] < each[kept[k]] * (1 - 1e-9):
            kept[k] = best
    ordered, now = [], start
    while kept:
        first = int(np.argmin(now.after_each(rows.pick(kept), goal)))
        ordered.append(kept.pop(first))
        now = now.plus(rows.pick(ordered[-1:]))
    return ordered


def _inverse(a: np.ndarray) -> np.ndarray:
    """Invert a symmetric positive matrix, scaled to unit diagonal, as entries differ widely."""
    scale = 1 / np.sqrt(np.diag(a))
    return np.asarray(np.linalg.inv(a * scale[:, None] * scale) * scale[:, None] * scale)
