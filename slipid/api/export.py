"""A deployed robot in the forms that robots load."""

from collections.abc import Sequence
from pathlib import Path

from slipid.control.deployed import DeployedRobot
from slipid.deploy.export import FORMS, Exported, Wish
from slipid.deploy.export import export as run
from slipid.support.progress import Reporter


def export(
    robot: DeployedRobot,
    folder: Path | str,
    to: Sequence[str] = FORMS,
    *,
    controller: str = "contact",
    path: str = "rectangle",
    speed: float = 0.2,
    map: Path | str | None = None,
) -> Exported:
    """Write a robot to a folder: robot.json, a README, checksums, and what is made of it.

    Args:
        robot: a fit's or a posterior's `deploy()`, or `DeployedRobot.load`; `on(...)` leaves
            floors out.
        folder: that is new, empty, or an older export, which is then replaced.
        to: `c` (C99 of the very steps of estimator and controller), `ros2` (parameters by the names
            of ros2_controllers and robot_localization), `stablehlo`, `table` (Markdown and CSV).
        controller: as of `slipid trial`.
        path: that the example in C follows; speed: along it [m/s].
        map: file of a floor map, for `contact_map`, which is told one.

    Raises:
        DataError: no such form, controller or path, a step that has no form in C, or other files
            lie there.
    """
    file = None if map is None else Path(map)
    wish = Wish(tuple(to), controller, path, speed, map=file)
    return run(robot, Path(folder), wish, Reporter(quiet=True))
