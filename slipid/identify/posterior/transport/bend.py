"""Polynomials that shift and stretch a coordinate by what coordinates before it say."""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float, Int

from slipid.identify.posterior.transport.coordinatewise import Matrix, Vector

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


@dataclass(frozen=True, eq=False)
class Bend:
    """Polynomials a (shift) and b (scale) of a group's coordinates.

    Factors are the columns whose product each monomial is, from (w, told, 1), where told is what
    plateaus say.
    """

    factors: Int[np.ndarray, "monomial 3"]
    shift: Float[np.ndarray, "coordinate monomial"]
    scale: Float[np.ndarray, "coordinate monomial"]

    def monomials(self, w: Matrix, told: Matrix) -> Matrix:
        """Products of columns (row, monomial)."""
        columns = np.clip(np.concatenate([w, told], axis=1), -FAR, FAR)
        columns = np.concatenate([columns, np.ones((len(w), 1))], axis=1)
        return np.asarray(columns[:, self.factors].prod(axis=2))

    def forward(self, w: Matrix, told: Matrix) -> Matrix:
        """The way from w to v."""
        f = self.monomials(w, told)
        return np.asarray((w - f @ self.shift.T) * np.exp(-f @ self.scale.T))

    @staticmethod
    def none(size: int, plateaus: int) -> "Bend":
        """No bend, with all monomials that there can be."""
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
