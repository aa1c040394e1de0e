"""Read logs: from files and their layout to runs in SI units, checked once, here."""

from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from slipid.data.log import Log
from slipid.data.reading.checks import MIN_ROWS, check_log, check_time, filled, unwrapped_ticks
from slipid.data.reading.layout import Layout
from slipid.data.reading.presets import preset
from slipid.data.reading.table import Table, read_table
from slipid.data.runs import Runs, collect, default_session
from slipid.data.wheel_signals import integral
from slipid.support.errors import DataError

Session = Literal["surface/load/speed", "folder", "file"]
"""What runs have in common between which the camera's marker stayed as it was."""


def read_runs(
    folder: Path | str,
    pattern: str,
    layout: Layout | str,
    *,
    surface: str | None = "folder",
    load: str = "as_built",
    session: Session = "surface/load/speed",
) -> Runs:
    """Every run of the files that match a glob.

    Runs of another load set-up are read by another call and added: `as_built + moved`.

    Args:
        folder: data folder, which the names of the runs are relative to.
        pattern: glob below the folder, such as `one_surface/*/*.csv`.
        layout: how the files are laid out, or the name of a preset.
        surface: name of the floor, `folder` for that of the folder each file lies in, or None where
            it is unknown.
        load: name of the load set-up.
        session: what runs have in common between which the camera's marker stayed as it was.

    Raises:
        DataError: no file matches, or one is wrong; the message names the file and the row.
    """
    root = Path(folder)
    chosen = preset(layout) if isinstance(layout, str) else layout
    logs = [
        log
        for path in find_logs(root, pattern)
        for log in read_logs(path, chosen, root, surface, load)
    ]
    return collect(logs, [session_of(log, session) for log in logs])


def session_of(log: Log, session: Session) -> str:
    """Name of the session of a run: its file, the folder of its file, or how it was driven."""
    if session == "file":
        return log.name
    if session == "folder":
        return log.name.rpartition("/")[0] or log.name
    return default_session(log)


def read_logs(
    path: Path, layout: Layout, root: Path, surface: str | None, load: str
) -> tuple[Log, ...]:
    """Every run in a CSV or Parquet file, where `layout.new_run` tells them apart.

    Parts of a file of a single row hold no motion and are left out.

    Args:
        root: data folder above the file, which the names of the runs are relative to.
        surface: name of the floor; `folder` stands for that of the file's folder less `_surface`.
        load: name of the load set-up.
    """
    surface = path.parent.name.removesuffix("_surface") if surface == "folder" else surface
    table = read_table(path, layout)
    if layout.drop_repeated_time:
        table = table.rows(np.append(np.diff(_time(table, layout)) != 0, True))
    name = path.relative_to(root).as_posix()
    starts = _run_starts(table, layout)
    if len(starts) == 1:
        return (_log(table, layout, name, surface, load),)
    pairs = [(a, b) for a, b in pairwise([*starts, len(table.values)]) if b - a >= MIN_ROWS]
    width = len(str(len(pairs)))
    return tuple(
        _log(table.rows(slice(a, b)), layout, f"{name}#{k:0{width}d}", surface, load)
        for k, (a, b) in enumerate(pairs, start=1)
    )


def find_logs(root: Path, pattern: str) -> list[Path]:
    """Files under `root` that match a glob, sorted by name; DataError where there are none."""
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; expected the folder of the logs")
    found = sorted(p for p in root.glob(pattern) if p.is_file())
    if found:
        return found
    nearest = root
    for part in Path(pattern).parts[:-1]:
        if not (nearest / part).is_dir():
            break
        nearest = nearest / part
    inside = sorted(p.name + ("/" if p.is_dir() else "") for p in nearest.iterdir())
    listed = ", ".join(inside[:8] + ["..."] * (len(inside) > 8))
    raise DataError(
        f"{root}: no file matches '{pattern}'; expected at least one "
        f"({nearest} has {listed or 'nothing in it'})"
    )


def _run_starts(table: Table, layout: Layout) -> list[int]:
    if layout.new_run == "time_restarts":
        time = table.stacked(layout.channels["time"])[:, 0]
        return [0, *(np.flatnonzero(np.diff(time) <= 0) + 1).tolist()]
    if layout.new_run == "ticks_restart":
        # A run that only drives away from its start counts up in magnitude on its fastest wheel.
        far = np.abs(table.stacked(layout.channels["wheel_ticks"])).max(axis=1)
        return [0, *(np.flatnonzero(far[1:] < far[:-1]) + 1).tolist()]
    return [0]


