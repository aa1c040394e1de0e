"""Every real set of logs with poses, with the robot that drove it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.data.reading.reader import read_runs
from slipid.data.runs import Runs, collect
from slipid.data.wheel_signals import integral
from slipid.model.geometry import Geometry, general, omni


@dataclass(frozen=True)
class RealSet:
    """Runs below the data folder, robot, and its mass where it is known [kg]."""

    name: str
    read: Callable[[Path], Runs]
    robot: Callable[[], Geometry]
    mass_kg: float | None = None


def _robotino(pattern: str, layout: str, folder: str, root: Path) -> Runs:
    return read_runs(root / folder, pattern, layout, surface=None)


def robotino() -> Geometry:
    return omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)


def optitrack() -> Geometry:
    return omni([300.0, 60.0, 180.0], 0.195, 0.051, 12.0)


def two_sides(radius: float, track: float) -> Geometry:
    """A skid steer whose sides are one wheel each."""
    return general([(0.0, 0.5 * track), (0.0, -0.5 * track)], [0.0, 0.0], [None, None], radius)


def skid_runs(folder: str, signed: bool, root: Path) -> Runs:
    """Logs with poses in some rows only, which are held over the others."""
    paths = sorted((root / "drive_skid" / folder).glob("*.csv"))
    return collect([_skid_log(path, f"{folder}/{path.name}", signed) for path in paths])


def _skid_log(path: Path, name: str, signed: bool) -> Log:
    rows = np.genfromtxt(path, delimiter=",", names=True)
    time, seen = rows["t"], np.isfinite(rows["x"])
    parts = [rows["x"][seen], rows["y"][seen], np.unwrap(rows["yaw"][seen])]
    speed = np.stack([rows["wl"], rows["wr"]], axis=1)
    return Log(
        name=name,
        path=path,
        sha256="0",
        time=time,
        wheel_angle=integral(time, speed),
        wheel_speed=speed,
        twist_command=np.stack([rows["cmd_v"], 0 * time, rows["cmd_w"]], axis=1),
        current=np.stack([rows["il"], rows["ir"]], axis=1),
        current_is_signed=signed,
        bus_voltage=0.5 * (rows["vl"] + rows["vr"]),
        gyro=np.nan_to_num(rows["gyro_z"]),
        pose=np.stack([np.interp(time, time[seen], part) for part in parts], axis=1),
        pose_fresh=seen,
        surface=None,
        load="as_built",
    )


def _sets() -> list[RealSet]:
    of_2022 = [f"one_surface/{s}/*.csv" for s in ("table", "brown", "gray", "green")]
    of_2022 += ["wheel_load/*/*.csv", "two_surfaces/*/*.csv", "one_surface/*/*.csv"]
    of_2021 = {f"experimental_data_{s}.csv": "robotino2021" for s in ("gray", "blue", "red")}
    of_2021["experimental_data_on_whole_field.csv"] = "robotino2021_field"
    warthog, husky = partial(two_sides, 0.30, 1.08), partial(two_sides, 0.165, 0.55)
    sets = [
        RealSet(
            f"robotino2022 {p}",
            partial(_robotino, p, "robotino2022", "robotino2022"),
            robotino,
            12.0,
        )
        for p in of_2022
    ]
    sets += [
        RealSet(f"robotino2021 {p}", partial(_robotino, p, layout, "robotino2021"), robotino, 12.0)
        for p, layout in of_2021.items()
    ]
    sets += [
        RealSet(
            f"omni3 {s}",
            partial(_robotino, f"{s}/*/*_run-*.csv", "omni3_optitrack", "omni3_optitrack"),
            optitrack,
        )
        for s in ("joystick", "square", "circular")
    ]
    for day in ("grass_2024_7_18", "grass_2024_7_29", "asphalt_2024_9_20"):
        sets.append(RealSet(day, partial(skid_runs, f"warthog_{day}", True), warthog))
    sets.append(
        RealSet("husky wet grass", partial(skid_runs, "husky_wetgrass", False), husky, 50.0)
    )
    return sets


REAL_SETS = tuple(_sets())
