"""What sensors and the overhead camera make of the truth: a log that errs like real ones."""

import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.log import Log
from slipid.data.wheel_signals import interpolate
from slipid.testsite.driving import Run, Trace
from slipid.testsite.site import Site


def observe(trace: Trace, site: Site, run: Run, name: str, seed: int) -> Log:
    """The log of a run, by its name and the seed of its noise."""
    s, rng = site.sensors, np.random.default_rng([seed, 1])
    count = int(trace.time[-1] / s.row_s) + 1
    uneven = s.row_s * (1 + s.row_jitter * rng.uniform(-1, 1, count))
    time = np.concatenate([[0.0], np.cumsum(uneven)])
    time = time[time <= trace.time[-1]]
    at = np.searchsorted(trace.time, time + 1e-9) - 1
    whole = np.floor(trace.wheel_angle[at] / site.tick) * site.tick
    quantum = s.speed_step / site.machine.gear_ratio
    speed = np.round(s.speed_gain * _averaged(trace.wheel_speed, at, 5) / quantum) * quantum
    width = max(1, round(s.average_s / (trace.time[1] - trace.time[0])))
    amps = s.amperes(_averaged(trace.current, at, width), rng)
    volts = s.volts(_averaged(trace.voltage, at, width), rng)
    bus = s.volts(_averaged(trace.bus[:, None], at, width)[:, 0], rng)
    turn = trace.yaw_rate[at] + s.gyro_bias * rng.normal()
    turn = turn + s.gyro_noise * rng.normal(size=turn.shape)
    duty = _averaged(trace.voltage / trace.bus[:, None], at, width)
    pose, fresh = _camera(trace, site, rng, time)
    logged = b"".join(np.ascontiguousarray(x).tobytes() for x in (whole, amps, volts, pose, time))
    return Log(
        name=f"{name}.csv",
        path=Path(f"{name}.csv"),
        sha256=hashlib.sha256(logged).hexdigest(),
        time=time,
        wheel_angle=whole - whole[0],
        wheel_speed=speed,
        wheel_speed_command=trace.wheel_command[at],
        twist_command=trace.twist_command[at],
        current=amps,
        current_is_signed=s.current_is_signed,
        voltage=volts if s.voltage else None,
        duty=np.round(duty, 3) if s.duty else None,
        bus_voltage=bus if s.bus_voltage else None,
        gyro=turn if s.gyro else None,
        pose=pose,
        pose_fresh=fresh,
        surface=run.surface,
        load=run.load,
    )


def _averaged(
    x: Float[np.ndarray, "step wheel"], at: np.ndarray, width: int
) -> Float[np.ndarray, "row wheel"]:
    """Mean of so many steps up to each row."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    first = np.maximum(at + 1 - width, 0)
    return (total[at + 1] - total[first]) / (at + 1 - first)[:, None]


def _camera(
    trace: Trace, site: Site, rng: np.random.Generator, time: Float[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, "row 3"], Bool[np.ndarray, " row"]]:
    """Marker poses as the rows hold them, and which rows bring a new frame."""
    s = site.sensors
    delay = s.lag_s - 0.5 * s.frame_s
    first = -(s.lag_s + 3 * s.frame_s)  # so that there is one to be logged when it starts
    taken = np.arange(first, trace.time[-1] + s.frame_s, s.frame_s) + rng.uniform(0, s.frame_s)
    taken = taken[(rng.uniform(size=len(taken)) >= s.dropout) | (taken + delay <= 0.0)]
    seen = interpolate(trace.time, trace.pose, taken)
    seen[:, 2] += float(np.radians(site.machine.marker_yaw_deg))
    seen[:, :2] += s.camera_noise_m * rng.normal(size=(len(taken), 2))
    seen[:, 2] += s.camera_noise_rad * rng.normal(size=len(taken))
    wrong = rng.uniform(size=len(taken)) < s.outlier
    seen[:, :2] += np.where(wrong[:, None], s.outlier_m * rng.normal(size=(len(taken), 2)), 0.0)
    seen[:, :2] /= s.camera_scale
    newest = np.searchsorted(taken + delay, time, side="right") - 1
    fresh = np.concatenate([[True], np.diff(newest) > 0])
    return seen[newest], fresh
