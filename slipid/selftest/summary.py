"""All replicates of a self-test as one answer: what this experiment recovers."""

from collections import Counter
from collections.abc import Sequence
from fnmatch import filter as matching

import numpy as np
from scipy.stats import binom, chi2

from slipid.identify.fit.problem import Problem
from slipid.identify.verdicts.estimates import derived
from slipid.job.config import Config
from slipid.selftest.replicates import Number, Replicate
from slipid.support.content import Content
from slipid.support.errors import DataError

SCHEMA = "slipid.selftest/1"
CHANCE = 1e-3
"""Probability below which errors this large, or so many intervals without the truth, are no chance.

A number whose intervals fail this is wrong, whatever its verdict says.
"""
SETTLED = 0.75
"""Least part of the fits that must converge."""
ORDER = ("identified", "weak", "not_identified", "at_bound")


def wanted_of(config: Config, problem: Problem) -> tuple[str, ...]:
    """Paths that must be recovered: the config's, else what the channels promise.

    Raises:
        DataError: a pattern of the config matches nothing that is fitted.
    """
    w, z = problem.windows, problem.space.start
    ratios = derived(problem.space, z, np.eye(len(z)), w.has_voltage)
    paths = [e.path for e in problem.space.free] + [e.path for e in ratios]
    given = config.content.selftest.wanted
    patterns = ["surface.*.creep", "surface.*.roller_drag", "robot.load_share@*"]
    patterns += ["surface.*.friction/motor.back_emf"] if w.has_current else []
    patterns += ["motor.resistance", "motor.back_emf"] if w.has_current and w.has_voltage else []
    for pattern in given or []:
        if not matching(paths, pattern):
            raise DataError(
                f"{config.path}: selftest.wanted '{pattern}': not fitted; "
                f"expected one of {', '.join(paths)}"
            )
    chosen = patterns if given is None else given
    return tuple(p for p in paths if any(matching([p], pattern) for pattern in chosen))


def summary(made: Sequence[Replicate], wanted: Sequence[str]) -> Content:
    """Error, coverage, verdict and whether it was recovered, of everything that was compared.

    Returns:
        `parameters` (ratios included), `curves`, `predictions`, `failed` (wanted and not
        recovered), `recovered`.
    """
    first = made[0]
    numbers = {path: judged([one.parameters[path] for one in made]) for path in first.parameters}
    curves = {floor: [one.curves[floor] for one in made] for floor in first.curves}
    failed = [p for p in wanted if numbers[p]["recovered"] in ("no", "wrong")]
    converged = sum(one.converged for one in made)
    return {
        "replicates": len(made),
        "converged": converged,
        "parameters": numbers,
        "curves": {
            floor: {
                "largest_gap": max(c.gap for c in each),
                "median_gap": float(np.median([c.gap for c in each])),
                "coverage90": float(np.mean([c.inside for c in each])),
            }
            for floor, each in curves.items()
        },
        "predictions": {
            floor: {
                model: float(np.mean([one.predictions[floor][model] for one in made]))
                for model in models
            }
            for floor, models in first.predictions.items()
        },
        "wanted": list(wanted),
        "failed": failed,
        "recovered": not failed and converged >= SETTLED * len(made),
    }


def judged(found: Sequence[Number]) -> Content:
    """One number over all replicates.

    `recovered` is yes where most fits call it identified, roughly where they call it weak, no where
    they say that they do not know it, and wrong where errors are larger than the fits say.
    """
    truth, value = np.array([f.truth for f in found]), np.array([f.value for f in found])
    inside, z = np.array([f.inside for f in found]), np.array([f.z for f in found])
    count = Counter(f.verdict for f in found)
    verdict = max(reversed(ORDER), key=lambda v: count[v])
    hits, total = int(inside.sum()), inside.size
    honest = binom.cdf(hits, total, 0.9) > CHANCE and chi2.sf(float((z**2).sum()), z.size) > CHANCE
    recovered = {"identified": "yes", "weak": "roughly"}.get(verdict, "no")
    if recovered != "no" and not honest:
        recovered = "wrong"
    return {
        "unit": found[0].unit,
        "labels": found[0].labels,
        "truth": truth.tolist(),
        "value": value.tolist(),
        "z": z.tolist(),
        "error_rms": _rms(value - truth),
        "relative_error_rms": _rms(value / truth - 1) if (truth > 0).all() else None,
        "z_rms": _rms(z),
        "coverage90": hits / total,
        "intervals": total,
        "verdicts": dict(count),
        "verdict": verdict,
        "recovered": recovered,
    }


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))
