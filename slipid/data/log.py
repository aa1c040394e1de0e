"""One recorded run as a frozen value: SI units, REP-103 axes, named arrays."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.align.clock import Clock


@dataclass(frozen=True, eq=False, kw_only=True)
class Log:
    """One run, every array at `time`, at which some sensor was read.

    What is of a wheel is of a drive, where several wheels share a motor.

    Attributes:
        name: path relative to the data root, with forward slashes; `#03` follows where one file
            holds several runs.
        path: the file.
        sha256: hash of the file's bytes.
        time: [s], strictly increasing; from the first row on where a clock counts from 1970.
        wheel_angle: [rad] at the wheel, cumulative from the first row, and even between two
            readings; no columns where a log has
            only poses.
        wheel_speed: [rad/s] at the wheel as the robot reported it, or None.
        wheel_speed_command: [rad/s] at the wheel, or None.
        twist_command: x [m/s], y [m/s], yaw rate [rad/s], or None.
        current: [A], or None.
        current_fresh: False where a current repeats what was read before (or was not read); None
            where it was read in every row.
        current_is_signed: False where the log has magnitudes only.
        voltage: [V] across each motor, or None; `voltage_fresh` as of the current.
        duty: [1] of each motor's bridge, or None.
        bus_voltage: [V], or None.
        gyro: yaw rate [rad/s], or None.
        pose: x [m], y [m], heading [rad] without wrap-around, in the scale of the logged camera,
            or None.
        pose_fresh: False where the row repeats the last pose.
        pose_clock: the clock of poses that had one of their own, as it was found from the motion.
        surface: name of the floor, None where it is unknown.
        load: name of the load set-up.
        notes: what the reader repaired, one sentence each.
    """

    name: str
    path: Path
    sha256: str
    time: Float[np.ndarray, " time"]
    wheel_angle: Float[np.ndarray, "time wheel"]
    wheel_speed: Float[np.ndarray, "time wheel"] | None = None
    wheel_speed_command: Float[np.ndarray, "time wheel"] | None = None
    twist_command: Float[np.ndarray, "time 3"] | None = None
    current: Float[np.ndarray, "time wheel"] | None = None
    current_fresh: Bool[np.ndarray, "time wheel"] | None = None
    current_is_signed: bool
    voltage: Float[np.ndarray, "time wheel"] | None = None
    voltage_fresh: Bool[np.ndarray, "time wheel"] | None = None
    duty: Float[np.ndarray, "time wheel"] | None = None
    bus_voltage: Float[np.ndarray, " time"] | None = None
    gyro: Float[np.ndarray, " time"] | None = None
    pose: Float[np.ndarray, "time 3"] | None = None
    pose_fresh: Bool[np.ndarray, " time"] | None = None
    pose_clock: Clock | None = None
    surface: str | None
    load: str
    notes: tuple[str, ...] = ()

    @property
    def samples(self) -> int:
        """Number of rows."""
        return len(self.time)

    @property
    def wheels(self) -> int:
        """Number of wheels, 0 where only poses were logged."""
        return self.wheel_angle.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last row [s]."""
        return float(self.time[-1] - self.time[0])

    def __repr__(self) -> str:
        """Name, size and what was measured, on one line."""
        names = ("wheel_speed", "current", "voltage", "duty", "bus_voltage", "gyro", "pose")
        has = [name for name in names if getattr(self, name) is not None]
        return (
            f"Log({self.name!r}, {self.samples} rows, {self.duration:.1f} s, {self.wheels} wheels, "
            f"surface={self.surface!r}, load={self.load!r}, has {', '.join(has) or 'ticks only'})"
        )
