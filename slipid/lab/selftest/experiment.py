"""The command `slipid selftest`: the parameters that an experiment can recover."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import filter as matching
from pathlib import Path

import numpy as np
from scipy.stats import binom, chi2

from slipid.app.check import expected
from slipid.app.config import Config, read_config, shape_of, single_floor_sections
from slipid.app.logs import layout_of
from slipid.app.problem import (
    ConfigFitTask,
    fit_task,
    read_fit_task,
    refuse_steered,
)
from slipid.data.runs import collect
from slipid.fitting.problem import Problem
from slipid.infer.verdicts.estimates import derived
from slipid.lab.selftest import replicates as test
from slipid.lab.selftest.logs import SimulatedSensors, heading_grid, simulate_logs, turning_grid
from slipid.lab.selftest.replicates import NumberRecovery, Replicate
from slipid.model.robot import build
from slipid.support.checkpoint import Checkpoint, key_of
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SCHEMA = "slipid.selftest/1"
LEVEL = 1e-3
"""Significance level of the two tests of a parameter's errors over all replicates.

The tests check whether its 90 % intervals contain the truth often enough, and whether its errors
agree with its standard deviations. A parameter that fails one of these tests counts as recovered
wrongly, unless its verdict already makes it count as not recovered."""
LEAST_CONVERGED = 0.75
"""Smallest fraction of the replicates' fits that must converge for a successful self test."""
VERDICT_ORDER = ("identified", "weak", "not_identified", "at_bound")
"""Verdicts of a fit; if several are equally frequent, the last one in this order is reported."""


def selftest(
    config_path: Path, data: Path | None, out: Path, count: int, seed: int, report: Reporter
) -> Content:
    """Simulate an experiment with known true parameters, fit it, and return what was recovered.

    The result is also written to selftest.json.

    Args:
        config_path: path of the config of the experiment.
        data: folder of the logs of the experiment, whose wheel motion the simulation uses; None to
            simulate the plan in the config's section `[selftest]`.
        out: folder for selftest.json and the replicates; a later call continues from these.
        count: number of replicates.
        seed: seed of true parameters and noise.
        report: receives messages about progress.
    """
    setup_jax(quiet=True)
    config = read_config(config_path)
    task = planned_task(config, report) if data is None else read_fit_task(config, data, report)
    problem = task.problem()
    wanted = wanted_paths(config, problem)
    test.plausible(task, problem)
    writable(out)
    report.stage("expected information")
    before = expected(task, problem, report.steps)
    kept = Checkpoint(out, key_of(config.hash, task.data_hash, seed))
    rows = test.replicates(task, problem, count, seed, kept, report)
    found = {
        "schema": SCHEMA,
        "source": "plan" if data is None else "logs",
        "runs": len(task.dataset),
        "seed": seed,
        "noise": dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True)),
        **summary(rows, wanted),
        "messages": list(before.messages),
        "data": {"hash": task.data_hash},
    }
    write_json(out / "selftest.json", found)
    return found


def planned_task(config: Config, report: Reporter) -> ConfigFitTask:
    """Return the fit task of a planned experiment, whose runs are the grid of `[selftest]`.

    The logs are simulated. They have the channels that the config's layouts name, and runs with
    every load set-up of the config on every floor.
    """
    wanted, shape = config.content.selftest, shape_of(config)
    refuse_steered(shape)
    sections = single_floor_sections(config.content.logs)
    loads = list(dict.fromkeys(section.load for section in sections))
    setups = [(floor, load) for floor in wanted.surfaces for load in loads]
    if shape.determines_twist:
        runs = heading_grid(setups, wanted.headings, wanted.speeds_m_s, wanted.turns)
    else:
        base = float(shape.base_radius)
        runs = turning_grid(setups, wanted.headings, wanted.speeds_m_s, base)
    drives = [replace(d, distance=wanted.distance_m) for d in runs]
    robot = build(shape, wanted.surfaces, loads, sorted({d.session for d in drives}))
    layouts = [layout_of(config, section) for section in sections]
    channels = [layout.holds for layout in layouts]
    has_current = all("current" in c for c in channels)
    has_voltage = all("voltage" in c or {"duty", "bus_voltage"} <= c for c in channels)
    is_signed = all(layout.current_is_signed for layout in layouts)
    logs = simulate_logs(
        robot, drives, 0, SimulatedSensors(has_voltage=has_voltage, signed=is_signed)
    )
    if not has_current:
        logs = [replace(log, current=None) for log in logs]
    report.line(
        f"no logs given; simulating the {len(logs)} runs of [selftest] on "
        f"{', '.join(wanted.surfaces)}"
    )
    return fit_task(config, collect(logs), [], report)


