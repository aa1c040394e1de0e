"""The config of `slipid simulate`: robot, floors and runs of the virtual test site."""

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from slipid.data import floor_map as terrain
from slipid.data.map_file import read_map
from slipid.support.errors import DataError
from slipid.support.toml_file import Section, checked, mapping_of, text_of
from slipid.testsite import experiments as ex
from slipid.testsite.camera import Camera
from slipid.testsite.driving import Site
from slipid.testsite.ground import GROUNDS, Ground
from slipid.testsite.machine import Machine
from slipid.testsite.motors import Motor, SpeedLoop
from slipid.testsite.sensors import Sensors

Speed = Annotated[float, Field(gt=0, le=3)]
Speeds = Annotated[list[Speed], Field(min_length=1)]
Distance = Annotated[float, Field(gt=0, le=100)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
"""Of surfaces, loads and maps: they name files and folders."""
RESERVED = ("one_surface", "two_surfaces", "wheel_load")
"""Folders of the 2022 layout."""


class FileMap(Section):
    """A floor map's file, beside the config."""

    kind: Literal["file"]
    file: str


class Patchwork(Section):
    """Random patches, by default smaller than the robot."""

    kind: Literal["patchwork"]
    surfaces: list[str] = Field(min_length=1)
    seed: int = Field(0, ge=0)
    patch_m: float = Field(0.25, ge=0.01, le=10)
    half_m: float = Field(1.2, ge=0.4, le=20)


class FourZones(Section):
    """Four surfaces around the middle of the rectangle, as in the 2021 paper's trial."""

    kind: Literal["four_zones"]
    surfaces: list[str] = Field(min_length=4, max_length=4)


Map = Annotated[FileMap | Patchwork | FourZones, Field(discriminator="kind")]


class Headings(Section):
    """Straight runs in evenly spread directions."""

    kind: Literal["headings"]
    surface: str
    load: str = "as_built"
    step_deg: float = Field(15.0, ge=0.1, le=360)
    first_deg: float = Field(0.0, allow_inf_nan=False)
    speeds_m_s: Speeds = Field(default=[0.1, 0.2])
    distance_m: Distance = 0.7


class Curves(Section):
    """Arcs, to the left and to the right in turn."""

    kind: Literal["curves"]
    surface: str
    load: str = "as_built"
    count: int = Field(4, ge=1, le=10_000)
    speeds_m_s: Speeds = Field(default=[0.1, 0.2])
    distance_m: Distance = 0.7


class PaperGrid(Section):
    """The 2021 paper's grid of commands."""

    kind: Literal["paper_grid"]
    surface: str
    load: str = "as_built"
    seconds: float = Field(3.0, gt=0, le=3600)


class Wander(Section):
    """Random way-points on a map."""

    kind: Literal["wander"]
    map: str
    load: str = "as_built"
    count: int = Field(8, ge=1, le=10_000)
    points: int = Field(4, ge=1, le=1000)
    by: Literal["camera", "encoders"] = "camera"


class Rectangle(Section):
    """The 2021 paper's 900 x 400 mm rectangle on a map."""

    kind: Literal["rectangle"]
    map: str
    load: str = "as_built"
    by: Literal["camera", "encoders"] = "encoders"
    repeats: int = Field(1, ge=1, le=10_000)
    speed_m_s: Speed = 0.2


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


@dataclass(frozen=True, eq=False)
class Plan:
    """What is to be simulated.

    Attributes:
        hash: of the config and of the map files it names.
        content: the config.
        site: robot and floors.
        maps: floors with several surfaces, by name.
        runs: name and run of each.
        filmed: names of the runs that are filmed.
    """

    hash: str
    content: Content
    site: Site
    maps: dict[str, terrain.FloorMap]
    runs: tuple[tuple[str, ex.Run], ...]
    filmed: tuple[str, ...]


def read_plan(path: Path) -> Plan:
    """Plan of a config file.

    Raises:
        DataError: wrong in the file or in a map it names; every mistake on a line.
    """
    return plan(path, text_of(path))


def plan(path: Path, text: str) -> Plan:
    """Plan of a config; the path is for messages, and maps lie beside it.

    Raises:
        DataError: wrong in the text or in a map it names; every mistake on a line.
    """
    mapping = mapping_of(path, text)
    surfaces = mapping.get("surfaces", {})
    if isinstance(surfaces, dict):  # a surface that slipid knows is changed, not made anew
        known = {
            name: {**asdict(GROUNDS[name]), **given}
            for name, given in surfaces.items()
            if name in GROUNDS and isinstance(given, dict)
        }
        mapping = {**mapping, "surfaces": {**surfaces, **known}}
    content = checked(path, mapping, Content)
    site = Site(
        content.robot,
        content.motor,
        content.speed_loop,
        content.sensors,
        {**GROUNDS, **content.surfaces},
        content.command_delay_s,
        content.acceleration_m_s2,
    )
    maps = {name: _floor(path, name, m) for name, m in content.maps.items()}
    _check(path, content, site, maps)
    everything: list[ex.Run] = []
    for k, one in enumerate(content.runs, 1):
        try:
            everything += _runs(one, maps, content, k)
        except ValueError as error:
            raise DataError(f"{path}: runs[{k}]: {error}") from error
    jitter = float(np.radians(content.heading_jitter_deg))
    named = tuple(ex.numbered(everything, jitter, content.seed))
    for pattern in content.video:
        if not any(fnmatch(name, pattern) for name, _ in named):
            folders = ", ".join(dict.fromkeys(f"{name[:-3]}*" for name, _ in named))
            raise DataError(
                f"{path}: video: no run is named '{pattern}'; expected some of {folders}"
            )
    return Plan(
        _hash(content, site, maps),
        content,
        site,
        maps,
        named,
        tuple(n for n, _ in named if any(fnmatch(n, pattern) for pattern in content.video)),
    )


def _check(path: Path, content: Content, site: Site, maps: Mapping[str, terrain.FloorMap]) -> None:
    """DataError where parts of a config do not go together."""
    for load in site.machine.centres_m:
        if not re.fullmatch("[A-Za-z0-9_-]+", load) or load in RESERVED:
            raise DataError(
                f"{path}: robot.centres_m: load '{load}'; expected letters, digits, _ and -, "
                f"none of {', '.join(RESERVED)}"
            )
    for k, runs in enumerate(content.runs, 1):
        _known(path, f"runs[{k}].load", runs.load, site.machine.centres_m)
        if isinstance(runs, Wander | Rectangle):
            _known(path, f"runs[{k}].map", runs.map, maps)
        else:
            _known(path, f"runs[{k}].surface", runs.surface, site.grounds)
    for name, floor in maps.items():
        if name in site.grounds:
            raise DataError(f"{path}: maps.{name}: also the name of a surface; expected another")
        for surface in floor.surfaces:
            _known(path, f"maps.{name}", surface, site.grounds)
        colours = [site.grounds[s].colour.lower() for s in floor.surfaces]
        if len(set(colours)) < len(colours):
            raise DataError(f"{path}: maps.{name}: two surfaces have one colour; expected others")
    if "robotino2022" in content.formats:
        robot, sensors = site.machine, site.sensors
        fits = len(robot.wheel_azimuths_deg) == 3 and robot.gear_ratio == 16
        fits &= site.motor.ticks_per_revolution == 2000 and not sensors.current_is_signed
        if not fits:
            raise DataError(
                f"{path}: formats: robotino2022 is for three wheels, gear 16, 2000 ticks and "
                "unsigned current; expected slipid alone for other robots"
            )


def _hash(content: Content, site: Site, maps: Mapping[str, terrain.FloorMap]) -> str:
    """Of all that decides what is driven and logged; videos may be asked for later."""
    said = content.model_dump(mode="json", exclude={"video", "camera"})
    floors = {
        name: [f.surfaces, f.corner, f.cell, f.cells.shape, sha256(f.cells.tobytes()).hexdigest()]
        for name, f in maps.items()
    }
    everything = {"said": said, "site": asdict(site), "maps": floors, "slipid": version("slipid")}
    return sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def _known(path: Path, where: str, name: str, choices: Collection[str]) -> None:
    if name not in choices:
        raise DataError(
            f"{path}: {where}: '{name}'; expected one of {', '.join(choices) or 'none'}"
        )


def _floor(path: Path, name: str, given: Map) -> terrain.FloorMap:
    if isinstance(given, FileMap):
        return read_map(path.parent / given.file)
    if isinstance(given, FourZones):
        return terrain.four_zones(given.surfaces)
    try:
        return terrain.patchwork(given.surfaces, given.seed, given.patch_m, given.half_m)
    except ValueError as error:
        raise DataError(f"{path}: maps.{name}: {error}") from error


def _runs(
    given: Runs, maps: dict[str, terrain.FloorMap], content: Content, place: int
) -> list[ex.Run]:
    if isinstance(given, Headings):
        return ex.headings(
            given.surface,
            given.load,
            given.step_deg,
            given.speeds_m_s,
            given.distance_m,
            given.first_deg,
        )
    if isinstance(given, Curves):
        return ex.curves(given.surface, given.load, given.count, given.speeds_m_s, given.distance_m)
    if isinstance(given, PaperGrid):
        return ex.paper_grid(given.surface, given.load, given.seconds)
    floor = maps[given.map]
    x0, y0, x1, y1 = floor.extent
    if isinstance(given, Rectangle) and not (x0 <= 0 <= x1 and y0 <= 0 <= y1):
        raise ValueError(
            f"it starts at 0, 0, but map {given.map} reaches from {x0:g}, {y0:g} to "
            f"{x1:g}, {y1:g}; expected a map around the start"
        )
    if isinstance(given, Wander):
        seed = 1000 * content.seed + place
        return ex.wander(floor, given.map, given.load, given.count, seed, given.points, given.by)
    return [
        ex.rectangle(floor, given.map, given.load, by=given.by, speed=given.speed_m_s)
        for _ in range(given.repeats)
    ]
