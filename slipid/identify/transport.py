"""Coordinates in which a posterior is nearly a standard Gaussian, learnt from draws of it.

A triangular map (Knothe-Rosenblatt) from coordinates x to u:

    shared ones       v = L^-1 (y - m)
    those of a group  w = L^-1 (y - m - B (y_given - m_given)), widest first
                      v_i = (w_i - a_i(w_1 .. w_i-1)) exp(-b_i(w_1 .. w_i-1))

with polynomials a and b, and a sinh-arcsinh map (Jones and Pewsey 2009, Biometrika 96, eq. 2) of
every coordinate,

    sinh(tail arcsinh((x - place) / scale) - skew)

from x to y or from v to u: first, where numbers act through their values and are kept as
logarithms; last, where the density is bent in x. Draws that were not learnt from decide. Groups
follow the shared coordinates and are bent by themselves, so that groups that are independent given
the shared ones stay so. It is one of the maps of Marzouk et al. 2016 (Sampling via measure
transport, section 3).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

Matrix = Float[np.ndarray, "_ _"]
Cube = Float[np.ndarray, "_ _ _"]
Vector = Float[np.ndarray, " _"]
FAR = 4.0
"""Polynomials stay what they are beyond this many stds."""
SQUARED = 5
CUBED = 3
"""Coordinates of a group, the widest first, that polynomials have squares and cubes of."""
MOST_DRAWS = 4000
WORTH = 3.0
"""Nats that a monomial must be worth."""
MOST_MONOMIALS = 12
"""Of a coordinate's mean and std."""


@dataclass(frozen=True, eq=False)
class Bend:
    """Polynomials a and b of a group's coordinates.

    Attributes:
        factors: columns whose product each monomial is, from (w, 1) (monomial, 3).
        shift, scale: coefficients of a and b (coordinate, monomial).
    """

    factors: np.ndarray
    shift: Matrix
    scale: Matrix

    def monomials(self, w: Matrix) -> Matrix:
        """Products of columns (row, monomial)."""
        columns = np.column_stack([np.clip(w, -FAR, FAR), np.ones(len(w))])
        return np.asarray(columns[:, self.factors].prod(axis=2))

    def slopes(self, w: Matrix) -> Cube:
        """Their derivatives by the columns (row, monomial, coordinate)."""
        columns = np.column_stack([np.clip(w, -FAR, FAR), np.ones(len(w))])
        size, out = w.shape[1], np.zeros((len(w), len(self.factors), w.shape[1] + 1))
        for slot in range(3):
            others = columns[:, np.delete(self.factors, slot, axis=1)].prod(axis=2)
            out += others[..., None] * np.eye(size + 1)[self.factors[:, slot]]
        return np.asarray(out[..., :size] * (np.abs(w) < FAR)[:, None, :])

    def forward(self, w: Matrix) -> Matrix:
        f = self.monomials(w)
        return np.asarray((w - f @ self.shift.T) * np.exp(-f @ self.scale.T))

    def back(self, v: Matrix) -> Matrix:
        w = np.zeros_like(v)
        for i in range(v.shape[1]):  # monomials of coordinate i have earlier ones only
            f = self.monomials(w)
            w[:, i] = f @ self.shift[i] + np.exp(f @ self.scale[i]) * v[:, i]
        return w

    def log_slope(self, w: Matrix) -> Matrix:
        """Log dw_i/dv_i."""
        return np.asarray(self.monomials(w) @ self.scale.T)

    def pull(self, w: Matrix, slope: Matrix) -> Matrix:
        """Derivative by v of what has the derivative `slope` by w, plus that of the log slopes."""
        f, d = self.monomials(w), self.slopes(w)
        shrink = np.exp(-f @ self.scale.T)
        v = (w - f @ self.shift.T) * shrink
        of_scale = np.einsum("if,nfk->nik", self.scale, d)
        of_shift = np.einsum("if,nfk->nik", self.shift, d)
        jacobian = shrink[..., None] * (np.eye(w.shape[1]) - of_shift) - v[..., None] * of_scale
        total = slope + of_scale.sum(axis=1)
        return np.asarray(np.linalg.solve(jacobian.transpose(0, 2, 1), total[..., None])[..., 0])

    @staticmethod
    def learnt(w: Matrix, effective: float) -> "Bend":
        """Polynomials for draws that are worth so many independent ones."""
        size = w.shape[1]
        factors = [(size, size, size)] + [(k, size, size) for k in range(size)]
        squared, cubed = range(min(SQUARED, size - 1)), range(min(CUBED, size - 1))
        factors += [(*pair, size) for pair in combinations_with_replacement(squared, 2)]
        factors += [(k, k, k) for k in cubed]
        kept = np.array(factors)
        bend = Bend(kept, np.zeros((size, len(kept))), np.zeros((size, len(kept))))
        f = bend.monomials(w)
        reach = np.where(kept == size, -1, kept).max(axis=1)
        for i in range(size):
            own = np.flatnonzero(reach < i)
            bend.shift[i, own], bend.scale[i, own] = _regression(f[:, own], w[:, i], effective)
        used = (bend.shift != 0).any(axis=0) | (bend.scale != 0).any(axis=0)
        return Bend(kept[used], bend.shift[:, used], bend.scale[:, used])


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


