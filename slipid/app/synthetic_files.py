"""Made logs as CSV files, with the truth in a folder of its own."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slipid.data.files import write_bytes, write_json
from slipid.data.log import Log
from slipid.model.robot import Robot
from slipid.parameter import entries

LAYOUT: dict[str, Any] = {
    "ticks_per_revolution": 2000,
    "gear_ratio": 16,
    "current_is_signed": False,
    "columns": {
        "time": {"column": "time", "unit": "s"},
        "twist_command_x": {"column": "command_x", "unit": "m/s"},
        "twist_command_y": {"column": "command_y", "unit": "m/s"},
        "twist_command_yaw": {"column": "command_yaw", "unit": "rad/s"},
        "wheel_ticks": {"columns": ["ticks_1", "ticks_2", "ticks_3"], "unit": "tick"},
        "current": {"columns": ["current_1", "current_2", "current_3"], "unit": "A"},
        "voltage": {"columns": ["voltage_1", "voltage_2", "voltage_3"], "unit": "V"},
        "pose_x": {"column": "x", "unit": "mm"},
        "pose_y": {"column": "y", "unit": "mm"},
        "pose_heading": {"column": "heading", "unit": "deg"},
    },
}
"""Layout of the files `write_logs` writes, as a config declares it; `voltage = false` without."""


def write_logs(logs: Sequence[Log], robot: Robot, out: Path, truth_dir: Path) -> list[Path]:
    """Write `<load>/<surface>/runNNN.csv` below a folder, and truth.json into one of its own.

    Args:
        logs: as `make_logs` gives them.
        robot: the truth.
        out: data folder.
        truth_dir: folder for truth.json, so that nothing that reads logs can find it by accident.
    """
    paths = []
    for log in logs:
        target = out / log.name
        write_bytes(target, _csv(log, robot).encode())
        paths.append(target)
    values = {
        e.path: {"value": np.asarray(e.get(robot)).tolist(), "unit": e.declaration.unit}
        for e in entries(robot)
    }
    write_json(truth_dir / "truth.json", {"schema": "slipid.truth/1", "parameters": values})
    return paths


def _csv(log: Log, robot: Robot) -> str:
    assert log.twist_command is not None
    assert log.current is not None
    assert log.pose is not None
    ticks = LAYOUT["ticks_per_revolution"] * robot.geometry.gear_ratio / (2 * np.pi)
    columns = [log.time[:, None], log.twist_command, np.round(log.wheel_angle * ticks), log.current]
    formats = ["%.4f", *["%.4f"] * 3, *["%d"] * log.wheels, *["%.4f"] * log.wheels]
    names = ["time", "command_x", "command_y", "command_yaw"]
    each = ["ticks", "current"]
    if log.voltage is not None:
        columns.append(log.voltage)
        formats += ["%.2f"] * log.wheels
        each.append("voltage")
    names += [f"{what}_{k + 1}" for what in each for k in range(log.wheels)]
    heading = np.degrees(log.pose[:, 2:])
    columns += [1000 * log.pose[:, :2], heading]
    formats += ["%.3f", "%.3f", "%.4f"]
    names += ["x", "y", "heading"]
    rows = np.concatenate(columns, axis=1)
    lines = [",".join(f % v for f, v in zip(formats, row, strict=True)) for row in rows]
    return "\n".join([",".join(names), *lines]) + "\n"
