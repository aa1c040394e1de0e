"""Functions that check runs before a fit, simulate runs, and predict the motion of a robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from slipid.api.fit import Numbers, Prior, fit_task_of
from slipid.app.check import (
    ExpectedEstimate,
    ExpectedEstimates,
    calibration_part,
    expected_if_any,
    overview,
)
from slipid.data.runs import Runs, collect
from slipid.lab.selftest import logs as known
from slipid.lab.selftest.logs import simulate_logs
from slipid.model.robot import Robot, steady_states
from slipid.parameter import as_numbers
from slipid.report.checks import show_check
from slipid.report.page import text_of
from slipid.support.content import Content
from slipid.support.progress import Reporter


@dataclass(frozen=True, eq=False)
class LogCheck:
    """Result of a check of runs; `print` shows it, `check[path]` is one expected estimate.

    Attributes:
        content: summary of the runs by floor, of their channels, and of the reader's repairs.
        result: expected verdict of each parameter, and sentences about combinations of parameters
            that the runs cannot determine.
    """

    content: Content
    result: ExpectedEstimates

    def __str__(self) -> str:
        return text_of(show_check, self.content | self.result.to_json())

    def __getitem__(self, path: str) -> ExpectedEstimate:
        """Return the expected estimate of one parameter; raise `KeyError` for an unknown path."""
        return self.result.parameters[path]


def check(
    runs: Runs,
    robot: Robot,
    *,
    priors: Mapping[str, Prior] | None = None,
    fixed: Mapping[str, Numbers] | None = None,
    free: Sequence[str] = (),
) -> LogCheck:
    """Return the result of a check of runs, which takes far less time than a fit.

    Arguments and errors are those of `fit`.
    """
    task = fit_task_of(runs, robot, priors or {}, fixed or {}, {}, free)
    content = overview(task)
    with Reporter(quiet=True) as report:
        started, part = calibration_part(task, content["findings"], report)
    return LogCheck(content | part, expected_if_any(started))


@dataclass(frozen=True, eq=False)
class SimulatedRuns:
    """Simulated runs and their true parameters.

    Attributes:
        runs: the runs, as `read_runs` would return them.
        robot: robot that drove the runs, a three-wheeled Robotino, with its true parameters.
    """

    runs: Runs
    robot: Robot

    @cached_property
    def truth(self) -> dict[str, float | list[float]]:
        """Return the true value of every parameter by its path [SI]."""
        return known.true_numbers(self.robot)


def simulate_runs(
    floors: Sequence[str] = ("firm", "soft"),
    *,
    headings: int = 12,
    speeds: Sequence[float] = (0.1, 0.2),
    turns: int = 2,
    truth: Mapping[str, float | Sequence[float]] | None = None,
    current: bool = True,
    voltage: bool = True,
    seed: int = 0,
) -> SimulatedRuns:
    """Return simulated runs of a robot whose parameters are known, with a Robotino's sensor noise.

    An older name, `made_runs`, still works.

    Args:
        floors: names of the floors; `firm` and `soft` have particular parameters, and any other
            floor has the declared start values.
        headings: number of evenly spread directions of travel, on every floor at every speed.
        speeds: speeds of the runs [m/s].
        turns: number of additional curved runs, on every floor at every speed.
        truth: true values of parameters, keyed by path, that replace the defaults [SI].
        current: True to simulate currents of the motors.
        voltage: True to simulate voltages of the motors.
        seed: seed of the noise.

    Raises:
        ValueError: there is no such parameter; the message lists all parameters.
    """
    drives = known.heading_grid([(floor, "as_built") for floor in floors], headings, speeds, turns)
    robot = known.true_robot(drives, truth)
    if wrong := sorted(set(truth or {}) - set(known.true_numbers(robot))):
        raise ValueError(
            f"no parameter '{wrong[0]}'; there are: {', '.join(known.true_numbers(robot))}"
        )
    logs = simulate_logs(robot, drives, seed, known.SimulatedSensors(has_voltage=voltage))
    return SimulatedRuns(
        collect(logs if current else [replace(log, current=None) for log in logs]), robot
    )


@dataclass(frozen=True, eq=False)
class SteadyMotion:
    """Steady motions of a robot, with a row for each command.

    Attributes:
        twist: twist of the body: x [m/s], y [m/s], yaw rate [rad/s].
        wheel_speed: commanded speed of each wheel [rad/s].
        slip: slip 1 - v / (r w) of every wheel [1], where v is the speed of its centre along the
            drive direction, r the radius and w the wheel speed; NaN for a wheel that stands still.
        torque: torque of the traction force at every wheel [N m], positive if the wheel drives.
        current: current of every motor [A], positive if the motor drives.
    """

    twist: Float[np.ndarray, "command 3"]
    wheel_speed: Float[np.ndarray, "command wheel"]
    slip: Float[np.ndarray, "command wheel"]
    torque: Float[np.ndarray, "command wheel"]
    current: Float[np.ndarray, "command drive"]


def steady_motion(
    robot: Robot, floor: str, command: Sequence[Sequence[float]] | np.ndarray, load: str = ""
) -> SteadyMotion:
    """Return the steady motion of a robot whose wheels keep the commanded speeds.

    An older name, `move`, still works.

    Args:
        robot: robot with its parameters, such as `fit.robot`.
        floor: name of the floor.
        command: commanded body twists x [m/s], y [m/s], yaw rate [rad/s], one in each row.
        load: name of the load set-up; by default the robot's first one.

    Raises:
        ValueError: there is no such floor or load set-up.

    Source: the force balance of `slipid.model.contact`.
    """
    frame, shape = robot.geometry.frame(), robot.geometry
    driven = np.atleast_2d(np.asarray(command, float)) @ np.asarray(shape.forward()).T
    driven /= float(frame.radius)
    place = robot.surface_index(floor), robot.load_index(load or robot.body.loads[0])
    found = steady_states(robot, driven, *place)
    speed = np.asarray(shape.at_wheels(as_numbers(driven)))
    rim = float(frame.radius) * np.asarray(frame.drive_share) * speed
    return SteadyMotion(
        twist=found.twist,
        wheel_speed=speed,
        slip=1
        - found.twist @ np.asarray(frame.hold).T / np.where(np.abs(speed) < 1e-6, np.nan, rim),
        torque=found.torque * np.sign(speed),
        current=found.current * np.sign(driven),
    )
