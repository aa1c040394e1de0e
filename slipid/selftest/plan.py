"""What is driven, seen by which sensors: the inputs of made logs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from slipid.identify.design.planned_runs import Drive


def grid(
    setups: Sequence[tuple[str, str]] = (
        ("firm", "as_built"),
        ("soft", "as_built"),
        ("soft", "moved"),
    ),
    headings: int = 12,
    speeds: Sequence[float] = (0.1, 0.2),
    turns: int = 2,
) -> tuple[Drive, ...]:
    """Every heading at every speed on every (floor, load), and `turns` curved runs of each."""
    drives = []
    for surface, load in setups:
        for speed in speeds:
            ways = 2 * np.pi * np.arange(headings) / headings
            drives += [Drive(surface, load, float(way), speed) for way in ways]
            ways = 2 * np.pi * (np.arange(turns) + 0.5) / max(turns, 1)
            drives += [
                Drive(surface, load, float(way), speed, turn=(-1) ** k * 4.0 * speed)
                for k, way in enumerate(ways)
            ]
    return tuple(drives)


@dataclass(frozen=True)
class Sensors:
    """How the logs are disturbed; stds by the names of `slipid.identify.fit.noise.noise`.

    Attributes:
        std: of every variance component; `floor` in a name stands for every floor without its own.
        ripple: of the current from row to row [A]; voltage_noise: [V].
        current_step, voltage_step: of the converters [A], [V]; ticks: per turn of the motor.
        row_period, frame_period: of the log and the camera [s].
        delay, ramp: from command to motion, and to full speed [s].
        wobble: of the wheel's angle, as time [s]; a real speed loop is never quite still.
        free_frames: frames come when the camera pleases, so that the lag differs by up to half a
            row; otherwise every new frame is exactly `camera.lag` old.
    """

    std: Mapping[str, float] = field(
        default_factory=lambda: {
            "camera.place": 0.0005,
            "camera.heading": 0.005,
            "process.floor.along": 0.004,
            "process.floor.across": 0.004,
            "process.floor.yaw": 0.008,
            "run.floor.along": 0.006,
            "run.floor.across": 0.006,
            "run.floor.yaw": 0.03,
            "current.floor.run": 0.03,
        }
    )
    ripple: float = 0.06
    voltage_noise: float = 0.07
    current_step: float = 1 / 39
    voltage_step: float = 0.1
    ticks: int = 2000
    row_period: float = 0.031
    frame_period: float = 1 / 29
    delay: float = 0.12
    ramp: float = 0.2
    wobble: float = 0.002
    has_voltage: bool = True
    free_frames: bool = False

    def of(self, name: str) -> float:
        """Std of a variance component."""
        head, _, last = name.partition(".")
        return (
            self.std[name] if name in self.std else self.std[f"{head}.floor.{last.split('.')[-1]}"]
        )
