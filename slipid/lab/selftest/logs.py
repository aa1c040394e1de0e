"""Simulation of logs of a robot whose parameters are all known, for self tests and tests.

The runs are a grid of straight and turning runs, such as those of a Robotino under an overhead
camera. The noise has the components of the likelihood: noise of the camera, noise of the motion
(which grows with distance), and a constant error of the motion and of the currents of each run. In
addition, the logs have features of real logs that the likelihood does not model: encoder ticks,
quantised unsigned currents with ripple, quantised voltages, repeated camera frames, uneven rows,
and a delayed and ramped start.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.log import Log
from slipid.data.wheel_signals import interpolate
from slipid.fitting.shared_effects import AXES
from slipid.infer.design.planned_runs import PlannedRun
from slipid.model.geometry import omni
from slipid.model.robot import Robot, build, steady_states
from slipid.model.se2 import compose, path
from slipid.parameter import entries
from slipid.search_space import Choice, Space
from slipid.support.blocks import in_blocks


def true_numbers(robot: Robot) -> dict[str, float | list[float]]:
    """Return the value of every parameter of a robot as plain numbers, keyed by path."""
    return {e.path: np.asarray(e.get(robot)).tolist() for e in entries(robot)}


_FLOORS = {
    "friction": (0.5, 0.8),
    "creep": (0.15, 0.45),
    "roller_drag": (0.18, 0.33),
    "roller_creep": (0.25, 0.2),
    "rolling_resistance": (0.008, 0.02),
    "slide_viscosity": (0.03, 0.05),
    "roller_viscosity": (0.03, 0.05),
    "scrub": (0.001, 0.002),
    "lead": (0.0015, 0.0045),
}
"""True surface parameters of the floors "firm" and "soft" in SI units, keyed by name."""
TRUTH: dict[str, float | tuple[float, ...]] = {
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
    **{f"surface.firm.{name}": firm for name, (firm, _) in _FLOORS.items()},
    **{f"surface.soft.{name}": soft for name, (_, soft) in _FLOORS.items()},
}
"""True parameters of the default robot in SI units, keyed by path.

They have the magnitudes found on real logs. All other parameters have their declared start
values."""


def nominal_robot(drives: Sequence[PlannedRun]) -> Robot:
    """Return a Robotino with declared start values and the floors, loads, sessions of a plan."""
    return build(
        omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0),
        sorted({d.surface for d in drives}),
        tuple(dict.fromkeys(d.load for d in drives)),
        sorted({d.session for d in drives}),
    )


def true_robot(
    drives: Sequence[PlannedRun], values: Mapping[str, float | Sequence[float]] | None = None
) -> Robot:
    """Return a Robotino with the parameters `TRUTH`, some of them replaced by `values`."""
    robot = nominal_robot(drives)
    known = {e.path for e in entries(robot)}
    values = {**TRUTH, **(values or {})}
    return Space(robot, [Choice(p, fixed=v) for p, v in values.items() if p in known]).template


def heading_grid(
    setups: Sequence[tuple[str, str]],
    headings: int = 12,
    speeds: Sequence[float] = (0.1, 0.2),
    turns: int = 2,
) -> tuple[PlannedRun, ...]:
    """Return straight runs and curves at each speed on each (floor, load).

    At each speed [m/s] there are straight runs in `headings` directions, and `turns` curves.
    """
    drives = []
    for (surface, load), speed in product(setups, speeds):
        angles = 2 * np.pi * np.arange(headings) / headings
        drives += [PlannedRun(surface, load, float(angle), speed) for angle in angles]
        angles = 2 * np.pi * (np.arange(turns) + 0.5) / max(turns, 1)
        drives += [
            PlannedRun(surface, load, float(angle), speed, turn=(-1) ** k * 4.0 * speed)
            for k, angle in enumerate(angles)
        ]
    return tuple(drives)


def turning_grid(
    setups: Sequence[tuple[str, str]], count: int, speeds: Sequence[float], base_radius: float
) -> tuple[PlannedRun, ...]:
    """Return runs of a robot that cannot drive sideways, at each speed on each (floor, load).

    At each speed [m/s] there are `count` runs, from straight ahead to turning on the spot. Their
    commands (forward speed, turn rate times base radius) [m/s] are evenly spaced on a circle whose
    radius is the speed.
    """
    drives = []
    angles = (2 * np.pi * np.arange(count) / count).tolist()
    for (surface, load), speed, angle in product(setups, speeds, angles):
        # rounded, since the computed cosine of a right angle is not exactly zero
        ahead, turn = (round(speed * float(f(angle)), 9) for f in (np.cos, np.sin))
        back = 0.0 if ahead >= 0 else np.pi
        drives.append(PlannedRun(surface, load, back, abs(ahead), turn=turn / base_radius))
    return tuple(drives)


@dataclass(frozen=True)
class SimulatedSensors:
    """Noise, sampling and quantisation of simulated logs.

    Attributes:
        std: std of each variance component, keyed by its name in `slipid.fitting.noise.noise`; a
            key with `floor` instead of a floor's name holds for every floor without an entry.
        ripple: std of the current's noise from row to row [A].
        voltage_noise: std of the voltage's noise from row to row [V].
        current_step, voltage_step: steps of the analogue-to-digital converters [A], [V].
        ticks: encoder ticks per turn of the motor.
        row_period, frame_period: time between rows and between camera frames [s].
        delay, ramp: time from command to motion, and from there to full speed [s].
        wobble: amplitude of an oscillation of the wheel angle, divided by the wheel speed [s]; it
            imitates the speed control, which is never perfectly steady.
        has_voltage: True if voltages are logged.
        signed: True if currents are logged with sign, False for magnitudes.
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
    signed: bool = False

    def of(self, name: str) -> float:
        """Return the std of the variance component of this name; 0 if `std` has no entry for it."""
        head, _, last = name.partition(".")
        of_any_floor = f"{head}.floor.{last.split('.')[-1]}"
        return self.std.get(name, self.std.get(of_any_floor, 0.0))


