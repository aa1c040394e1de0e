"""Flat directions of the parameter space, with formulas and remedies as texts for people.

In coordinates scaled by the prior stds S, the information of prior and data is P = S C^-1 S, where
C is the covariance of the fit; P has the eigenvalue 1 in directions about which the data are
uninformative. A unit direction u is flat if u^T P u < 1 / 0.8^2: the data then reduce the prior std
along u by less than a fifth, even if all other directions are known. The result is a sparse basis
of the flat directions, so that each direction changes few parameters; it is found by dropping
parameters one by one.

Where currents were logged, a direction that contains motion parameters only is judged by the
information about the motion, with the electric parameters marginalised.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.fitting.variances import Search, Square
from slipid.infer.verdicts.estimates import WEAK
from slipid.infer.verdicts.wording import NOTHING, OTHERS_CHANGE, Axis, axes_of, formula, remedy
from slipid.model.robot import Validity
from slipid.search_space import Space

FLAT_INFORMATION = 1 / WEAK**2
"""Information along a unit direction below which it is flat; the prior's own information is 1."""
TORQUE_SCALE = (
    "motor.back_emf",
    "motor.coulomb_friction",
    "motor.viscous_friction",
    "surface.friction",
)
"""Quantities that can be multiplied by a common factor without any change of the currents."""
_NO_EFFECT = 1.02
"""Information along a unit direction below which the data count as uninformative about it.

Such directions are searched for first."""
_NAMED_RATIO = 0.3
"""Smallest prior-scaled step, or exponent, of a parameter that a formula contains, relative to the
largest one."""


@dataclass(frozen=True)
class FlatDirection:
    """Direction of the parameter space along which the likelihood is flat.

    Attributes:
        paths: names of the parameters that change.
        powers: change of each parameter with a variable t: exponent p of the factor t^p for a
            positive parameter, multiple of t [unit] for an unbounded one; the one of largest
            magnitude is 1.
        others: number of further parameters that change slightly.
        formula: description of the direction in words.
        remedy: channels to log or runs to drive that would determine the parameters.
    """

    paths: tuple[str, ...]
    powers: tuple[float, ...]
    others: int
    formula: str
    remedy: str

    @property
    def text(self) -> str:
        return f"{self.formula}: {self.remedy}"


class _Precision:
    """Information P in prior-scaled coordinates.

    Attributes:
        given: information P about all parameters.
        electric: mask of the electric parameters, None without currents.
        motion: information about the motion parameters with the electric ones marginalised.
    """

    def __init__(self, given: Square, electric: np.ndarray | None = None):
        self.given, self.electric = given, electric
        self.motion = np.zeros_like(given)
        if electric is not None:
            motion = np.ix_(~electric, ~electric)
            self.motion[motion] = np.linalg.inv(np.linalg.inv(given)[motion])

    def of(self, picked: list[int]) -> Float[np.ndarray, "some some"]:
        """Return the information about some coordinates, given all other ones."""
        of_motion = self.electric is not None and not self.electric[picked].any()
        return (self.motion if of_motion else self.given)[np.ix_(picked, picked)]

    def along(self, picked: list[int], u: np.ndarray) -> float:
        return float(u @ self.of(picked) @ u)

    def flattest(self, picked: list[int]) -> tuple[float, np.ndarray]:
        """Return the smallest information along a unit vector on `picked`, and that vector."""
        values, vectors = np.linalg.eigh(self.of(picked))
        return float(values[0]), vectors[:, 0]


def flat_directions(
    space: Space,
    covariance: Square,
    has_current: bool,
    has_voltage: bool,
    validity: Mapping[str, Validity] | None = None,
    sideways: bool = True,
) -> tuple[FlatDirection, ...]:
    """Return directions in which the data reduce the std of the prior by less than a fifth.

    Flat single parameters come first, each as its own direction, since they would otherwise be part
    of other directions. Marker yaws of single sessions and load biases of floors are taken as
    known.

    Args:
        space: free parameters and their priors.
        covariance: Laplace covariance of the search vector.
        has_current: True if currents were logged.
        has_voltage: True if voltages were logged.
        validity: ranges that the runs on each floor cover, from which remedies are derived.
        sideways: True if the robot can drive in any direction.
    """
    axes = [axis for e in space.free for axis in axes_of(e)]
    known = [axis.entry.session is not None or axis.entry.declaration.deviation for axis in axes]
    kept = [k for k, is_known in enumerate(known) if not is_known]
    scale = [k for k in kept if axes[k].entry.quantity in TORQUE_SCALE]
    std = space.prior_std
    given = np.linalg.inv(covariance) * (std[:, None] * std)
    precision = _Precision(given, space.electric if has_current else None)
    out = []
    for picked, u in _sparse(precision, kept, scale, 1 / std):
        main = _named(precision, [axes[k] for k in picked], picked, u, std[picked])
        mine = [axes[k] for k, is_main in zip(picked, main, strict=True) if is_main]
        step = _rounded(precision, picked, u, std[picked], main)[main]
        power = step / step[np.argmax(np.abs(step))]
        moving, rest = [axis.entry for axis in mine], len(picked) - len(mine)
        out.append(
            FlatDirection(
                paths=tuple(e.path for e in moving),
                powers=tuple(round(float(p), 2) for p in power),
                others=rest,
                formula=formula(mine, power, step)
                + (OTHERS_CHANGE if rest and len(mine) > 1 else ""),
                remedy=remedy(moving, has_current, has_voltage, validity or {}, sideways),
            )
        )
    return tuple(out)