@dataclass(frozen=True, eq=False)
class Warp:
    """Sinh-arcsinh map of every coordinate."""

    place: Vector
    scale: Vector
    skew: Vector
    tail: Vector

    def forward(self, v: Matrix) -> Matrix:
        return np.sinh(self.tail * np.arcsinh((v - self.place) / self.scale) - self.skew)

    def back(self, u: Matrix) -> Matrix:
        return self.place + self.scale * np.sinh((np.arcsinh(u) + self.skew) / self.tail)

    def log_slope(self, u: Matrix) -> Matrix:
        """Log dv/du of every coordinate."""
        inner = (np.arcsinh(u) + self.skew) / self.tail
        # cosh without overflow
        cosh = np.abs(inner) + np.log1p(np.exp(-2 * np.abs(inner))) - np.log(2)
        return np.asarray(np.log(self.scale / self.tail) + cosh - 0.5 * np.log1p(u**2))

    def pull(self, u: Matrix, slope: Matrix) -> Matrix:
        """Derivative by u of what has the derivative `slope` by v, plus that of the log slopes."""
        inner = (np.arcsinh(u) + self.skew) / self.tail
        bend = np.tanh(inner) / (self.tail * np.sqrt(1 + u**2)) - u / (1 + u**2)
        return np.asarray(slope * np.exp(self.log_slope(u)) + bend)

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
        slope: of own ones by given ones (given, own).
        root: Cholesky factor of the covariance of what is left.
        bend: of it; None for shared coordinates.
    """

    own: np.ndarray
    given: np.ndarray
    slope: Matrix
    root: Matrix
    bend: Bend | None

    def left(self, about: Matrix) -> Matrix:
        """What others do not say of own coordinates, by the root; from all less their means."""
        left = about[:, self.own] - about[:, self.given] @ self.slope
        return np.asarray(np.linalg.solve(self.root, left.T).T)


@dataclass(frozen=True, eq=False)
class Transport:
    """The whole map, of vectors x (row, size) to and from u (row, size).

    Attributes:
        first: from x to y.
        mean: of y.
        stairs: from y to v; every coordinate is in one.
        last: from v to u.
    """

    first: Warp
    mean: Vector
    stairs: tuple[Stair, ...]
    last: Warp

    def forward(self, x: Matrix) -> Matrix:
        about = self.first.forward(x) - self.mean
        v = np.empty_like(about)
        for s in self.stairs:
            w = s.left(about)
            v[:, s.own] = s.bend.forward(w) if s.bend else w
        return self.last.forward(v)

    def back(self, u: Matrix) -> Matrix:
        return self.placed(u)[0]

    def placed(self, u: Matrix) -> tuple[Matrix, Matrix]:
        """x, and the part of log |dx/du| of every coordinate (row, size)."""
        y, log, _ = self._warped(u)
        return self.first.back(y), log + self.first.log_slope(y)

    def _warped(self, u: Matrix) -> tuple[Matrix, Matrix, list[Matrix]]:
        """y, the part of log |dy/du|, and w of every stair."""
        v, log = self.last.back(u), self.last.log_slope(u)
        about, ws = np.empty_like(u), []
        for s in self.stairs:
            w = v[:, s.own]
            if s.bend:
                w = s.bend.back(w)
                log[:, s.own] += s.bend.log_slope(w)
            ws.append(w)
            about[:, s.own] = about[:, s.given] @ s.slope + w @ s.root.T
            log[:, s.own] += np.linalg.slogdet(s.root)[1] / len(s.own)
        return self.mean + about, log, ws

    def pull(self, u: Matrix, slope: Callable[[Matrix], Matrix]) -> Matrix:
        """Derivative by u of what has the derivative slope(x) by x, plus that of log |dx/du|."""
        y, _, ws = self._warped(u)
        by_y, by_v = self.first.pull(y, slope(self.first.back(y))), np.empty_like(u)
        for s, w in zip(reversed(self.stairs), reversed(ws), strict=True):
            own = by_y[:, s.own]
            by_y[:, s.given] += own @ s.slope.T
            by_v[:, s.own] = own @ s.root
            if s.bend:
                by_v[:, s.own] = s.bend.pull(w, by_v[:, s.own])
        return self.last.pull(u, by_v)

    def log_density(self, x: Matrix) -> Vector:
        """Of what is a standard Gaussian in u, up to a constant."""
        u = self.forward(x)
        return np.asarray((-0.5 * u**2 - self.placed(u)[1]).sum(axis=1))


def gaussian(mean: Vector, covariance: Matrix, group: np.ndarray, kind: np.ndarray) -> Transport:
    """Map of a Gaussian.

    Args:
        group: of each coordinate, -1 where groups share it.
        kind: of each coordinate; of a group's, those of a higher kind follow those of lower ones.
    """
    stairs = _stairs(covariance, group, kind, covariance)
    return Transport(Warp.none(len(mean)), mean, stairs, Warp.none(len(mean)))


def _stairs(
    covariance: Matrix, group: np.ndarray, kind: np.ndarray, at_mode: Matrix
) -> tuple[Stair, ...]:
    """Of a Gaussian; the coordinates that are widest at the mode come first in a stair.

    A valley has its direction at the mode, where draws are as wide across as they are bent.
    """
    shared, stairs = np.flatnonzero(group < 0), []

    def stair(own: np.ndarray, given: np.ndarray) -> None:
        if len(own):
            own = own[np.argsort(-np.diag(_given(at_mode, own, given)[1]))]
            slope, left = _given(covariance, own, given)
            stairs.append(Stair(own, given, slope, np.linalg.cholesky(left), None))

    for k in np.unique(kind):
        stair(shared[kind[shared] == k], shared[kind[shared] < k])
    for g in range(group.max() + 1):
        for k in np.unique(kind):
            before = np.flatnonzero((group == g) & (kind < k))
            stair(np.flatnonzero((group == g) & (kind == k)), np.concatenate([shared, before]))
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
        draws: (draw, size), its halves from chains that do not know of each other.
        effective: number of independent ones that they are worth, about.
        covariance: Laplace; counts as many draws as there are coordinates.
    """
    some = draws[:: max(1, len(draws) // MOST_DRAWS)]
    halves = some[: len(some) // 2], some[len(some) // 2 :]

    def made(rows: Matrix, effective: float, warp_first: bool) -> Transport:
        size = rows.shape[1]
        first = Warp.learnt(rows) if warp_first else Warp.none(size)
        y = first.forward(rows)
        middle = y.mean(axis=0)
        step = np.exp(first.log_slope(first.forward(rows.mean(axis=0, keepdims=True))))[0]
        at_mode = covariance / np.outer(step, step)
        both = effective * np.cov(y.T).reshape(size, size) + size * at_mode
        stairs = tuple(
            replace(s, bend=Bend.learnt(s.left(y - middle), effective))
            if group[s.own[0]] >= 0 and len(s.own) > 1
            else s
            for s in _stairs(both / (effective + size), group, kind, at_mode)
        )
        found = Transport(first, middle, stairs, Warp.none(size))
        return found if warp_first else replace(found, last=Warp.learnt(found.forward(rows)))

    def worth(warp_first: bool) -> float:
        pairs = halves, halves[::-1]
        return float(
            sum(made(a, effective / 2, warp_first).log_density(b).mean() for a, b in pairs)
        )

    return made(some, effective, worth(True) > worth(False))
