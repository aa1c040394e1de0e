"""Log files of a robot that drives a known way, in the words and units that people use."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

RADIUS, TRACK = 0.1, 0.4


def wheel_speeds(time):
    """Of the left and the right wheel [rad/s]: forth and back, with a turn."""
    ahead = 4.0 * np.sin(0.9 * time)
    return np.stack([ahead + 0.5, ahead - 0.5 * np.cos(0.3 * time)], axis=1)


def motion(time):
    """Angles of both wheels [rad] and the pose [m, m, rad] of wheels that do not slip."""
    fine = np.linspace(0.0, float(time[-1]) + 0.01, 20_000)
    speeds = wheel_speeds(fine)
    dt = fine[1] - fine[0]
    angle = np.cumsum(speeds, axis=0) * dt
    yaw = RADIUS * (angle[:, 1] - angle[:, 0]) / TRACK
    ahead = RADIUS * speeds.mean(axis=1)
    x, y = (np.cumsum(ahead * part(yaw)) * dt for part in (np.cos, np.sin))
    at = [np.interp(time, fine, column) for column in (*angle.T, x, y, yaw)]
    return np.stack(at[:2], axis=1), np.stack(at[2:], axis=1)


def table(
    path: Path, columns: Mapping[str, np.ndarray], delimiter: str = ",", header: bool = True
) -> Path:
    """Write columns; numbers that are NaN are empty cells, whole ones have no point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = zip(*columns.values(), strict=True)
    lines = [delimiter.join(columns)] if header else []
    lines += [delimiter.join(_cell(value) for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _cell(value) -> str:
    if isinstance(value, int | np.integer | str):
        return str(value)
    return "" if np.isnan(value) else f"{value:.9g}"


def plain(seconds: float = 12.0, rate: float = 50.0) -> dict[str, np.ndarray]:
    """One file of a run in SI: speeds and poses in every row, commands, signed currents."""
    time = np.arange(0.0, seconds, 1 / rate)
    _, pose = motion(time)
    speeds = wheel_speeds(time)
    return {
        "t": time,
        "left_vel": speeds[:, 0],
        "right_vel": speeds[:, 1],
        "cur_left": 0.4 * speeds[:, 0] + 0.1,
        "cur_right": 0.4 * speeds[:, 1] - 0.1,
        "x": pose[:, 0],
        "y": pose[:, 1],
        "yaw": pose[:, 2],
        "cmd_v": RADIUS * speeds.mean(axis=1),
        "cmd_w": RADIUS * (speeds[:, 1] - speeds[:, 0]) / TRACK,
    }
