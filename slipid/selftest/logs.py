"""Logs made from a robot whose every number is known: for selftests and tests of recovery.

Straight and turning runs of a grid like a Robotino's under an overhead camera. The noise is the one
the likelihood assumes (camera, process growing with distance, run effects, current level per run);
on top of it come the traps of real logs it does not know of: ticks, quantised unsigned currents
with ripple, quantised voltages, repeated camera frames, uneven rows, a delayed and ramped start.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.log import Log
from slipid.identify.design.planned_runs import Drive
from slipid.model.robot import Robot, wheel_torque
from slipid.model.rollout import replay_twist
from slipid.model.se2 import compose, path
from slipid.selftest.plan import Sensors


def make_logs(
    robot: Robot, drives: Sequence[Drive], seed: int, sensors: Sensors | None = None
) -> list[Log]:
    """Logs of a plan, in memory.

    Args:
        robot: the truth; must know the plan's floors, loads and sessions.
        drives: the plan.
        seed: of the one random generator.
        sensors: noise and converters.
    """
    sensors = sensors or Sensors()
    rng = np.random.default_rng(seed)
    longest = max(d.seconds(_base(robot)) for d in drives) + sensors.delay + sensors.ramp
    rows = int(np.ceil(longest / sensors.row_period)) + 2
    time, angle = _wheels(robot, drives, sensors, rows, rng)
    floor = jnp.asarray([robot.surface_index(d.surface) for d in drives])
    load = jnp.asarray([robot.load_index(d.load) for d in drives])
    dt = np.diff(time, axis=1)
    speed = np.diff(angle, axis=1) / dt[..., None]
    xi, amps = (np.asarray(x) for x in _twists(robot, dt, speed, floor, load))
    pose = _poses(robot, drives, sensors, dt, speed, xi, rng)
    seen, fresh = _camera(robot, drives, sensors, time, pose, rng)
    channels = _electric(robot, drives, sensors, speed, amps, rng)
    tick = 2 * np.pi / (sensors.ticks * robot.geometry.gear_ratio)
    logs = []
    for k, d in enumerate(drives):
        n = int(np.searchsorted(time[k], d.seconds(_base(robot)) + sensors.delay + sensors.ramp))
        whole = np.floor(angle[k, :n] / tick) * tick
        current, voltage, reported = (None if c is None else c[k, :n] for c in channels)
        logs.append(
            Log(
                name=f"{d.load}/{d.surface}/run{k:03d}.csv",
                path=Path(f"{d.load}/{d.surface}/run{k:03d}.csv"),
                sha256=hashlib.sha256(whole.tobytes() + seen[k, :n].tobytes()).hexdigest(),
                time=time[k, :n],
                wheel_angle=whole - whole[0],
                wheel_speed=reported,
                twist_command=np.tile(d.command, (n, 1)),
                current=current,
                current_is_signed=False,
                voltage=voltage,
                pose=seen[k, :n],
                pose_fresh=fresh[k, :n],
                surface=d.surface,
                load=d.load,
            )
        )
    return logs


def _base(robot: Robot) -> float:
    return float(robot.geometry.base_radius)


def _wheels(
    robot: Robot, drives: Sequence[Drive], s: Sensors, rows: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Times (run, row) and true wheel angles (run, row, wheel)."""
    n, j = len(drives), np.asarray(robot.geometry.forward())
    want = np.stack([d.command for d in drives]) @ j.T / float(robot.geometry.wheel_radius)
    uneven = rng.uniform(0.9, 1.1, (n, rows))
    time = np.cumsum(uneven * s.row_period, axis=1)
    time -= time[:, :1]
    x = np.clip((time - s.delay) / s.ramp, 0.0, 1.0)
    moved = s.ramp * (x**3 - x**4 / 2) + np.clip(time - s.delay - s.ramp, 0.0, None)
    phase = rng.uniform(0, 2 * np.pi, (n, 1, want.shape[1]))
    swing = s.wobble * np.sin(2 * np.pi * 2.0 * time[..., None] + phase) * x[..., None]
    return time, want[:, None] * (moved[..., None] + swing)


@jax.jit
def _twists(
    robot: Robot, dt: Array, speed: Array, floor: Array, load: Array
) -> tuple[Array, Array]:
    """Body twists and signed motor currents of every step of every run."""
    frame = robot.geometry.frame()

    def one(h: Array, w: Array, f: Array, s: Array) -> tuple[Array, Array]:
        xi = replay_twist(robot, h, w, f, s)
        torque = jax.vmap(lambda x, v: wheel_torque(robot, frame, x, v, f, s))(xi, w)
        return xi, jax.vmap(robot.motor.current)(torque, w)

    return jax.vmap(one)(dt, speed, floor, load)


