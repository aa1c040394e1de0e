"""Logs made from a robot whose every number is known: for the demo and for tests of recovery.

Straight and turning runs of a grid like a Robotino's under an overhead camera. The noise is the one
the likelihood assumes (camera, process growing with distance, run effects, current level per run);
on top of it come the traps of real logs it does not know of: ticks, quantised unsigned currents
with ripple, quantised voltages, repeated camera frames, uneven rows, a delayed and ramped start.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.log import Log
from slipid.model.geometry import omni
from slipid.model.robot import Robot, build, compose, wheel_torque
from slipid.model.rollout import path, replay_twist
from slipid.parameter import Choice, Space, entries

ROBOTINO = (60.0, 180.0, 300.0)
"""Azimuths of the wheels [deg]."""


@dataclass(frozen=True)
class Drive:
    """One run: a constant command on one floor with one load set-up.

    Attributes:
        heading: of the commanded motion in the body frame [rad]; speed: [m/s]; turn: [rad/s].
        distance: commanded length [m], arc of the rim where it only turns.
    """

    surface: str
    load: str
    heading: float
    speed: float
    turn: float = 0.0
    distance: float = 0.7

    @property
    def session(self) -> str:
        """Time in which the marker stayed as it was, as `slipid.data.dataset` names it."""
        return f"{self.surface}/{self.load}/{self.speed:.2f}"


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
    """How the logs are disturbed; stds by the names of `slipid.identify.likelihood.noise`.

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


TRUTH: dict[str, Any] = {
    "robot.mass": 12.0,
    "robot.load_share@as_built": (0.29, 0.42, 0.29),
    "robot.load_share@moved": (0.33, 0.35, 0.32),
    "motor.resistance": 5.5,
    "motor.back_emf": 0.0514,
    "motor.inductance": 8.9e-3,
    "motor.rotor_inertia": 7.1e-6,
    "motor.coulomb_friction": 0.07,
    "motor.viscous_friction": 0.006,
    "camera.scale": 1.117,
    "camera.lag": 0.056,
    "camera.marker_yaw": -0.015,
    "surface.firm.friction": 0.5,
    "surface.firm.creep": 0.15,
    "surface.firm.roller_drag": 0.18,
    "surface.firm.roller_creep": 0.25,
    "surface.firm.rolling_resistance": 0.008,
    "surface.firm.slide_viscosity": 0.03,
    "surface.firm.roller_viscosity": 0.03,
    "surface.firm.scrub": 0.001,
    "surface.firm.lead": 0.0015,
    "surface.soft.friction": 0.8,
    "surface.soft.creep": 0.45,
    "surface.soft.roller_drag": 0.33,
    "surface.soft.roller_creep": 0.2,
    "surface.soft.rolling_resistance": 0.02,
    "surface.soft.slide_viscosity": 0.05,
    "surface.soft.roller_viscosity": 0.05,
    "surface.soft.scrub": 0.002,
    "surface.soft.lead": 0.0045,
}
"""Numbers of the default robot [SI], the rest as declared; of the size found on real logs."""


def blank(drives: Sequence[Drive]) -> Robot:
    """Robotino at declared starts that knows the floors, loads and sessions of a plan."""
    return build(
        omni(list(ROBOTINO), 0.125, 0.04, 16.0),
        sorted({d.surface for d in drives}),
        tuple(dict.fromkeys(d.load for d in drives)),
        sorted({d.session for d in drives}),
    )


def truth(drives: Sequence[Drive], values: Mapping[str, Any] | None = None) -> Robot:
    """Robotino with the numbers of `TRUTH`, or others; what the plan does not need is left out."""
    robot = blank(drives)
    known = {e.path for e in entries(robot)}
    values = {**TRUTH, **(values or {})}
    return Space(robot, [Choice(p, fixed=v) for p, v in values.items() if p in known]).template


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
    longest = max(_duration(d, robot) for d in drives) + sensors.delay + sensors.ramp
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
        n = int(np.searchsorted(time[k], _duration(d, robot) + sensors.delay + sensors.ramp))
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
                wheel_speed_command=None,
                twist_command=np.tile(_command(d), (n, 1)),
                current=current,
                current_is_signed=False,
                voltage=voltage,
                duty=None,
                bus_voltage=None,
                gyro=None,
                pose=seen[k, :n],
                pose_fresh=fresh[k, :n],
                surface=d.surface,
                load=d.load,
            )
        )
    return logs


def _command(d: Drive) -> np.ndarray:
    return np.array([d.speed * np.cos(d.heading), d.speed * np.sin(d.heading), d.turn])


def _duration(d: Drive, robot: Robot) -> float:
    return d.distance / (d.speed + abs(d.turn) * float(robot.geometry.base_radius) * (d.speed == 0))


