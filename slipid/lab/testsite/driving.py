"""What is driven, twists one after the other or way-points, and what truly happens then."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap, uniform
from slipid.lab.testsite.plant import TIMESTEP, SimulatedRobot, heading_of
from slipid.lab.testsite.site import Site

PERIOD = 0.05
"""Between two commands to the robot [s]."""
REACHED_M = 0.02
"""Distance at which a way-point counts as reached [m]."""
BodyTwist = tuple[float, float, float]
"""Ahead, left [m/s], turn [rad/s]."""


@dataclass(frozen=True)
class TimedTwists:
    """Twists one after the other, each for so many seconds; none of the sensors is asked."""

    legs: tuple[tuple[BodyTwist, float], ...]

    def command(self, time: float) -> BodyTwist | None:
        """Twist at a time, None when it is over."""
        for twist, seconds in self.legs:
            if time < seconds - 1e-9:
                return twist
            time -= seconds
        return None


@dataclass(frozen=True)
class Waypoints:
    """Places one after the other, without turning; a pose is believed.

    Attributes:
        places: x, y [m] in the frame of the pose.
        speed: [m/s].
        by: the pose that is believed: `encoders` from the start on, or `camera` (the true one).
    """

    places: tuple[tuple[float, float], ...]
    speed: float = 0.2
    by: Literal["encoders", "camera"] = "encoders"


@dataclass(frozen=True)
class SiteRun:
    """One run.

    Attributes:
        surface: what its log says it drove on, None where that is for others to find out.
        load: name of the load set-up.
        program: `TimedTwists` or `Waypoints`.
        start: x, y [m], heading [rad].
        floor: which surface lies where, None for `surface` everywhere.
        place: name of the floor, in file names.
    """

    surface: str | None
    load: str
    program: TimedTwists | Waypoints
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    floor: FloorMap | None = None
    place: str = ""

    @property
    def folder(self) -> str:
        """Folder of its log: the surface, or the floor's name."""
        return self.place or str(self.surface)

    @property
    def map(self) -> FloorMap:
        """The floor."""
        return self.floor if self.floor is not None else uniform(str(self.surface))


def straight(
    surface: str, load: str, heading: float, speed: float, distance: float, turn: float = 0.0
) -> SiteRun:
    """A constant command that starts so that a robot without slip is in the middle halfway.

    Args:
        heading: direction of the commanded motion in the body frame [rad].
        speed: [m/s]; 0 turns on the spot.
        distance: commanded length [m], arc of the rim where it only turns.
        turn: [rad/s].
    """
    seconds = distance / (speed or abs(turn) * 0.125)
    twist = (speed * float(np.cos(heading)), speed * float(np.sin(heading)), turn)
    back = 0.0 if speed == 0 else 0.5 * distance
    start = (-back * float(np.cos(heading)), -back * float(np.sin(heading)), 0.0)
    return SiteRun(surface, load, TimedTwists(((twist, seconds), ((0.0, 0.0, 0.0), 0.3))), start)


def named_runs(runs: Sequence[SiteRun], jitter: float, seed: int) -> list[tuple[str, SiteRun]]:
    """Runs with names `<load>/<folder>/runNNN`, each put down by hand: its heading is not exact."""
    rng = np.random.default_rng(seed)
    counts: dict[str, int] = {}
    out = []
    for run in runs:
        folder = f"{run.load}/{run.folder}"
        counts[folder] = counts.get(folder, -1) + 1
        x, y, heading = run.start
        start = (x, y, heading + float(rng.uniform(-jitter, jitter)))
        out.append((f"{folder}/run{counts[folder]:03d}", replace(run, start=start)))
    return out


@dataclass(frozen=True, eq=False)
class Trace:
    """What truly happened, a row per time step.

    Attributes:
        time: time since the end of the settling [s].
        pose: pose of the body: x, y [m], heading [rad].
        yaw_rate: [rad/s].
        wheel_angle, wheel_speed, wheel_command: [rad], [rad/s], [rad/s].
        current, voltage: those of the motors, signed along the drive direction [A], [V].
        bus: voltage of the supply [V].
        sinkage: depth to which each wheel has sunk [m].
        twist_command: what was sent to the robot at this time: [m/s, m/s, rad/s].
    """

    time: Float[np.ndarray, " step"]
    pose: Float[np.ndarray, "step 3"]
    yaw_rate: Float[np.ndarray, " step"]
    wheel_angle: Float[np.ndarray, "step wheel"]
    wheel_speed: Float[np.ndarray, "step wheel"]
    wheel_command: Float[np.ndarray, "step wheel"]
    current: Float[np.ndarray, "step wheel"]
    voltage: Float[np.ndarray, "step wheel"]
    bus: Float[np.ndarray, " step"]
    sinkage: Float[np.ndarray, "step wheel"]
    twist_command: Float[np.ndarray, "step 3"]


