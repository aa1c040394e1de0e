"""Doors of the logs: rows, bags, motors on a bench, and the tables beside them."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slipid.app.bench import read_motor_log
from slipid.app.logs import unpack
from slipid.data.check.sanity import findings
from slipid.data.check.short_runs import short_runs
from slipid.data.reading.bag.layout import declared_bag_layout
from slipid.data.reading.end_poses import read_end_poses
from slipid.data.reading.layout import CHANNELS
from slipid.data.reading.motor_layout import MotorOptions, given_columns
from slipid.data.reading.presets import declared_layout
from slipid.data.reading.reader import read_logs
from slipid.data.runs import collect
from slipid.model.geometry import omni
from slipid.model.robot import Robot
from slipid.predict.kinematics import nominal
from slipid.predict.selection import aligned_path
from tests.fuzz.door import Door
from tests.helpers import broken_logs, made_bags, motor_layouts
from tests.helpers.made_bags import Message, in_order, joint_states, transform, write_bag
from tests.helpers.made_ulogs import write_ulog

HERE = Path()
ROBOTINO = {"format": "robotino2022"}
RADIUS, HEADINGS = 0.04, (20.0, 80.0, 200.0, 270.0)
SHAPE = omni([60.0, 180.0, 300.0], 0.125, RADIUS, 16.0)
TWO_FILES = {
    **broken_logs.GENERIC_LAYOUT,
    "columns": {
        k: v for k, v in broken_logs.GENERIC_LAYOUT["columns"].items() if not k.startswith("pose")
    },
    "beside": {"{stem}.poses.csv": {"format": "tracked"}},
}
BAG = {
    "kind": "bag",
    "joints": ["left", "right"],
    "topics": {
        "wheel_angle": {"topic": "/joint_states", "field": "position"},
        "wheel_speed": {"topic": "/joint_states", "field": "velocity"},
        "current": {"topic": "/joint_states", "field": "effort", "unit": "A"},
        "pose": {"topic": "/tf", "frame": "map", "child": "base"},
        "gyro": {"topic": "/imu"},
    },
}
RUNS = {"table": "runs.csv", "from_start": True}
ULOG = {
    "kind": "bag",
    "topics": {
        "wheel_angle": {"topic": "wheel_encoders"},
        "wheel_speed": {"topic": "wheel_encoders"},
    },
}
TIME = 1.7e9 + np.arange(0.0, 1.0, 0.02)


def _rows(layout: dict[str, Any], path: Path, name: str = "run.csv") -> Any:
    found = read_logs(HERE / name, declared_layout(layout, "layout"), HERE, "x", "as_built")
    return found.logs


def _values(path: Path) -> dict[str, Any] | None:
    """Return what a config or the command line gives, always a mapping, or None."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):  # which a config cannot give either
        return None
    return content if isinstance(content, dict) else None


def _laid_out(path: Path) -> Any:
    """Read a log with a layout that a config declares, here in a file of its own."""
    layout = _values(path)
    if layout is None:
        return None
    return _bag(layout, path) if layout.get("kind") == "bag" else _rows(layout, path)


def _bag(layout: dict[str, Any], path: Path) -> Any:
    declared = declared_bag_layout(layout, "layout", HERE)
    bags = [p for p in HERE.iterdir() if p.name.startswith("bag")]
    return read_logs(bags[0], declared, HERE, "x", "as_built").logs


def _many(path: Path) -> Any:
    """Read and check several runs, of which one is damaged, as `slipid check` does."""
    layout = declared_layout(ROBOTINO, "layout")
    logs = [
        log
        for k in range(len(HEADINGS))
        for log in read_logs(HERE / f"run{k}.csv", layout, HERE, "x", "as_built").logs
    ]
    runs = collect(logs)
    short = short_runs(runs, RADIUS, 5)
    kept = runs.subset([k for k in range(len(runs)) if k not in short])
    paths = [aligned_path(runs, k, nominal(SHAPE), Robot.of(SHAPE)) for k in range(len(runs))]
    return logs, findings(kept, SHAPE), paths


def _several(folder: Path) -> None:
    for k, heading in enumerate(HEADINGS):
        text = broken_logs.robotino_text(60, heading=heading)
        (folder / f"run{k}.csv").write_text(text, encoding="utf-8")


def _robotino(folder: Path) -> None:
    (folder / "run.csv").write_text(broken_logs.robotino_text(60), encoding="utf-8")


def _generic(folder: Path) -> None:
    (folder / "run.csv").write_text(broken_logs.generic_text(60), encoding="utf-8")


def _with_poses(folder: Path) -> None:
    _generic(folder)
    rows = [f"{0.02 * k:.6f},{0.004 * k:.6f},0.001,{0.0001 * k:.6f}" for k in range(60)]
    text = "\n".join(["time,x,y,heading", *rows]) + "\n"
    (folder / "run.poses.csv").write_text(text, encoding="utf-8")


