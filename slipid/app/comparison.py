"""The hypothesis ladder of a config: folds kept one by one, then verdicts and a picture."""

import hashlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slipid.app import files, runtime
from slipid.app.config import read_config
from slipid.app.progress import Reporter
from slipid.data.files import read_json, writable, write_json
from slipid.data.log import DataError

SCHEMA, SCHEMA_FOLD = "slipid.comparison/1", "slipid.comparison.fold/1"
FOLDS = "folds"
"""Folder of finished folds inside the result's; a fold there is not done again."""
EXACT = 6
"""Runs that are left out one by one, to see how good importance sampling is."""


def compare(
    config_path: Path, data: Path, out: Path, questions: Sequence[str], report: Reporter
) -> dict[str, Any]:
    """Judge every rung of the ladder on left-out runs and write comparison.json and a picture.

    Args:
        questions: what is left out: some of `slipid.identify.compare.QUESTIONS`.

    Raises:
        DataError: config, logs or questions are wrong; nothing was written then.
    """
    runtime.start()
    from slipid.app.job import read_job
    from slipid.identify.compare import folds_of
    from slipid.identify.ranking import ranking
    from slipid.identify.transfer import transfer

    config = read_config(config_path)
    report.stage("reading logs")
    job = read_job(config, data, report.count, report.line)
    asked = {name: folds_of(job.dataset, name) for name in dict.fromkeys(questions)}
    try:
        job.robot.geometry.inverse()
    except ValueError as error:
        raise DataError(f"{config.path}: nothing to compare: {error}") from error
    for name in [name for name, fold in asked.items() if (fold < 0).all()]:
        report.line(f"skipped: {name}: no floor has runs in two of them")
        del asked[name]
    if not asked:
        raise DataError(
            f"{config.path}: no run can be left out; expected several headings or speeds"
        )
    report.stage("cutting windows")
    problem = job.problem()
    writable(out)
    results, whole = _folds(job, problem, asked, out / FOLDS, report)
    found: dict[str, Any] = {
        "schema": SCHEMA,
        "questions": {
            name: {
                "folds": len(some),
                "converged": all(fold["converged"] for fold in some),
                "floors": ranking(_rows(some)),
                "cost": _cost(some),
            }
            for name, some in results.items()
        },
        "surfaces": transfer(problem.windows, whole.robot) if problem.windows.has_current else {},
        "loo": _loo(whole, out / FOLDS, _key(job, problem), report),
        "data": {"hash": job.data_hash, "runs": len(job.dataset), "skipped": list(job.skipped)},
        "config": {"name": config.path.name, "sha256": config.hash},
        "versions": files.versions(),
        "runs": {name: _rows(some) for name, some in results.items()},
    }
    report.stage("writing")
    write_json(out / "comparison.json", found)
    from slipid.app.plots_compare import compare_plot

    report.line(f"in {out}: comparison.json, {compare_plot(found, out).name}")
    return found


def _rows(folds: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for fold in folds for row in fold["rows"]]


