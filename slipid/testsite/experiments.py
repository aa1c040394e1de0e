"""What is driven: single runs, the grids of the published logs, way-points and the rectangle."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slipid.data.floor_map import FloorMap, uniform

Twist = tuple[float, float, float]
"""Ahead, left [m/s], turn [rad/s]."""


@dataclass(frozen=True)
class Timed:
    """Twists one after the other, each for so many seconds; none of the sensors is asked."""

    legs: tuple[tuple[Twist, float], ...]

    def command(self, time: float) -> Twist | None:
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
        within_m: distance at which a place counts as reached.
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
        heading: direction of the commanded motion in the body frame [rad].
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
    """The 2021 paper's grid: x, y, both, and turns on the spot, forwards and backwards."""
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
