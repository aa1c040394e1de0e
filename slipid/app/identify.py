"""Fit of a robot to the logs of a config or to runs, with verdicts and result files."""

import itertools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slipid.app.calibrate import calibrated, remarks, write_run
from slipid.app.check import sanity
from slipid.app.config import FitSection, read_config
from slipid.app.floor_maps import map_files
from slipid.app.logs import read_run_file
from slipid.app.problem import ConfigFitTask, FitTask, read_fit_task, with_mixed
from slipid.data.check.findings import wrong
from slipid.fitting.multi_floor import multi_floor_runs
from slipid.fitting.multi_floor_fit import fit_multi_floor
from slipid.fitting.optimise import Optimum, optimise, start_rounds
from slipid.fitting.problem import FitState, Problem
from slipid.infer.fit_file import save
from slipid.infer.posterior.coordinates import Fitted, around
from slipid.infer.posterior.short_chain import short_chain
from slipid.infer.result import Fit, required
from slipid.infer.summary import summarise
from slipid.infer.verdicts.profile import Profile, profile, profiled
from slipid.infer.verdicts.trust import Trust
from slipid.predict.agreement import contradiction, floor_errors, largest_shift
from slipid.predict.selection import (
    KinematicFit,
    calibrated_model,
    contact_errors,
    selected,
)
from slipid.predict.slip_models import slip_models
from slipid.support.checkpoint import Checkpoint, key_of
from slipid.support.errors import DataError
from slipid.support.files import writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import COMPILING_S, Reporter

NEAR_OPTIMUM = 3
"""Round number given to a start near the optimum, so that the fit does not repeat its first rounds,
which take more steps."""
CHECKPOINT = "checkpoint"
"""Name, without suffix, of the file with the state of an unfinished fit."""
FOLLOWING = ("posterior.nc", "validation.json", "trial.json", "design.json")
"""Names of files that later commands make from a fit, which take long to make again."""


@dataclass(frozen=True, eq=False)
class IdentifyResult:
    """Result of `identify`.

    Attributes:
        fit: the fit.
        task: runs, config and choices from which the fit was made.
        profiles: profile likelihoods that were requested.
        written: names of the written files.
    """

    fit: Fit
    task: ConfigFitTask
    profiles: tuple[Profile, ...]
    written: tuple[str, ...]

    @property
    def trust(self) -> Trust:
        """Trust in the fit."""
        return self.fit.trust


def identify(
    task: ConfigFitTask,
    data: Path,
    out: Path,
    report: Reporter,
    profiles: Sequence[str] = (),
) -> IdentifyResult:
    """Return the fit of a config's robot to its logs, and write all results to `out`.

    If `out` has the checkpoint of the same fit, which was interrupted, the fit resumes from it. The
    checkpoint stays until `forget_checkpoint` is called, after robot and page were written.

    Args:
        task: runs and config, from `checked_task`.
        data: folder of the logs.
        out: folder to write to.
        report: reporter of the progress.
        profiles: paths of parameters whose profile likelihood is computed.

    Raises:
        DataError: a path is wrong, or the runs allow only a calibration
            (`FitTask.calibration_only`); in this case nothing was written.
    """
    began = time.monotonic()
    task = with_mixed(task, data, report)

    def begin(problem: Problem) -> Checkpoint:
        for path in profiles:
            try:
                profiled(problem.space, path)
            except ValueError as error:
                raise DataError(f"--profile: {error}") from error
        writable(out)
        if sentence := _replaced_fit(out, task):
            report.line(sentence)
        names = problem.space.names, problem.noise.names
        return Checkpoint(out, key_of(task.config.hash, task.data_hash, *names))

    fit, problem, optimum = fitted(task, report, begin)
    report.stage("writing")
    written = (*save(fit, out, task.config.text), "run.json", "config.toml")
    write_run(task, fit.trust, data, out, time.monotonic() - began)
    if profiles and task.mixed:
        report.line("profiles use only the runs on one floor each")

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
    return IdentifyResult(fit, task, tuple(result), written)


def forget_checkpoint(out: Path) -> None:
    """Delete the checkpoint of a fit, all of whose results have been written."""
    (out / f"{CHECKPOINT}.npz").unlink(missing_ok=True)


def checked_task(
    config_path: Path, data: Path, report: Reporter, anyway: bool = False
) -> ConfigFitTask:
    """Return the fit task of a config whose runs do not contradict it.

    Args:
        config_path: the config.
        data: folder of the logs.
        report: reporter of the progress.
        anyway: True to return a task even if logs and config contradict each other; the
            contradictions are reported.

    Raises:
        DataError: config or logs are wrong.
    """
    setup_jax(quiet=True)
    config = read_config(config_path)
    map_files(config)
    task = read_fit_task(config, data, report)
    report.line(f"{len(task.dataset)} runs on {', '.join(task.robot.surfaces.labels)}")
    _check_sanity(task, report, anyway)
    return task


