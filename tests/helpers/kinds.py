"""Robots of every kind of drive with known numbers, and what their logs are fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slipid.app.problem import lag_from_motion
from slipid.data.runs import Runs, collect
from slipid.data.windows import windows
from slipid.fitting.optimise import optimise
from slipid.fitting.problem import Problem
from slipid.infer.design.planned_runs import PlannedRun
from slipid.infer.result import Fit
from slipid.infer.summary import summarise
from slipid.lab.selftest.logs import SimulatedSensors, heading_grid, simulate_logs, turning_grid
from slipid.model.geometry import Geometry, differential, mecanum, omni, skid_steer
from slipid.model.robot import Robot, build
from slipid.parameter import entries
from slipid.robot.deployed import DeployedRobot
from slipid.search_space import Choice, Space
from tests.helpers.known_robot import deploy_known

SHAPES = {
    "omni 4": omni([45.0, 135.0, 225.0, 315.0], 0.2, 0.05, 16.0),
    "mecanum": mecanum(0.2, 0.15, 0.05, 16.0),
    "skid": skid_steer(0.2, 0.25, 0.1, 16.0, drive_of=(0, 1, 0, 1)),
    "differential": differential(0.2, 0.1, 16.0),
}
FLOORS = {"firm": 0.08, "soft": 0.3}
"""Creep of the floors."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """Runs that were made, the robot that made them, and what is fitted."""

    truth: Robot
    data: Runs
    choices: tuple[Choice, ...]


def experiment(kind: str, seed: int = 0, headings: int = 12) -> Experiment:
    """Runs of a robot of some kind on two floors, with currents and voltages."""
    shape = SHAPES[kind]
    drives = plan(shape, headings)
    truth = known(shape, drives)
    # wheels that are dragged along brake, which magnitudes of currents do not tell
    fine = SimulatedSensors(ripple=0.005, current_step=0.002, voltage_step=0.005, signed=True)
    data = collect(simulate_logs(truth, drives, seed, fine))
    return Experiment(truth, data, wanted(truth, data))


def known(shape: Geometry, drives: Sequence[PlannedRun]) -> Robot:
    """A robot of this shape whose every number is known, in the sessions that are driven."""
    robot = build(shape, list(FLOORS), ("as_built",), sorted({d.session for d in drives}))
    choices = [Choice(path, fixed=value) for path, value in numbers(robot).items()]
    return Space(robot, choices).template


def deployed(kind: str) -> DeployedRobot:
    """A robot of some kind for controllers, which knows every number."""
    robot = build(SHAPES[kind], list(FLOORS), ("as_built",), ("today",))
    choices = [Choice(path, fixed=value) for path, value in numbers(robot).items()]
    return deploy_known(Space(robot, choices).template)


def fitted(truth: Robot, data: Runs, choices: Sequence[Choice]) -> Fit:
    """Windows at the lag that a fit starts from, a problem on them, its optimum and its summary."""
    start = Space(truth, choices).template
    labels = truth.surfaces.labels, truth.body.loads, truth.camera.sessions
    w = windows(data, float(start.geometry.wheel_radius), float(start.camera.lag), longest=2.0)
    problem = Problem(w, build(truth.geometry, *labels), list(choices))
    return summarise(problem, optimise(problem), data, choices)


def plan(shape: Geometry, headings: int) -> tuple[PlannedRun, ...]:
    setups = [(floor, "as_built") for floor in FLOORS]
    if shape.determines_twist:
        return heading_grid(setups, headings, (0.15, 0.3), turns=4)
    return turning_grid(setups, headings, (0.15, 0.3), float(shape.base_radius))


def numbers(robot: Robot) -> dict[str, float | list[float]]:
    """The true numbers, where they are not the declared starts."""
    wheels = robot.geometry.wheels
    share = np.linspace(0.9, 1.1, wheels) if wheels > 2 else np.array([1.0, 1.0])
    out: dict[str, float | list[float]] = {
        "robot.mass": 20.0,
        "robot.load_share@as_built": (share / share.sum()).tolist(),
        "motor.resistance": 2.0,
        "motor.back_emf": 0.05,
        "motor.coulomb_friction": 0.05,
        "camera.lag": 0.05,
    }
    for floor, creep in FLOORS.items():
        out[f"surface.{floor}.creep"] = creep
        out[f"surface.{floor}.friction"] = 0.6
    return {path: value for path, value in out.items() if path in {e.path for e in entries(robot)}}


def wanted(truth: Robot, data: Runs) -> tuple[Choice, ...]:
    """What is free, and priors that a user could have; they do not know the truth."""
    held = (
        [] if not all(truth.geometry.grips) else ["roller_drag", "roller_creep", "roller_viscosity"]
    )
    return (
        *(Choice(f"surface.*.{name}", free=False) for name in held),
        Choice("robot.mass", fixed=20.0),
        *lag_from_motion(data),
        Choice("motor.resistance", start=3.0, prior_mean=2.5, prior_std=1.5),
        Choice("motor.back_emf", start=0.03, prior_mean=0.04, prior_std=0.02),
    )
