"""What sensors and an overhead camera make of the truth: a log that errs like real ones."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.log import Log
from slipid.testsite.plant import Trace
from slipid.testsite.refuse import at_most, not_negative, positive


@dataclass(frozen=True)
class Sensors:
    """How logs err.

    Attributes:
        row_s, row_jitter: mean time between rows [s], and its spread as part of it.
        current_step_a, current_noise_a: step of the current's converter, and its noise [A].
        current_is_signed: else magnitudes are logged, as most robots do.
        speed_step, speed_gain: quantum of the reported motor speed [rad/s], and how much it reads
            too high [1].
        voltage, duty, bus_voltage, gyro: whether these are logged.
        voltage_step_v, voltage_noise_v: [V].
        gyro_noise, gyro_bias: [rad/s]; the bias is drawn anew for every run.
        average_s: over which currents and voltages are averaged before they are sampled [s].
        frame_s, lag_s: between camera frames, and mean age of the pose in a row [s].
        camera_scale: true length over logged length; the camera of the 2022 logs has 1.117.
        camera_noise_m, camera_noise_rad: noise of every frame.
        dropout: part of the frames that is lost.
        outlier, outlier_m: part of the frames that is wrong, and by how much [m].
    """

    row_s: float = 0.031
    row_jitter: float = 0.1
    current_step_a: float = 1 / 39
    current_noise_a: float = 0.05
    current_is_signed: bool = False
    speed_step: float = 2.83
    speed_gain: float = 1.013
    voltage: bool = True
    duty: bool = False
    bus_voltage: bool = False
    gyro: bool = False
    voltage_step_v: float = 0.1
    voltage_noise_v: float = 0.05
    gyro_noise: float = 0.004
    gyro_bias: float = 0.005
    average_s: float = 0.008
    frame_s: float = 1 / 29
    lag_s: float = 0.056
    camera_scale: float = 1.117
    camera_noise_m: float = 0.0005
    camera_noise_rad: float = 0.004
    dropout: float = 0.01
    outlier: float = 0.0005
    outlier_m: float = 0.03

    def __post_init__(self) -> None:
        positive(self, "row_s", "current_step_a", "speed_step", "speed_gain", "voltage_step_v")
        positive(self, "frame_s", "camera_scale")
        not_negative(self, "current_noise_a", "voltage_noise_v", "gyro_noise", "gyro_bias")
        not_negative(self, "average_s", "camera_noise_m", "camera_noise_rad", "outlier_m")
        at_most(self, row_s=1.0, average_s=1.0, camera_scale=100.0, frame_s=1.0)
        for name in ("row_s", "frame_s", "camera_scale"):
            if getattr(self, name) < 1e-3:
                raise ValueError(f"{name} = {getattr(self, name)}; expected 0.001 or above")
        for name in ("row_jitter", "dropout", "outlier"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} = {getattr(self, name)}; expected 0 or above, below 1")
        if self.voltage_step_v < 0.01:
            raise ValueError(f"voltage_step_v = {self.voltage_step_v}; expected 0.01 or above")
        if not 0.5 * self.frame_s <= self.lag_s <= 0.4:
            raise ValueError(f"lag_s = {self.lag_s}; expected half of frame_s or above, up to 0.4")


def observe(
    trace: Trace,
    sensors: Sensors,
    rng: np.random.Generator,
    *,
    name: str,
    surface: str | None,
    load: str,
    gear_ratio: float,
    ticks_per_revolution: int,
    marker_yaw: float,
) -> Log:
    """The log of one run.

    Args:
        trace: the truth.
        sensors: how they err.
        rng: their noise.
        name: name of the log.
        surface: what the log says it drove on.
        load: name of the load set-up.
        gear_ratio: turns of the motor per turn of the wheel.
        ticks_per_revolution: ticks in one turn of the motor.
        marker_yaw: heading of the marker less the body's [rad].
    """
    s = sensors
    count = int(trace.time[-1] / s.row_s) + 1
    uneven = s.row_s * (1 + s.row_jitter * rng.uniform(-1, 1, count))
    time = np.concatenate([[0.0], np.cumsum(uneven)])
    time = time[time <= trace.time[-1]]
    at = np.searchsorted(trace.time, time + 1e-9) - 1
    tick = 2 * np.pi / (ticks_per_revolution * gear_ratio)
    whole = np.floor(trace.wheel_angle[at] / tick) * tick
    quantum = s.speed_step / gear_ratio
    speed = np.round(s.speed_gain * _averaged(trace.wheel_speed, at, 5) / quantum) * quantum
    width = max(1, round(s.average_s / (trace.time[1] - trace.time[0])))
    amps = _averaged(trace.current, at, width)
    amps = amps + s.current_noise_a * rng.normal(size=amps.shape)
    amps = amps if s.current_is_signed else np.abs(amps)
    volts = _averaged(trace.voltage, at, width)
    volts = volts + s.voltage_noise_v * rng.normal(size=volts.shape)
    bus = _averaged(trace.bus[:, None], at, width)[:, 0]
    bus = bus + s.voltage_noise_v * rng.normal(size=bus.shape)
    turn = trace.yaw_rate[at] + s.gyro_bias * rng.normal()
    turn = turn + s.gyro_noise * rng.normal(size=turn.shape)
    duty = _averaged(trace.voltage / trace.bus[:, None], at, width)
    pose, fresh = _camera(trace, s, rng, time, marker_yaw)
    logged = [whole, amps, volts, pose, time]
    return Log(
        name=name,
        path=Path(name),
        sha256=hashlib.sha256(
            b"".join(np.ascontiguousarray(x).tobytes() for x in logged)
        ).hexdigest(),
        time=time,
        wheel_angle=whole - whole[0],
        wheel_speed=speed,
        wheel_speed_command=trace.wheel_command[at],
        twist_command=trace.twist_command[at],
        current=np.round(amps / s.current_step_a) * s.current_step_a,
        current_is_signed=s.current_is_signed,
        voltage=np.round(volts / s.voltage_step_v) * s.voltage_step_v if s.voltage else None,
        duty=np.round(duty, 3) if s.duty else None,
        bus_voltage=np.round(bus / s.voltage_step_v) * s.voltage_step_v if s.bus_voltage else None,
        gyro=turn if s.gyro else None,
        pose=pose,
        pose_fresh=fresh,
        surface=surface,
        load=load,
    )


def _averaged(
    x: Float[np.ndarray, "step wheel"], at: np.ndarray, width: int
) -> Float[np.ndarray, "row wheel"]:
    """Mean of so many steps up to each row."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    first = np.maximum(at + 1 - width, 0)
    return (total[at + 1] - total[first]) / (at + 1 - first)[:, None]