def _replaced_fit(out: Path, task: ConfigFitTask) -> str | None:
    """Return a sentence on the fit in a folder, and on later results that go with it, or None."""
    try:
        before = read_run_file(out)
    except DataError:
        return None
    later = ", ".join(name for name in FOLLOWING if (out / name).exists())
    same = before.config.sha256 == task.config.hash
    if same and before.data.hash == task.data_hash:
        stays = f"{out} has {later} of an earlier fit: deleted unless the new fit is the same"
        return stays if later else None
    other = "other logs" if same else f"a different {before.config.name}"
    deleted = f", and {later} deleted" if later else ""
    return f"{out} has a fit of {other}; it is replaced{deleted} when this one is done"


def _check_sanity(task: ConfigFitTask, report: Reporter, anyway: bool) -> None:
    """Report the findings of the sanity check; raise `DataError` for wrong ones unless `anyway`."""
    report.stage("comparing logs with config")
    found = sanity(task)
    if (bad := wrong(found)) and not anyway:
        listed = "\n".join(f"  {k}. {finding}" for k, finding in enumerate(bad, start=1))
        raise DataError(
            f"not fitted: logs and config contradict each other\n{listed}\n"
            "correct the config or the logs, or use --anyway to fit all the same"
        )
    for finding in found:
        if finding.severity != "note":
            report.line(f"{finding.severity}: {finding}")


def fitted(
    task: FitTask,
    report: Reporter,
    begin: Callable[[Problem], Checkpoint | None] = lambda _: None,
) -> tuple[Fit, Problem, Optimum]:
    """Return the fit of a task, and its problem and optimum without runs over several floors.

    The kinematics are calibrated first, and the force balance is fitted from there.

    Args:
        task: the fit task.
        report: reporter of the progress.
        begin: called with the problem before it is optimised; it returns the checkpoint from which
            the fit continues, and in which every round is saved, or None.
    """
    kinematic = calibrated(task, report)
    task = task.started_from(kinematic.calibration)
    problem = task.problem()
    problem, optimum = optimised(task, problem, begin(problem), report)
    return summarised(task, problem, optimum, report, kinematic), problem, optimum


def optimised(
    task: FitTask, problem: Problem, kept: Checkpoint | None, report: Reporter
) -> tuple[Problem, Optimum]:
    """Return the problem of a task whose optimum was found, and this optimum.

    If the fitted lag differs too much from the assumed one (see `FitTask.cutting_robot`), windows
    are cut again, which makes another problem, and the fit is repeated from its optimum.

    Args:
        task: the fit task.
        problem: the task's problem at the assumed lag, `task.problem()`.
        kept: checkpoint from which the fit continues, and in which every round is saved, or None.
        report: reporter of the progress.
    """
    optimum = _optimised(task, problem, _restored(kept, report), kept, report)
    robot = task.cutting_robot(problem.space.tree(optimum.state.z))
    lag, before = float(robot.camera.lag), problem.windows.lag
    if lag == before:
        return problem, optimum
    report.line(f"windows cut again for a lag of {lag:.2f} s; it was {before:.2f} s before")
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
    """Return the optimum of one problem.

    `before` is the state from which to continue, or None, and the losses of all rounds before it.
    """
    settings = task.settings
    start, history = before
    first: list[float] = []

    of_start = start_rounds(problem.space)
    rounds_done = itertools.count(1)

    def tell(state: FitState) -> None:
        what = f"round {state.round}, loss {state.loss:.2f}, moved {state.moved:.3g} std"
        if state.stage != "joint":
            report.stage("first values, floor by floor")
            report.advance(next(rounds_done), of_start, state.stage)
            return
        report.stage("joint")
        # Progress is measured in the logarithm of the step size, which shrinks to the tolerance.
        moved = max(state.moved, 1e-12)
        first.append(max(moved, 2 * settings.tolerance))
        whole = math.log(first[0] / settings.tolerance)
        report.advance(min(math.log(first[0] / moved), whole), whole, what)
        history.append(state.loss)
        if kept is not None:
            kept.save(CHECKPOINT, state.arrays | {"history": np.array(history)})

    report.stage("compiling", usual_s=COMPILING_S)
    rounds = settings.rounds
    if start is not None and start.moved < settings.tolerance:
        rounds = start.round  # the state has converged: only what follows the rounds is missing
    optimum = optimise(
        problem, start=start, most_rounds=rounds, tolerance=settings.tolerance, tell=tell
    )
    return replace(optimum, history=tuple(history))


def _restored(kept: Checkpoint | None, report: Reporter) -> tuple[FitState | None, list[float]]:
    """Return the state of an interrupted fit from its checkpoint, or None, and its losses."""
    result = None if kept is None else kept.load(CHECKPOINT)
    if result is None or kept is None:
        return None, []
    history = result.pop("history").tolist()
    start = FitState.of(result)
    report.line(f"resuming from round {start.round} of {kept.folder / CHECKPOINT}.npz")
    return start, history


