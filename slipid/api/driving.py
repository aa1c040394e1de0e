"""A deployed robot that drives on its own model: is the path kept, and does it know where it is?"""

from dataclasses import dataclass

from slipid.control import closed_loop, trajectory
from slipid.control.deployed import DeployedRobot
from slipid.data.floor_map import FloorMap
from slipid.deploy.controllers import ROWS, pilot_of
from slipid.deploy.deploy import habits_of
from slipid.deploy.trial import REST_S
from slipid.deploy.trial_site import floor_of, site, starts, twin


@dataclass(frozen=True, eq=False)
class Drive:
    """One closed-loop run; `print` says what became of the path.

    Attributes:
        course: path, true and believed poses, commands and estimates, a row per period.
        floor: the map it was driven on.
        metrics: what became of the path, from true poses.
    """

    course: closed_loop.Course
    floor: FloorMap
    metrics: closed_loop.Metrics

    def __str__(self) -> str:
        m = self.metrics
        ended = "ends" if m.finished else "was given up, with the way that was left it ends"
        return (
            f"{ended} {m.closure_mm:.0f} mm from where it should, turned by "
            f"{m.heading_error_deg:+.1f} deg; {m.cross_track_rmse_mm:.0f} mm beside the path (rms)"
        )


def drive(
    robot: DeployedRobot, controller: str = "contact", *, start: int = 0, seed: int = 0
) -> Drive:
    """Drive the 2021 paper's rectangle on the twin: the model itself, with delays and noise.

    Args:
        robot: a fit's or a posterior's `deploy()`, or `DeployedRobot.load`.
        controller: as of `slipid trial`: `encoder`, `contact`, `contact_gyro`, ...
        start: which of twenty poses on patches of the robot's floors.
        seed: of the sensors' noise.

    Raises:
        ValueError: no such controller or start.
    """
    places = starts(20, floor := site(robot))
    if controller not in ROWS or not 0 <= start < len(places):
        names = ", ".join(ROWS)
        raise ValueError(f"controller '{controller}' from start {start}; expected {names}; 0 to 19")
    row, begin = ROWS[controller], places[start]
    plant = twin(robot, floor, begin, seed, habits_of(robot, gyro=row.gyro))
    path = trajectory.rectangle().moved(begin).waiting(REST_S)
    course = closed_loop.drive(
        pilot_of(robot, row, floor=floor_of(floor, robot.labels)), path, plant, begin
    )
    return Drive(course, floor, closed_loop.metrics(course))
