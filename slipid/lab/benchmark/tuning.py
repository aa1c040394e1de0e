"""The same chance for every method: its settings by held-back training runs.

A plain reading of the tables: where slipid is ahead, where it is not, and by how much.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slipid.lab.benchmark.protocols import INNER, inner
from slipid.lab.benchmark.scores import scored
from slipid.lab.benchmark.slipid_rows import NAME
from slipid.lab.benchmark.summary import MeanInterval, RowSummary
from slipid.predict.slip_model import TRIES, ByFloor, RobotSpec, Run, SlipModel

WORST = 2.0
"""Relative error beyond which it does not matter how far a setting is off."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """A method with its settings, and in words which these are and how many were tried."""

    method: SlipModel
    settings: str
    tried: int


def tuned(method: SlipModel, runs: Sequence[Run], spec: RobotSpec, kind: str) -> Tuned:
    """The method with the best of its settings, unfitted.

    Each is fitted without a part of the runs, of the kind that the method will be judged by as far
    as the training runs have such parts, and judged on that part by its mean error, of the end over
    the path or of the energy (`SlipModel.aim`), floors counting alike. A setting with which the
    method cannot be fitted counts as the worst. All training runs are used, since settings that are
    best for fewer are too cautious. A method that is fitted floor by floor may also do better with
    one fit to all runs: with the best settings both are tried.
    """
    candidates = list(method.candidates())[:TRIES]
    part = inner(runs, kind)
    pools = isinstance(method, ByFloor) and len({method.group_of(run.signals) for run in runs}) > 1
    if len(candidates) == 1 and not pools:
        return Tuned(method, "", 1)
    losses = [_loss(candidate, runs, part, spec) for candidate in candidates]
    best = candidates[int(np.argmin(losses))]
    settings = [settings_of(best, candidates)]
    if pools and isinstance(best, ByFloor):
        pooled = replace(best, pooled=True)
        if _loss(pooled, runs, part, spec) < min(losses):
            best = pooled
            settings.append("one fit to all runs")
    words = ", ".join(word for word in settings if word)
    return Tuned(best, words, len(candidates) + pools)


def _loss(method: SlipModel, runs: Sequence[Run], part: np.ndarray, spec: RobotSpec) -> float:
    """Mean error over parts left out in turn, over runs and then over floors."""
    errors: dict[str, list[float]] = {}
    for k in range(INNER):
        fitted = [run for run, p in zip(runs, part, strict=True) if p != k]
        floors = {run.signals.floor for run in fitted}
        left_out = [
            run for run, p in zip(runs, part, strict=True) if p == k and run.signals.floor in floors
        ]
        if not fitted or not left_out:
            continue
        try:
            said = method.fit(fitted, spec).predict([run.signals for run in left_out], spec)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            return np.inf
        for run, one in zip(left_out, said, strict=True):
            found = scored(run, one, spec, "path")
            error = found.energy_error if method.aim == "energy" else found.endpoint_error
            error = np.inf if error is None else error
            mine = errors.setdefault(run.floor, [])
            mine.append(min(error, WORST) if np.isfinite(error) else WORST)
    return float(np.mean([np.mean(mine) for mine in errors.values()])) if errors else 0.0


def settings_of(best: object, candidates: Sequence[object]) -> str:
    """The fields in which candidates differ, as the best one has them: `ridge = 0.01`."""
    inside = [vars(c.method if isinstance(c, ByFloor) else c) for c in (best, *candidates)]
    names = [name for name in inside[0] if len({repr(one[name]) for one in inside}) > 1]
    return ", ".join(f"{name} = {inside[0][name]!r}" for name in names)


NAMED = 4
"""Rows that a sentence names."""


def reading(tables: Mapping[str, Mapping[str, Mapping[str, RowSummary]]]) -> list[str]:
    """A sentence for each protocol of each data set."""
    return [
        sentence(name, protocol, found)
        for name, protocols in tables.items()
        for protocol, found in protocols.items()
    ]


def sentence(name: str, protocol: str, found: Mapping[str, RowSummary]) -> str:
    """What the end-point errors of one table say of slipid."""
    head = f"{name}, {protocol.replace('_', ' ')}: "
    own = found.get(NAME)
    errors = {row: s.endpoint_error for row, s in found.items() if s.endpoint_error is not None}
    if own is None or own.endpoint_error is None:
        why = "was not asked" if own is None else own.absent
        return f"{head}slipid has no row ({why})"
    mine = _percent(own.endpoint_error)
    others = {row: error for row, error in errors.items() if not row.startswith(NAME)}
    if not others:
        return f"{head}slipid errs by {mine}; nothing to compare it with"
    ahead = {row: b for row in others if (b := found[row].behind) is not None and b.high < 0}
    tied = [row for row in others if (b := found[row].behind) is not None and b.low <= 0 <= b.high]
    if ahead:
        best = min(ahead, key=lambda row: others[row].value)
        also = f" (and {len(ahead) - 1} more)" if len(ahead) > 1 else ""
        return (
            f"{head}{best}{also} is ahead of slipid: {_percent(others[best])} against {mine}, "
            f"{_points(ahead[best])}"
        )
    best = min(others, key=lambda row: others[row].value)
    said = f"{head}slipid errs by {mine}, the best other row, {best}, by {_percent(others[best])}"
    if tied:
        tied.sort(key=lambda row: others[row].value)
        more = f" and {len(tied) - NAMED} more" if len(tied) > NAMED else ""
        return f"{said}; not told apart from {', '.join(tied[:NAMED])}{more}"
    behind = found[best].behind
    return f"{said}, {_points(behind)}" if behind is not None else said


def _percent(x: MeanInterval) -> str:
    return f"{100 * x.value:.1f} %"


def _points(x: MeanInterval) -> str:
    """A difference in points of percent, with its interval."""
    return f"{100 * x.value:+.1f} points [{100 * x.low:+.1f}, {100 * x.high:+.1f}]"