def _log(table: Table, layout: Layout, name: str, surface: str | None, load: str) -> Log:
    """Convert a table that holds one run."""
    notes: list[str] = []
    time = _time(table, layout)
    check_time(table, layout, time)
    have = {
        channel: _channel(table, layout, channel, time, notes)
        for channel in layout.channels
        if channel != "time"
    }
    pose, fresh = _pose(table, layout, have)
    log = Log(
        name=name,
        path=table.path,
        sha256=table.sha256,
        time=time,
        wheel_angle=_wheel_angle(layout, have, time, notes),
        wheel_speed=_at_wheel(layout, have, "speed"),
        wheel_speed_command=_at_wheel(layout, have, "speed_command"),
        twist_command=_twist(have, len(time)),
        current=have.get("current"),
        current_is_signed=layout.current_is_signed,
        voltage=_voltage(have),
        duty=have.get("duty"),
        bus_voltage=have["bus_voltage"][:, 0] if "bus_voltage" in have else None,
        gyro=have["gyro"][:, 0] if "gyro" in have else None,
        pose=pose,
        pose_fresh=fresh,
        surface=surface,
        load=load,
        notes=tuple(notes),
    )
    check_log(log, table, layout)
    return log


def _time(table: Table, layout: Layout) -> Float[np.ndarray, " row"]:
    if "time" not in layout.channels:
        return np.arange(len(table.values)) * float(layout.row_period or 1.0)
    channel = layout.channels["time"]
    cells = table.stacked(channel)
    return ((cells * channel.scale + channel.offset) * layout.to_si("time"))[:, 0]


def _channel(
    table: Table, layout: Layout, name: str, time: Float[np.ndarray, " row"], notes: list[str]
) -> Float[np.ndarray, "row column"]:
    """A channel in SI units, short gaps filled."""
    channel = layout.channels[name]
    cells = filled(table, channel, time, notes)
    if name == "wheel_ticks" and not layout.ticks_are_increments:
        cells = unwrapped_ticks(cells, layout.tick_bits, notes)
    return (cells * channel.scale + channel.offset) * layout.to_si(name)


def _wheel_angle(
    layout: Layout, have: dict[str, np.ndarray], time: Float[np.ndarray, " row"], notes: list[str]
) -> Float[np.ndarray, "row wheel"]:
    """Cumulative angle at the wheel: from ticks, else angles, else the integral of the speed."""
    if "wheel_ticks" in have:
        ticks = have["wheel_ticks"]
        ticks = np.cumsum(ticks, axis=0) if layout.ticks_are_increments else ticks
        per_turn = float(layout.ticks_per_revolution or 1.0) * layout.gear_ratio
        angle = ticks * (2.0 * np.pi / per_turn)
    elif "wheel_angle" in have:
        angle = have["wheel_angle"]
    elif "motor_angle" in have:
        angle = have["motor_angle"] / layout.gear_ratio
    elif (speed := _at_wheel(layout, have, "speed")) is not None:
        angle = integral(time, speed)
        notes.append("wheel angle integrated from the reported speed")
    else:
        return np.zeros((len(time), 0))
    return angle - angle[0]


def _at_wheel(layout: Layout, have: dict[str, np.ndarray], what: str) -> np.ndarray | None:
    if f"wheel_{what}" in have:
        return have[f"wheel_{what}"]
    if f"motor_{what}" in have:
        return have[f"motor_{what}"] / layout.gear_ratio
    return None


def _voltage(have: dict[str, np.ndarray]) -> np.ndarray | None:
    """As logged, else the duty cycle of the bus voltage where both were."""
    if "voltage" not in have and {"duty", "bus_voltage"} <= have.keys():
        return have["duty"] * have["bus_voltage"]
    return have.get("voltage")


def _twist(have: dict[str, np.ndarray], rows: int) -> np.ndarray | None:
    names = [f"twist_command_{axis}" for axis in ("x", "y", "yaw")]
    if not have.keys() & set(names):
        return None
    return np.concatenate([have.get(name, np.zeros((rows, 1))) for name in names], axis=1)


def _pose(
    table: Table, layout: Layout, have: dict[str, np.ndarray]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Pose with the heading unwrapped, and which rows bring a new camera frame."""
    if "pose_x" not in have:
        return None, None
    names = ("pose_x", "pose_y", "pose_heading")
    cells = np.concatenate([table.stacked(layout.channels[name]) for name in names], axis=1)
    fresh = np.ones(len(cells), dtype=bool)
    fresh[1:] = np.any(np.diff(cells, axis=0) != 0, axis=1)
    fresh &= ~np.isnan(cells).any(axis=1)
    pose = np.concatenate([have[name] for name in names], axis=1)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return pose, fresh
