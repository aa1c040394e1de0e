"""Runs of the simulated robot by timed twists or way-points, and records of its true motion."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap, uniform
from slipid.lab.testsite.plant import TIMESTEP, SimulatedRobot, heading_of
from slipid.lab.testsite.site import Site

PERIOD = 0.05
"""Time between two commands to the robot [s]."""
REACHED_M = 0.02
"""Distance at which a way-point counts as reached [m]."""
SPIN_ARM_M = 0.125
"""Arm at which the length of a turn on the spot is measured [m]."""
STEERING = 1.0
"""Turn rate over the angle to the next way-point, and largest turn rate [1/s], [rad/s]."""
BodyTwist = tuple[float, float, float]
"""Forward and leftward speed [m/s], and turn rate [rad/s]."""


@dataclass(frozen=True)
class TimedTwists:
    """Open-loop program: twists that are commanded one after the other.

    Attributes:
        legs: each twist with its duration [s].
    """

    legs: tuple[tuple[BodyTwist, float], ...]

    def twists(self, plant: SimulatedRobot) -> Iterator[BodyTwist]:
        """Yield the twist of each period until the end of the last leg."""
        end = 0.0
        for twist, seconds in self.legs:
            end += seconds
            while plant.time < end - 1e-9:
                yield twist


@dataclass(frozen=True)
class Waypoints:
    """Closed-loop program: positions to reach one after the other.

    A robot that can drive sideways does not turn; any other turns towards the next position.

    Attributes:
        places: x, y of the positions [m], in the frame of the pose that `by` chooses.
        speed: speed between the positions [m/s].
        by: pose that is used as feedback: `encoders` (dead reckoning from the start) or `camera`
            (the true pose).
    """

    places: tuple[tuple[float, float], ...]
    speed: float = 0.2
    by: Literal["encoders", "camera"] = "encoders"

    def twists(self, plant: SimulatedRobot) -> Iterator[BodyTwist]:
        """Yield the twist of each period, in the body frame, until all positions are reached.

        Iteration also ends if the run takes longer than 10 s plus three times its duration without
        slip.
        """
        # the longest allowed duration needs the length of all legs; the start is not in `places`,
        # so the first leg is taken as long as that from the last position to the first
        corners = np.array([self.places[-1], *self.places])
        longest = 10.0 + 3 * float(np.hypot(*np.diff(corners, axis=0).T).sum()) / self.speed
        pose, back = np.zeros(3), np.linalg.pinv(plant.robot.wheel_from_twist)
        angle, goals = plant.wheel_angle, list(self.places)
        sideways = bool(plant.robot.wheel_from_twist[:, 1].any())
        while plant.time <= longest:
            before, angle = angle, plant.wheel_angle
            pose = _moved(pose, back @ (angle - before))
            if self.by == "camera":
                pose = np.array(plant.pose)
            while goals and np.hypot(*(goals[0] - pose[:2])) <= REACHED_M:
                del goals[0]
            if not goals:
                return
            offset = goals[0] - pose[:2]
            distance = float(np.hypot(*offset))
            speed = min(self.speed, max(0.05, 2.0 * distance))
            x, y = speed * offset / distance
            c, s = np.cos(pose[2]), np.sin(pose[2])
            ahead, left = float(c * x + s * y), float(c * y - s * x)
            if sideways:
                yield ahead, left, 0.0
            else:
                turn = STEERING * float(np.arctan2(left, ahead))
                yield max(ahead, 0.0), 0.0, min(max(turn, -STEERING), STEERING)


def _moved(pose: Float[np.ndarray, "3"], step: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the pose after a small displacement (x, y, turn) in the body frame [m, m, rad]."""
    middle = pose[2] + 0.5 * step[2]
    c, s = np.cos(middle), np.sin(middle)
    return pose + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1], step[2]])


@dataclass(frozen=True)
class SiteRun:
    """One run on the test site.

    Attributes:
        surface: surface named in the log; None if the floor has several.
        load: name of the load set-up.
        program: `TimedTwists` or `Waypoints`.
        start: start pose: x, y [m], heading [rad].
        floor: map of the floor; None if `surface` is everywhere.
        place: name of the floor in file names; empty to use the name of the surface.
    """

    surface: str | None
    load: str
    program: TimedTwists | Waypoints
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    floor: FloorMap | None = None
    place: str = ""

    @property
    def folder(self) -> str:
        """Name of the log's folder: the floor's name or, if it has none, the surface's name."""
        return self.place or str(self.surface)

    @property
    def map(self) -> FloorMap:
        """Map of the floor."""
        return self.floor if self.floor is not None else uniform(str(self.surface))


