"""`slipid demo`: identify a robot from logs of the virtual test site, and show the true values."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipid.cli.common import MOST_SEED, Next, Out, Quiet, emit, executor_of, guarded, option
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.extras import MissingExtra
from slipid.support.folder import locked
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from slipid.app.identify import IdentifyResult
    from slipid.report.page import Page

TRUTH = "fit/truth/truth.json"
"""Name of the file of true values in the folder of logs."""
PARTS = ("fit", "unseen")
"""Names of the folders of fitted runs and of predicted runs.

The config of each part is `testsite_<part>.toml`."""


@guarded
def demo(
    out: Out = Path("demo_out"),
    plant: Annotated[
        str,
        option("NAME", "`recorded` for logs that ship with slipid, `mujoco` to simulate new ones."),
    ] = "recorded",
    seed: Annotated[
        int | None,
        typer.Option(min=0, max=MOST_SEED, help="Seed of the simulation, with --plant mujoco."),
    ] = None,
    quiet: Quiet = False,
) -> int:
    """Identify a robot from small logs of the virtual test site; write all results to a folder."""
    from slipid.infer.result_folder import WRITTEN

    with (
        Reporter(quiet=quiet) as report,
        locked(out / "result", "demo", *WRITTEN),
        executor_of(None) as executor,
    ):
        done, found, truth = run(out, plant, seed, executor, report)
    from slipid.report.answers import show_validation
    from slipid.report.calibration import show_trust
    from slipid.report.estimates import show_truth

    def show(page: "Page") -> None:
        show_truth(page, done.fit, truth)
        show_validation(page, found)
        page.line()
        show_trust(page, done.fit.trust)

    step = Next("a config for your own robot, from its logs", ("new", "--from", "logs"))
    emit(None, None, show, [step], out / "result", done.written)
    return 0 if done.fit.converged else 1


def run(
    out: Path, plant: str, seed: int | None, executor: "Executor", report: Reporter
) -> tuple["IdentifyResult", Content, Content]:
    """Return a fit to logs of the test site, predictions of runs not fitted, and the true values.

    Args:
        out: folder to write to.
        plant: `recorded` for the logs that ship with slipid, `mujoco` to simulate new ones.
        seed: seed of the simulation, or None.
        executor: executor of the simulated runs.
        report: reporter of the progress.

    Raises:
        DataError: there is no such plant, a seed is given for recorded logs, or MuJoCo is missing.
    """
    from slipid.app.identify import checked_task
    from slipid.app.logs import packaged_config, unpack
    from slipid.cli.identify import run as identify
    from slipid.cli.validate import run as validate
    from slipid.infer.result_folder import CONFIG, refuse_foreign_config
    from slipid.report.html.fit_page import write_report
    from slipid.support.files import read_json, write_bytes

    if plant not in ("recorded", "mujoco"):
        raise DataError(f"--plant {plant}: unknown; expected recorded or mujoco")
    if plant == "recorded" and seed is not None:
        raise DataError("--seed is given without a simulation; expected --plant mujoco with it")
    config, text = out / "robotino.toml", packaged_config("robotino.toml")
    result, source = out / "result", out / plant
    for path in (config, result / CONFIG):
        refuse_foreign_config(result, text, path)
    if plant == "recorded":
        report.stage("unpacking recorded logs")
        unpack(source)
    else:
        drive_anew(source, seed or 0, executor, report)
    write_bytes(config, text.encode())
    logs = source / "fit" / "logs"
    done = identify(checked_task(out / "robotino.toml", logs, report), logs, result, report)
    found, written = validate(result, source / "unseen" / "logs", report)
    report.stage("writing the page")
    with suppress(MissingExtra):  # `identify` has named it
        write_report(result)
    done = replace(done, written=(*done.written, *written))
    truth = read_json(source / TRUTH, "the true values that `slipid simulate` wrote")
    return done, found, truth["parameters"]


def drive_anew(out: Path, seed: int, executor: "Executor", report: Reporter) -> None:
    """Simulate anew, on the test site, all runs whose recorded logs ship with slipid."""
    from slipid.app.logs import packaged_config
    from slipid.lab.testsite.config import plan
    from slipid.lab.testsite.simulate import simulate

    for k, part in enumerate(PARTS):
        name = f"testsite_{part}.toml"
        text = packaged_config(name).replace(f"seed = {k}\n", f"seed = {2 * seed + k}\n")
        simulate(plan(Path(name), text), out / part, executor, report)
