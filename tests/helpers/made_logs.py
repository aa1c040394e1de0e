"""Made logs as files, the truth in a folder of its own."""

from collections.abc import Sequence
from pathlib import Path

from slipid.data.log import Log
from slipid.data.write import own_columns, own_csv
from slipid.lab.selftest.logs import true_numbers
from slipid.model.robot import Robot
from slipid.parameter import entries
from slipid.support.files import write_bytes, write_json

TICKS = 2000
"""Per turn of the motor."""
LAYOUT = {
    "ticks_per_revolution": TICKS,
    "gear_ratio": 16.0,
    "current_is_signed": False,
    "columns": own_columns(3, ["voltage"]),
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
        gear = float(robot.geometry.gear_ratio)
        write_bytes(target, own_csv(log, gear, TICKS).encode())
        paths.append(target)
    units = {e.path: e.declaration.unit for e in entries(robot)}
    values = {path: {"value": v, "unit": units[path]} for path, v in true_numbers(robot).items()}
    write_json(truth_dir / "truth.json", {"schema": "slipid.truth/1", "parameters": values})
    return paths
