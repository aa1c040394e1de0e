"""Overall judgement of a fit: floors that disagree about the wheel loads, and trust in the fit.

Each floor has separate load biases (`slipid.model.contact_law`). Their prior is estimated from all
floors and keeps them near zero; the intervals of the loads take this prior into account. The test
for disagreement replaces this prior by an uninformative one. With L the precision of the fit, P0
the part of L from the prior, and P1 the precision of the uninformative prior, the search vector z,
relative to its prior mean, changes by

    d = (L + P1 - P0)^-1 (P0 - P1) z

and the difference of two floors' biases, squared and divided by its covariance, is a chi-square
variable if the contact law holds on both floors.

A fit is trusted if it converged, predicts runs about as well as encoders or better, and has
physically plausible parameters.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from math import isfinite
from typing import Literal

import numpy as np
from scipy.stats import chi2, norm

from slipid.fitting.variances import Search, Square
from slipid.infer.verdicts.estimates import Estimate
from slipid.search_space import Space
from slipid.support.content import Content

LARGEST_P_VALUE = 0.01
"""Largest p-value at which a disagreement is reported."""
_UNINFORMATIVE_STD = 1.0
"""Std of the uninformative prior of load biases."""


def disputes(space: Space, z: Search, covariance: Square) -> dict[tuple[str, str], float]:
    """Return pairs of floors whose load biases differ by more than noise, with the difference.

    A difference is given as the number of standard errors with the same p-value, largest first. The
    prior of the biases in `space` must have the fitted std (`Space.with_pooled`).
    """
    bias = {e.surface: space.slices[e.path] for e in space.free if e.declaration.deviation}
    if len(bias) < 2:
        return {}
    at = np.concatenate([np.arange(p.start, p.stop) for p in bias.values()])
    precision, less = (
        np.linalg.inv(covariance),
        1 / space.prior_std[at] ** 2 - 1 / _UNINFORMATIVE_STD**2,
    )
    precision[at, at] -= less
    wide = np.linalg.inv(precision)
    separate = np.asarray(z) + wide[:, at] @ (less * (np.asarray(z) - space.prior_mean)[at])
    found = {}
    for one, other in combinations(bias, 2):
        difference = separate[bias[one]] - separate[bias[other]]
        spread = wide[bias[one]] - wide[bias[other]]
        spread = spread[:, bias[one]] - spread[:, bias[other]]
        chance = float(chi2.sf(difference @ np.linalg.solve(spread, difference), len(difference)))
        if chance < LARGEST_P_VALUE:
            found[str(one), str(other)] = float(norm.isf(chance / 2))
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))


def marked(
    numbers: Mapping[str, Estimate], found: Mapping[tuple[str, str], float]
) -> dict[str, Estimate]:
    """Change `identified` to `disputed` in the verdicts of load fractions if floors disagree."""
    return {
        path: replace(e, verdict="disputed")
        if found and path.startswith("robot.load_share@") and e.verdict == "identified"
        else e
        for path, e in numbers.items()
    }


Word = Literal["trusted", "doubtful", "not to be trusted"]
WORDS: tuple[Word, ...] = ("trusted", "doubtful", "not to be trusted")
DOUBTFUL_RATIO, UNTRUSTED_RATIO = 1.1, 1.5
"""Ratios of the error of the model to that of the encoders above which a fit is doubtful, or not to
be trusted."""
SMALL_ERROR = 0.005
"""Largest excess of the model's end-point error over that of the encoders, both divided by path
length, that is ignored."""
USELESS_ERROR = 0.5
"""End-point error, divided by path length, above which a model is useless."""
MANY_AT_BOUNDS = 3
"""Smallest number of parameters at their bounds for which a fit is not to be trusted."""
PLAUSIBLE: Mapping[str, tuple[float, float]] = {
    "motor.resistance": (1e-3, 1e3),
    "motor.back_emf": (1e-4, 10.0),
    "surface.*.friction": (5e-3, 5.0),
    "camera.scale": (0.2, 5.0),
    "camera.lag": (-5.0, 5.0),
    "robot.wheel_radius": (2e-3, 2.0),
    "robot.base_radius": (5e-3, 10.0),
}
"""Physically plausible ranges of the parameters of wheeled robots, in SI units."""


@dataclass(frozen=True)
class EndPoints:
    """Mean open-loop end-point errors on a floor, divided by the path length.

    Attributes:
        model: error of the fitted model.
        encoders: error of the path that the encoders give if no wheel slips.
    """

    model: float
    encoders: float


@dataclass(frozen=True)
class Trust:
    """Trust in a fit, with the prediction errors on which it is based.

    Attributes:
        word: level of trust.
        reasons: reasons against the fit, one sentence each.
        floors: end-point errors, keyed by floor.
        runs: number of predicted runs.
    """

    word: Word
    reasons: tuple[str, ...]
    floors: Mapping[str, EndPoints]
    runs: int = 0

    def __str__(self) -> str:
        return f"{self.word}: {'; '.join(self.reasons)}" if self.reasons else self.word

    @property
    def is_bad(self) -> bool:
        """True if the fit must not be used."""
        return self.word == WORDS[-1]

    @property
    def warning(self) -> str | None:
        """Warning that every figure of an unusable fit shows; None for a usable fit."""
        return f"THIS FIT IS {self.word.upper()}" if self.is_bad else None

    def to_json(self) -> Content:
        return {
            "verdict": self.word,
            "reasons": list(self.reasons),
            "runs": self.runs,
            "endpoint_error_over_path": {name: asdict(e) for name, e in self.floors.items()},
        }


_Reason = tuple[int, str]
"""Reason against a fit: its severity as an index of `WORDS`, and a sentence."""


def verdict_of_trust(
    floors: Mapping[str, EndPoints],
    converged: bool,
    parameters: Iterable[Estimate],
    runs: int = 0,
) -> Trust:
    """Return the trust in a fit, by its worst aspect: errors, convergence or parameters.

    Args:
        floors: end-point errors, keyed by floor; those of held-out runs, if there are any.
        converged: True if the fit converged.
        parameters: every parameter of the fit.
        runs: number of predicted runs.
    """
    numbers = list(parameters)
    reasons = [*_of_errors(floors), *_of_numbers(numbers)]
    if not converged:
        reasons.append((1, "the fit did not converge"))
    verdicts = {e.verdict for e in numbers} - {"fixed"}
    if verdicts and not verdicts & {"identified", "weak", "disputed"}:
        reasons.append((1, "the logs determine no parameter of the fit"))
    reasons.sort(key=lambda reason: -reason[0])
    level = max((level for level, _ in reasons), default=0)
    return Trust(WORDS[level], tuple(sentence for _, sentence in reasons), floors, runs)


def _of_errors(floors: Mapping[str, EndPoints]) -> Iterator[_Reason]:
    """Yield reasons against a fit from its open-loop errors, floor by floor."""
    for name, e in floors.items():
        both = f"{100 * e.model:.1f} % of the path, those of encoders by {100 * e.encoders:.1f} %"
        if not isfinite(e.model):
            yield (2, f"on {name} the fit's predictions are not finite numbers")
        elif e.model > e.encoders + SMALL_ERROR and e.model > DOUBTFUL_RATIO * e.encoders:
            much = e.model > UNTRUSTED_RATIO * e.encoders and e.model > e.encoders + 4 * SMALL_ERROR
            yield (2 if much else 1, f"on {name} the fit's predictions are off by {both}")
        elif e.model > USELESS_ERROR:
            yield (1, f"on {name} the fit's predictions are off by {both}: neither is useful there")


def _of_numbers(numbers: list[Estimate]) -> Iterator[_Reason]:
    """Yield reasons against a fit from parameters that are implausible or at their bounds."""
    for e in numbers:
        for pattern, (low, high) in PLAUSIBLE.items():
            value = np.atleast_1d(np.asarray(e.value, float))
            if fnmatchcase(e.path, pattern) and not ((value >= low) & (value <= high)).all():
                worst = float(value[np.argmax(np.abs(value))])
                yield (
                    2,
                    f"{e.path} = {worst:.3g} {e.unit}; plausible values are {low:g} to {high:g}",
                )
    bounds = [e.path for e in numbers if e.verdict == "at_bound"]
    if bounds:
        level = 2 if len(bounds) >= MANY_AT_BOUNDS else 1
        verb = "is at its bound" if len(bounds) == 1 else "are at their bounds"
        yield (level, f"{', '.join(bounds)} {verb}")
