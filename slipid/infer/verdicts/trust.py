"""Trust in what was identified on each floor, from predictions of held-out runs.

A fit is trusted if the model that was selected on each floor predicts held-out runs no worse than
any simpler model, the lengths of the config included, but for a tenth and .1 % of the path, and has
physically plausible parameters. The force balance must also have converged, if it was selected on
some floor. Calibrated lengths that predict far worse than the config's make a fit doubtful even
where they are not selected, since some runs must contradict the others.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from math import isfinite
from typing import Literal

import numpy as np

from slipid.infer.verdicts.estimates import Estimate
from slipid.predict.selection import FloorSelection
from slipid.support.content import Content

Word = Literal["trusted", "doubtful", "not to be trusted"]
WORDS: tuple[Word, ...] = ("trusted", "doubtful", "not to be trusted")
WORSE_RATIO, WORSE_ERROR = 1.1, 0.001
"""The selected model is worse than a simpler one if its error exceeds that of the simpler one by
more than this factor, and by more than this error over the path length [1]."""
FAR_WORSE_RATIO = 1.5
"""Calibrated lengths that are not selected are far worse than the config's if their error exceeds
that of the config's by more than this factor, and by `WORSE_ERROR` [1]; with three correct runs
of a robot whose lengths are as in the config it exceeds it by less."""
USELESS_ERROR = 0.5
"""Error over the path length above which a model is useless [1]."""
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
class Trust:
    """Trust in a fit, with the prediction errors on which it is based.

    Attributes:
        word: level of trust.
        reasons: reasons against the fit, one sentence each.
        notes: suspected causes and other remarks that do not lower the trust, one sentence each.
        floors: selected model and errors of all models, keyed by floor.
    """

    word: Word
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    floors: Mapping[str, FloorSelection]

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
            "notes": list(self.notes),
            "runs": {name: floor.runs for name, floor in self.floors.items()},
            "held_out": {name: floor.held_out for name, floor in self.floors.items()},
            "held_out_error_over_path": {
                name: dict(floor.errors) for name, floor in self.floors.items()
            },
        }


_Reason = tuple[int, str]
"""Reason against a fit: its severity as an index of `WORDS`, and a sentence."""


def verdict_of_trust(
    floors: Mapping[str, FloorSelection],
    converged: bool = True,
    parameters: Iterable[Estimate] = (),
    notes: Iterable[str] = (),
) -> Trust:
    """Return the trust in a fit, by its worst aspect: errors, convergence or parameters.

    Args:
        floors: selection of the model on each floor.
        converged: True if the fit of the force balance converged.
        parameters: every parameter of the force balance.
        notes: remarks that do not lower the trust.
    """
    numbers = list(parameters)
    reasons = list(_of_errors(floors))
    uses_contact = any(floor.model == "contact" for floor in floors.values())
    about_contact = list(_of_numbers(numbers))
    if not converged:
        about_contact.append((2, "the fit of the force balance did not converge"))
    verdicts = {e.verdict for e in numbers} - {"fixed"}
    if verdicts and not verdicts & {"identified", "weak", "disputed"}:
        about_contact.append((1, "the logs determine no parameter of the fit"))
    remarks = list(notes)
    if uses_contact:
        reasons += about_contact
    else:
        remarks += [f"force balance, not selected: {sentence}" for _, sentence in about_contact]
    reasons.sort(key=lambda reason: -reason[0])
    level = max((level for level, _ in reasons), default=0)
    return Trust(WORDS[level], tuple(sentence for _, sentence in reasons), tuple(remarks), floors)


def _of_errors(floors: Mapping[str, FloorSelection]) -> Iterator[_Reason]:
    """Yield reasons against a fit from the errors of held-out runs, floor by floor."""
    for name, floor in floors.items():
        own, order = floor.errors[floor.model], list(floor.errors)
        simpler = order[: order.index(floor.model)]
        if not isfinite(own):
            yield (2, f"on {name} the predictions of {floor.model} are not finite numbers")
            continue
        for other in simpler:
            error = floor.errors[other]
            if own > WORSE_RATIO * error and own > error + WORSE_ERROR:
                yield (
                    2,
                    f"on {name} {floor.model} is off by {100 * own:.2f} % of the path, and the "
                    f"simpler {other} by {100 * error:.2f} %",
                )
        plain, fitted = (floor.errors.get(name, np.nan) for name in ("nominal", "calibrated"))
        worse = fitted > FAR_WORSE_RATIO * plain and fitted > plain + WORSE_ERROR
        if worse and floor.model != "calibrated":
            yield (
                1,
                f"on {name} the calibrated lengths are off by {100 * fitted:.2f} % of the path, "
                f"and the config's by {100 * plain:.2f} %: some runs contradict the others",
            )
        if own > USELESS_ERROR:
            yield (
                2,
                f"on {name} {floor.model} is off by {100 * own:.0f} % of the path, which is "
                "useless: check the columns and units of wheels and poses",
            )
        if not floor.held_out:
            yield (
                1,
                f"on {name} there is only one run, so that no held-out run can judge the models; "
                "drive at least two",
            )


def _of_numbers(numbers: list[Estimate]) -> Iterator[_Reason]:
    """Yield reasons against a fit from parameters that are implausible or at their bounds."""
    for e in numbers:
        for pattern, (low, high) in PLAUSIBLE.items():
            value = np.atleast_1d(np.asarray(e.value, float))
            if fnmatchcase(e.path, pattern) and not ((value >= low) & (value <= high)).all():
                worst = float(value[np.argmax(np.abs(value))])
                unit = "" if e.unit == "1" else f" {e.unit}"
                yield (
                    2,
                    f"{e.path} = {worst:.3g}{unit}; plausible values are {low:g} to {high:g}",
                )
    bounds = [e.path for e in numbers if e.verdict == "at_bound"]
    if bounds:
        level = 2 if len(bounds) >= MANY_AT_BOUNDS else 1
        verb = "is at its bound" if len(bounds) == 1 else "are at their bounds"
        yield (level, f"{', '.join(bounds)} {verb}")
