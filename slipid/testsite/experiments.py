"""What is driven: twists one after the other, or way-points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

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
    """

    places: tuple[tuple[float, float], ...]
    speed: float = 0.2
    by: Literal["encoders", "camera"] = "encoders"


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