def _wheels(
    robot: Robot, drives: Sequence[Drive], s: Sensors, rows: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Times (run, row) and true wheel angles (run, row, wheel)."""
    n, j = len(drives), np.asarray(robot.geometry.forward())
    want = np.stack([_command(d) for d in drives]) @ j.T / float(robot.geometry.wheel_radius)
    uneven = rng.uniform(0.9, 1.1, (n, rows))
    time = np.cumsum(uneven * s.row_period, axis=1)
    time -= time[:, :1]
    x = np.clip((time - s.delay) / s.ramp, 0.0, 1.0)
    moved = s.ramp * (x**3 - x**4 / 2) + np.clip(time - s.delay - s.ramp, 0.0, None)
    phase = rng.uniform(0, 2 * np.pi, (n, 1, want.shape[1]))
    swing = s.wobble * np.sin(2 * np.pi * 2.0 * time[..., None] + phase) * x[..., None]
    return time, want[:, None] * (moved[..., None] + swing)


@jax.jit
def _twists(robot: Robot, dt: Array, speed: Array, floor: Array, load: Array) -> Any:
    """Body twists and signed motor currents of every step of every run."""
    frame = robot.geometry.frame()

    def one(h: Array, w: Array, f: Array, s: Array) -> Any:
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
    """What the camera logs of true body poses: the inverse of its correction, by iteration."""

    def one(body: Array, psi: Array) -> Array:
        marker = compose(body, jnp.stack([*robot.camera.marker_place, psi]))
        q = marker.at[:2].divide(robot.camera.scale)
        for _ in range(12):
            gap = marker - robot.camera.corrected(q)
            q = q + gap / jnp.stack([robot.camera.scale, robot.camera.scale, jnp.ones(())])
        return q

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


LAYOUT: dict[str, Any] = {
    "ticks_per_revolution": 2000,
    "gear_ratio": 16,
    "current_is_signed": False,
    "columns": {
        "time": {"column": "time", "unit": "s"},
        "twist_command_x": {"column": "command_x", "unit": "m/s"},
        "twist_command_y": {"column": "command_y", "unit": "m/s"},
        "twist_command_yaw": {"column": "command_yaw", "unit": "rad/s"},
        "wheel_ticks": {"columns": ["ticks_1", "ticks_2", "ticks_3"], "unit": "tick"},
        "current": {"columns": ["current_1", "current_2", "current_3"], "unit": "A"},
        "voltage": {"columns": ["voltage_1", "voltage_2", "voltage_3"], "unit": "V"},
        "pose_x": {"column": "x", "unit": "mm"},
        "pose_y": {"column": "y", "unit": "mm"},
        "pose_heading": {"column": "heading", "unit": "deg"},
    },
}
"""Layout of the files `write_logs` writes, as a config declares it; `voltage = false` without."""


def write_logs(logs: Sequence[Log], robot: Robot, out: Path, truth_dir: Path) -> list[Path]:
    """Write `<load>/<surface>/runNNN.csv` below a folder, and truth.json into one of its own.

    Args:
        logs: as `make_logs` gives them.
        robot: the truth.
        out: data folder.
        truth_dir: folder for truth.json, so that nothing that reads logs can find it by accident.
    """
    paths = []
    for log in logs:
        target = out / log.name
        target.parent.mkdir(parents=True, exist_ok=True)
        _atomic(target, _csv(log, robot))
        paths.append(target)
    truth_dir.mkdir(parents=True, exist_ok=True)
    values = {
        e.path: {"value": np.asarray(e.get(robot)).tolist(), "unit": e.declaration.unit}
        for e in entries(robot)
    }
    text = json.dumps({"schema": "slipid.truth/1", "parameters": values}, indent=1)
    _atomic(truth_dir / "truth.json", text + "\n")
    return paths


def _csv(log: Log, robot: Robot) -> str:
    assert log.twist_command is not None
    assert log.current is not None
    assert log.pose is not None
    ticks = LAYOUT["ticks_per_revolution"] * robot.geometry.gear_ratio / (2 * np.pi)
    columns = [log.time[:, None], log.twist_command, np.round(log.wheel_angle * ticks), log.current]
    formats = ["%.4f", *["%.4f"] * 3, *["%d"] * log.wheels, *["%.4f"] * log.wheels]
    names = ["time", "command_x", "command_y", "command_yaw"]
    each = ["ticks", "current"]
    if log.voltage is not None:
        columns.append(log.voltage)
        formats += ["%.2f"] * log.wheels
        each.append("voltage")
    names += [f"{what}_{k + 1}" for what in each for k in range(log.wheels)]
    heading = np.degrees(log.pose[:, 2:])
    columns += [1000 * log.pose[:, :2], heading]
    formats += ["%.3f", "%.3f", "%.4f"]
    names += ["x", "y", "heading"]
    rows = np.concatenate(columns, axis=1)
    lines = [",".join(f % v for f, v in zip(formats, row, strict=True)) for row in rows]
    return "\n".join([",".join(names), *lines]) + "\n"


def _atomic(target: Path, text: str) -> None:
    part = target.with_name(target.name + ".part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, target)


def demo_logs(out: Path, truth_dir: Path, seed: int = 0, voltage: bool = True) -> list[Path]:
    """The demo's data: two floors, one of them with two load set-ups, two speeds.

    Args:
        out: data folder.
        truth_dir: folder of truth.json.
        seed: of the noise.
        voltage: whether the motor voltages are logged.
    """
    drives = grid()
    robot = truth(drives)
    sensors = replace(Sensors(), has_voltage=voltage)
    return write_logs(make_logs(robot, drives, seed, sensors), robot, out, truth_dir)
