"""Sections of a config of `slipid simulate`: floor maps, runs, and parameters of the site."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from slipid.data import floor_map as terrain
from slipid.data.floor_map import read_map
from slipid.lab.testsite.driving import SPIN_ARM_M, SiteRun, TimedTwists, Waypoints, straight
from slipid.lab.testsite.motors import MotorBuild, SpeedLoop
from slipid.lab.testsite.omni_build import OmniBuild
from slipid.lab.testsite.ordinary_build import OrdinaryBuild
from slipid.lab.testsite.site import SiteCamera, SiteSensors
from slipid.lab.testsite.surfaces import SurfacePhysics
from slipid.support.quantities import Bounds, Degrees, InsidePath, Seed
from slipid.support.toml_file import Section

Speed = Annotated[float, Bounds(1e-3, 3, "m/s")]
Speeds = Annotated[list[Speed], Field(min_length=1)]
Distance = Annotated[float, Bounds(1e-3, 100, "m")]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
"""Name of a surface, load set-up or map, which is also used in names of files and folders."""


class FileMap(Section):
    """Floor map that is read from a file in the folder of the config."""

    kind: Literal["file"]
    file: InsidePath

    def floor(self, folder: Path) -> terrain.FloorMap:
        return read_map(folder / self.file)


class Patchwork(Section):
    """Floor map of random square patches, by default smaller than the robot."""

    kind: Literal["patchwork"]
    surfaces: list[str] = Field(min_length=1)
    seed: Seed = 0
    patch_m: Annotated[float, Bounds(0.01, 10, "m")] = 0.25
    half_m: Annotated[float, Bounds(0.4, 20, "m")] = 1.2

    def floor(self, folder: Path) -> terrain.FloorMap:
        return terrain.patchwork(self.surfaces, self.seed, self.patch_m, self.half_m)


class FourZones(Section):
    """Floor map of four square zones with one surface each, which share a corner.

    The shared corner is the centre of the rectangular path that `RectangleRuns` drives.
    """

    kind: Literal["four_zones"] = "four_zones"
    surfaces: list[str] = Field(min_length=4, max_length=4)

    def floor(self, folder: Path) -> terrain.FloorMap:
        return terrain.four_zones(self.surfaces)


Map = Annotated[FileMap | Patchwork | FourZones, Field(discriminator="kind")]


class SurfaceRuns(Section):
    """Base class of runs on a floor with a single surface."""

    surface: str
    load: str = "as_built"

    def straight(self, heading: float, speed: float, distance: float, turn: float = 0.0) -> SiteRun:
        return straight(self.surface, self.load, heading, speed, distance, turn)


class HeadingRuns(SurfaceRuns):
    """Straight runs in evenly spaced directions."""

    kind: Literal["headings"] = "headings"
    step_deg: Annotated[float, Bounds(0.1, 360, "deg")] = 15.0
    first_deg: Degrees = 0.0
    speeds_m_s: Speeds = Field(default=[0.1, 0.2])
    distance_m: Distance = 0.7

    def runs(self) -> list[SiteRun]:
        headings = np.radians(self.first_deg + np.arange(0.0, 360.0, self.step_deg)).tolist()
        return [self.straight(a, v, self.distance_m) for v in self.speeds_m_s for a in headings]


class CurveRuns(SurfaceRuns):
    """Runs along arcs, alternately to the left and to the right."""

    kind: Literal["curves"] = "curves"
    count: Annotated[int, Bounds(1, 10_000)] = 4
    speeds_m_s: Speeds = Field(default=[0.1, 0.2])
    distance_m: Distance = 0.7

    def runs(self) -> list[SiteRun]:
        headings = (2 * np.pi * (np.arange(self.count) + 0.5) / self.count).tolist()
        return [
            self.straight(a, v, self.distance_m, (-1) ** k * 4.0 * v)
            for v in self.speeds_m_s
            for k, a in enumerate(headings)
        ]


class PaperGridRuns(SurfaceRuns):
    """The 2021 paper's grid of runs: along x, y and the diagonals, and turns on the spot.

    Each motion is driven in both directions.
    """

    kind: Literal["paper_grid"] = "paper_grid"
    seconds: Annotated[float, Bounds(0.01, 3600, "s")] = 3.0

    def runs(self) -> list[SiteRun]:
        out = []
        for ahead, left in ((1, 0), (0, 1), (1, 1), (1, -1)):
            for size in (0.1, 0.2, 0.3, 0.4)[: 4 if not (ahead and left) else 3]:
                for sign in (1, -1):
                    x, y = sign * size * ahead, sign * size * left
                    heading, speed = float(np.arctan2(y, x)), float(np.hypot(x, y))
                    out.append(self.straight(heading, speed, speed * self.seconds))
        for rate in (20, 40, 60):
            for sign in (1, -1):
                turn = sign * float(np.radians(rate))
                out.append(self.straight(0.0, 0.0, abs(turn) * SPIN_ARM_M * self.seconds, turn))
        return out


class ArcRuns(SurfaceRuns):
    """Runs ahead along arcs and straight lines, backward at negative speeds."""

    kind: Literal["arcs"] = "arcs"
    curvatures_1_m: list[Annotated[float, Bounds(-20, 20, "1/m")]] = Field(
        default=[0.0, 0.5, -0.5], min_length=1
    )
    speeds_m_s: list[Annotated[float, Bounds(1e-3, 3, "m/s", of_size=True)]] = Field(
        default=[0.3], min_length=1
    )
    distance_m: Distance = 1.5

    def runs(self) -> list[SiteRun]:
        return [
            self.straight(0.0 if v > 0 else np.pi, abs(v), self.distance_m, v * curvature)
            for v in self.speeds_m_s
            for curvature in self.curvatures_1_m
        ]


class SpinRuns(SurfaceRuns):
    """Turns on the spot, to the right at negative rates."""

    kind: Literal["spins"] = "spins"
    rates_deg_s: list[Annotated[float, Bounds(0.1, 360, "deg/s", of_size=True)]] = Field(
        default=[40.0, -40.0], min_length=1
    )
    angle_deg: Annotated[float, Bounds(0.1, 3600, "deg")] = 360.0

    def runs(self) -> list[SiteRun]:
        arc = SPIN_ARM_M * float(np.radians(self.angle_deg))
        return [self.straight(0.0, 0.0, arc, w) for w in np.radians(self.rates_deg_s).tolist()]


class PathRuns(SurfaceRuns):
    """Runs of random arcs, straight lines and turns on the spot, one after the other.

    Every fourth leg, on average, is a turn on the spot; the others are driven at one of the
    speeds, with turn rates from 0 to `turn_deg_s` to either side.
    """

    kind: Literal["paths"] = "paths"
    seed: Seed = 0
    count: Annotated[int, Bounds(1, 10_000)] = 4
    legs: Annotated[int, Bounds(1, 1000)] = 4
    leg_s: Annotated[float, Bounds(0.01, 3600, "s")] = 2.5
    speeds_m_s: Speeds = Field(default=[0.2, 0.4])
    turn_deg_s: Annotated[float, Bounds(0.01, 360, "deg/s")] = 40.0

    def runs(self) -> list[SiteRun]:
        rng, most = np.random.default_rng(self.seed), float(np.radians(self.turn_deg_s))
        out = []
        for k in range(self.count):
            speed, legs = self.speeds_m_s[k % len(self.speeds_m_s)], []
            for _ in range(self.legs):
                turn = float(rng.uniform(-most, most))
                on_the_spot = rng.uniform() < 0.25
                legs.append(((0.0 if on_the_spot else speed, 0.0, turn), self.leg_s))
            program = TimedTwists((*legs, ((0.0, 0.0, 0.0), 0.3)))
            out.append(SiteRun(self.surface, self.load, program))
        return out


class MapRuns(Section):
    """Base class of runs on a map that the config names."""

    map: str
    load: str = "as_built"


class WanderRuns(MapRuns):
    """Runs through random way-points on a map."""

    kind: Literal["wander"] = "wander"
    count: Annotated[int, Bounds(1, 10_000)] = 8
    points: Annotated[int, Bounds(1, 1000)] = 4
    by: Literal["camera", "encoders"] = "camera"

    def runs(self, floor: terrain.FloorMap, seed: int) -> list[SiteRun]:
        rng = np.random.default_rng(seed)
        x0, y0, x1, y1 = floor.extent
        low, high = np.array([x0, y0]) + 0.3, np.array([x1, y1]) - 0.3
        if (low >= high).any():
            size = f"{x1 - x0:g} x {y1 - y0:g} m"
            raise ValueError(
                f"a floor of {size}; expected more than 0.6 x 0.6 m, since way-points keep 0.3 m "
                "from its edges"
            )
        out = []
        for _ in range(self.count):
            (x, y), *goals = rng.uniform(low, high, (self.points + 1, 2)).tolist()
            start = (x, y, float(rng.uniform(-np.pi, np.pi)))
            speed = float(rng.choice([0.1, 0.2, 0.3]))
            program = Waypoints(tuple((x, y) for x, y in goals), speed, self.by)
            out.append(SiteRun(None, self.load, program, start, floor, self.map))
        return out


class RectangleRuns(MapRuns):
    """Runs along the 2021 paper's rectangle of 900 x 400 mm on a map.

    A robot that can drive sideways does not turn: the sides are driven forward, right, back, left.
    With `by = "encoders"` the robot steers to the
    corners by dead reckoning.
    """

    kind: Literal["rectangle"] = "rectangle"
    by: Literal["camera", "encoders"] = "encoders"
    repeats: Annotated[int, Bounds(1, 10_000)] = 1
    speed_m_s: Speed = 0.2

    def runs(self, floor: terrain.FloorMap, seed: int) -> list[SiteRun]:
        x0, y0, x1, y1 = floor.extent
        if not (x0 <= 0 <= x1 and y0 <= 0 <= y1):
            raise ValueError(
                f"the rectangle starts at 0, 0, but map {self.map} reaches from {x0:g}, {y0:g} to "
                f"{x1:g}, {y1:g}; expected a map around the start"
            )
        corners = ((0.9, 0.0), (0.9, -0.4), (0.0, -0.4), (0.0, 0.0))
        program = Waypoints(corners, self.speed_m_s, self.by)
        return [SiteRun(None, self.load, program, floor=floor, place=self.map)] * self.repeats


Runs = Annotated[
    HeadingRuns
    | CurveRuns
    | PaperGridRuns
    | ArcRuns
    | SpinRuns
    | PathRuns
    | WanderRuns
    | RectangleRuns,
    Field(discriminator="kind"),
]


SIDEWAYS = ("headings", "curves", "paper_grid")
"""Kinds of runs in directions that only robots that can drive sideways can take."""


class SimulationContent(Section):
    """Content of a config of `slipid simulate`."""

    seed: Seed = 0
    formats: list[Literal["slipid", "robotino2022"]] = Field(default=["slipid"], min_length=1)
    heading_jitter_deg: Annotated[float, Bounds(0, 180, "deg")] = 5.0
    command_delay_s: Annotated[float, Bounds(0, 10, "s")] = 0.12
    acceleration_m_s2: Annotated[float, Bounds(0.01, 1000, "m/s^2")] = 1.0
    robot: OmniBuild | OrdinaryBuild = Field(default_factory=OmniBuild, discriminator="drive")
    motor: MotorBuild = MotorBuild()
    speed_loop: SpeedLoop = SpeedLoop()
    sensors: SiteSensors = SiteSensors()
    video: list[str] = Field(default_factory=list)
    camera: SiteCamera = SiteCamera()
    surfaces: dict[Name, SurfacePhysics] = Field(default_factory=dict)
    maps: dict[Name, Map] = Field(default_factory=dict)
    runs: list[Runs] = Field(min_length=1)