def _parquet(folder: Path) -> None:
    import pyarrow.csv
    import pyarrow.parquet

    _generic(folder)
    table = pyarrow.csv.read_csv(folder / "run.csv")
    (folder / "run.csv").unlink()
    pyarrow.parquet.write_table(table, folder / "run.parquet")


def _with_layout(layout: dict[str, Any], make: Callable[[Path], None], folder: Path) -> None:
    make(folder)
    (folder / "layout.values").write_text(json.dumps(layout), encoding="utf-8")


def _messages() -> list[Message]:
    angle = np.column_stack([5.0 * (TIME - TIME[0]), 4.0 * (TIME - TIME[0])])
    arrays = {"position": angle, "velocity": 0 * angle + 5.0, "effort": 0 * angle + 0.3}
    joints = joint_states("/joint_states", TIME, ["left", "right"], **arrays)
    tf = [
        Message(
            "/tf",
            "tf2_msgs/msg/TFMessage",
            {"transforms": [transform(t, "map", "base", 0.2 * (t - TIME[0]), 0, 0)]},
            t,
        )
        for t in TIME.tolist()
    ]
    imu = [
        Message(
            "/imu",
            "sensor_msgs/msg/Imu",
            {"header": made_bags.header(t), "angular_velocity": made_bags.vector(z=0.1)},
            t,
        )
        for t in TIME.tolist()
    ]
    return in_order(joints, tf, imu)


def _bag_of(storage: str, compression: str | None, folder: Path) -> None:
    options = {} if compression is None else {"compression": compression}
    write_bag(folder / f"bag{made_bags.SUFFIX[storage]}", storage, _messages(), **options)


def _loose(suffix: str, storage: str, folder: Path) -> None:
    """Write the file of a bag alone, without metadata.yaml."""
    _bag_of(storage, None, folder)
    whole = folder / "bag"
    next(whole.glob(f"*{suffix}")).rename(folder / f"bag0{suffix}")
    shutil.rmtree(whole)


