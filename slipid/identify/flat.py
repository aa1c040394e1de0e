"""What the data leave open, as formulas a person reads, with what would close it.

In coordinates scaled by the prior's stds the information P = S C^-1 S of prior and data has the
eigenvalue 1 where the data say nothing. A direction u is flat where u^T P u < 1 / 0.8^2: a step of
one prior std along it is hardly noticed, whatever else is known. Of all such directions those that
move few numbers are sought: a sparse basis, found by leaving numbers out one by one.

Where currents do not inform motion, a direction of the motion alone is judged by what motion tells,
whether or not the numbers that currents tell are known.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from slipid.identify.identifiability import NEEDS_VOLTAGE, WEAK
from slipid.identify.problem import is_electric
from slipid.identify.remedies import listed, remedy
from slipid.parameter import Declaration, Entry, Space

NOTICED = 1 / WEAK**2
"""Information along a direction, that of the prior being 1, from which it is not flat."""
_UNSEEN = 1.02
"""Below it the data say nothing at all: these directions come first, and with exact powers."""
_PART = 0.3
"""Least part of the largest prior-scaled step, or of the largest power, that is named."""
_LARGE = 10.0
"""Powers that differ more are no formula for people."""
_SAME = 0.05
"""Powers that differ less are one."""


@dataclass(frozen=True)
class Flat:
    """A direction in which the data do not hold the parameters.

    Attributes:
        paths: of the parameters that move together.
        powers: each is multiplied by t to this power, for any t; what has no bounds moves by this
            times t [unit]. The largest is 1 or -1.
        others: how many more move a little with them.
        formula: the same for people.
        remedy: the channel or the runs that would tell.
    """

    paths: tuple[str, ...]
    powers: tuple[float, ...]
    others: int
    formula: str
    remedy: str

    @property
    def text(self) -> str:
        """One sentence."""
        return f"{self.formula}: {self.remedy}"


@dataclass(frozen=True)
class _Axis:
    """One coordinate of the search space, as people call it."""

    path: str
    label: str
    unit: str
    is_log: bool


class _Told:
    """Information in prior-scaled coordinates.

    Args:
        given: of all coordinates, P.
        electric: those that currents tell given the motion, where that is so.
    """

    def __init__(self, given: Float[np.ndarray, "free free"], electric: np.ndarray | None = None):
        self.given, self.electric = given, electric
        self.motion = np.zeros_like(given)
        if electric is not None:
            motion = np.ix_(~electric, ~electric)
            self.motion[motion] = np.linalg.inv(np.linalg.inv(given)[motion])

    def of(self, picked: list[int]) -> Float[np.ndarray, "some some"]:
        """Information on some coordinates, the others being known."""
        of_motion = self.electric is not None and not self.electric[picked].any()
        return (self.motion if of_motion else self.given)[np.ix_(picked, picked)]


def flat_directions(
    space: Space,
    covariance: Float[np.ndarray, "free free"],
    has_current: bool,
    has_voltage: bool,
    validity: Mapping[str, Any] | None = None,
    current_informs_motion: bool = False,
) -> tuple[Flat, ...]:
    """Directions in which the data narrow the prior by less than a fifth.

    Numbers of which the data say nothing come first, each by itself: they would mix into the
    directions of others. The yaws of single sessions are deviations by declaration and are taken as
    known.

    Args:
        space: free numbers and their priors.
        covariance: of the posterior.
        has_current, has_voltage: what was logged.
        validity: what every floor was driven with, as `curves.validity` says; makes the remedies
            definite.
        current_informs_motion: as the `Problem` was told.
    """
    axes = [axis for e in space.free for axis in _axes(e)]
    kept = [k for k, axis in enumerate(axes) if not axis.path.startswith("camera.session_yaw")]
    electric = [k for k in kept if axes[k].path == "robot.mass" or is_electric(axes[k].path)]
    std = space.prior_std
    outer = std[:, None] * std
    told = _Told(np.linalg.inv(covariance) * outer)
    if has_current and not current_informs_motion:
        told = _Told(told.given, np.array([is_electric(axis.path) for axis in axes]))
    out = []
    for picked, u in _sparse(told, kept, electric):
        mine = [axes[k] for k in picked]
        main = _named(told, mine, picked, u, std[picked])
        mine = [axis for axis, is_main in zip(mine, main, strict=True) if is_main]
        step = _rounded(told, picked, u, std[picked], main)[main]
        power = step / step[np.argmax(np.abs(step))]
        paths = tuple(axis.path for axis in mine)
        rest = len(picked) - len(mine)
        out.append(
            Flat(
                paths=paths,
                powers=tuple(round(float(p), 2) for p in power),
                others=rest,
                formula=_formula(mine, power, step) + (_SMALL if rest and len(mine) > 1 else ""),
                remedy=remedy(paths, has_current, has_voltage, validity or {}),
            )
        )
    return tuple(out)


def sentences(found: Iterable[Flat]) -> tuple[str, ...]:
    """One sentence per direction; numbers by themselves that one remedy would tell share one."""
    alone: dict[str, list[str]] = {}
    together = []
    for f in found:
        if len(f.paths) == 1:
            alone.setdefault(f.remedy, []).append(f.formula.removeprefix(_NOTHING))
        else:
            together.append(f.text)
    return (*(f"{_NOTHING}{', '.join(names)}: {cure}" for cure, names in alone.items()), *together)


def _sparse(
    told: _Told, among: list[int], first: list[int]
) -> list[tuple[list[int], Float[np.ndarray, " some"]]]:
    """Basis of the flat directions, each a unit vector that needs every coordinate it names.

    When one is found, its largest coordinate (the first, if several are as large) counts as known
    from there on, as in Gaussian elimination; so the next one is another. Directions within
    `first` come before those of all of `among`.
    """
    alone = [k for k in among if told.of([k])[0, 0] < NOTICED]
    found = [([k], np.ones(1)) for k in alone]
    known = set(alone)
    for group, limit in ((first, _UNSEEN), (among, _UNSEEN), (among, NOTICED)):
        while left := [k for k in group if k not in known]:
            value, u = _flattest(told, left)
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
    told: _Told, picked: list[int], u: np.ndarray, limit: float
) -> tuple[list[int], np.ndarray] | None:
    """A flat direction with a coordinate less, None where every one is needed."""
    for drop in np.argsort(np.abs(u)):
        fewer = [k for j, k in enumerate(picked) if j != drop]
        if fewer:
            value, other = _flattest(told, fewer)
            if value < limit:
                return fewer, other
    return None


def _named(
    told: _Told, axes: list[_Axis], picked: list[int], u: np.ndarray, std: np.ndarray
) -> np.ndarray:
    """Which numbers of a direction are worth naming.

    Those that take a good part of the step. Where the data say nothing at all also those of a good
    power: a wide prior makes the part of a number small whose scale is as open as the others'.
    """
    main = np.abs(u) >= _PART * np.abs(u).max()
    if _along(told, picked, u) < _UNSEEN and len({axis.is_log for axis in axes}) == 1:
        power = np.abs(u * std)
        main |= power >= _PART * power.max()
    return np.asarray(main)


def _rounded(
    told: _Told, picked: list[int], u: np.ndarray, std: np.ndarray, main: np.ndarray
) -> np.ndarray:
    """Step of one prior std, with the powers of those named in halves if it is still flat."""
    step = u * std
    top = float(np.abs(step[main]).max())
    halves = np.where(main, np.round(2 * step / top) / 2 * top, step)
    size = float(np.linalg.norm(halves / std))
    if (halves[main] != 0).all() and _along(told, picked, halves / std / size) < NOTICED:
        return halves / size
    return step


def _along(told: _Told, picked: list[int], u: np.ndarray) -> float:
    return float(u @ told.of(picked) @ u)


def _flattest(told: _Told, picked: list[int]) -> tuple[float, np.ndarray]:
    values, vectors = np.linalg.eigh(told.of(picked))
    return float(values[0]), vectors[:, 0]


# words -------------------------------------------------------------------------------------------

_NOTHING = "the data say next to nothing of "
_SMALL = ", while others move a little"


def _axes(entry: Entry) -> list[_Axis]:
    """The coordinates of a free number, of shares the log ratios that their basis is made of."""
    d = entry.declaration
    unit = "log-odds" if np.isfinite(d.upper) else d.unit
    if entry.size == 1:
        return [_Axis(entry.path, entry.path, unit, _is_log(d))]
    if d.shares:
        each = [
            f"{'wheel' if k == 1 else 'wheels'} {_list(range(1, k + 1))} : wheel {k + 1}"
            for k in range(1, entry.size)
        ]
        return [_Axis(entry.path, f"{entry.path} ({what})", d.unit, True) for what in each]
    return [
        _Axis(entry.path, f"{entry.path} [{label}]", unit, _is_log(d)) for label in entry.labels
    ]


def _list(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers))


def _is_log(d: Declaration) -> bool:
    return bool(np.isfinite(d.lower) and not np.isfinite(d.upper))


def _formula(axes: list[_Axis], power: np.ndarray, step: np.ndarray) -> str:
    """Direction in words: powers relative to the largest, step of one prior std."""
    names = [axis.label for axis in axes]
    if len(axes) == 1:
        return _NOTHING + names[0]
    if all(axis.is_log for axis in axes) and np.ptp(np.log(np.abs(power))) < np.log(_LARGE):
        return _product(names, power)
    if not any(axis.is_log for axis in axes) and len({axis.unit for axis in axes}) == 1:
        return _sum(names, power)
    moves = [
        f"{axis.label} x {np.exp(s):.4g}" if axis.is_log else f"{axis.label} {s:+.2g} {axis.unit}"
        for axis, s in zip(axes, step, strict=True)
    ]
    return f"nearly unseen if together: {', '.join(moves)}"


def _product(names: list[str], power: np.ndarray) -> str:
    if (np.abs(power - 1) < _SAME).all():
        short = _short(names)
        last = NEEDS_VOLTAGE[1] if NEEDS_VOLTAGE[1] in short else short[0]
        return f"{', '.join(short)} only as {', '.join(f'{p}/{last}' for p in short if p != last)}"
    if len(names) == 2:
        k = float(power[1] / power[0])  # b / a^k does not change
        first, other = names if abs(k) >= 1 else names[::-1]
        k = k if abs(k) >= 1 else 1 / k
        held = _power(first, abs(k))
        held = f"{held} * {other}" if k < 0 else f"{other} / {held}"
        return f"{names[0]} and {names[1]} only as {held}"
    if (np.abs(np.abs(power) - 1) < _SAME).all():
        up, down = (
            listed([n for n, k in zip(names, power, strict=True) if s * k > 0]) for s in (1, -1)
        )
        return f"unseen for any factor: {up} times it, {down} divided by it"
    parts = [_power(p, k) for p, k in zip(names, power, strict=True)]
    return f"{', '.join(parts)} (each times t to the power shown, any t)"


def _power(name: str, k: float) -> str:
    return name if abs(k - 1) < _SAME else f"{name}^{k:.2g}"


def _sum(names: list[str], weight: np.ndarray) -> str:
    if (np.abs(weight - 1) < _SAME).all():
        return f"{', '.join(names)} only as their differences"
    if len(names) == 2:
        k = float(weight[1] / weight[0])  # b - k a does not change
        first, other = names if abs(k) >= 1 else names[::-1]
        k = k if abs(k) >= 1 else 1 / k
        times = "" if abs(abs(k) - 1) < _SAME else f"{abs(k):.2g} "
        sign = "+" if k < 0 else "-"
        return f"{names[0]} and {names[1]} only as {other} {sign} {times}{first}"
    parts = [f"{n} {k:+.2g} t" for n, k in zip(names, weight, strict=True)]
    return f"unseen for any t: {', '.join(parts)}"


def _short(paths: list[str]) -> list[str]:
    """The paths, with one pattern in place of the frictions of several floors."""
    floors = [p for p in paths if p.startswith("surface.") and p.endswith(".friction")]
    if len(floors) < 2:
        return list(paths)
    return [p for p in paths if p not in floors] + ["surface.*.friction"]
