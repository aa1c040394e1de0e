"""The config of `slipid simulate`, and the config with which `slipid identify` fits its logs."""

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
from slipid.data.write import OPTIONAL, own_columns
from slipid.lab.testsite import driving as ex
from slipid.lab.testsite.sections import SIDEWAYS, MapRuns, SimulationContent
from slipid.lab.testsite.site import Site
from slipid.lab.testsite.surfaces import SURFACES
from slipid.support.errors import DataError
from slipid.support.toml_file import checked, mapping_of

RESERVED = ("one_surface", "two_surfaces", "wheel_load")
"""Folder names of the 2022 data set, which are not allowed as names of load set-ups."""
_IDENTIFY_CONFIG = """\
# Identifies the robot of these logs:
#   slipid identify {name} --data logs --out result
# The logs were simulated by slipid simulate; the true values are in truth/, which no fit reads.

[robot]
{wheels}
wheel_radius_m = {radius}
gear_ratio = {gear}
mass_kg = {mass}
{own}
[layouts.testsite]
ticks_per_revolution = {ticks}
gear_ratio = {gear}
current_is_signed = {signed}

[layouts.testsite.columns]
{columns}
{beside}{sets}
[parameters]
"camera.scale" = {{ prior = {{ mean = {scale}, std = 0.002 }} }}      # measured, with an error
"camera.lag" = {{ prior = {{ mean = {lag}, std = 0.02 }} }}
"camera.marker_yaw" = {{ free = true }}
"motor.resistance" = {{ start = {r[0]}, prior = {{ mean = {r[1]}, std = {r[2]} }} }}
"motor.back_emf" = {{ start = {c[0]}, prior = {{ mean = {c[1]}, std = {c[2]} }} }}
{place}"""
_OMNI_LIMITS = """
[robot.limits]
speed_m_s = 0.5
yaw_rate_rad_s = 2.0
acceleration_m_s2 = 1.0
wheel_speed_rad_s = 13.0
voltage_v = 22.0

[robot.sensors]
ammeter_std_a = 0.07
voltmeter_std_v = 0.06
gyro_std_rad_s = 0.004
gyro_bias_std_rad_s = 0.01
stale_s = 0.3
"""
_MARKER_PLACE = '"camera.marker_place" = { prior = { mean = [0.0, 0.0], std = 0.1 } }\n'
_TRACKED_LAYOUT = """
# poses of each run, tracked in its video by slipid track, for example:
#   slipid track video/as_built/firm/run000.avi --camera video/camera.json \\
#     --marker-size {size} --marker-height {height} --out logs/as_built/firm/run000.poses.csv
[layouts.testsite.beside."{{stem}}.poses.csv"]
format = "tracked"
"""


@dataclass(frozen=True, eq=False)
class SimulationPlan:
    """All runs and videos of a simulation.

    Attributes:
        hash: hash of the config and of the map files it names.
        content: content of the config.
        site: robot, sensors and surfaces.
        maps: maps of floors with several surfaces, keyed by name.
        runs: pairs of name and run.
        filmed: names of the runs that are filmed.
    """

    hash: str
    content: SimulationContent
    site: Site
    maps: dict[str, terrain.FloorMap]
    runs: tuple[tuple[str, ex.SiteRun], ...]
    filmed: tuple[str, ...]


