"""A log: one recorded run as a frozen value with SI units, REP-103 axes and named arrays."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.align.clock import Clock


@dataclass(frozen=True, eq=False, kw_only=True)
class Log:
    """One run, with every array at the times `time` at which some sensor was read.

    A wheel stands for a drive where several wheels share a motor.

    Attributes:
        name: path relative to the data root, with forward slashes; `#03` follows where one file
            holds several runs.
        path: the file.
        sha256: hash of the file's bytes.
        time: time [s], strictly increasing; relative to the first row where a clock counts from
            1970.
        wheel_angle: angle of each wheel [rad], cumulative from the first row and linear between two
            readings; no columns where a log has only poses.
        wheel_speed: reported speed of each wheel [rad/s], or None.
        wheel_speed_command: commanded speed of each wheel [rad/s], or None.
        twist_command: commanded x [m/s], y [m/s] and yaw rate [rad/s], or None.
        current: current of each motor [A], or None.
        current_fresh: False where a current repeats the last reading; None where it was read in
            every row.
        current_is_signed: False where the log has magnitudes only.
        voltage: voltage across each motor [V], or None.
        voltage_fresh: False where a voltage repeats the last reading; None where it was read in
            every row.
        duty: duty cycle of each motor's bridge [1], or None.
        bus_voltage: supply voltage [V], or None.
        gyro: yaw rate [rad/s], or None.
        pose: x [m], y [m], heading [rad] without wrap-around, in the scale of the camera's log, or
            None.
        pose_fresh: False where the row repeats the last pose.
        pose_clock: clock of poses with times of their own, estimated from the motion, or None.
        surface: name of the floor, None where it is unknown.
        load: name of the load set-up.
        notes: repairs made by the reader, one sentence each.
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
        """Return the number of rows."""
        return len(self.time)

    @property
    def wheels(self) -> int:
        """Return the number of wheels, 0 where only poses were logged."""
        return self.wheel_angle.shape[1]

    @property
    def duration(self) -> float:
        """Return the time from the first to the last row [s]."""
        return float(self.time[-1] - self.time[0])

    def __repr__(self) -> str:
        """Return name, size and measured channels on one line."""
        names = ("wheel_speed", "current", "voltage", "duty", "bus_voltage", "gyro", "pose")
        has = [name for name in names if getattr(self, name) is not None]
        return (
            f"Log({self.name!r}, {self.samples} rows, {self.duration:.1f} s, {self.wheels} wheels, "
            f"surface={self.surface!r}, load={self.load!r}, has {', '.join(has) or 'ticks only'})"
        )