def _with_runs(folder: Path) -> None:
    _bag_of("rosbag1", None, folder)
    rows = ["start,end,surface,load,name,bag", "0.0,0.4,wood,own,a,bag.bag", "0.5,0.9,felt,,b,"]
    (folder / "runs.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def _ulog(folder: Path) -> None:
    formats = {"wheel_encoders": "uint64_t timestamp;float[2] wheel_speed;float[2] wheel_angle;"}
    messages = [
        ("wheel_encoders", 0, struct.pack("<Q4f", 7_000_000 + 20_000 * k, 2, 1, 0.04 * k, 0.02 * k))
        for k in range(50)
    ]
    write_ulog(folder / "bag.ulg", formats, messages)


def _motors(names: tuple[str, ...], folder: Path) -> None:
    motor_layouts.without_voltage(folder / "main.csv", motor_layouts.signals(rows=120))
    for one in motor_layouts.LAYOUTS:
        if one.name in names:
            step = 1e-3 if one.voltage else motor_layouts.STEP
            rows = round(120 * motor_layouts.STEP / step) if one.voltage else 120
            one.write(folder / one.name, motor_layouts.signals(rows=rows, step=step))


def _motor(path: Path) -> Any:
    one = next(one for one in motor_layouts.LAYOUTS if one.name == path.name)
    if not one.voltage:
        return read_motor_log(path, {}, None, one.options).records
    given = {"voltage": given_columns(f"{path}::{one.voltage}", "voltage")}
    return read_motor_log(HERE / "main.csv", given, None, one.options).records


def _motor_columns(path: Path) -> Any:
    """Read a log with columns that were given as options of the command."""
    given = _values(path)
    if given is None or not all(isinstance(text, str) for text in given.values()):
        return None  # options are words
    if not {*given} <= {*CHANNELS}:
        return None  # there is no such option
    columns = {name: given_columns(text, name) for name, text in given.items()}
    return read_motor_log(HERE / "plain.csv", columns, None, MotorOptions()).records


def _end_poses(folder: Path) -> None:
    lines = ["run,x_m,y_m,heading_deg,start_x_m,start_y_m,start_heading_deg"]
    lines += [f"a/{k}.csv,{0.1 * k},0.5,360,0,0.1,2" for k in range(4)]
    (folder / "ends.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _end_coordinates(path: Path) -> Any:
    found = read_end_poses(path)  # nan where a coordinate was not measured
    return [[x for x in (*one.start, *one.end) if x == x] for one in found.values()]


def _archive(folder: Path) -> None:
    from tests.fuzz.archives import packed

    logs = {f"fit/logs/{k}.csv": broken_logs.robotino_text(20).encode() for k in range(2)}
    (folder / "recorded.zip").write_bytes(packed({**logs, "fit/truth/truth.json": b"{}\n"}))


def _unpacked(path: Path) -> None:
    from slipid.app import logs

    folder, before, logs.RECORDED = Path.cwd(), logs.RECORDED, path.absolute()
    try:
        (folder / "new").mkdir()
        os.chdir(folder / "new")  # outside of which nothing may be written
        unpack(HERE)
    finally:
        logs.RECORDED = before
        os.chdir(folder)
        shutil.rmtree(folder / "new", ignore_errors=True)


_MOTORS = tuple(one.name for one in motor_layouts.LAYOUTS)
_SCOPES = tuple(one.name for one in motor_layouts.LAYOUTS if one.voltage)
_ROWS = tuple(n for n in _MOTORS if n.endswith(".csv") and n not in _SCOPES)
_COLUMNS = {"voltage": "U", "current": "I:A", "motor_speed": "w:rad/s", "time": "t:s"}


def _bag_door(
    name: str, make: Callable[[Path], None], layout: dict[str, Any] = BAG, **more: Any
) -> Door:
    return Door(name, make, partial(_bag, layout), mentions=("bag",), weight=0.5, **more)


def _layout_door(name: str, layout: dict[str, Any], make: Callable[[Path], None]) -> Door:
    written = partial(_with_layout, layout, make)
    return Door(name, written, _laid_out, ("layout.values",), mentions=("layout", "bag"))


def _columns_file(folder: Path) -> None:
    _motors(("plain.csv",), folder)
    (folder / "columns.values").write_text(json.dumps(_COLUMNS), encoding="utf-8")


DOORS = (
    Door("csv_robotino", _robotino, partial(_rows, ROBOTINO)),
    Door("csv_generic", _generic, partial(_rows, broken_logs.GENERIC_LAYOUT)),
    Door("csv_many", _several, _many, ("run1.csv",), weight=0.5),
    Door("csv_with_poses", _with_poses, partial(_rows, TWO_FILES)),
    Door("parquet", _parquet, partial(_rows, broken_logs.GENERIC_LAYOUT, name="run.parquet")),
    _bag_door("bag_ros1", partial(_bag_of, "rosbag1", None)),
    _bag_door("bag_ros1_lz4", partial(_bag_of, "rosbag1", "LZ4")),
    _bag_door("bag_sqlite3", partial(_bag_of, "sqlite3", None)),
    _bag_door("bag_sqlite3_zstd", partial(_bag_of, "sqlite3", "FILE")),
    _bag_door("bag_messages_zstd", partial(_bag_of, "sqlite3", "MESSAGE")),
    _bag_door("bag_mcap", partial(_bag_of, "mcap", None)),
    _bag_door("bag_mcap_zstd", partial(_bag_of, "mcap", "MESSAGE")),
    _bag_door("bag_mcap_alone", partial(_loose, ".mcap", "mcap")),
    _bag_door("bag_sqlite3_alone", partial(_loose, ".db3", "sqlite3")),
    _bag_door("bag_metadata", partial(_bag_of, "sqlite3", None), targets=("bag/metadata.yaml",)),
    _bag_door("bag_mcap_metadata", partial(_bag_of, "mcap", None), targets=("bag/metadata.yaml",)),
    Door("ulog", _ulog, partial(_bag, ULOG)),
    _layout_door("layout_generic", broken_logs.GENERIC_LAYOUT, _generic),
    _layout_door("layout_robotino", ROBOTINO | {"columns": {}, "tick_bits": 16}, _robotino),
    _layout_door("layout_two_files", TWO_FILES, _with_poses),
    _layout_door("layout_bag", BAG | {"runs": {"pause_s": 0.3}}, partial(_bag_of, "mcap", None)),
    _layout_door("layout_bag_runs", BAG | {"runs": RUNS}, _with_runs),
    _bag_door("bag_runs", _with_runs, targets=("runs.csv",), layout=BAG | {"runs": RUNS}),
    Door("motor_rows", partial(_motors, _ROWS), _motor, _ROWS),
    Door("motor_oscilloscope", partial(_motors, _SCOPES), _motor, _SCOPES),
    Door("motor_json", partial(_motors, _MOTORS), _motor, ("sysid.json", "old.json")),
    Door("motor_wpilog", partial(_motors, _MOTORS), _motor, ("sysid.wpilog",)),
    Door(
        "motor_columns",
        _columns_file,
        _motor_columns,
        ("columns.values",),
        mentions=("plain.csv", "--"),
    ),
    Door("end_poses", _end_poses, _end_coordinates),
    Door("packaged_logs", _archive, _unpacked, mentions=("cannot be written",)),
)
