"""Runs of any lengths are laid side by side, so that the filter tracks all of them at once.

Of each run it holds what the filter hears: speeds of the wheels, the gyro, and the forces that the
motors' currents tell.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.baselines.motion.ward_iagnemma.dynamics import REST
from slipid.identify.compare.slip_model import Heard, Machine

_DRIVING = 0.3
"""Share of the fastest rim speed from which on a wheel counts as driving."""


@dataclass(frozen=True, eq=False)
class Padded:
    """Runs side by side, padded to the same number of steps with steps of no time.

    Attributes:
        dt: [s], 0 in padding.
        rim: rim speed of each drive [m/s].
        rolling: q if nothing slipped [m/s].
        gyro: [rad/s], nan where there is none.
        pull: force of each motor at the rim by its current [N], nan where it tells nothing.
    """

    dt: Float[np.ndarray, "run step"]
    rim: Float[np.ndarray, "run step drive"]
    rolling: Float[np.ndarray, "run step 3"]
    gyro: Float[np.ndarray, "run step"]
    pull: Float[np.ndarray, "run step drive"]

    @classmethod
    def of(cls, runs: Sequence[Heard], machine: Machine) -> "Padded":
        """Of runs of any lengths."""
        shape, drives = (len(runs), max(len(run) for run in runs)), len(machine.forward)
        padded = cls(
            dt=np.zeros(shape),
            rim=np.zeros((*shape, drives)),
            rolling=np.zeros((*shape, 3)),
            gyro=np.full(shape, np.nan),
            pull=np.full((*shape, drives), np.nan),
        )
        for k, run in enumerate(runs):
            steps = slice(len(run))
            padded.dt[k, steps] = run.dt
            padded.rim[k, steps] = run.speed * machine.wheel_radius
            padded.rolling[k, steps] = run.rolling(machine) * machine.size
            padded.gyro[k, steps] = np.nan if run.gyro is None else run.gyro
            padded.pull[k, steps] = pulls(run, machine)
        return padded


def pulls(run: Heard, machine: Machine) -> Float[np.ndarray, "step drive"]:
    """Force n C_e I / r along each drive's motion [N]; nan where it tells nothing."""
    rim = np.abs(run.speed * machine.wheel_radius)
    if run.current is None:
        return np.full(rim.shape, np.nan)
    drives = (rim >= _DRIVING * rim.max(axis=1, keepdims=True)) & (rim > REST)
    scale = machine.gear_ratio * machine.back_emf / machine.wheel_radius
    return np.where(drives, scale * run.along(machine), np.nan)
