"""Simulated runs without poses for floor classifiers."""

import numpy as np

from slipid.lab.systems.floors.interface import FloorSignals

HZ = 6.5


def made_floor_run(
    floor: str,
    speed: np.ndarray,
    level: float,
    *,
    name: str | None = None,
    noise: float = 0.3,
    seed: int = 0,
    gyro: bool = True,
) -> FloorSignals:
    """Return a run with currents of `level` [A] plus noise at wheel speeds (row, drive)."""
    rng = np.random.default_rng(seed)
    rows = len(speed)
    return FloorSignals(
        name=name or f"{floor}/{seed}",
        floor=floor,
        time=np.arange(rows) / HZ,
        speed=speed,
        current=np.abs(level + noise * rng.normal(size=speed.shape)),
        gyro=0.02 * rng.normal(size=rows) if gyro else None,
        vibration=np.abs(rng.normal(size=rows)),
    )


def ahead(rows: int = 60, rate: float = 1.5, drives: int = 2) -> np.ndarray:
    """Return wheel speeds of straight motion (row, drive) [rad/s]."""
    return np.full((rows, drives), rate)


def made_floor_runs(
    levels: dict[str, float], runs: int = 4, rows: int = 60, **kw: float
) -> list[FloorSignals]:
    """Return straight runs on floors that differ in their currents [A]."""
    return [
        made_floor_run(floor, ahead(rows), level, seed=100 * n + k, name=f"{floor}/{k}", **kw)
        for n, (floor, level) in enumerate(levels.items())
        for k in range(runs)
    ]
