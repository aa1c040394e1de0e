"""What the commands do; `cli` only parses arguments and turns errors into exit codes."""

import hashlib
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slipid.app import files, runtime
from slipid.app.config import Config, read_config
from slipid.app.progress import Reporter
from slipid.data.files import writable, write_bytes, write_json
from slipid.data.log import DataError

CHECKPOINT = "checkpoint.npz"


@dataclass(frozen=True, eq=False)
class Done:
    """End of `identify`: the fit, the runs it saw, and the files written."""

    fit: Any
    job: Any
    written: tuple[str, ...]


def identify(config_path: Path, data: Path, out: Path, report: Reporter) -> Done:
    """Fit the robot of a config to its logs and write everything to `out`.

    Raises:
        DataError: config or logs are wrong; nothing was written then.
    """
    began = time.monotonic()
    runtime.start()
    config = read_config(config_path)
    report.tolerance = config.content.fit.tolerance
    report.stage("reading logs")
    from slipid.app.job import read_job

    job = read_job(config, data, report.count, report.line)
    report.line(f"{len(job.dataset)} runs on {', '.join(job.robot.surfaces.labels)}")
    report.stage("cutting windows")
    problem = job.problem()
    writable(out)
    optimum = _optimise(job, problem, out, report)
    report.stage("intervals and verdicts")
    from slipid.identify.result import summarise

    fit = summarise(problem, optimum, job.dataset, job.choices, config.content.fit.seed)
    report.stage("simpler models, for comparison")
    fit = _with_baselines(fit, job)
    report.stage("writing")
    fit.save(out)
    _keep_run(config, job, data, out, time.monotonic() - began)
    written = ["identified.json", "fit.json", "fit.npz", "run.json", "config.toml"]
    from slipid.app.plots import identify_plots

    report.stage("drawing")
    try:
        written += [path.name for path in identify_plots(fit, job.dataset, out)]
    except DataError as error:  # the numbers are written; a run too short to draw spoils none
        report.line(f"no more pictures: {error}")
    (out / CHECKPOINT).unlink(missing_ok=True)
    return Done(fit, job, tuple(written))


def _optimise(job: Any, problem: Any, out: Path, report: Reporter) -> Any:
    """Optimum, from the checkpoint of this very job where there is one."""
    from slipid.identify.fit import Options, optimise

    wanted = job.config.content.fit
    same = [job.config.hash, job.data_hash, *map(str, files.versions().items())]
    same += [*problem.space.names, *problem.noise.names]
    key = hashlib.sha256("\n".join(same).encode()).hexdigest()
    kept = files.load_checkpoint(out / CHECKPOINT, key)
    history: list[float] = [] if kept is None else kept[1]
    if kept is not None:
        report.line(f"going on from round {kept[0].round} of {out / CHECKPOINT}")

    def tell(state: Any) -> None:
        report.state(state)
        if state.stage == "joint":
            history.append(state.loss)
            files.save_checkpoint(out / CHECKPOINT, key, state, history)

    report.stage("compiling")
    rounds = wanted.rounds
    if kept is not None and kept[0].moved < wanted.tolerance:
        rounds = kept[0].round  # it had settled: only the last steps are missing
    options = Options(most_rounds=rounds, tolerance=wanted.tolerance)
    optimum = optimise(problem, start=kept and kept[0], options=options, tell=tell)
    reason = optimum.reason
    if optimum.converged:
        round_ = optimum.state.round
        reason = f"no number moved {wanted.tolerance:g} of its std in round {round_}"
    return replace(optimum, history=tuple(history), reason=reason)


def _with_baselines(fit: Any, job: Any) -> Any:
    """The fit, with every simpler model learnt from the same runs at the fitted camera and lag."""
    from slipid.data.dataset import windows
    from slipid.identify.ladder import rungs

    wanted, robot = job.config.content.fit, fit.robot
    try:
        robot.geometry.inverse()
    except ValueError:  # wheels that do not fix the twist: none of them applies
        return fit
    cut = windows(
        job.dataset,
        float(robot.geometry.wheel_radius),
        lag=float(robot.camera.lag),
        per_piece=wanted.windows_per_piece,
        longest=wanted.longest_window_s,
    )
    learnt = [rung.fit(cut, robot) for rung in rungs(fit.has["current"])]
    return fit.with_baselines(
        {r.name: {floor: v.tolist() for floor, v in r.state.items()} for r in learnt}
    )