def members(found: Iterable[FlatDirection]) -> frozenset[str]:
    """Return the paths of the parameters that change along flat directions."""
    return frozenset(path for f in found for path in f.paths)


def sentences(found: Iterable[FlatDirection]) -> tuple[str, ...]:
    """Return a sentence per direction; single parameters with the same remedy share a sentence."""
    alone: dict[str, list[str]] = {}
    together = []
    for f in found:
        if len(f.paths) == 1:
            alone.setdefault(f.remedy, []).append(f.formula.removeprefix(NOTHING))
        else:
            together.append(f.text)
    single = (f"{NOTHING}{', '.join(names)}: {cure}" for cure, names in alone.items())
    return (*single, *together)


def _sparse(
    precision: _Precision, among: list[int], symmetry: list[int], move: Search
) -> list[tuple[list[int], Float[np.ndarray, " some"]]]:
    """Return a basis of the flat directions, as pairs of coordinates and a unit vector on them.

    A direction would no longer be flat if any one of its coordinates were fixed. After each
    direction, the coordinate with its largest component (the first of equal ones) counts as known,
    as in Gaussian elimination, so that directions are independent.

    Args:
        precision: the information.
        among: indices of the coordinates that are searched.
        symmetry: indices of coordinates that a common factor may scale. The direction of this
            scaling is tested as a whole first, since the search would only find parts of it.
        move: prior-scaled step of each coordinate for a common factor on all parameters.
    """
    alone = [k for k in among if precision.of([k])[0, 0] < FLAT_INFORMATION]
    found = [([k], np.ones(1)) for k in alone]
    known = set(alone)
    whole = [k for k in symmetry if k not in known]
    along = move[whole] / np.linalg.norm(move[whole])
    if len(whole) > 1 and precision.along(whole, along) < FLAT_INFORMATION:
        found.append((whole, along))
        known.add(whole[0])
    for limit in (_NO_EFFECT, FLAT_INFORMATION):
        while left := [k for k in among if k not in known]:
            value, u = precision.flattest(left)
            if value >= limit:
                break
            picked = left
            while (fewer := _without_one(precision, picked, u, limit)) is not None:
                picked, u = fewer
            found.append((picked, u))
            largest = np.abs(u) > 0.9 * np.abs(u).max()
            known.add(picked[int(np.argmax(largest))])
    return found


def _without_one(
    precision: _Precision, picked: list[int], u: np.ndarray, limit: float
) -> tuple[list[int], np.ndarray] | None:
    """Return a direction with information below `limit` on all but one coordinate, or None.

    The coordinate with the smallest component of `u` is dropped first.
    """
    for drop in np.argsort(np.abs(u)):
        fewer = [k for j, k in enumerate(picked) if j != drop]
        if fewer:
            value, other = precision.flattest(fewer)
            if value < limit:
                return fewer, other
    return None


def _named(
    precision: _Precision, axes: list[Axis], picked: list[int], u: np.ndarray, std: np.ndarray
) -> np.ndarray:
    """Return a mask of the coordinates of a direction that its formula contains.

    These are the coordinates with large prior-scaled steps (`_NAMED_RATIO`). If the data have no
    information along the direction, coordinates with large exponents are included as well: with a
    wide prior, the prior-scaled step is small even if the exponent is as large as all others.
    """
    main = np.abs(u) >= _NAMED_RATIO * np.abs(u).max()
    if precision.along(picked, u) < _NO_EFFECT and len({axis.is_log for axis in axes}) == 1:
        power = np.abs(u * std)
        main |= power >= _NAMED_RATIO * power.max()
    return np.asarray(main)


def _rounded(
    precision: _Precision, picked: list[int], u: np.ndarray, std: np.ndarray, main: np.ndarray
) -> np.ndarray:
    """Return the rounded search-space step along a direction; its length is 1 prior std.

    The steps of the coordinates in `main` are rounded to multiples of half the largest one, so that
    the exponents of a formula are simple. The steps stay unrounded if rounding would make one of
    them zero, or if the rounded direction is not flat.
    """
    step = u * std
    top = float(np.abs(step[main]).max())
    halves = np.where(main, np.round(2 * step / top) / 2 * top, step)
    size = float(np.linalg.norm(halves / std))
    if (halves[main] != 0).all() and precision.along(
        picked, halves / std / size
    ) < FLAT_INFORMATION:
        return halves / size
    return step
