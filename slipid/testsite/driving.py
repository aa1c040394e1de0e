"""Driving: a run on a site, as a trace of what truly happened."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from slipid.testsite.experiments import Run, Twist, Waypoints
from slipid.testsite.ground import GROUNDS, Ground
from slipid.testsite.machine import Machine
from slipid.testsite.motors import Motor, SpeedLoop
from slipid.testsite.plant import Plant, Trace, heading_of
from slipid.testsite.sensors import Sensors

PERIOD = 0.05
"""Between two commands to the robot [s]."""


@dataclass(frozen=True)
class Site:
    """Everything that stays the same from run to run.

    Attributes:
        machine, motor, loop: the robot.
        sensors: sensors that make its logs.
        grounds: physics of every surface.
        command_delay_s: delay from a command to the wheels.
        acceleration: acceleration of the wheels' rims towards a new command [m/s^2].
    """

    machine: Machine = field(default_factory=Machine)
    motor: Motor = field(default_factory=Motor)
    loop: SpeedLoop = field(default_factory=SpeedLoop)
    sensors: Sensors = field(default_factory=Sensors)
    grounds: Mapping[str, Ground] = field(default_factory=lambda: dict(GROUNDS))
    command_delay_s: float = 0.12
    acceleration: float = 1.0


def drive(run: Run, site: Site, seed: int, timestep: float | None = None) -> Trace:
    """Drive one run.

    Args:
        run: what to do.
        site: robot and floors.
        seed: seed of how the wheels stand and of the floor's unevenness.
        timestep: time step of the engine [s], by default `plant.TIMESTEP`.

    Raises:
        DataError: MuJoCo is missing, a surface has no physics, or the simulation became unstable.
    """
    more = {} if timestep is None else {"timestep": timestep}
    plant = Plant(
        site.machine,
        site.motor,
        site.loop,
        run.map,
        site.grounds,
        run.load,
        run.start,
        seed,
        **more,
    )
    recorder = _Recorder(plant)
    machine = site.machine
    back = np.linalg.pinv(machine.wheel_from_twist)
    believed = np.zeros(3)
    before = plant.wheel_angle
    every = round(PERIOD / plant.dt)
    waiting: list[tuple[float, Float[np.ndarray, " wheel"]]] = []
    wheels = wanted = np.zeros(len(before))
    slew = site.acceleration * plant.dt / machine.wheel_radius_m
    goal = 0
    sent = np.zeros(3)
    program = run.program
    while True:
        if isinstance(program, Waypoints):
            turned = plant.wheel_angle
            believed = _moved(believed, back @ (turned - before))
            before = turned
            pose = believed if program.by == "encoders" else np.array(plant.pose)
            goal, twist = _towards(program, goal, pose, plant.time)
        else:
            twist = program.command(plant.time)
        if twist is None:
            break
        sent = np.array(twist)
        waiting.append((plant.time + site.command_delay_s, machine.wheel_from_twist @ sent))
        for _ in range(every):
            while waiting and waiting[0][0] <= plant.time + 1e-9:
                wanted = waiting.pop(0)[1]
            wheels = wheels + np.clip(wanted - wheels, -slew, slew)
            recorder.record(wheels, sent)
            plant.step(wheels.tolist())
    recorder.record(wheels, sent)
    plant.check()
    return recorder.trace()


def _towards(
    program: Waypoints, goal: int, pose: Float[np.ndarray, "3"], time: float
) -> tuple[int, Twist | None]:
    """The next way-point, and the twist towards it in the body frame."""
    while goal < len(program.places):
        far = np.array(program.places[goal]) - pose[:2]
        size = float(np.hypot(*far))
        if size > program.within_m:
            break
        goal += 1
    longest = program.longest_s
    if longest is None:
        corners = np.array([program.places[-1], *program.places])  # at least as long as the way
        steps = np.diff(corners, axis=0)
        longest = 10.0 + 3 * float(np.hypot(*steps.T).sum()) / program.speed
    if goal == len(program.places) or time > longest:
        return goal, None
    speed = min(program.speed, max(0.05, 2.0 * size))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = speed * far / size
    return goal, (float(c * x + s * y), float(c * y - s * x), 0.0)


def _moved(pose: Float[np.ndarray, "3"], step: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Pose after a small displacement in the body frame."""
    middle = pose[2] + 0.5 * step[2]
    c, s = np.cos(middle), np.sin(middle)
    return pose + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])


class _Recorder:
    """Rows of a trace while they come: the engine's state as it is, made sense of at the end."""

    def __init__(self, plant: Plant):
        self.plant = plant
        self._position = np.concatenate([np.arange(7), plant.wheel_at])
        self._velocity = np.concatenate([[5], plant.wheel_dof])
        self._rows: list[list[float]] = []

    def record(self, wanted: Float[np.ndarray, " wheel"], sent: Float[np.ndarray, "3"]) -> None:
        p = self.plant
        row = [p.time, p.drive.bus, *p.drive.current, *p.drive.voltage]
        row += p.data.qpos[self._position].tolist()
        row += p.data.qvel[self._velocity].tolist()
        row += p.data.xpos[p.wheel_body, 2].tolist()
        self._rows.append(row + wanted.tolist() + sent.tolist())

    def trace(self) -> Trace:
        n = len(self.plant.wheel_at)
        widths = [1, 1, n, n, 7, n, 1, n, n, n, 3]
        t, bus, amps, volts, q, angle, turn, speed, height, wanted, sent = np.split(
            np.array(self._rows), np.cumsum(widths)[:-1], axis=1
        )
        heading = np.unwrap(heading_of(q[:, 3:]))[:, None]
        return Trace(
            time=t[:, 0],
            pose=np.concatenate([q[:, :2], heading], axis=1),
            yaw_rate=turn[:, 0],
            wheel_angle=angle - self.plant.angle_at_start,
            wheel_speed=speed,
            wheel_command=wanted,
            current=amps,
            voltage=volts,
            bus=bus[:, 0],
            sinkage=np.maximum(self.plant.machine.wheel_radius_m - height, 0.0),
            twist_command=sent,
        )