def summarised(
    task: FitTask, problem: Problem, optimum: Optimum, report: Reporter, kinematic: KinematicFit
) -> Fit:
    """Return the fit from an optimum, with intervals, verdicts and simpler models for comparison.

    The slip model of every floor is selected. Runs over several floors, if the task has some, are
    fitted as well.
    """
    report.stage("intervals and verdicts", usual_s=COMPILING_S)
    fit = summarise(problem, optimum, task.dataset, task.choices, task.settings.seed)
    if task.mixed:
        fit, problem, optimum = with_mixed_runs(fit, task, problem, optimum, report)
    fit = with_chain(fit, task.settings, report)
    report.stage("predicting held-out runs")
    contact = contact_errors(task.dataset, problem, optimum, report.steps)
    selection = selected(
        task.dataset, {**kinematic.errors, "contact": contact}, kinematic.contradicted
    )
    fit = replace(
        fit,
        calibration=kinematic.calibration,
        selection=selection,
        suspects=remarks(kinematic, selection, task),
        robot_settings=task.robot_settings,
    )
    report.stage("simpler models, for comparison")
    return _with_baselines(fit, task)


def with_chain(fit: Fit, settings: FitSection, report: Reporter) -> Fit:
    """Return the fit with the draws of a short chain, if the settings ask for them.

    A fit that did not converge stays as it is.
    """
    if settings.intervals != "sampled" or not fit.converged:
        return fit
    chain = short_chain(*around(required(fit.problem), Fitted.of(fit)), settings.seed, report)
    return replace(fit, chain=chain)


def with_mixed_runs(
    fit: Fit, task: FitTask, problem: Problem, optimum: Optimum, report: Reporter
) -> tuple[Fit, Problem, Optimum]:
    """Return the fit to all runs, those over several floors included, its problem and optimum.

    If the runs over several floors contradict the given fit, which is of runs on one floor each,
    the given fit is returned, with the reason.
    """
    report.stage("runs over several floors")
    mixed = multi_floor_runs(task.mixed, fit.robot)

    def tell(state: FitState) -> None:
        report.note(f"round {state.round}, loss {state.loss:.2f}, moved {state.moved:.3g} std")

    limits = task.settings
    result = fit_multi_floor(problem, optimum, mixed, tell, limits.rounds, limits.tolerance)
    new = summarise(result.problem, result.optimum, task.dataset, task.choices, task.settings.seed)
    floors = floor_errors(fit.contact, new.contact, task.dataset)
    about: dict[str, Any] = {
        "near": np.asarray(fit.z).tolist(),
        "runs": len(mixed.runs),
        "windows": int(mixed.counts.sum()),
        "before": result.before._asdict(),
        "after": result.after and result.after._asdict(),
        "learnt": result.learnt._asdict(),
        "as_if": {name: e._asdict() for name, e in result.as_if.items()},
        "floors": {name: asdict(e) for name, e in floors.items()},
    }
    report.line(_mixed_sentence(about))
    alone = {name: e.speed for name, e in result.as_if.items()}
    end = result.optimum
    moved = largest_shift(fit.space, fit.z, fit.covariance, end.state.z, new.converged)
    sentence = contradiction(floors, moved, result.learnt.speed, alone, result.gain)
    if sentence is None:
        return replace(new, mixed=about), result.problem, end
    report.line(sentence)
    return replace(fit, refused={**about, "reason": sentence}), problem, optimum


def _mixed_sentence(about: Mapping[str, Any]) -> str:
    """Return a sentence about the prediction errors of runs over several floors.

    `about` has the errors before and after learning from these runs.
    """

    def off(errors: Mapping[str, float]) -> str:
        return f"{errors['yaw_rate']:.3f} rad/s and {1000 * errors['speed']:.1f} mm/s"

    sentence = f"{about['runs']} runs over several floors: predicted within {off(about['before'])}"
    if about["after"] is None:
        return (
            f"{sentence} by the fit to the other runs; one run cannot judge what was learnt from it"
        )
    after = off(about["after"])
    return f"{sentence} by the fit to the other runs, {after} after learning from the other half"


def _with_baselines(fit: Fit, task: FitTask) -> Fit:
    """Return the fit with simpler models, fitted to the same runs with the calibrated sensor."""
    seen, shape = fit.seen, fit.config_shape
    cut = task.windows(seen)
    learnt = [model.fit(cut, seen) for model in slip_models(shape, fit.channels.current)]
    if fit.calibration is not None:
        own = calibrated_model(fit.calibration, shape)
        learnt = [own if model.name == own.name else model for model in learnt]
    plain = {m.name: {floor: v.tolist() for floor, v in m.state.items()} for m in learnt}
    return replace(fit, baselines=plain)
