"""What the commands do; `cli` only parses arguments and turns errors into exit codes."""

import hashlib
import importlib
import time
from collections.abc import Sequence
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
    """End of `identify`: the fit, the runs it saw, the files written, the profiles asked for."""

    fit: Any
    job: Any
    written: tuple[str, ...]
    profiles: tuple[Any, ...] = ()


def identify(
    config_path: Path, data: Path, out: Path, report: Reporter, profile: Sequence[str] = ()
) -> Done:
    """Fit the robot of a config to its logs and write everything to `out`.

    Args:
        config_path: of the job.
        data: folder its globs start from.
        out: folder to write to.
        report: progress.
        profile: paths of numbers whose profile likelihood is wanted, too.

    Raises:
        DataError: config or logs are wrong; nothing was written then.
    """
    began = time.monotonic()
    runtime.start()
    config = read_config(config_path)
    report.tolerance = config.content.fit.tolerance
    report.stage("reading logs")
    from slipid.app.job import read_job, with_mixed

    job = read_job(config, data, report.count, report.line)
    report.line(f"{len(job.dataset)} runs on {', '.join(job.robot.surfaces.labels)}")
    job = with_mixed(job, data, report.count, report.line)
    report.stage("cutting windows")
    problem = job.problem()
    from slipid.identify.profile import profiled

    for path in profile:
        try:
            profiled(problem.space, path)
        except ValueError as error:
            raise DataError(f"--profile: {error}") from error
    writable(out)
    optimum = _optimise(job, problem, out, report)
    report.stage("intervals and verdicts")
    from slipid.identify.result import summarise

    fit = summarise(problem, optimum, job.dataset, job.choices, config.content.fit.seed)
    fit = _with_mixed(fit, job, problem, optimum, report)
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
    if profile and job.mixed:
        report.line("profiles are of the runs on one floor each")
    profiles = _profiles(problem, optimum, profile, out, report)
    written += ["profile.json", "profile.png"] if profiles else []
    (out / CHECKPOINT).unlink(missing_ok=True)
    return Done(fit, job, tuple(written), profiles)


def _profiles(
    problem: Any, optimum: Any, paths: Sequence[str], out: Path, report: Reporter
) -> tuple[Any, ...]:
    """Profiles of some numbers, written and drawn."""
    if not paths:
        return ()
    from slipid.app import drawing
    from slipid.app.plots_profile import profile_figure
    from slipid.identify.profile import profile

    found = []
    for path in dict.fromkeys(paths):
        report.stage(f"profile of {path}")
        found.append(profile(problem, optimum, path, report.point))
    each = {p.path: p.to_json() for p in found}
    write_json(out / "profile.json", {"schema": "slipid.profile/1", "profiles": each})
    drawing.save(profile_figure(found), out / "profile.png")
    return tuple(found)


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


def _with_mixed(fit: Any, job: Any, problem: Any, optimum: Any, report: Reporter) -> Any:
    """The fit, with what runs over several floors add to it."""
    if not job.mixed:
        return fit
    from slipid.identify.crossing import crossing
    from slipid.identify.mixed import update
    from slipid.identify.result import updated

    report.stage("runs over several floors")
    sets = [crossing(data, floor, fit.robot) for data, floor in job.mixed]
    found = update(fit.space, fit.z, fit.covariance, sets)
    report.line(_judged(found.about))
    return updated(fit, found, problem, optimum, job.dataset)


def _judged(about: Any) -> str:
    """What runs over several floors told, as a sentence."""

    def off(errors: Any) -> str:
        return f"{errors['yaw_rate']:.3f} rad/s and {1000 * errors['speed']:.1f} mm/s"

    said = f"{about['runs']} runs over several floors: predicted within {off(about['before'])}"
    if about["after"] is None:
        return f"{said} by the others; one run cannot judge what it taught"
    return f"{said} by the others, {off(about['after'])} when half has taught the other"


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
                "logs": {log.name: log.sha256 for log in job.logs},
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
    from slipid.app.config import one_floor
    from slipid.app.job import read_dataset
    from slipid.identify.result import load
    from slipid.identify.validate import Frozen, validation

    fit = load(out)
    config = read_config(out / "config.toml")
    sections = one_floor(config.content.validate_.logs or config.content.logs)
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


@dataclass(frozen=True, eq=False)
class Sampled:
    """End of `sample`: numbers from the draws, how the chains did, and the files written."""

    parameters: Any
    content: dict[str, Any]
    about: dict[str, Any]
    written: tuple[str, ...]