def _camera(
    trace: Trace,
    s: Sensors,
    rng: np.random.Generator,
    time: Float[np.ndarray, " row"],
    marker_yaw: float,
) -> tuple[Float[np.ndarray, "row 3"], Bool[np.ndarray, " row"]]:
    """Marker poses as the rows hold them, and which rows bring a new frame."""
    delay = s.lag_s - 0.5 * s.frame_s
    first = -(s.lag_s + 3 * s.frame_s)  # so that there is one to be logged when it starts
    taken = np.arange(first, trace.time[-1] + s.frame_s, s.frame_s) + rng.uniform(0, s.frame_s)
    taken = taken[(rng.uniform(size=len(taken)) >= s.dropout) | (taken + delay <= 0.0)]
    seen = np.stack([np.interp(taken, trace.time, trace.pose[:, k]) for k in range(3)], axis=1)
    seen[:, 2] += marker_yaw
    seen[:, :2] += s.camera_noise_m * rng.normal(size=(len(taken), 2))
    seen[:, 2] += s.camera_noise_rad * rng.normal(size=len(taken))
    wrong = rng.uniform(size=len(taken)) < s.outlier
    seen[:, :2] += np.where(wrong[:, None], s.outlier_m * rng.normal(size=(len(taken), 2)), 0.0)
    seen[:, :2] /= s.camera_scale
    newest = np.searchsorted(taken + delay, time, side="right") - 1
    fresh = np.concatenate([[True], np.diff(newest) > 0])
    return seen[newest], fresh