def simulate_logs(
    robot: Robot, drives: Sequence[PlannedRun], seed: int, sensors: SimulatedSensors | None = None
) -> list[Log]:
    """Return simulated logs of planned runs on floors, loads and sessions that the robot has."""
    return _LogSimulator(
        robot, drives, sensors or SimulatedSensors(), np.random.default_rng(seed)
    ).logs()


@dataclass(frozen=True, eq=False)
class _LogSimulator:
    """Simulator of the logs of all runs at once; its arrays have shape (run, row or step, ...)."""

    robot: Robot
    drives: Sequence[PlannedRun]
    sensors: SimulatedSensors
    random: np.random.Generator

    def logs(self) -> list[Log]:
        robot, drives, s = self.robot, self.drives, self.sensors
        base = float(robot.geometry.base_radius)
        seconds = [d.seconds(base) + s.delay + s.ramp for d in drives]
        time, angle = self.wheels(int(np.ceil(max(seconds) / s.row_period)) + 2)
        dt = np.diff(time, axis=1)
        speed = np.diff(angle, axis=1) / dt[..., None]
        floor, load = (
            np.repeat(each, dt.shape[1])
            for each in (
                [robot.surface_index(d.surface) for d in drives],
                [robot.load_index(d.load) for d in drives],
            )
        )
        steady = steady_states(robot, speed.reshape(-1, speed.shape[-1]), floor, load)
        xi, amps = steady.twist.reshape(*dt.shape, 3), steady.current.reshape(speed.shape)
        pose, fresh = self.camera(time, self.poses(dt, speed, xi))
        channels = self.electric(speed, amps)
        tick = 2 * np.pi / (s.ticks * robot.geometry.gear_ratio)
        out = []
        for k, d in enumerate(drives):
            n = int(np.searchsorted(time[k], seconds[k]))
            whole = np.floor(angle[k, :n] / tick) * tick
            current, voltage, reported = (None if c is None else c[k, :n] for c in channels)
            name = f"{d.load}/{d.surface}/run{k:03d}.csv"
            out.append(
                Log(
                    name=name,
                    path=Path(name),
                    sha256=hashlib.sha256(whole.tobytes() + pose[k, :n].tobytes()).hexdigest(),
                    time=time[k, :n],
                    wheel_angle=whole - whole[0],
                    wheel_speed=reported,
                    twist_command=np.tile(d.command, (n, 1)),
                    current=current,
                    current_is_signed=s.signed,
                    voltage=voltage,
                    pose=pose[k, :n],
                    pose_fresh=fresh[k, :n],
                    surface=d.surface,
                    load=d.load,
                )
            )
        return out

    def wheels(self, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the times [s] and the true wheel angles [rad] of `rows` rows of every run."""
        s, n, j = self.sensors, len(self.drives), np.asarray(self.robot.geometry.forward())
        radius = float(self.robot.geometry.wheel_radius)
        want = np.stack([d.command for d in self.drives]) @ j.T / radius
        uneven = self.random.uniform(0.9, 1.1, (n, rows))
        time = np.cumsum(uneven * s.row_period, axis=1)
        time -= time[:, :1]
        x = np.clip((time - s.delay) / s.ramp, 0.0, 1.0)
        moved = s.ramp * (x**3 - x**4 / 2) + np.clip(time - s.delay - s.ramp, 0.0, None)
        phase = self.random.uniform(0, 2 * np.pi, (n, 1, want.shape[1]))
        swing = s.wobble * np.sin(2 * np.pi * 2.0 * time[..., None] + phase) * x[..., None]
        return time, want[:, None] * (moved[..., None] + swing)

    def poses(
        self,
        dt: Float[np.ndarray, "run step"],
        speed: Float[np.ndarray, "run step wheel"],
        xi: Float[np.ndarray, "run step 3"],
    ) -> Float[np.ndarray, "run row 3"]:
        """Return true body poses, whose motion includes process noise and run effects.

        Start and end of each run lie opposite each other about the camera's origin.
        """
        s, shape, rng = self.sensors, self.robot.geometry, self.random
        back = np.asarray(shape.pseudo_inverse())
        step = speed * dt[..., None] * float(shape.wheel_radius) @ back.T
        distance = np.linalg.norm(step[..., :2], axis=-1)[..., None]
        u = np.where(distance > 0, step[..., :2] / np.maximum(distance, 1e-12), [1.0, 0.0])
        distance = distance[..., 0] + np.abs(step[..., 2]) * float(shape.base_radius)
        drawn = []
        for part in AXES:
            grown, level = (
                np.array([s.of(f"{kind}.{d.surface}.{part}") for d in self.drives])[:, None]
                for kind in ("process", "run")
            )
            noise = grown * np.sqrt(distance) * rng.normal(size=distance.shape)
            drawn.append(noise + level * distance * rng.normal(size=(len(distance), 1)))
        along, across, yaw = drawn
        x, y = u[..., 0], u[..., 1]
        extra = np.stack([x * along - y * across, y * along + x * across, yaw], -1)
        start = np.zeros((len(distance), 3))
        start[:, 2] = rng.uniform(-0.1, 0.1, len(distance))
        pose = np.array(_paths(jnp.asarray(xi + extra / dt[..., None]), jnp.asarray(dt), start))
        pose[..., :2] -= 0.5 * (pose[:, -1:, :2] + pose[:, :1, :2])
        return pose

    def camera(
        self, time: Float[np.ndarray, "run row"], pose: Float[np.ndarray, "run row 3"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the logged poses, and for each row True if it has a new camera frame."""
        robot, s, rng = self.robot, self.sensors, self.random
        fresh, marker = np.ones(time.shape, bool), np.empty_like(pose)
        for k, t in enumerate(time):
            frames = np.arange(t[0] - 1.0, t[-1] + 1.0, s.frame_period)
            frames += rng.uniform(0, s.frame_period)
            newest = np.searchsorted(frames, t) - 1
            fresh[k, 1:] = np.diff(newest) > 0
            at = t - float(robot.camera.lag)  # time at which a frame logged at t was taken
            marker[k] = interpolate(t, pose[k], at)
        session = [robot.session_index(d.session) for d in self.drives]
        yaw = np.array([float(robot.camera.yaw(k)) for k in session])
        every = marker.reshape(-1, 3), np.repeat(yaw, marker.shape[1])
        logged = in_blocks(partial(_as_logged, robot), *every).reshape(marker.shape)
        std = [s.of(f"camera.{part}") for part in ("place", "place", "heading")]
        logged = logged + rng.normal(size=logged.shape) * np.array(std)
        rows = np.arange(time.shape[1])
        last = np.maximum.accumulate(np.where(fresh, rows, 0), axis=1)
        return np.take_along_axis(logged, last[..., None], axis=1), fresh

    def electric(
        self, speed: Float[np.ndarray, "run step wheel"], amps: Float[np.ndarray, "run step wheel"]
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Return logged currents [A], voltages [V] or None, and reported wheel speeds [rad/s].

        Currents are magnitudes unless `sensors.signed`.
        """
        s, motor, rng = self.sensors, self.robot.motor, self.random
        level = np.array([s.of(f"current.{d.surface}.run") for d in self.drives])[:, None, None]
        amps = amps + level * rng.normal(size=(len(amps), 1, amps.shape[2])) * (speed != 0)
        true, w = _row_means(amps), _row_means(speed)
        measured = true + s.ripple * rng.normal(size=true.shape)
        measured = measured if s.signed else np.abs(measured)
        current = np.round((measured + float(motor.current_offset)) / s.current_step)
        noise = s.voltage_noise * rng.normal(size=true.shape)
        held = np.asarray(motor.voltage(jnp.asarray(true), jnp.asarray(w))) + noise
        voltage = np.round(held / s.voltage_step) * s.voltage_step if s.has_voltage else None
        # report wheel speeds as a Robotino does: in steps of `quantum`, and 1.3 % too high
        quantum = 2.83 / self.robot.geometry.gear_ratio
        return current * s.current_step, voltage, np.round(1.013 * w / quantum) * quantum


_paths = jax.jit(jax.vmap(path))


@jax.jit
def _as_logged(robot: Robot, pose: Array, yaw: Array) -> Array:
    """Return the poses that the camera logs, without noise, for true poses of the body.

    `yaw` is the heading of the marker in the body frame at each pose [rad].
    """

    def one(body: Array, psi: Array) -> Array:
        return robot.camera.logged(compose(body, jnp.stack([*robot.camera.marker_place, psi])))

    return jax.vmap(one)(pose, yaw)


def _row_means(x: Float[np.ndarray, "run step wheel"]) -> Float[np.ndarray, "run row wheel"]:
    """Return values at rows from values of steps: the mean of the steps before and after a row."""
    ends = np.concatenate([x[:, :1], x, x[:, -1:]], axis=1)
    return 0.5 * (ends[:, 1:] + ends[:, :-1])