def _poses(
    robot: Robot,
    drives: Sequence[Drive],
    s: Sensors,
    dt: Float[np.ndarray, "run step"],
    speed: Float[np.ndarray, "run step wheel"],
    xi: Float[np.ndarray, "run step 3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "run row 3"]:
    """Body poses with process noise and run effects, centred on the origin of the camera."""
    back = np.linalg.pinv(np.asarray(robot.geometry.forward()))
    step = speed * dt[..., None] * float(robot.geometry.wheel_radius) @ back.T
    far = np.linalg.norm(step[..., :2], axis=-1)
    u = np.where(far[..., None] > 0, step[..., :2] / np.maximum(far, 1e-12)[..., None], [1.0, 0.0])
    far = far + np.abs(step[..., 2]) * float(robot.geometry.base_radius)
    drawn = []
    for part in ("along", "across", "yaw"):
        grown = np.array([s.of(f"process.{d.surface}.{part}") for d in drives])[:, None]
        level = np.array([s.of(f"run.{d.surface}.{part}") for d in drives])[:, None]
        noise = grown * np.sqrt(far) * rng.normal(size=far.shape)
        drawn.append(noise + level * far * rng.normal(size=(len(drives), 1)))
    along, across, yaw = drawn
    extra = np.stack(
        [u[..., 0] * along - u[..., 1] * across, u[..., 1] * along + u[..., 0] * across, yaw], -1
    )
    start = np.zeros((len(drives), 3))
    start[:, 2] = rng.uniform(-0.1, 0.1, len(drives))
    pose = np.array(_paths(jnp.asarray(xi + extra / dt[..., None]), jnp.asarray(dt), start))
    pose[..., :2] -= 0.5 * (pose[:, -1:, :2] + pose[:, :1, :2])
    return pose


@jax.jit
def _paths(xi: Array, dt: Array, start: Array) -> Array:
    return jax.vmap(path)(xi, dt, start)


def _camera(
    robot: Robot,
    drives: Sequence[Drive],
    s: Sensors,
    time: Float[np.ndarray, "run row"],
    pose: Float[np.ndarray, "run row 3"],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Logged poses (run, row, 3) and whether each row brings a new frame."""
    lag, n = float(robot.camera.lag), len(drives)
    at = np.empty_like(time)
    fresh = np.ones(time.shape, bool)
    for k in range(n):
        frames = np.arange(time[k, 0] - 1.0, time[k, -1] + 1.0, s.frame_period)
        frames += rng.uniform(0, s.frame_period)
        newest = np.searchsorted(frames, time[k]) - 1
        fresh[k, 1:] = np.diff(newest) > 0
        age = time[k] - frames[newest] - 0.5 * s.row_period if s.free_frames else 0.0
        at[k] = time[k] - lag - age
    yaw = np.array([float(robot.camera.yaw(robot.session_index(d.session))) for d in drives])
    marker = np.empty_like(pose)
    for c in range(3):
        for k in range(n):
            marker[k, :, c] = np.interp(at[k], time[k], pose[k, :, c])
    logged = np.asarray(_as_logged(robot, jnp.asarray(marker), jnp.asarray(yaw)))
    logged = logged + rng.normal(size=logged.shape) * np.array(
        [s.of("camera.place"), s.of("camera.place"), s.of("camera.heading")]
    )
    rows = np.arange(time.shape[1])
    last = np.maximum.accumulate(np.where(fresh, rows, 0), axis=1)
    return np.take_along_axis(logged, last[..., None], axis=1), fresh


@jax.jit
def _as_logged(robot: Robot, pose: Array, yaw: Array) -> Array:
    """What the camera logs of true body poses."""

    def one(body: Array, psi: Array) -> Array:
        return robot.camera.logged(compose(body, jnp.stack([*robot.camera.marker_place, psi])))

    return jax.vmap(lambda run, psi: jax.vmap(lambda p: one(p, psi))(run))(pose, yaw)


def _electric(
    robot: Robot,
    drives: Sequence[Drive],
    s: Sensors,
    speed: Float[np.ndarray, "run step wheel"],
    amps: Float[np.ndarray, "run step wheel"],
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Logged current magnitudes [A], voltages [V] and reported speeds [rad/s] (run, row, wheel)."""
    level = np.array([s.of(f"current.{d.surface}.run") for d in drives])[:, None, None]
    amps = amps + level * rng.normal(size=(len(drives), 1, amps.shape[2])) * (speed != 0)
    true, w = _at_rows(amps), _at_rows(speed)
    measured = np.abs(true + s.ripple * rng.normal(size=true.shape))
    current = np.round((measured + float(robot.motor.current_offset)) / s.current_step)
    noise = s.voltage_noise * rng.normal(size=true.shape)
    held = np.asarray(robot.motor.voltage(jnp.asarray(true), jnp.asarray(w))) + noise
    voltage = np.round(held / s.voltage_step) * s.voltage_step if s.has_voltage else None
    quantum = 2.83 / robot.geometry.gear_ratio  # as a Robotino reports it, 1.3 % high
    return current * s.current_step, voltage, np.round(1.013 * w / quantum) * quantum


def _at_rows(x: Float[np.ndarray, "run step wheel"]) -> Float[np.ndarray, "run row wheel"]:
    """What a sensor reads at the rows between steps: the mean of the two steps that meet there."""
    ends = np.concatenate([x[:, :1], x, x[:, -1:]], axis=1)
    return 0.5 * (ends[:, 1:] + ends[:, :-1])
