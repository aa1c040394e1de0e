"""A robot of which only the contact and the motors are known, as the floor filter drives it."""

from dataclasses import fields

from slipid.control.deployed import DeployedRobot
from slipid.control.robot_file.record import FloorRecord, LoadRecord, RobotRecord, Wheels
from slipid.deploy.forecaster import given
from slipid.model.robot import Robot

HIGHEST_A, HIGHEST_SPEED = 100.0, 20.0
"""Of what is measured; what is far above it is no reading [A], [rad/s]."""


def deployed(robot: Robot) -> DeployedRobot:
    """The robot as it drives, its numbers as they are.

    What the floor filter does not use, a robot's uncertainty and what a fit has seen, is left at
    values that limit nothing.
    """
    shape = robot.geometry
    none = (0.0, 0.0, 0.0)
    load = LoadRecord(
        name=robot.body.loads[0],
        spread=(none,) * len(robot.surfaces.labels),
        told=None,
        highest_current=HIGHEST_A,
        wheel_curve=((0.0, 0.0),) * shape.drives,
    )
    record = RobotRecord(
        wheels=Wheels(**{f.name: getattr(shape, f.name) for f in fields(Wheels)}),
        parameters={path: n for path, n in given(robot).items() if not path.startswith("camera.")},
        floors=tuple(
            FloorRecord(name=name, process=none, effect=none, current_std=1.0, seen=None)
            for name in robot.surfaces.labels
        ),
        loads=(load,),
        current_trend=(0.0, 0.0),
        highest_speed=HIGHEST_SPEED,
        draws={},
    )
    return DeployedRobot.of(record)
