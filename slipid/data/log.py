"""Class `Log`: one recorded run, frozen, with named arrays in SI units and axes as in REP 103."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.align.clock import Clock


@dataclass(frozen=True)
class WheelReading:
    """Source of the wheel angles in a layout, for the advice of checks.

    Attributes:
        channel: channel of the layout; empty if unknown.
        gear_ratio: gear ratio of the layout.
        whole: True if an angle of the layout had whole numbers of radians only, as ticks have.
        columns: name of each wheel's column; empty if unknown.
    """

    channel: str = ""
    gear_ratio: float = 1.0
    whole: bool = False
    columns: tuple[str, ...] = ()

    @property
    def divided_by(self) -> float:
        """Return the gear ratio by which the readings were divided; 1 for those of wheels."""
        of_motor = self.channel == "wheel_ticks" or self.channel.startswith("motor")
        return self.gear_ratio if of_motor else 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Log:
    """One run; all arrays have a row for each time at which at least one sensor was read.

    If several wheels share a motor, "wheel" stands for that motor with all its wheels.

    Attributes:
        name: path relative to the data root, with forward slashes; if a file contains several runs,
            a suffix such as `#03` is added.
        path: path of the file.
        sha256: SHA-256 hash of the file's bytes.
        time: time [s], strictly increasing; times that are logged as seconds since 1970 are shifted
            to start at 0.
        wheel_angle: angle of each wheel [rad], cumulative from the first row, interpolated linearly
            between readings; it has no columns if the log has only poses.
        wheel_reading: what the angles were computed from.
        wheel_speed: reported speed of each wheel [rad/s], or None.
        wheel_speed_command: commanded speed of each wheel [rad/s], or None.
        travel: integrals of the twist that the robot's odometry reports, ahead [m], to the left [m]
            and in yaw [rad], if no motion of wheels is logged; else None.
        twist_command: commanded x [m/s], y [m/s] and yaw rate [rad/s], or None.
        current: current of each motor [A], or None; torque of each drive at the wheel [N m] if
            `current_is_torque`.
        current_fresh: False where a current repeats the last reading; None if every row has new
            currents.
        current_is_signed: False if the log has only magnitudes of currents.
        current_is_torque: True if the log has torques, with no torque constant by which they could
            be currents; it then has no voltages.
        voltage: voltage across each motor [V], or None.
        voltage_fresh: False where a voltage repeats the last reading; None if every row has new
            voltages.
        duty: duty cycle of each motor's bridge [1], or None.
        bus_voltage: supply voltage [V], or None.
        gyro: yaw rate [rad/s], or None.
        steering: steering angle, positive to the left [rad], linear between readings, or None.
        pose: x [m], y [m], heading [rad] without wrap-around, in the scale of the camera's log (not
            corrected for a wrong camera scale), or None; nan in coordinates that were not measured,
            such as the heading of a satellite receiver or the position of a compass.
        pose_fresh: False where the row repeats the last pose.
        pose_clock: clock offset and drift, estimated from the motion, of poses that have times of
            their own; else None.
        surface: name of the surface, or None if it is unknown.
        load: name of the load set-up.
        notes: repairs made when the log was read, one sentence each.
    """

    name: str
    path: Path
    sha256: str
    time: Float[np.ndarray, " time"]
    wheel_angle: Float[np.ndarray, "time wheel"]
    wheel_reading: WheelReading = WheelReading()
    wheel_speed: Float[np.ndarray, "time wheel"] | None = None
    wheel_speed_command: Float[np.ndarray, "time wheel"] | None = None
    travel: Float[np.ndarray, "time 3"] | None = None
    twist_command: Float[np.ndarray, "time 3"] | None = None
    current: Float[np.ndarray, "time wheel"] | None = None
    current_fresh: Bool[np.ndarray, "time wheel"] | None = None
    current_is_signed: bool
    current_is_torque: bool = False
    voltage: Float[np.ndarray, "time wheel"] | None = None
    voltage_fresh: Bool[np.ndarray, "time wheel"] | None = None
    duty: Float[np.ndarray, "time wheel"] | None = None
    bus_voltage: Float[np.ndarray, " time"] | None = None
    gyro: Float[np.ndarray, " time"] | None = None
    steering: Float[np.ndarray, " time"] | None = None
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
        """Number of wheels, 0 if only poses were logged."""
        return self.wheel_angle.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last row [s]."""
        return float(self.time[-1] - self.time[0])

    def __repr__(self) -> str:
        """Return one line with the name, size and logged channels."""
        electric = ("current", "voltage", "duty", "bus_voltage")
        names = ("wheel_speed", *electric, "gyro", "steering", "pose")
        has = [name for name in names if getattr(self, name) is not None]
        return (
            f"Log({self.name!r}, {self.samples} rows, {self.duration:.1f} s, {self.wheels} wheels, "
            f"surface={self.surface!r}, load={self.load!r}, has {', '.join(has) or 'ticks only'})"
        )