def _cost(folds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Fitted numbers per floor, and seconds per fold to fit and to predict, of every model."""
    out = {}
    for model, numbers in folds[0]["numbers"].items():
        seconds = [fold["seconds"][model] for fold in folds]
        out[model] = {
            "numbers": numbers,
            "fit_s": float(np.median([s["fit"] for s in seconds])),
            "predict_s": float(np.median([s["predict"] for s in seconds])),
        }
    return out


def _key(job: Any, problem: Any) -> list[str]:
    """What every fold depends on."""
    same = [job.config.hash, job.data_hash, *map(str, files.versions().items())]
    return [*same, *problem.space.names, *problem.noise.names]


def _folds(
    job: Any, problem: Any, asked: dict[str, Any], folder: Path, report: Reporter
) -> tuple[dict[str, list[dict[str, Any]]], Any]:
    """Every fold of every question, and the force balance fitted to all runs."""
    from slipid.identify.compare import judge
    from slipid.identify.fit import Options, optimise
    from slipid.identify.predictive import contact_of
    from slipid.identify.problem import State

    wanted, data = job.config.content.fit, job.dataset
    options = Options(most_rounds=wanted.rounds, tolerance=wanted.tolerance)
    key = _key(job, problem)

    def tell(state: Any) -> None:
        report.beside(f"{state.stage}, round {state.round}")

    def whole() -> dict[str, Any]:
        optimum = optimise(problem, options=options, tell=tell)
        state = optimum.state
        return {
            "z": state.z,
            "log_variance": state.log_variance,
            "covariance": optimum.covariance,
            "converged": optimum.converged,
        }

    work: list[tuple[str, str, str, Callable[[], dict[str, Any]]]] = []
    for name, fold in asked.items():
        parts = sorted({int(f) for f in fold if f >= 0})
        for count, k in enumerate(parts, start=1):
            judged = np.flatnonzero(fold == k)

            def one(judged: np.ndarray = judged) -> dict[str, Any]:
                return judge(problem, job.choices, data, judged, options, tell)

            work.append((name, f"{name}_{k}", f"{name}, fold {count} of {len(parts)}", one))
    work.append(("all", "all", "all runs", whole))
    done: dict[str, list[dict[str, Any]]] = {}
    clock = _Clock(len(work))
    for name, label, said, make in work:
        report.stage(f"{said}; {clock.said()}")
        fold, fresh = kept_fold(folder / f"{label}.json", [*key, label], make)
        clock.tick(fresh)
        done.setdefault(name, []).append(fold)
    fit = done.pop("all")[0]
    z, log_v = np.asarray(fit["z"], float), np.asarray(fit["log_variance"], float)
    state = State(z, log_v, 0, np.inf, np.inf, "joint")
    return done, contact_of(problem, state, np.asarray(fit["covariance"], float))


def kept_fold(
    path: Path, key: Sequence[str], make: Callable[[], dict[str, Any]]
) -> tuple[dict[str, Any], bool]:
    """A finished fold from its file where that is of this very job, else made and kept.

    Returns:
        the fold as its file has it, and whether it was made now.
    """
    wanted = hashlib.sha256("\n".join(key).encode()).hexdigest()
    try:
        kept = read_json(path, "a finished fold of `slipid compare`")
        if kept["key"] == wanted and kept["schema"] == SCHEMA_FOLD:
            return kept["fold"], False
    except (DataError, KeyError, TypeError):
        pass
    write_json(path, {"schema": SCHEMA_FOLD, "key": wanted, "fold": make()})
    return read_json(path, "a finished fold of `slipid compare`")["fold"], True


class _Clock:
    """How long the folds that are left will take, from those done in this process."""

    def __init__(self, total: int):
        self.total, self.done, self.fresh = total, 0, 0
        self.began = time.monotonic()
        self.spent = 0.0

    def tick(self, fresh: bool) -> None:
        self.done += 1
        now = time.monotonic()
        if fresh:
            self.fresh += 1
            self.spent += now - self.began
        self.began = now

    def said(self) -> str:
        text = f"{self.done} of {self.total} fits done"
        if not self.fresh:
            return text
        left = self.spent / self.fresh * (self.total - self.done)
        return f"{text}, about {max(1, round(left / 60))} min left"


def _loo(contact: Any, folder: Path, key: Sequence[str], report: Reporter) -> dict[str, Any]:
    """Leave-one-run-out by importance sampling beside exact refits, where arviz is installed."""
    from slipid.identify.loo import exact_loo, psis_loo

    report.stage("leave one run out, by importance sampling")

    def make() -> dict[str, Any]:
        found = psis_loo(contact)
        # the least reliable one, and some spread over all runs
        count = len(found.log_density)
        spread = np.linspace(0, count, EXACT, endpoint=False).astype(int)[1:]
        pick = dict.fromkeys([int(np.argmax(found.pareto_k)), *spread.tolist()])
        exact = [
            {
                "run": run,
                "psis": float(found.log_density[run]),
                "exact": exact_loo(contact, run),
                "pareto_k": float(found.pareto_k[run]),
            }
            for run in pick
        ]
        return {
            "elpd": float(found.log_density.mean()),
            "pareto_k_max": float(found.pareto_k.max()),
            "good_k": found.good_k,
            "unreliable": int((found.pareto_k > found.good_k).sum()),
            "exact": exact,
            "log_density": found.log_density,
            "pareto_k": found.pareto_k,
        }

    try:
        return kept_fold(folder / "loo.json", [*key, "loo"], make)[0]
    except DataError as error:
        if "slipid[posterior]" not in str(error):
            raise
        report.line(f"skipped: {error}")
        return {"skipped": str(error)}