def sample(
    out: Path, data: Path | None, draws: int, most: int, block: int, seed: int, report: Reporter
) -> Sampled:
    """Posterior of the fit in `out`: posterior.nc, sample.json, and intervals in identified.json.

    Raises:
        DataError: no fit there, other logs than it was made of, or the posterior extra is missing.
    """
    began = time.monotonic()
    runtime.start()
    try:
        for module in ("arviz_base", "arviz_stats", "h5netcdf", "threadpoolctl"):
            importlib.import_module(module)  # used after hours of work
        from slipid.app import posterior_file
        from slipid.app import sample as job_of
        from slipid.identify.sampler import Plan
    except ImportError as error:
        raise DataError(f"{error}; expected `pip install slipid[posterior]`") from error
    from slipid.app.job import read_job
    from slipid.identify.result import load

    fit = load(out)
    job_of.on_one_floor(fit)
    folder = job_of.where_the_logs_are(out, data)
    report.stage("reading logs")
    job = read_job(read_config(out / "config.toml"), folder, report.count, report.line)
    job_of.same_logs(fit, job)
    report.stage("compiling")
    problem, plan = job.problem(), Plan(seed=seed, most=most, block=block)
    found = job_of.sample(out, fit, problem, plan, draws, report)
    report.stage("writing")
    about = job_of.summary(found, plan, time.monotonic() - began)
    content = job_of.identified(fit, found, problem)
    marks = {k: str(v) for k, v in about.items() if not isinstance(v, dict)}
    marks |= {"schema": posterior_file.SCHEMA, "data_hash": fit.data_hash}
    runs = tuple(log.name for log in job.dataset.logs)
    made = posterior_file.tree(problem, found, runs, marks)
    posterior_file.write(made, out / "posterior.nc")
    job_of.write(out, content, about)
    from slipid.app.plots_posterior import posterior_plots

    report.stage("drawing")
    drawn = posterior_plots(fit, found, out)
    if found.converged:
        job_of.Blocks(out / job_of.FOLDER, "").remove()
    written = ("posterior.nc", "sample.json", "identified.json", *(p.name for p in drawn))
    return Sampled(job_of.estimates(fit, found), content, about, written)


def selftest(
    config_path: Path, data: Path | None, out: Path, count: int, seed: int, report: Reporter
) -> dict[str, Any]:
    """What an experiment can recover, by making it with known truth and fitting that.

    Args:
        config_path: of the experiment.
        data: its logs, whose wheel motion is taken; without them a plan is made.
        out: folder for selftest.json and the replicates, which a later call goes on from.
        count: replicates.
        seed: of truths and noise.
        report: progress.

    Raises:
        DataError: config or logs are wrong.
    """
    runtime.start()
    from slipid.app import selftest as test
    from slipid.app.check import expected
    from slipid.app.job import read_job
    from slipid.app.selftest_summary import SCHEMA, summary, wanted_of

    config = read_config(config_path)
    if data is None:
        job = test.planned(config, report.line)
    else:
        report.stage("reading logs")
        job = read_job(config, data, report.count, report.line)
    problem = job.problem()
    wanted = wanted_of(config, problem)
    test.plausible(config, job.choices, problem)
    writable(out)
    report.stage("expected information")
    before = expected(job, problem)
    kept, key = out / "replicates.json", test.key_of(job, seed)
    done = files.load_replicates(kept, key)
    if done:
        report.line(f"{min(len(done), count)} of {count} replicates are in {kept} already")
    report.stage("replicates")

    def tell(rows: list[dict[str, Any]]) -> None:
        files.save_replicates(kept, key, rows)
        report.part(len(rows), count)

    rows = test.replicates(config, job.choices, problem, count, seed, done, tell, report.round)
    found = {
        "schema": SCHEMA,
        "source": "plan" if data is None else "logs",
        "runs": len(job.dataset),
        "seed": seed,
        "noise": dict(zip(problem.noise.names, problem.noise.typical.tolist(), strict=True)),
        **summary(rows, wanted),
        "messages": before["messages"],
        "data": {"hash": job.data_hash},
    }
    write_json(out / "selftest.json", found)
    return found


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


def tune(out: Path, wanted: Any, report: Reporter) -> dict[str, Any]:
    """Gains for the robot that a folder holds.

    Args:
        out: folder `identify` wrote.
        wanted: load set-up, method, rollouts, seed, gyro, by name.
        report: told what is going on.
    """
    report.stage("reading the fit")
    runtime.start()
    from slipid.app.tune import tune as run
    from slipid.identify.result import load

    fit = load(out)
    writable(out)
    return run(fit, out, **wanted, report=report)


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
    found = overview(job) | expected(job, job.problem())
    if out is not None:
        from slipid.app.raw_plots import raw_plots

        report.stage("drawing")
        write_json(out / "check.json", found)
        raw_plots(job.dataset, out)
    return found
