"""Fit a robot, from a config and its logs or from runs, with verdicts and result files."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slipid.app.bench_priors import COPY_NAME
from slipid.app.check import refuse_if_wrong, sanity
from slipid.app.config import read_config
from slipid.app.logs import write_run_file
from slipid.app.problem import ConfigFitTask, FitTask, read_fit_task, with_mixed
from slipid.app.trust import TrustReport, trust_report
from slipid.fitting.multi_floor import multi_floor_runs
from slipid.fitting.multi_floor_fit import fit_multi_floor
from slipid.fitting.optimise import Optimum, optimise
from slipid.fitting.problem import FitState, Problem
from slipid.infer.fit_file import save
from slipid.infer.result import Fit
from slipid.infer.summary import summarise
from slipid.infer.verdicts.profile import Profile, profile, profiled
from slipid.predict.agreement import contradiction, floor_errors, largest_shift
from slipid.predict.slip_models import slip_models
from slipid.support.checkpoint import Checkpoint, key_of
from slipid.support.errors import DataError
from slipid.support.files import read_json, writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

NEAR_OPTIMUM = 3
"""Round from which a fit counts as near its optimum."""
CHECKPOINT = "checkpoint"
"""Name of the file with the state of an unfinished fit."""


@dataclass(frozen=True, eq=False)
class IdentifyResult:
    """Result of `identify`.

    Attributes:
        fit: the fit.
        task: the runs, the config and the choices that it was made from.
        trust: verdict on the fit by its open-loop predictions.
        profiles: the requested profile likelihoods.
        written: names of the files.
    """

    fit: Fit
    task: ConfigFitTask
    trust: TrustReport
    profiles: tuple[Profile, ...]
    written: tuple[str, ...]


def identify(
    config_path: Path,
    data: Path,
    out: Path,
    report: Reporter,
    profiles: Sequence[str] = (),
    anyway: bool = False,
) -> IdentifyResult:
    """Fit the robot of a config to its logs and write everything to `out`.

    A fit that was interrupted there is continued.

    Args:
        profiles: paths of numbers whose likelihood is profiled.
        anyway: fit even where logs and config contradict each other, and report that.

    Raises:
        DataError: config or logs are wrong; nothing was written then.
    """
    began = time.monotonic()
    setup_jax(quiet=True)
    config = read_config(config_path)
    task = read_fit_task(config, data, report)
    report.line(f"{len(task.dataset)} runs on {', '.join(task.robot.surfaces.labels)}")
    _check_sanity(task, report, anyway)
    task = with_mixed(task, data, report)
    report.stage("cutting windows")
    problem = task.problem()
    for path in profiles:
        try:
            profiled(problem.space, path)
        except ValueError as error:
            raise DataError(f"--profile: {error}") from error
    writable(out)
    if sentence := _replaced_fit(out, task):
        report.line(sentence)
    key = key_of(config.hash, task.data_hash, problem.space.names, problem.noise.names)
    kept = Checkpoint(out, key)
    problem, optimum = optimised(task, problem, kept, report)
    fit = summarised(task, problem, optimum, report)
    report.stage("predicting the fitted runs")
    trust = trust_report(fit, task.dataset)
    report.stage("writing")
    written = (*save(fit, out), "run.json", "config.toml")
    _write_run(task, trust, data, out, time.monotonic() - began)
    if profiles and task.mixed:
        report.line("profiles are of the runs on one floor each")

    def tell(points: int, rise: float) -> None:
        report.note(f"{points} points, rise {rise:.2f}")

    result = []
    for path in dict.fromkeys(profiles):
        report.stage(f"profile of {path}")
        result.append(profile(problem, optimum, path, tell))
    if result:
        each = {p.path: asdict(p) for p in result}
        write_json(out / "profile.json", {"schema": "slipid.profile/1", "profiles": each})
        written = (*written, "profile.json")
    kept.remove(f"{CHECKPOINT}.npz")
    return IdentifyResult(fit, task, trust, tuple(result), written)


def _replaced_fit(out: Path, task: ConfigFitTask) -> str | None:
    """Return a sentence where a folder has the fit of another config or other logs, else None."""
    try:
        before = read_json(out / "run.json", "what identify wrote")
        config, data = before["config"], before["data"]
    except (DataError, KeyError, TypeError):
        return None
    if config["sha256"] == task.config.hash and data["hash"] == task.data_hash:
        return None
    other = "other logs" if config["sha256"] == task.config.hash else f"another {config['name']}"
    return f"{out} has a fit of {other}; it is replaced when this one is done"


def _check_sanity(task: ConfigFitTask, report: Reporter, anyway: bool) -> None:
    """Report contradictions between logs and config; refuse them unless `anyway`."""
    report.stage("do logs and config go together?")
    result = sanity(task)
    if not anyway:
        refuse_if_wrong(result)
    for finding in result:
        if finding.severity != "note":
            report.line(f"{finding.severity}: {finding}")


def _write_run(
    task: ConfigFitTask, trust: TrustReport, data: Path, out: Path, seconds: float
) -> None:
    """Write run.json and the copies of config and bench file that later commands read."""
    config = task.config
    if (bench := config.content.wheels.motor) is not None:
        write_json(out / COPY_NAME, read_json(config.path.parent / bench, "the numbers of a motor"))
    logs = {log.name: log.sha256 for log in task.logs}
    inputs = {
        "folder": str(data),
        "hash": task.data_hash,
        "logs": logs,
        "skipped": task.skipped,
    }
    verdict = {"trust": trust.to_json(), "seed": task.settings.seed}
    write_run_file(out, config, inputs, seconds, verdict)


def optimised(
    task: FitTask, problem: Problem, kept: Checkpoint | None, report: Reporter
) -> tuple[Problem, Optimum]:
    """Return the optimum of a task and the problem it belongs to, starting from `task.problem()`.

    Windows are cut again, which makes another problem, where the fitted lag differs from the
    expected one (see `FitTask.cutting_robot`). The fit continues from the checkpoint of this very
    task, and every round is kept there.
    """
    optimum = _optimised(task, problem, _restored(kept, report), kept, report)
    robot = task.cutting_robot(problem.space.tree(optimum.state.z))
    lag, before = float(robot.camera.lag), problem.windows.lag
    if lag == before:
        return problem, optimum
    report.line(f"cut anew at a lag of {lag:.2f} s; it was {before:.2f} s before")
    again = problem.of(task.windows(robot))
    start = replace(optimum.state, round=NEAR_OPTIMUM, moved=np.inf, effect=None)
    return again, _optimised(task, again, (start, list(optimum.history)), kept, report)


def _optimised(
    task: FitTask,
    problem: Problem,
    before: tuple[FitState | None, list[float]],
    kept: Checkpoint | None,
    report: Reporter,
) -> Optimum:
    """Return the optimum of one problem, from an earlier state and its losses, if there is one."""
    settings = task.settings
    start, history = before
    first: list[float] = []

    def tell(state: FitState) -> None:
        report.stage(state.stage)
        what = f"round {state.round}, loss {state.loss:.2f}, moved {state.moved:.3g} std"
        if state.stage != "joint":  # the staged start ends after a given number of rounds
            report.note(what)
            return
        # the end is where steps that shrink as they do fall below the tolerance
        moved = max(state.moved, 1e-12)
        first.append(max(moved, 2 * settings.tolerance))
        whole = math.log(first[0] / settings.tolerance)
        report.advance(min(math.log(first[0] / moved), whole), whole, what)
        history.append(state.loss)
        if kept is not None:
            kept.save(CHECKPOINT, state.arrays | {"history": np.array(history)})

    report.stage("compiling")
    rounds = settings.rounds
    if start is not None and start.moved < settings.tolerance:
        rounds = start.round  # it had settled: only the last steps are missing
    optimum = optimise(
        problem, start=start, most_rounds=rounds, tolerance=settings.tolerance, tell=tell
    )
    return replace(optimum, history=tuple(history))


def _restored(kept: Checkpoint | None, report: Reporter) -> tuple[FitState | None, list[float]]:
    """Return the state and the losses of an interrupted fit; None and no losses without one."""
    result = None if kept is None else kept.load(CHECKPOINT)
    if result is None or kept is None:
        return None, []
    history = result.pop("history").tolist()
    start = FitState.of(result)
    report.line(f"going on from round {start.round} of {kept.folder / CHECKPOINT}.npz")
    return start, history


def summarised(task: FitTask, problem: Problem, optimum: Optimum, report: Reporter) -> Fit:
    """Return the fit with intervals, runs over several floors, and simpler models beside it."""
    report.stage("intervals and verdicts")
    fit = summarise(problem, optimum, task.dataset, task.choices, task.settings.seed)
    if task.mixed:
        fit = _with_mixed_runs(fit, task, problem, optimum, report)
    report.stage("simpler models, for comparison")
    return _with_baselines(fit, task)


def _with_mixed_runs(
    fit: Fit, task: FitTask, problem: Problem, optimum: Optimum, report: Reporter
) -> Fit:
    """Return the fit to all runs, or to runs on one floor each where the others contradict it."""
    report.stage("runs over several floors")
    mixed = multi_floor_runs(task.mixed, fit.robot)

    def tell(state: FitState) -> None:
        report.note(f"round {state.round}, loss {state.loss:.2f}, moved {state.moved:.3g} std")

    limits = task.settings
    result = fit_multi_floor(problem, optimum, mixed, tell, limits.rounds, limits.tolerance)
    new = summarise(result.problem, result.optimum, task.dataset, task.choices, task.settings.seed)
    floors = floor_errors(fit.contact, new.contact, task.dataset)
    after = result.after and result.after._asdict()
    about: dict[str, Any] = {
        "runs": len(mixed.runs),
        "windows": int(mixed.counts.sum()),
        "before": result.before._asdict(),
        "after": after,
        "learnt": result.learnt._asdict(),
        "as_if": {name: e._asdict() for name, e in result.as_if.items()},
        "floors": {name: asdict(e) for name, e in floors.items()},
    }
    report.line(_mixed_sentence(about))
    alone = {name: e.speed for name, e in result.as_if.items()}
    end = result.optimum
    moved = largest_shift(fit.space, fit.z, fit.covariance, end.state.z, end.converged)
    sentence = contradiction(floors, moved, result.learnt.speed, alone)
    if sentence is None:
        return replace(new, mixed=about)
    report.line(sentence)
    return replace(fit, refused={**about, "reason": sentence})


def _mixed_sentence(about: Mapping[str, Any]) -> str:
    """Return a sentence about the prediction of runs over several floors."""

    def off(errors: Mapping[str, float]) -> str:
        return f"{errors['yaw_rate']:.3f} rad/s and {1000 * errors['speed']:.1f} mm/s"

    sentence = f"{about['runs']} runs over several floors: predicted within {off(about['before'])}"
    if about["after"] is None:
        return f"{sentence} by the others; one run cannot judge what was learnt from it"
    return f"{sentence} by the others, {off(about['after'])} after learning from the other half"


def _with_baselines(fit: Fit, task: FitTask) -> Fit:
    """Return the fit with simpler models, fitted to the same runs at its camera and lag."""
    cut, shape = task.windows(fit.robot), fit.space.template.geometry
    learnt = [model.fit(cut, fit.robot) for model in slip_models(shape, fit.channels.current)]
    plain = {m.name: {floor: v.tolist() for floor, v in m.state.items()} for m in learnt}
    return replace(fit, baselines=plain)