def plan(path: Path, text: str) -> SimulationPlan:
    """Return the plan that a config describes.

    Args:
        path: path of the config, for error messages; map files are in the same folder.
        text: content of the config.

    Raises:
        DataError: the text or a map that it names has mistakes; the message lists them by line.
    """
    mapping = mapping_of(path, text)
    if "logs" in mapping and "runs" not in mapping:
        raise DataError(
            f"{path}: the config of a robot and its logs; expected that of a test site, such as "
            "configs/testsite.toml, with the runs to simulate in tables [[runs]]"
        )
    surfaces = mapping.get("surfaces", {})
    # a built-in surface that the config changes keeps its built-in values for omitted keys
    if isinstance(surfaces, dict):
        known = {
            name: {**asdict(SURFACES[name]), **given}
            for name, given in surfaces.items()
            if name in SURFACES and isinstance(given, dict)
        }
        mapping = {**mapping, "surfaces": {**surfaces, **known}}
    if isinstance(robot := mapping.get("robot"), dict):
        mapping = {**mapping, "robot": {"drive": "omni", **robot}}
    content = checked(path, mapping, SimulationContent)
    parts = content.robot, content.motor, content.speed_loop, content.sensors
    surfaces = {**SURFACES, **content.surfaces}
    site = Site(*parts, surfaces, content.command_delay_s, content.acceleration_m_s2)
    maps, everything = {}, list[ex.SiteRun]()
    for name, given in content.maps.items():
        with _naming(f"{path}: maps.{name}"):
            maps[name] = given.floor(path.parent)
    _check(path, content, site, maps)
    for k, runs in enumerate(content.runs, 1):
        with _naming(f"{path}: runs[{k}]"):
            if isinstance(runs, MapRuns):
                everything += runs.runs(maps[runs.map], 1000 * content.seed + k)
            else:
                everything += runs.runs()
    jitter = float(np.radians(content.heading_jitter_deg))
    named = tuple(ex.named_runs(everything, jitter, content.seed))
    for pattern in content.video:
        if not any(fnmatch(name, pattern) for name, _ in named):
            folders = ", ".join(dict.fromkeys(f"{name[:-3]}*" for name, _ in named))
            raise DataError(
                f"{path}: video: no run matches '{pattern}'; expected names of runs, {folders}"
            )
    filmed = tuple(n for n, _ in named if any(fnmatch(n, pattern) for pattern in content.video))
    return SimulationPlan(_hash(content, site, maps), content, site, maps, named, filmed)


def _check(
    path: Path, content: SimulationContent, site: Site, maps: Mapping[str, terrain.FloorMap]
) -> None:
    """Raise `DataError` if parts of a config contradict each other."""
    for load in site.robot.centres_m:
        if not re.fullmatch("[A-Za-z0-9_-]+", load) or load in RESERVED:
            raise DataError(
                f"{path}: robot.centres_m: '{load}' cannot be the name of a load set-up; expected "
                f"letters, digits, _ and -, and none of {', '.join(RESERVED)}"
            )
    for k, runs in enumerate(content.runs, 1):
        _refuse_unknown(path, f"runs[{k}].load", runs.load, site.robot.centres_m)
        if runs.kind in SIDEWAYS and site.robot.drive != "omni":
            raise DataError(
                f"{path}: runs[{k}].kind: '{runs.kind}' drives sideways, which a "
                f"{site.robot.drive} robot cannot; expected one of arcs, spins, paths, wander, "
                "rectangle"
            )
        if isinstance(runs, MapRuns):
            _refuse_unknown(path, f"runs[{k}].map", runs.map, maps)
        else:
            _refuse_unknown(path, f"runs[{k}].surface", runs.surface, site.surfaces)
    for name, floor in maps.items():
        if name in site.surfaces:
            raise DataError(
                f"{path}: maps.{name}: also the name of a surface; expected another name"
            )
        for surface in floor.surfaces:
            _refuse_unknown(path, f"maps.{name}", surface, site.surfaces)
        colours = [site.surfaces[s].colour.lower() for s in floor.surfaces]
        if len(set(colours)) < len(colours):
            raise DataError(
                f"{path}: maps.{name}: two surfaces have the same colour; expected different "
                "colours"
            )
    if "robotino2022" in content.formats:
        robot, sensors = site.robot, site.sensors
        fits = robot.drive == "omni" and robot.drives == 3 and robot.gear_ratio == 16
        fits &= site.motor.ticks_per_revolution == 2000 and not sensors.current_is_signed
        if not fits:
            raise DataError(
                f"{path}: formats: robotino2022 is only for three omni wheels, gear ratio 16, 2000 "
                "ticks and unsigned currents; expected the format slipid for other robots"
            )


def _hash(content: SimulationContent, site: Site, maps: Mapping[str, terrain.FloorMap]) -> str:
    """Return a hash of everything that determines runs and logs, not of the settings of videos."""
    config = content.model_dump(mode="json", exclude={"video", "camera"})
    floors = {
        name: [f.surfaces, f.corner, f.cell, f.cells.shape, sha256(f.cells.tobytes()).hexdigest()]
        for name, f in maps.items()
    }
    everything = {
        "said": config,
        "site": site.to_json(),
        "maps": floors,
        "slipid": version("slipid"),
    }
    return sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def _refuse_unknown(path: Path, where: str, name: str, choices: Collection[str]) -> None:
    if name not in choices:
        raise DataError(
            f"{path}: {where}: '{name}'; expected one of {', '.join(choices) or 'none'}"
        )


