"""`slipid identify`: fit a robot to its logs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from slipid.cli.common import (
    ConfigFile,
    DataFolder,
    Json,
    Next,
    Out,
    Quiet,
    can_draw,
    emit,
    flag,
    guarded,
    option,
)
from slipid.support.errors import DataError
from slipid.support.folder import locked
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.app.calibrate import CalibrationResult
    from slipid.app.config import Config
    from slipid.app.identify import IdentifyResult
    from slipid.app.problem import ConfigFitTask
    from slipid.report.page import Page


PRIORS = Next('use it as priors of a robot, by [robot] motor = "FILE" in its config', ("new",))


@guarded
def identify(
    config: ConfigFile,
    data: DataFolder,
    out: Out,
    profile: Annotated[
        list[str] | None,
        option("PATH", "Also compute the profile likelihood of a parameter; may be repeated."),
    ] = None,
    anyway: Annotated[
        bool, flag("--anyway", "Fit even if logs and config contradict each other.")
    ] = False,
    only: Annotated[
        str | None,
        option("PART", "Stop after a part: calibration (radii, track, place of the pose sensor)."),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
) -> int:
    """Calibrate a robot, fit its motors, floors and loads, and select the model of every floor.

    Writes report.html, a page to look at, identified.json, fit.json, robot.json and pictures. An
    interrupted fit is continued. The exit code is 1 if the selected models are not to be trusted:
    on held-out runs, a simpler model predicts better, or a selected force balance did not converge
    or is not plausible.
    """
    from slipid.app.config import BenchMotors, read_config
    from slipid.app.identify import IdentifyResult, checked_task
    from slipid.infer.result_folder import WRITTEN, refuse_foreign_config
    from slipid.report.calibration import show_calibration, show_trust
    from slipid.report.estimates import show_fit
    from slipid.report.gains import show_gains
    from slipid.support.files import read_json

    wanted = read_config(config)
    if only not in (None, "calibration"):
        raise DataError(f"--only {only}: no such part; expected calibration")
    if only and profile:
        raise DataError("--profile needs the force balance: leave out --only calibration")
    if isinstance(wanted.content.robot, BenchMotors):
        if only:
            raise DataError("--only calibration: a motor on a bench has no kinematics to calibrate")
        return bench(wanted, data, out, profile or (), json, quiet)
    with Reporter(quiet=quiet) as report, locked(out, "identify", *WRITTEN):
        refuse_foreign_config(out, wanted.text)
        task = checked_task(config, data, report, anyway)
        if reason := task.calibration_only:
            report.line(f"calibration alone: {reason}")
        if only or reason:
            done: CalibrationResult | IdentifyResult = calibration(task, data, out, report)
        else:
            done = run(task, data, out, report, profile or ())
    content = read_json(out / "identified.json", "a result of `slipid identify`")

    def show(page: "Page") -> None:
        if isinstance(done, IdentifyResult):
            show_fit(page, done.fit, done.profiles)
            show_gains(page, content)
        else:
            show_calibration(page, done.calibration)
        show_trust(page, done.trust)

    if done.trust.is_bad:
        following = [Next("look for mistakes in the logs", ("check", config, "--data", data))]
    else:
        following = [
            Next(
                "predict runs that were not fitted, here in a folder other",
                ("validate", out, "--data", "other"),
            ),
            Next("take it to the robot", ("export", out, "--out", out / "to_go")),
        ]
    emit(json, content, show, following, out, done.written)
    return 1 if done.trust.is_bad else 0


def calibration(
    task: "ConfigFitTask", data: Path, out: Path, report: Reporter
) -> "CalibrationResult":
    """Return the calibration of a robot's kinematics alone, and write its results."""
    from slipid.app.calibrate import calibrate_only
    from slipid.deploy.deploy import calibrated_robot, switch_robot
    from slipid.report.html.fit_page import write_calibration_report

    done = calibrate_only(task, data, out, report)
    robot = calibrated_robot(
        done.calibration, task.robot, done.models, task.dataset, task.robot_settings
    )
    written = (*done.written, *switch_robot(out, robot))
    page = write_calibration_report(done, out, report)
    return replace(done, written=(*page, *written))


def run(
    task: "ConfigFitTask",
    data: Path,
    out: Path,
    report: Reporter,
    profiles: Sequence[str] = (),
) -> "IdentifyResult":
    """Return the fit of a robot to its logs, and write all results and pictures.

    Arguments are those of `slipid.app.identify.identify`.

    Raises:
        DataError: as in `slipid.app.identify.identify`.
    """
    from slipid.app.identify import forget_checkpoint, identify
    from slipid.deploy.deploy import write_robot
    from slipid.report.html.fit_page import write_fit_report

    done = identify(task, data, out, report, profiles)
    written = (*done.written, *write_robot(out, done.fit))
    if can_draw(report):
        written += tuple(path.name for path in _draw(done, out, report))
    page = write_fit_report(done.fit, done.task, out, report)
    forget_checkpoint(out)
    return replace(done, written=(*page, *written))


def _draw(done: "IdentifyResult", out: Path, report: Reporter) -> list[Path]:
    """Write the pictures of a fit and of its profiles; return the files."""
    from slipid.plots.drawing import save
    from slipid.plots.fit import identify_plots
    from slipid.plots.posterior import profile_figure

    drawn: list[Path] = []
    try:
        warning = done.fit.trust.warning
        drawn += identify_plots(done.fit, done.task.dataset, out, warning, report.steps)
    except DataError as error:  # a run is too short to be drawn; the results are already written
        report.line(f"no further pictures: {error}")
    if done.profiles:
        drawn.append(save(profile_figure(done.profiles), out / "profile.png"))
    return drawn


def bench(
    config: "Config", data: Path, out: Path, profile: Sequence[str], json: str | None, quiet: bool
) -> int:
    """Identify motors on a bench, write and print the result, and return the exit code."""
    from slipid.app.bench import bench_content, identify_bench
    from slipid.infer.result_folder import WRITTEN, refuse_foreign_config
    from slipid.report.estimates import show_bench
    from slipid.report.html.bench_page import bench_page
    from slipid.report.html.page import REPORT, try_page

    if profile:
        raise DataError("--profile is not available for drive = 'motor'; omit it")
    with Reporter(quiet=quiet) as report, locked(out, "identify", *WRITTEN, "bench_*.png"):
        refuse_foreign_config(out, config.text)
        fit, written = identify_bench(config, data, out, report)
        if can_draw(report):
            from slipid.plots.bench import bench_plots

            written = (*written, *(path.name for path in bench_plots(fit, out)))
        page = bench_page(fit, config.path.name)
        written = (*try_page(page, out / REPORT, report), *written)
    emit(json, bench_content(fit), lambda page: show_bench(page, fit), [PRIORS], out, written)
    return 0 if fit.good else 1