def straight(
    surface: str, load: str, heading: float, speed: float, distance: float, turn: float = 0.0
) -> SiteRun:
    """Return a run with a constant command.

    The start is placed so that the origin is the middle of the path, if it is straight and nothing
    slips.

    Args:
        surface: name of the surface.
        load: name of the load set-up.
        heading: direction of the commanded motion in the body frame [rad].
        speed: commanded speed [m/s]; 0 for a turn on the spot.
        distance: commanded path length [m]; for a turn on the spot, the arc length of a point at
            `SPIN_ARM_M` from the middle of the robot [m].
        turn: commanded turn rate [rad/s].
    """
    seconds = distance / (speed or abs(turn) * SPIN_ARM_M)
    twist = (speed * float(np.cos(heading)), speed * float(np.sin(heading)), turn)
    back = 0.0 if speed == 0 else 0.5 * distance
    start = (-back * float(np.cos(heading)), -back * float(np.sin(heading)), 0.0)
    return SiteRun(surface, load, TimedTwists(((twist, seconds), ((0.0, 0.0, 0.0), 0.3))), start)


def named_runs(runs: Sequence[SiteRun], jitter: float, seed: int) -> list[tuple[str, SiteRun]]:
    """Return pairs of a name `<load>/<folder>/runNNN` and a run whose start heading is changed.

    Headings change at random by at most `jitter` [rad], as if the robot were placed by hand.
    """
    rng, jitter = np.random.default_rng(seed), abs(jitter)  # numpy refuses a range of -0 to 0
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
    """True motion of a run, with one row per time step.

    Wheel angles, wheel speeds and commands have a value for each motor: those of the first of the
    wheels that it turns.

    Attributes:
        time: time since the robot had settled on the floor [s].
        pose: pose of the body: x, y [m], heading [rad].
        yaw_rate: yaw rate of the body [rad/s].
        wheel_angle: angle of the wheels [rad].
        wheel_speed: speed of the wheels [rad/s].
        wheel_command: commanded speed of the wheels [rad/s].
        current: current of each motor, signed along the drive direction [A].
        voltage: voltage of each motor, signed along the drive direction [V].
        bus: voltage of the supply [V].
        sinkage: depth to which each wheel has sunk [m].
        twist_command: twist commanded to the robot at this time [m/s, m/s, rad/s].
    """

    time: Float[np.ndarray, " step"]
    pose: Float[np.ndarray, "step 3"]
    yaw_rate: Float[np.ndarray, " step"]
    wheel_angle: Float[np.ndarray, "step drive"]
    wheel_speed: Float[np.ndarray, "step drive"]
    wheel_command: Float[np.ndarray, "step drive"]
    current: Float[np.ndarray, "step drive"]
    voltage: Float[np.ndarray, "step drive"]
    bus: Float[np.ndarray, " step"]
    sinkage: Float[np.ndarray, "step wheel"]
    twist_command: Float[np.ndarray, "step 3"]


class RimSpeeds:
    """Target speeds of the wheels, which follow commands with the site's delay and acceleration."""

    def __init__(self, site: Site, plant: SimulatedRobot):
        self.plant, self.delay = plant, site.command_delay_s
        self.slew = site.acceleration * plant.dt / site.robot.wheel_radius_m
        self.speed = self._wanted = np.zeros(len(plant.wheel_dof))
        self._waiting: list[tuple[float, Float[np.ndarray, " wheel"]]] = []

    def send(self, command: Float[np.ndarray, " wheel"]) -> None:
        """Send a command [rad/s], which arrives after the delay."""
        self._waiting.append((self.plant.time + self.delay, command))

    def follow(self) -> Float[np.ndarray, " wheel"]:
        """Return the target speeds of the wheels over the next time step [rad/s]."""
        while self._waiting and self._waiting[0][0] <= self.plant.time + 1e-9:
            self._wanted = self._waiting.pop(0)[1]
        self.speed = self.speed + np.clip(self._wanted - self.speed, -self.slew, self.slew)
        return self.speed


def drive(run: SiteRun, site: Site, seed: int, timestep: float = TIMESTEP) -> Trace:
    """Drive one run and return its true motion; site, seed and time step as in `SimulatedRobot`.

    Raises:
        DataError: MuJoCo is missing, or the simulation became unstable.
    """
    plant = SimulatedRobot(site, run.map, run.load, run.start, seed, timestep)
    rims, sent = RimSpeeds(site, plant), np.zeros(3)
    rows: list[tuple[float | list[float] | np.ndarray, ...]] = []

    def record() -> None:
        """Append the engine's state to `rows`, in the order of the fields of `Trace`.

        Heights of the wheel axes stand for the sinkage, which follows from them at the end.
        """
        p, d = plant, plant.data
        body, angle = d.qpos[:7].copy(), d.qpos[p.wheel_at] - p.angle_at_start
        wheels = angle, d.qvel[p.wheel_dof], rims.speed
        electric = list(p.drive.current), list(p.drive.voltage), p.drive.bus
        heights = d.xpos[p.wheel_body, 2]
        rows.append((p.time, body, d.qvel[5], *wheels, *electric, heights, sent))

    for twist in run.program.twists(plant):
        sent = np.array(twist)
        rims.send(site.robot.wheel_from_twist @ sent)
        for _ in range(round(PERIOD / plant.dt)):
            rims.follow()
            record()
            plant.step(rims.speed.tolist())
    record()
    plant.check()
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    body = columns[1]
    columns[1] = np.column_stack([body[:, :2], np.unwrap(heading_of(body[:, 3:]))])
    columns[-2] = np.maximum(site.robot.radii - columns[-2], 0.0)
    return Trace(*columns)
