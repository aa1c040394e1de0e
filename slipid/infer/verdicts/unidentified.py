"""What the data leave open, as formulas a person reads, with what would close it.

In coordinates scaled by the prior's stds the information P = S C^-1 S of prior and data has the
eigenvalue 1 where the data say nothing. A direction u is flat where u^T P u < 1 / 0.8^2: a step of
one prior std along it is hardly noticed, whatever else is known. Of all such directions those that
move few numbers are sought: a sparse basis, found by leaving numbers out one by one.

Where currents were logged, a direction of the motion alone is judged by what motion tells,
whether or not the numbers that currents tell are known.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.fit.variances import Search, Square
from slipid.infer.verdicts.estimates import WEAK
from slipid.infer.verdicts.wording import NOTHING, SMALL, Axis, axes_of, formula, remedy
from slipid.model.robot import Validity
from slipid.parameter import Entry
from slipid.search_space import Space

NOTICED = 1 / WEAK**2
"""Information along a direction, that of the prior being 1, from which it is not flat."""
TORQUE_SCALE = (
    "motor.back_emf",
    "motor.coulomb_friction",
    "motor.viscous_friction",
    "surface.friction",
)
"""Numbers that may all be larger by one factor without any change of the currents."""
_UNSEEN = 1.02
"""Below it the data say nothing at all: these directions come first, and with exact powers."""
_PART = 0.3
"""Least part of the largest prior-scaled step, or of the largest power, that is named."""


@dataclass(frozen=True)
class FlatDirection:
    """A direction in which the data do not hold the parameters.

    Each of the paths is multiplied by t to its power, for any t; what has no bounds moves by this
    times t [unit]. The largest power is 1 or -1; `others` more move a little with them. The formula
    is the same for people, the remedy the channel or the runs that would tell.
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
    """Information P in prior-scaled coordinates; currents may tell some given the motion."""

    def __init__(self, given: Square, electric: np.ndarray | None = None):
        self.given, self.electric = given, electric
        self.motion = np.zeros_like(given)
        if electric is not None:
            motion = np.ix_(~electric, ~electric)
            self.motion[motion] = np.linalg.inv(np.linalg.inv(given)[motion])

    def of(self, picked: list[int]) -> Float[np.ndarray, "some some"]:
        """Information on some coordinates, the others being known."""
        of_motion = self.electric is not None and not self.electric[picked].any()
        return (self.motion if of_motion else self.given)[np.ix_(picked, picked)]

    def along(self, picked: list[int], u: np.ndarray) -> float:
        return float(u @ self.of(picked) @ u)

    def flattest(self, picked: list[int]) -> tuple[float, np.ndarray]:
        """The least information along any unit vector of these coordinates, and that vector."""
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
    """Directions in which the data narrow the prior by less than a fifth.

    Numbers of which the data say nothing come first, each by itself: they would mix into the
    directions of others. The yaws of single sessions and what a floor's law lacks are deviations by
    declaration and are taken as known.

    `validity`, what every floor was driven with, and whether the robot can drive in any direction,
    `sideways`, make the remedies definite.
    """
    axes = [axis for e in space.free for axis in axes_of(e)]
    kept = [k for k, axis in enumerate(axes) if not _known(axis.entry)]
    scale = [k for k in kept if axes[k].entry.quantity in TORQUE_SCALE]
    std = space.prior_std
    given = np.linalg.inv(covariance) * (std[:, None] * std)
    told = _Precision(given, space.electric if has_current else None)
    out = []
    for picked, u in _sparse(told, kept, scale, 1 / std):
        main = _named(told, [axes[k] for k in picked], picked, u, std[picked])
        mine = [axes[k] for k, is_main in zip(picked, main, strict=True) if is_main]
        step = _rounded(told, picked, u, std[picked], main)[main]
        power = step / step[np.argmax(np.abs(step))]
        moving, rest = [axis.entry for axis in mine], len(picked) - len(mine)
        out.append(
            FlatDirection(
                paths=tuple(e.path for e in moving),
                powers=tuple(round(float(p), 2) for p in power),
                others=rest,
                formula=formula(mine, power, step) + (SMALL if rest and len(mine) > 1 else ""),
                remedy=remedy(moving, has_current, has_voltage, validity or {}, sideways),
            )
        )
    return tuple(out)


