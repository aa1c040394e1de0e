"""`slipid simulate`: simulate runs on the virtual test site, and write their logs."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from slipid.cli.common import ConfigFile, Jobs, Json, Next, Out, Quiet, emit, executor_of, guarded
from slipid.support.content import Content
from slipid.support.folder import locked
from slipid.support.progress import Reporter

if TYPE_CHECKING:
    from slipid.lab.testsite.config import SimulationPlan
    from slipid.report.page import Page


@guarded
def simulate(
    config: ConfigFile, out: Out, jobs: Jobs = None, json: Json = None, quiet: Quiet = False
) -> int:
    """Simulate logs on the virtual test site (MuJoCo physics); needs the extra `testsite`.

    Writes the logs, a config for `slipid identify`, floor maps, and, in a separate folder, the true
    values. Finished runs are kept and not simulated again.
    """
    from slipid.lab.testsite.config import plan as read
    from slipid.lab.testsite.simulate import simulate as run
    from slipid.support.toml_file import text_of

    plan = read(config, text_of(config))
    with (
        Reporter(quiet=quiet) as report,
        locked(out, "simulate", "simulate.json"),
        executor_of(jobs) as executor,
    ):
        found = run(plan, out, executor, report)
    emit(json, found, lambda page: show(page, found, out), list(following(plan, out)))
    return 0


def show(page: "Page", found: Content, out: Path) -> None:
    """Print the number and duration of the simulated runs."""
    page.line(f"{len(found['runs'])} runs, {found['driven']} of them simulated now")
    if found["pace"] is not None:
        page.line(f"{found['seconds']:.0f} s at {found['pace']:.1f} times real time")
    page.line(f"true values, which no fit reads: {out / 'truth'}")


def following(plan: "SimulationPlan", out: Path) -> Iterator[Next]:
    """Yield the commands to suggest after a simulation."""
    from slipid.lab.testsite.config import can_identify

    if can_identify(plan):
        words = ("identify", out / "robot.toml", "--data", out / "logs", "--out", out / "result")
        yield Next("fit the robot to its logs", words)
    if "robotino2022" in plan.content.formats:
        config, data = Path("configs/robotino2022.toml"), out / "robotino2022"
        words = ("identify", config, "--data", data, "--out", out / "result2022")
        yield Next("fit it to its logs in the format of the 2022 data set", words)
