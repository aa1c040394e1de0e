"""A folder with logs of the plain robot, and a config that reads them."""

from __future__ import annotations

from pathlib import Path

from slipid.data.write import own_columns, own_csv
from tests.helpers.plain_robot import BASE, GEAR, OMNI, RADIUS, TICKS, as_runs, drive

ROBOT = f"""[robot]
drive = "omni"
wheel_azimuths_deg = [60, 180, 300]
base_radius_m = {BASE}
wheel_radius_m = {RADIUS}
gear_ratio = {GEAR}
mass_kg = 12.0
"""


def config(folder: Path, robot: str = ROBOT, gear: float = GEAR) -> Path:
    """A folder with logs, and a config that reads them."""
    runs = as_runs([raw.less("speed", "command") for raw in drive(OMNI)])
    for log in runs.logs:
        path = folder / "logs" / log.name
        path.parent.mkdir(exist_ok=True)
        path.write_text(own_csv(log, GEAR, int(TICKS)), encoding="utf-8")
    columns = own_columns(3, ["voltage", "gyro"])
    text = robot + '[[logs]]\nglob = "*.csv"\nformat = "mine"\nsurface = "floor"\n'
    text += f"[layouts.mine]\nticks_per_revolution = {TICKS}\ngear_ratio = {gear}\n"
    for name, of in columns.items():
        keys = "\n".join(
            f"{key} = {value}" if isinstance(value, list) else f'{key} = "{value}"'
            for key, value in of.items()
        )
        text += f"[layouts.mine.columns.{name}]\n{keys}\n"
    file = folder / "my.toml"
    file.write_text(text, encoding="utf-8")
    return file
