"""Function `calibrate`: calibrated kinematics of a robot, without a fit of motors and contact."""

from collections.abc import Mapping
from dataclasses import dataclass

from slipid.api.fit import Numbers, Prior, fit_task_of
from slipid.app.calibrate import CalibrationResult, calibration_of
from slipid.data.check.columns import refuse_misordered
from slipid.data.check.stuck import refuse_stuck
from slipid.data.runs import Runs
from slipid.deploy.deploy import calibrated_robot
from slipid.fitting.calibration.result import Calibration
from slipid.infer.verdicts.trust import Trust
from slipid.model.robot import Robot
from slipid.report.calibration import show_calibration, show_trust
from slipid.report.page import Page, text_of
from slipid.robot.deployed import DeployedRobot
from slipid.support.progress import Reporter


@dataclass(frozen=True, eq=False)
class RobotCalibration:
    """Calibrated kinematics and pose sensor of a robot; `print` shows them.

    Attributes:
        result: calibration, selected kinematic models and trust, with their runs.
    """

    result: CalibrationResult

    @property
    def calibration(self) -> Calibration:
        """Rolling radii, track or base, place and lag of the pose sensor, with intervals."""
        return self.result.calibration

    @property
    def trust(self) -> Trust:
        """Trust in the selected models, from predictions of held-out runs."""
        return self.result.trust

    def deploy(self) -> DeployedRobot:
        """Return the robot for an estimator."""
        task, models = self.result.task, self.result.models
        return calibrated_robot(
            self.calibration, task.robot, models, task.dataset, task.robot_settings
        )

    def __str__(self) -> str:
        def show(page: Page, found: CalibrationResult) -> None:
            show_calibration(page, found.calibration)
            show_trust(page, found.trust)

        return text_of(show, self.result)


def calibrate(
    runs: Runs,
    robot: Robot,
    *,
    priors: Mapping[str, Prior] | None = None,
    fixed: Mapping[str, Numbers] | None = None,
    quiet: bool = False,
) -> RobotCalibration:
    """Return the calibrated kinematics of a robot, in seconds.

    Runs may lack headings, positions, or all poses but the first and the last, and the robot may
    steer.

    Args:
        runs: runs from `read_runs`, each on one floor.
        robot: robot that drove the runs, with the lengths that are believed.
        priors: priors of parameters of the pose sensor, such as `camera.lag`, keyed by path.
        fixed: values of such parameters that are known, keyed by path [SI].
        quiet: True to report no progress.

    Raises:
        DataError: no wheel turns, columns of wheels are exchanged, or an
            encoder or the positions stay constant while the robot moves.
        ValueError: there is no such parameter, or a value is outside its bounds.

    Source: `slipid.fitting.calibration.estimate`.
    """
    refuse_misordered(runs.logs)
    refuse_stuck(runs, robot.geometry)
    task = fit_task_of(runs, robot, priors or {}, fixed or {}, {}, ())
    with Reporter(quiet=quiet) as report:
        return RobotCalibration(calibration_of(task, report))
