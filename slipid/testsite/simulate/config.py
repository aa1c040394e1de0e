"""The config of `slipid simulate`: robot, floors and runs of the virtual test site."""

import json
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

import numpy as np

from slipid.data import floor_map as terrain
from slipid.support.errors import DataError
from slipid.support.toml_file import checked, mapping_of
from slipid.testsite import experiments as ex
from slipid.testsite.ground import GROUNDS
from slipid.testsite.simulate.sections import Content, OnMap
from slipid.testsite.site import Site

RESERVED = ("one_surface", "two_surfaces", "wheel_load")
"""Folders of the 2022 layout."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What is to be simulated.

    Attributes:
        hash: of the config and of the map files it names.
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
    maps, everything = {}, list[ex.Run]()
    for name, given in content.maps.items():
        with _said_of(f"{path}: maps.{name}"):
            maps[name] = given.floor(path.parent)
    _check(path, content, site, maps)
    for k, runs in enumerate(content.runs, 1):
        with _said_of(f"{path}: runs[{k}]"):
            if isinstance(runs, OnMap):
                everything += runs.runs(maps[runs.map], 1000 * content.seed + k)
            else:
                everything += runs.runs()
    jitter = float(np.radians(content.heading_jitter_deg))
    named = tuple(ex.numbered(everything, jitter, content.seed))
    for pattern in content.video:
        if not any(fnmatch(name, pattern) for name, _ in named):
            folders = ", ".join(dict.fromkeys(f"{name[:-3]}*" for name, _ in named))
            raise DataError(
                f"{path}: video: no run is named '{pattern}'; expected some of {folders}"
            )
    filmed = tuple(n for n, _ in named if any(fnmatch(n, pattern) for pattern in content.video))
    return Plan(_hash(content, site, maps), content, site, maps, named, filmed)


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
        if isinstance(runs, OnMap):
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


@contextmanager
def _said_of(what: str) -> Iterator[None]:
    """Says of which part of the config an error is that does not know."""
    try:
        yield
    except DataError:
        raise
    except ValueError as error:
        raise DataError(f"{what}: {error}") from error
