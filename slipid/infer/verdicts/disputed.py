"""Floors that disagree about the loads on the wheels by more than noise.

A floor sees the loads with a bias of its own (`slipid.model.contact_law`), and a prior that was
found from all floors holds these biases near zero: intervals of the loads count it. Whether floors
really disagree is asked of the data alone. With P0 the precision that this prior adds to that of
the fit, L, and P1 one of a prior so wide that it says nothing, every floor on its own would move
the numbers z by

    d = (L + P1 - P0)^-1 (P0 - P1) z    of the biases

and the difference of the biases of two floors, over its covariance, is a chi-square if the law is
right about both.

Whether a fit may be used: does it predict, did it settle, are its numbers those of a robot?
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from math import isfinite
from typing import Literal

import numpy as np
from scipy.stats import chi2, norm

from slipid.fit.variances import Search, Square
from slipid.infer.verdicts.estimates import Estimate
from slipid.search_space import Space

CHANCE = 0.01
"""Disagreement is said where noise alone would make as much this rarely."""
_WIDE = 1.0
"""Std of biases that nothing is known about beforehand."""


@dataclass(frozen=True)
class Dispute:
    """Two floors, and how many standard errors what they say of the loads is apart."""

    floors: tuple[str, str]
    sigma: float

    @property
    def sentence(self) -> str:
        one, other = self.floors
        return (
            f"{one} and {other} disagree about the loads on the wheels by {self.sigma:.1f} "
            "standard errors of their noise: the contact law lacks something; intervals count it"
        )


def disputes(space: Space, z: Search, covariance: Square) -> tuple[Dispute, ...]:
    """Pairs of floors whose biases of the load differ by more than noise, the worst first.

    The space has the prior that biases were found to have (`Space.with_pooled`).
    """
    bias = {e.surface: space.slices[e.path] for e in space.free if e.declaration.deviation}
    if len(bias) < 2:
        return ()
    at = np.concatenate([np.arange(p.start, p.stop) for p in bias.values()])
    told, less = np.linalg.inv(covariance), 1 / space.prior_std[at] ** 2 - 1 / _WIDE**2
    told[at, at] -= less
    wide = np.linalg.inv(told)
    apart = np.asarray(z) + wide[:, at] @ (less * (np.asarray(z) - space.prior_mean)[at])
    found = []
    for one, other in combinations(bias, 2):
        difference = np.zeros((bias[one].stop - bias[one].start, len(apart)))
        difference[:, bias[one]] = np.eye(len(difference))
        difference[:, bias[other]] = -np.eye(len(difference))
        gap, spread = difference @ apart, difference @ wide @ difference.T
        chance = float(chi2.sf(gap @ np.linalg.solve(spread, gap), len(gap)))
        if chance < CHANCE:
            found.append(Dispute((str(one), str(other)), float(norm.isf(chance / 2))))
    return tuple(sorted(found, key=lambda d: -d.sigma))


def marked(numbers: Mapping[str, Estimate], found: Iterable[Dispute]) -> dict[str, Estimate]:
    """The same, loads called *disputed* instead of *identified* where floors disagree."""
    if not any(True for _ in found):
        return dict(numbers)
    return {
        path: replace(e, verdict="disputed")
        if path.startswith("robot.load_share@") and e.verdict == "identified"
        else e
        for path, e in numbers.items()
    }


Word = Literal["trusted", "doubtful", "not to be trusted"]
WORDS: tuple[Word, ...] = ("trusted", "doubtful", "not to be trusted")
WORSE, MUCH_WORSE = 1.1, 1.5
"""Error of the model over that of encoders on a floor: doubtful from the first on, absurd from the
second on."""
SMALL = 0.005
"""Difference of both errors below which neither is better."""
ABSURD = 0.5
"""Error, as a share of the way, with which no model is of use."""
MANY_AT_BOUNDS = 3
"""Numbers at their bounds from which the model does not fit the logs at all."""
PLAUSIBLE: Mapping[str, tuple[float, float]] = {
    "motor.resistance": (1e-3, 1e3),
    "motor.back_emf": (1e-4, 10.0),
    "surface.*.friction": (5e-3, 5.0),
    "camera.scale": (0.2, 5.0),
    "camera.lag": (-5.0, 5.0),
    "robot.wheel_radius": (2e-3, 2.0),
    "robot.base_radius": (5e-3, 10.0),
}
"""What such numbers of wheeled robots are, in SI."""


@dataclass(frozen=True)
class EndPoints:
    """Mean open-loop end-point errors on a floor, as shares of the way: model and encoders."""

    model: float
    encoders: float


@dataclass(frozen=True)
class Trust:
    """How far a fit may be trusted, and why not further, one sentence each."""

    word: Word
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.word}: {'; '.join(self.reasons)}" if self.reasons else self.word


@dataclass(frozen=True)
class _Reason:
    """How bad, as an index of `WORDS`, and a sentence."""

    level: int
    said: str


def verdict_of_trust(
    floors: Mapping[str, EndPoints], converged: bool, parameters: Iterable[Estimate]
) -> Trust:
    """The worst of what errors, convergence and numbers say.

    Args:
        floors: errors by name of the floor; of runs that the fit has not seen, where there are any.
        converged: whether the fit came to rest.
        parameters: every number of the fit.
    """
    numbers = list(parameters)
    reasons = [*_of_errors(floors), *_of_numbers(numbers)]
    if not converged:
        reasons.append(_Reason(1, "the fit did not come to rest"))
    told = [e.verdict for e in numbers if e.verdict != "fixed"]
    if told and not any(v in ("identified", "weak", "disputed") for v in told):
        reasons.append(_Reason(1, "the logs tell none of its numbers"))
    reasons.sort(key=lambda r: -r.level)
    level = max((r.level for r in reasons), default=0)
    return Trust(WORDS[level], tuple(r.said for r in reasons))


def _of_errors(floors: Mapping[str, EndPoints]) -> Iterator[_Reason]:
    """What open-loop errors say, floor by floor."""
    for name, e in floors.items():
        both = f"{100 * e.model:.1f} % of the way, encoders alone by {100 * e.encoders:.1f} %"
        if not isfinite(e.model):
            yield _Reason(2, f"on {name} its predictions are not numbers")
        elif e.model > e.encoders + SMALL and e.model > WORSE * e.encoders:
            much = e.model > MUCH_WORSE * e.encoders and e.model > e.encoders + 4 * SMALL
            yield _Reason(2 if much else 1, f"on {name} it is off by {both}")
        elif e.model > ABSURD:
            yield _Reason(1, f"on {name} it is off by {both}: neither is of use there")


def _of_numbers(numbers: list[Estimate]) -> Iterator[_Reason]:
    """What numbers say that no robot has, or that ran into their bounds."""
    for e in numbers:
        for pattern, (low, high) in PLAUSIBLE.items():
            value = np.atleast_1d(np.asarray(e.value, float))
            if fnmatchcase(e.path, pattern) and not ((value >= low) & (value <= high)).all():
                worst = float(value[np.argmax(np.abs(value))])
                yield _Reason(
                    2, f"{e.path} = {worst:.3g} {e.unit}, where {low:g} to {high:g} can be"
                )
    bounds = [e.path for e in numbers if e.verdict == "at_bound"]
    if bounds:
        level = 2 if len(bounds) >= MANY_AT_BOUNDS else 1
        verb = "is at its bound" if len(bounds) == 1 else "are at their bounds"
        yield _Reason(level, f"{', '.join(bounds)} {verb}")