@contextmanager
def _naming(what: str) -> Iterator[None]:
    """Return a context that turns a `ValueError` into a `DataError` beginning with `what`."""
    try:
        yield
    except DataError:
        raise
    except ValueError as error:
        raise DataError(f"{what}: {error}") from error


def identify_config(plan: SimulationPlan, by_video: bool = False) -> str:
    """Return the text of a config with which `slipid identify` fits the logs in slipid's format.

    With `by_video`, the config reads poses tracked in the videos instead of poses in the logs.
    """
    robot, sensors = plan.site.robot, plan.site.sensors
    measured = 0.0015 * float(np.random.default_rng([plan.content.seed, 2]).normal())
    more = [channel for channel in OPTIONAL if getattr(sensors, channel)]
    columns = own_columns(robot.drives, more)
    resistance, back_emf = plan.site.motor.resistance_ohm, plan.site.motor.back_emf_vs
    beside, scale, lag = "", sensors.camera_scale, 0.05
    if by_video:
        columns = {name: c for name, c in columns.items() if not name.startswith("pose_")}
        beside = _TRACKED_LAYOUT.format(size=robot.marker_size_m, height=robot.marker_height_m)
        scale, lag = 1.0, 0.0
    one = {(run.load, run.surface) for _, run in plan.runs if run.surface is not None}
    where = [(load, surface, 'surface = "folder"') for load, surface in sorted(one)]
    where += [(load, name, f'map = "maps/{name}.toml"') for load, name in _map_sets(plan)]
    sets = "".join(
        f'\n[[logs]]\nglob = "{load}/{name}/run*[0-9].csv"\nformat = "testsite"\n'
        f'{floor}\nload = "{load}"\n'
        for load, name, floor in where
    )
    return _IDENTIFY_CONFIG.format(
        wheels="\n".join(f"{key} = {_inline(v)}" for key, v in robot.drive_section.items()),
        radius=robot.wheel_radius_m,
        gear=robot.gear_ratio,
        mass=robot.mass_kg,
        own=_OMNI_LIMITS if robot.drive == "omni" else "",
        ticks=plan.site.motor.ticks_per_revolution,
        signed=str(sensors.current_is_signed).lower(),
        columns="\n".join(f"{name} = {_inline(c)}" for name, c in columns.items()),
        sets=sets,
        name="robot_video.toml" if by_video else "robot.toml",
        beside=beside,
        scale=round(scale * (1 + measured), 4),
        lag=lag,
        place="" if robot.drive == "omni" else _MARKER_PLACE,
        # vague, and away from the true values
        r=[float(f"{f * resistance:.3g}") for f in (2.0, 1.4545, 0.7273)],
        c=[float(f"{f * back_emf:.3g}") for f in (0.5, 0.778, 0.389)],
    )


def _map_sets(plan: SimulationPlan) -> list[tuple[str, str]]:
    """Return the pairs (load set-up, map) of the runs across several surfaces that a fit can use.

    A fit can use a run on a map if every surface of the map, and the load set-up of the run, also
    occur in runs on a single surface. Poses of runs on maps are logged in the frame of the map,
    even if the robot was steered by dead reckoning.
    """
    one = [run for _, run in plan.runs if run.surface is not None]
    floors, loads = {run.surface for run in one}, {run.load for run in one}
    pairs = {(run.load, name.split("/")[1]) for name, run in plan.runs if run.surface is None}
    return sorted(
        (load, name)
        for load, name in pairs
        if load in loads and set(plan.maps[name].surfaces) <= floors
    )


def all_filmed(plan: SimulationPlan) -> bool:
    """Return True if every run that `slipid identify` reads is filmed."""
    mapped = {f"{load}/{name}/" for load, name in _map_sets(plan)}
    read = [
        n for n, r in plan.runs if r.surface is not None or n.rpartition("/")[0] + "/" in mapped
    ]
    return set(read) <= set(plan.filmed)


def _inline(value: object) -> str:
    """Return a value as TOML text on one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_inline(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_inline(v) for v in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def can_identify(plan: SimulationPlan) -> bool:
    """Return True if logs are written in slipid's format and some runs are on a single surface."""
    return "slipid" in plan.content.formats and any(r.surface is not None for _, r in plan.runs)
