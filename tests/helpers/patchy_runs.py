"""These runs slip in patches, where their currents are higher."""

import numpy as np

from slipid.predict.slip_model import Run
from tests.helpers.made_runs import ROBOTINO, made_run, straight

LOST = 0.4
"""What the made runs lose of their twist where they slip."""


def patchy(seed: int, gyro: bool = False, overlap: float = 0.02, lost: float = LOST) -> Run:
    """A run that slips in some windows of half a second; there its currents are higher."""
    rng = np.random.default_rng(seed)
    slips = np.repeat(rng.random(20) < 0.4, 5)
    rolling = straight(rng.uniform(-np.pi, np.pi), 0.2, 100)
    rolling[:, 2] = 0.3
    rolling *= rng.uniform(0.99, 1.01, (100, 1))
    twist = rolling * np.where(slips, 1.0 - lost, 1.0)[:, None]
    current = np.where(slips, 0.9, 0.5)[:, None] + overlap * rng.normal(size=(100, 3))
    yaw = twist[:, 2] + 0.001 * rng.normal(size=100) if gyro else None
    return made_run(rolling, twist, current=np.abs(current), gyro=yaw, name=f"made{seed}")


def slipping(run: Run) -> np.ndarray:
    """Which steps of a run of 0.1 s slip."""
    rolling = run.signals.rolling(ROBOTINO)
    return np.linalg.norm(rolling - run.twist, axis=1) > 0.2 * np.linalg.norm(rolling, axis=1)