class RimSpeeds:
    """Wheel speeds that follow commands with the site's delay and acceleration."""

    def __init__(self, site: Site, plant: SimulatedRobot):
        self.plant, self.delay = plant, site.command_delay_s
        self.slew = site.acceleration * plant.dt / site.machine.wheel_radius_m
        self.speed = self._wanted = np.zeros(len(plant.wheel_dof))
        self._waiting: list[tuple[float, Float[np.ndarray, " wheel"]]] = []

    def send(self, command: Float[np.ndarray, " wheel"]) -> None:
        """A command [rad/s] sets out."""
        self._waiting.append((self.plant.time + self.delay, command))

    def follow(self) -> Float[np.ndarray, " wheel"]:
        """Speeds [rad/s] to be kept over the next time step."""
        while self._waiting and self._waiting[0][0] <= self.plant.time + 1e-9:
            self._wanted = self._waiting.pop(0)[1]
        self.speed = self.speed + np.clip(self._wanted - self.speed, -self.slew, self.slew)
        return self.speed


def drive(run: SiteRun, site: Site, seed: int, timestep: float = TIMESTEP) -> Trace:
    """Drive one run; arguments as of `SimulatedRobot`.

    Raises:
        DataError: MuJoCo is missing, or the simulation became unstable.
    """
    plant = SimulatedRobot(site, run.map, run.load, run.start, seed, timestep)
    recorder, rims = _Recorder(plant), RimSpeeds(site, plant)
    back = np.linalg.pinv(site.machine.wheel_from_twist)
    believed, sent, goal = np.zeros(3), np.zeros(3), 0
    before = plant.wheel_angle
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
        rims.send(site.machine.wheel_from_twist @ sent)
        for _ in range(round(PERIOD / plant.dt)):
            recorder.record(rims.follow(), sent)
            plant.step(rims.speed.tolist())
    recorder.record(rims.speed, sent)
    plant.check()
    return recorder.trace()


def _towards(
    program: Waypoints, goal: int, pose: Float[np.ndarray, "3"], time: float
) -> tuple[int, BodyTwist | None]:
    """The next way-point, and the twist towards it in the body frame.

    It is given up after thrice the time without slip and 10 s.
    """
    while goal < len(program.places):
        far = np.array(program.places[goal]) - pose[:2]
        size = float(np.hypot(*far))
        if size > REACHED_M:
            break
        goal += 1
    corners = np.array([program.places[-1], *program.places])  # at least as long as the way
    longest = 10.0 + 3 * float(np.hypot(*np.diff(corners, axis=0).T).sum()) / program.speed
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

    def __init__(self, plant: SimulatedRobot):
        self.plant = plant
        self._rows: list[tuple[float | list[float] | np.ndarray, ...]] = []

    def record(self, wanted: Float[np.ndarray, " wheel"], sent: Float[np.ndarray, "3"]) -> None:
        p, d = self.plant, self.plant.data
        body, turn, height = d.qpos[:7].copy(), d.qvel[5], d.xpos[p.wheel_body, 2]
        wheels = d.qpos[p.wheel_at], d.qvel[p.wheel_dof], height, wanted
        electric = list(p.drive.current), list(p.drive.voltage), p.drive.bus
        self._rows.append((p.time, body, turn, *wheels, *electric, sent))

    def trace(self) -> Trace:
        columns = (np.array(column) for column in zip(*self._rows, strict=True))
        time, body, turn, angle, speed, height, wanted, amps, volts, bus, sent = columns
        heading = np.unwrap(heading_of(body[:, 3:]))[:, None]
        return Trace(
            time=time,
            pose=np.concatenate([body[:, :2], heading], axis=1),
            yaw_rate=turn,
            wheel_angle=angle - self.plant.angle_at_start,
            wheel_speed=speed,
            wheel_command=wanted,
            current=amps,
            voltage=volts,
            bus=bus,
            sinkage=np.maximum(self.plant.machine.wheel_radius_m - height, 0.0),
            twist_command=sent,
        )
