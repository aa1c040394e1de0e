"""What is driven: single runs, the grids of the published logs, way-points and the rectangle."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from slipid.data.terrain import FloorMap, uniform
from slipid.testsite.drive import Motor, SpeedLoop
from slipid.testsite.ground import GROUNDS, Ground
from slipid.testsite.machine import Machine
from slipid.testsite.plant import Plant, Trace, heading_of
from slipid.testsite.sensors import Sensors

PERIOD = 0.05
"""Between two commands to the robot [s]."""

Twist = tuple[float, float, float]
"""Ahead, left [m/s], turn [rad/s]."""


@dataclass(frozen=True)
class Site:
    """Everything that stays the same from run to run.

    Attributes:
        machine, motor, loop: the robot.
        sensors: of its logs.
        grounds: physics of every surface.
        command_delay_s: from a command to the wheels.
        acceleration: of the wheels' rims towards a new command [m/s^2].
    """

    machine: Machine = field(default_factory=Machine)
    motor: Motor = field(default_factory=Motor)
    loop: SpeedLoop = field(default_factory=SpeedLoop)
    sensors: Sensors = field(default_factory=Sensors)
    grounds: Mapping[str, Ground] = field(default_factory=lambda: dict(GROUNDS))
    command_delay_s: float = 0.12
    acceleration: float = 1.0


@dataclass(frozen=True)
class Timed:
    """Twists one after the other, each for so many seconds; none of the sensors is asked."""

    legs: tuple[tuple[Twist, float], ...]

    def command(self, time: float, pose: Float[np.ndarray, "3"]) -> Twist | None:
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
        within_m: from a place it is reached.
        longest_s: after which it is given up; by default thrice the time without slip and 10 s.
    """

    places: tuple[tuple[float, float], ...]
    speed: float = 0.2
    by: str = "encoders"
    within_m: float = 0.02
    longest_s: float | None = None

    def __post_init__(self) -> None:
        if self.by not in ("encoders", "camera"):
            raise ValueError(f"way-points by {self.by!r}; expected encoders or camera")


@dataclass(frozen=True)
class Run:
    """One run.

    Attributes:
        surface: what its log says it drove on, None where that is for others to find out.
        load: name of the load set-up.
        program: `Timed` or `Waypoints`.
        start: x, y [m], heading [rad].
        floor: which surface lies where, None for `surface` everywhere.
        place: name of the floor, in file names.
    """

    surface: str | None
    load: str
    program: Timed | Waypoints
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
    surface: str,
    load: str,
    heading: float,
    speed: float,
    distance: float,
    turn: float = 0.0,
) -> Run:
    """A constant command that starts so that a robot without slip is in the middle halfway.

    Args:
        surface: everywhere.
        load: name of the load set-up.
        heading: of the commanded motion in the body frame [rad].
        speed: [m/s]; 0 turns on the spot.
        distance: commanded length [m], arc of the rim where it only turns.
        turn: [rad/s].
    """
    seconds = distance / (speed or abs(turn) * 0.125)
    twist = (speed * float(np.cos(heading)), speed * float(np.sin(heading)), turn)
    back = 0.0 if speed == 0 else 0.5 * distance
    start = (-back * float(np.cos(heading)), -back * float(np.sin(heading)), 0.0)
    return Run(surface, load, Timed(((twist, seconds), ((0.0, 0.0, 0.0), 0.3))), start)


def headings(
    surface: str,
    load: str,
    step_deg: float,
    speeds: Sequence[float],
    distance: float,
    first_deg: float = 0.0,
) -> list[Run]:
    """Straight runs in directions so many degrees apart, at every speed: the 2022 logs' plan."""
    ways = np.radians(first_deg + np.arange(0.0, 360.0, step_deg))
    return [straight(surface, load, float(a), v, distance) for v in speeds for a in ways]


def paper_grid(surface: str, load: str, seconds: float = 3.0) -> list[Run]:
    """The 2021 paper's grid: x, y, both, and turns on the spot, forwards and backwards.

    Args:
        surface: everywhere.
        load: name of the load set-up.
        seconds: of a run.
    """
    ways = [(1, 0), (0, 1), (1, 1), (1, -1)]
    out = []
    for ahead, left in ways:
        for size in (0.1, 0.2, 0.3, 0.4)[: 4 if not (ahead and left) else 3]:
            for sign in (1, -1):
                x, y = sign * size * ahead, sign * size * left
                heading, speed = float(np.arctan2(y, x)), float(np.hypot(x, y))
                out.append(straight(surface, load, heading, speed, speed * seconds))
    for rate in (20, 40, 60):
        for sign in (1, -1):
            turn = sign * float(np.radians(rate))
            out.append(straight(surface, load, 0.0, 0.0, abs(turn) * 0.125 * seconds, turn))
    return out


def curves(
    surface: str, load: str, count: int, speeds: Sequence[float], distance: float
) -> list[Run]:
    """Arcs in evenly spread directions, to the left and to the right in turn."""
    ways = 2 * np.pi * (np.arange(count) + 0.5) / max(count, 1)
    return [
        straight(surface, load, float(a), v, distance, (-1) ** k * 4.0 * v)
        for v in speeds
        for k, a in enumerate(ways)
    ]


def wander(
    floor: FloorMap,
    place: str,
    load: str,
    count: int,
    seed: int,
    points: int = 4,
    by: str = "camera",
) -> list[Run]:
    """Random way-points on a floor with several surfaces."""
    rng = np.random.default_rng(seed)
    x0, y0, x1, y1 = floor.extent
    low, high = np.array([x0, y0]) + 0.3, np.array([x1, y1]) - 0.3
    if (low >= high).any():
        raise ValueError(f"a floor of {x1 - x0:g} x {y1 - y0:g} m; expected more than 0.6 x 0.6 m")
    out = []
    for _ in range(count):
        places = rng.uniform(low, high, (points + 1, 2))
        start = (float(places[0, 0]), float(places[0, 1]), float(rng.uniform(-np.pi, np.pi)))
        goals = tuple((float(x), float(y)) for x, y in places[1:])
        program = Waypoints(goals, float(rng.choice([0.1, 0.2, 0.3])), by)
        out.append(Run(None, load, program, start, floor, place))
    return out


def rectangle(
    floor: FloorMap,
    place: str,
    load: str,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    by: str = "encoders",
    sides: tuple[float, float] = (0.9, 0.4),
    speed: float = 0.2,
) -> Run:
    """The paper's trial (figure 7): ahead, to the right, back and to the left, without turning.

    With `encoders` the corners are those of the robot's own frame at the start.
    """
    a, b = sides
    corners = np.array([[a, 0.0], [a, -b], [0.0, -b], [0.0, 0.0]])
    if by == "camera":
        c, s = np.cos(start[2]), np.sin(start[2])
        corners = corners @ np.array([[c, s], [-s, c]]) + start[:2]
    places = tuple((float(x), float(y)) for x, y in corners)
    return Run(None, load, Waypoints(places, speed, by), start, floor, place)


def drive(run: Run, site: Site, seed: int, timestep: float | None = None) -> Trace:
    """Drive one run.

    Args:
        run: what to do.
        site: robot and floors.
        seed: of how the wheels stand and of the floor's unevenness.
        timestep: of the engine [s], by default `plant.TIMESTEP`.

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
            twist = program.command(plant.time, believed)
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


def numbered(runs: Sequence[Run], jitter: float, seed: int) -> list[tuple[str, Run]]:
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