def wanted_paths(config: Config, problem: Problem) -> tuple[str, ...]:
    """Return the paths of the parameters and ratios that a successful self test must recover.

    These paths match the patterns in the config or, if it has none, the patterns of parameters that
    the logged channels should identify.

    Raises:
        DataError: a pattern of the config matches no fitted parameter and no ratio.
    """
    w, z = problem.windows, problem.space.start
    ratios = derived(problem.space, z, np.eye(len(z)), w.has_voltage)
    paths = [e.path for e in problem.space.free] + [e.path for e in ratios]
    given = config.content.selftest.wanted
    patterns = ["surface.*.creep"]
    # other drives depend too little on loads and roller drag to require that these are recovered
    if problem.robot.geometry.determines_twist:
        patterns += ["surface.*.roller_drag", "robot.load_share@*"]
    patterns += ["surface.*.friction/motor.back_emf"] if w.has_current else []
    patterns += ["motor.resistance", "motor.back_emf"] if w.has_current and w.has_voltage else []
    for pattern in given or []:
        if not matching(paths, pattern):
            raise DataError(
                f"{config.path}: selftest.wanted '{pattern}': not fitted, not even as a ratio; "
                f"expected one of {', '.join(paths)}"
            )
    chosen = patterns if given is None else given
    return tuple(p for p in paths if any(matching([p], pattern) for pattern in chosen))


def summary(replicates: Sequence[Replicate], wanted: Sequence[str]) -> Content:
    """Return the comparison of estimates with the truth, summarised over all replicates.

    Returns:
        Content of selftest.json: errors, coverage, verdict and recovery of each of the
        `parameters` (ratios included); errors of `curves` and `predictions` by floor; `failed`, the
        required parameters that were not recovered; `recovered`, True if there are none, and if
        enough fits converged.
    """
    first = replicates[0]
    numbers = {
        path: number_summary([one.parameters[path] for one in replicates])
        for path in first.parameters
    }
    curves = {floor: [one.curves[floor] for one in replicates] for floor in first.curves}
    failed = [p for p in wanted if numbers[p]["recovered"] in ("no", "wrong")]
    converged = sum(one.converged for one in replicates)
    return {
        "replicates": len(replicates),
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
                model: float(np.mean([one.predictions[floor][model] for one in replicates]))
                for model in models
            }
            for floor, models in first.predictions.items()
        },
        "wanted": list(wanted),
        "failed": failed,
        "recovered": not failed and converged >= LEAST_CONVERGED * len(replicates),
    }


def number_summary(found: Sequence[NumberRecovery]) -> Content:
    """Return the summary of one parameter over all replicates.

    `recovered` follows from the most frequent verdict of the fits: "yes" for identified, "roughly"
    for weak, and "no" for any other verdict. "yes" and "roughly" become "wrong" if the errors are
    significantly larger than the fits' intervals and standard deviations allow (`LEVEL`).
    """
    truth, value = np.array([f.truth for f in found]), np.array([f.value for f in found])
    inside, z = np.array([f.inside for f in found]), np.array([f.z for f in found])
    count = Counter(f.verdict for f in found)
    verdict = max(reversed(VERDICT_ORDER), key=lambda v: count[v])
    hits, total = int(inside.sum()), inside.size
    honest = binom.cdf(hits, total, 0.9) > LEVEL and chi2.sf(float((z**2).sum()), z.size) > LEVEL
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