def _keep_run(config: Config, job: Any, data: Path, out: Path, seconds: float) -> None:
    """What later commands and readers need to know of this run."""
    write_bytes(out / "config.toml", config.text.encode())
    write_json(
        out / "run.json",
        {
            "schema": "slipid.run/1",
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(seconds, 1),
            "config": {"name": config.path.name, "sha256": config.hash},
            "data": {
                "folder": str(data),
                "hash": job.data_hash,
                "logs": {log.name: log.sha256 for log in job.dataset.logs},
                "skipped": list(job.skipped),
            },
            "seed": config.content.fit.seed,
            "versions": files.versions(),
        },
    )


def validate(out: Path, data: Path, report: Reporter) -> dict[str, Any]:
    """Open-loop prediction of runs by the fit in `out`, as the validation file has it.

    Pictures of it go to `out`.

    Raises:
        DataError: no fit there, or logs that it cannot predict.
    """
    runtime.start()
    from slipid.app.job import read_dataset
    from slipid.identify.result import load
    from slipid.identify.validate import Frozen, validation

    fit = load(out)
    config = read_config(out / "config.toml")
    sections = config.content.validate_.logs or config.content.logs
    report.stage("reading logs")
    dataset, skipped = read_dataset(config, sections, data, report.count)
    for sentence in skipped:
        report.line(sentence)
    seen = {sha for _, sha in fit.runs}
    again = sum(log.sha256 in seen for log in dataset.logs)
    if again:
        report.line(f"{again} of {len(dataset)} runs were fitted: they say little about new ones")
    report.stage("predicting")
    frozen = Frozen(
        robot=fit.robot,
        space=fit.space,
        z=fit.z,
        covariance=fit.covariance,
        variance=dict(fit.variance),
        rungs=_restored(fit.baselines, out),
    )
    found = validation(frozen, dataset)
    report.stage("drawing")
    from slipid.app.plots import validate_plots

    drawn = validate_plots(fit, dataset, found, out)
    report.line(f"in {out}: {', '.join(path.name for path in drawn)}")
    return found


def _restored(states: Any, out: Path) -> Any:
    from slipid.identify.ladder import restored

    try:
        return restored(dict(states))
    except ValueError as error:
        raise DataError(f"{out / 'fit.json'}: {error}") from error


def design(out: Path, wanted: Any, report: Reporter) -> tuple[Any, list[str]]:
    """Runs to drive next for the fit in `out`, and the files written there.

    Raises:
        DataError: no fit there, or something is wanted that it does not have.
    """
    runtime.start()
    from slipid.app import design as job
    from slipid.identify.result import load

    fit = load(out)
    report.stage("simulating candidate runs")
    found = job.design(fit, wanted)
    report.stage("drawing")
    write_json(out / "design.json", found.content)
    written = ["design.json"]
    for old in ("design_commands.csv", "design.png"):
        (out / old).unlink(missing_ok=True)
    if found.drives:
        from slipid.app.drawing import save
        from slipid.app.plots_design import design_figure

        write_bytes(out / "design_commands.csv", job.commands(found).encode())
        save(design_figure(found), out / "design.png")
        written += ["design_commands.csv", "design.png"]
    return found, written


def check(config_path: Path, data: Path, out: Path | None, report: Reporter) -> dict[str, Any]:
    """What the logs hold, and what they can be expected to tell, before any fit.

    Raises:
        DataError: config or logs are wrong.
    """
    runtime.start()
    from slipid.app.check import expected, overview
    from slipid.app.job import read_job

    config = read_config(config_path)
    report.stage("reading logs")
    job = read_job(config, data, report.count, report.line)
    report.stage("expected information")
    estimates, flat = expected(job)
    found = overview(job) | {
        "parameters": {
            e.path: {
                "unit": e.unit,
                "start": e.value,
                "expected_std": e.std,
                "ratio": e.ratio,
                "verdict": e.verdict,
            }
            for e in estimates
        },
        "messages": [f.text for f in flat],
    }
    if out is not None:
        from slipid.app.raw_plots import raw_plots

        report.stage("drawing")
        write_json(out / "check.json", found)
        raw_plots(job.dataset, out)
    return found
