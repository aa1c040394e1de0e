"""Tuning of the settings of every method in the same way: on held-out training runs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from slipid.lab.benchmark.protocols import INNER_FOLDS, inner
from slipid.lab.benchmark.scores import scored
from slipid.predict.slip_model import TRIES, RobotSpec, Run, SlipModel
from slipid.predict.slip_models import ByFloor

LARGEST_ERROR = 2.0
"""Upper limit of a run's relative error in the loss; larger errors are replaced by this limit."""
Method = TypeVar("Method")


@dataclass(frozen=True, eq=False)
class Tuned(Generic[Method]):
    """A method with the best of its settings, unfitted.

    Attributes:
        method: the method.
        settings: its settings in words.
        tried: number of settings that were compared.
        loss: loss of the method; NaN if there was only one candidate.
    """

    method: Method
    settings: str = ""
    tried: int = 1
    loss: float = np.nan


def best_candidate(candidates: Sequence[Method], loss: Callable[[Method], float]) -> Tuned[Method]:
    """Return the candidate with the smallest loss; the first such candidate if several tie."""
    if len(candidates) == 1:
        return Tuned(candidates[0])
    losses = [loss(candidate) for candidate in candidates]
    best = candidates[int(np.argmin(losses))]
    return Tuned(best, settings_of(best, candidates), len(candidates), min(losses))


def tuned(method: SlipModel, runs: Sequence[Run], spec: RobotSpec, kind: str) -> Tuned[SlipModel]:
    """Return the method with the best of its settings, unfitted.

    With each setting, the method is fitted without a part of the runs and scored on that part. The
    part is chosen by the protocol's kind of split where the training runs allow it (see `inner`).
    The score is a mean error in which all floors have equal weights: the end-point error relative
    to the path length, or the energy error if this is `SlipModel.aim`. A setting with which the
    method cannot be fitted has the worst score. All training runs are used, since settings that are
    best for fewer runs are too cautious. For a method that is fitted floor by floor, one fit to all
    runs together is also tried with the best settings, and used if it has the smaller loss.
    """
    part = inner(runs, kind)

    def loss(candidate: SlipModel) -> float:
        return _loss(candidate, runs, part, spec)

    found = best_candidate(list(method.candidates())[:TRIES], loss)
    best = found.method
    if not isinstance(best, ByFloor) or len({best.group_of(run.signals) for run in runs}) < 2:
        return found
    separate = found.loss if found.tried > 1 else loss(best)
    pooled = replace(best, pooled=True)
    if loss(pooled) >= separate:
        return replace(found, tried=found.tried + 1)
    words = ", ".join(filter(None, (found.settings, "one fit to all runs")))
    return Tuned(pooled, words, found.tried + 1)


def _loss(method: SlipModel, runs: Sequence[Run], part: np.ndarray, spec: RobotSpec) -> float:
    """Return the mean error on parts of the runs that are held out in turn.

    Errors are averaged over the runs of each floor and then over floors. The loss is infinite if
    the method cannot be fitted, and 0 if no part can be held out.
    """
    errors: dict[str, list[float]] = {}
    for k in range(INNER_FOLDS):
        training = [run for run, p in zip(runs, part, strict=True) if p != k]
        floors = {run.signals.floor for run in training}
        held_out = [
            run for run, p in zip(runs, part, strict=True) if p == k and run.signals.floor in floors
        ]
        if not training or not held_out:
            continue
        try:
            fitted = method.fit(training, spec)
            predicted = fitted.predict([run.signals for run in held_out], spec)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            return np.inf
        for run, one in zip(held_out, predicted, strict=True):
            score = scored(run, one, spec, "path")
            error = score.energy_error if method.aim == "energy" else score.endpoint_error
            known = LARGEST_ERROR if error is None or not np.isfinite(error) else error
            errors.setdefault(run.floor, []).append(min(known, LARGEST_ERROR))
    return float(np.mean([np.mean(of_floor) for of_floor in errors.values()])) if errors else 0.0


def settings_of(best: object, candidates: Sequence[object]) -> str:
    """Return the best candidate's values of the fields in which candidates differ, as text.

    An example is `ridge = 0.01`.
    """
    inside = [vars(c.method if isinstance(c, ByFloor) else c) for c in (best, *candidates)]
    names = [name for name in inside[0] if len({repr(one[name]) for one in inside}) > 1]
    return ", ".join(f"{name} = {inside[0][name]!r}" for name in names)