def members(found: Iterable[FlatDirection]) -> frozenset[str]:
    """Paths of the numbers that move along flat directions."""
    return frozenset(path for f in found for path in f.paths)


def _known(entry: Entry) -> bool:
    return entry.session is not None or entry.declaration.deviation


def sentences(found: Iterable[FlatDirection]) -> tuple[str, ...]:
    """One sentence per direction; numbers by themselves that one remedy would tell share one."""
    alone: dict[str, list[str]] = {}
    together = []
    for f in found:
        if len(f.paths) == 1:
            alone.setdefault(f.remedy, []).append(f.formula.removeprefix(NOTHING))
        else:
            together.append(f.text)
    return (*(f"{NOTHING}{', '.join(names)}: {cure}" for cure, names in alone.items()), *together)


def _sparse(
    told: _Precision, among: list[int], symmetry: list[int], move: Search
) -> list[tuple[list[int], Float[np.ndarray, " some"]]]:
    """Basis of the flat directions, each a unit vector that needs every coordinate it names.

    When one is found, its largest coordinate (the first, if several are as large) counts as known
    from there on, as in Gaussian elimination; so the next one is another. The symmetry, if it is
    one in these data, comes first and whole: search would find parts of it. `move` is each
    coordinate's prior-scaled step in it.
    """
    alone = [k for k in among if told.of([k])[0, 0] < NOTICED]
    found = [([k], np.ones(1)) for k in alone]
    known = set(alone)
    whole = [k for k in symmetry if k not in known]
    along = move[whole] / np.linalg.norm(move[whole])
    if len(whole) > 1 and told.along(whole, along) < NOTICED:
        found.append((whole, along))
        known.add(whole[0])
    for limit in (_UNSEEN, NOTICED):
        while left := [k for k in among if k not in known]:
            value, u = told.flattest(left)
            if value >= limit:
                break
            picked = left
            while (fewer := _without_one(told, picked, u, limit)) is not None:
                picked, u = fewer
            found.append((picked, u))
            largest = np.abs(u) > 0.9 * np.abs(u).max()
            known.add(picked[int(np.argmax(largest))])
    return found


def _without_one(
    told: _Precision, picked: list[int], u: np.ndarray, limit: float
) -> tuple[list[int], np.ndarray] | None:
    """A flat direction with a coordinate less, None where every one is needed."""
    for drop in np.argsort(np.abs(u)):
        fewer = [k for j, k in enumerate(picked) if j != drop]
        if fewer:
            value, other = told.flattest(fewer)
            if value < limit:
                return fewer, other
    return None


def _named(
    told: _Precision, axes: list[Axis], picked: list[int], u: np.ndarray, std: np.ndarray
) -> np.ndarray:
    """Which numbers of a direction are worth naming.

    Those that take a good part of the step. Where the data say nothing at all also those of a good
    power: a wide prior makes the part of a number small whose scale is as open as the others'.
    """
    main = np.abs(u) >= _PART * np.abs(u).max()
    if told.along(picked, u) < _UNSEEN and len({axis.is_log for axis in axes}) == 1:
        power = np.abs(u * std)
        main |= power >= _PART * power.max()
    return np.asarray(main)


def _rounded(
    told: _Precision, picked: list[int], u: np.ndarray, std: np.ndarray, main: np.ndarray
) -> np.ndarray:
    """Step of one prior std, with the powers of those named in halves if it is still flat."""
    step = u * std
    top = float(np.abs(step[main]).max())
    halves = np.where(main, np.round(2 * step / top) / 2 * top, step)
    size = float(np.linalg.norm(halves / std))
    if (halves[main] != 0).all() and told.along(picked, halves / std / size) < NOTICED:
        return halves / size
    return step
