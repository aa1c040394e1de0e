"""What a config of `slipid simulate` can hold: floors, runs, and the numbers of the site."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from slipid.data import floor_map as terrain
from slipid.data.map_file import read_map
from slipid.support.toml_file import Section
from slipid.testsite import experiments as ex
from slipid.testsite.camera import Camera
from slipid.testsite.ground import Ground
from slipid.testsite.machine import Machine
from slipid.testsite.motors import Motor, SpeedLoop
from slipid.testsite.site import Sensors

Speed = Annotated[float, Field(gt=0, le=3)]
Speeds = Annotated[list[Speed], Field(min_length=1)]
Distance = Annotated[float, Field(gt=0, le=100)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
"""Of surfaces, loads and maps: they name files and folders."""


class FileMap(Section):
    """A floor map's file, beside the config."""

    kind: Literal["file"]
    file: str

    def floor(self, folder: Path) -> terrain.FloorMap:
        return read_map(folder / self.file)


class Patchwork(Section):
    """Random patches, by default smaller than the robot."""

    kind: Literal["patchwork"]
    surfaces: list[str] = Field(min_length=1)
    seed: int = Field(0, ge=0)
    patch_m: float = Field(0.25, ge=0.01, le=10)
    half_m: float = Field(1.2, ge=0.4, le=20)

    def floor(self, folder: Path) -> terrain.FloorMap:
        return terrain.patchwork(self.surfaces, self.seed, self.patch_m, self.half_m)


class FourZones(Section):
    """Four surfaces around the middle of the rectangle, as in the 2021 paper's trial."""

    kind: Literal["four_zones"]
    surfaces: list[str] = Field(min_length=4, max_length=4)

    def floor(self, folder: Path) -> terrain.FloorMap:
        return terrain.four_zones(self.surfaces)


Map = Annotated[FileMap | Patchwork | FourZones, Field(discriminator="kind")]


class OnOneSurface(Section):
    """Runs that begin anywhere on a floor of one surface."""

    surface: str
    load: str = "as_built"


class Headings(OnOneSurface):
    """Straight runs in evenly spread directions."""

    kind: Literal["headings"]
    step_deg: float = Field(15.0, ge=0.1, le=360)
    first_deg: float = Field(0.0, allow_inf_nan=False)
    speeds_m_s: Speeds = Field(default=[0.1, 0.2])
    distance_m: Distance = 0.7

    def runs(self) -> list[ex.Run]:
        speeds, far = self.speeds_m_s, self.distance_m
        return ex.headings(self.surface, self.load, self.step_deg, speeds, far, self.first_deg)


class Curves(OnOneSurface):
    """Arcs, to the left and to the right in turn."""

    kind: Literal["curves"]
    count: int = Field(4, ge=1, le=10_000)
    speeds_m_s: Speeds = Field(default=[0.1, 0.2])
    distance_m: Distance = 0.7

    def runs(self) -> list[ex.Run]:
        return ex.curves(self.surface, self.load, self.count, self.speeds_m_s, self.distance_m)


class PaperGrid(OnOneSurface):
    """The 2021 paper's grid of commands."""

    kind: Literal["paper_grid"]
    seconds: float = Field(3.0, gt=0, le=3600)

    def runs(self) -> list[ex.Run]:
        return ex.paper_grid(self.surface, self.load, self.seconds)


class OnMap(Section):
    """Runs on a map of the config."""

    map: str
    load: str = "as_built"


class Wander(OnMap):
    """Random way-points on a map."""

    kind: Literal["wander"]
    count: int = Field(8, ge=1, le=10_000)
    points: int = Field(4, ge=1, le=1000)
    by: Literal["camera", "encoders"] = "camera"

    def runs(self, floor: terrain.FloorMap, seed: int) -> list[ex.Run]:
        return ex.wander(floor, self.map, self.load, self.count, seed, self.points, self.by)


class Rectangle(OnMap):
    """The 2021 paper's 900 x 400 mm rectangle on a map."""

    kind: Literal["rectangle"]
    by: Literal["camera", "encoders"] = "encoders"
    repeats: int = Field(1, ge=1, le=10_000)
    speed_m_s: Speed = 0.2

    def runs(self, floor: terrain.FloorMap, seed: int) -> list[ex.Run]:
        x0, y0, x1, y1 = floor.extent
        if not (x0 <= 0 <= x1 and y0 <= 0 <= y1):
            raise ValueError(
                f"it starts at 0, 0, but map {self.map} reaches from {x0:g}, {y0:g} to "
                f"{x1:g}, {y1:g}; expected a map around the start"
            )
        one = ex.rectangle(floor, self.map, self.load, by=self.by, speed=self.speed_m_s)
        return [one] * self.repeats


Runs = Annotated[Headings | Curves | PaperGrid | Wander | Rectangle, Field(discriminator="kind")]


class Content(Section):
    """The whole file."""

    seed: int = Field(0, ge=0)
    formats: list[Literal["slipid", "robotino2022"]] = Field(default=["slipid"], min_length=1)
    heading_jitter_deg: float = Field(5.0, ge=0, le=180)
    command_delay_s: float = Field(0.12, ge=0, le=10)
    acceleration_m_s2: float = Field(1.0, ge=0.01, le=1000)
    robot: Machine = Field(default_factory=Machine)
    motor: Motor = Motor()
    speed_loop: SpeedLoop = SpeedLoop()
    sensors: Sensors = Sensors()
    video: list[str] = Field(default_factory=list)
    camera: Camera = Camera()
    surfaces: dict[Name, Ground] = Field(default_factory=dict)
    maps: dict[Name, Map] = Field(default_factory=dict)
    runs: list[Runs] = Field(min_length=1)
