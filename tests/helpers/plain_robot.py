"""Logs of wheeled robots from a few lines of numpy that share nothing with slipid's model.

Wheels follow commands after a delay; floors let every wheel's push through in part; encoders,
poses, gyro and ammeters are rounded, late and noisy.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.data.runs import Runs, collect
from slipid.model import geometry as g
from slipid.model.geometry import Geometry

PERIOD = 0.04
DELAY = 0.12
RADIUS = 0.05
GEAR = 16.0
TICKS = 2000.0
BASE = 0.2
LENGTH, WIDTH = 0.2, 0.15
OHM, VOLT_S = 0.8, 0.5


@dataclass
class Raw:
    """One run as it was recorded: what mistakes are made in."""

    time: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    command: np.ndarray
    twist: np.ndarray
    current: np.ndarray
    voltage: np.ndarray
    gyro: np.ndarray
    pose: np.ndarray
    has: frozenset[str] = field(
        default=frozenset({"speed", "command", "twist", "current", "voltage", "gyro"})
    )

    def less(self, *channels: str) -> "Raw":
        return replace(self, has=self.has - set(channels))


@dataclass(frozen=True, eq=False)
class Drive:
    """Turns of the wheels per twist (wheel, 3), what it is declared as, and how it scrubs."""

    name: str
    rolling: np.ndarray
    geometry: Geometry
    sideways: bool
    scrub: float


def _omni() -> Drive:
    a = np.radians([60.0, 180.0, 300.0])
    rolling = np.stack([-np.sin(a), np.cos(a), np.full(3, BASE)], axis=1) / RADIUS
    return Drive("omni", rolling, g.omni([60.0, 180.0, 300.0], BASE, RADIUS, GEAR), True, 1.0)


def _mecanum() -> Drive:
    k = LENGTH + WIDTH
    rolling = np.array([[1, -1, -k], [1, 1, k], [1, 1, -k], [1, -1, k]]) / RADIUS
    return Drive("mecanum", rolling, g.mecanum(LENGTH, WIDTH, RADIUS, GEAR), True, 1.0)


def _skid() -> Drive:
    rolling = np.array([[1, 0, -WIDTH], [1, 0, WIDTH], [1, 0, -WIDTH], [1, 0, WIDTH]]) / RADIUS
    return Drive("skid", rolling, g.skid_steer(LENGTH, WIDTH, RADIUS, GEAR), False, 1.6)


OMNI, MECANUM, SKID = DRIVES = (_omni(), _mecanum(), _skid())


def drive(of: Drive, runs: int = 6, seed: int = 0, speed: float = 0.3) -> list[Raw]:
    """Runs in all directions, of about eight seconds each."""
    rng = np.random.default_rng(seed)
    return [_run(of, rng, speed) for _ in range(runs)]


def _run(of: Drive, rng: np.random.Generator, speed: float) -> Raw:
    time = np.arange(0.0, 8.0, PERIOD) + rng.uniform(0, 0.004, 200).cumsum() * 0.1
    rows = len(time)
    twist = np.zeros((rows, 3))
    edges = [8, *sorted(rng.choice(np.arange(25, rows - 25), 3, replace=False)), rows - 10]
    for a, b in pairwise(edges):
        way = rng.uniform(-np.pi, np.pi)
        v = speed * rng.uniform(0.5, 1.0)
        sideways = v * np.sin(way) if of.sideways else 0.0
        ahead = v * np.cos(way) if of.sideways else v * rng.choice([-1, 1])
        twist[a:b] = ahead, sideways, rng.uniform(0.3, 1.2) * rng.choice([-1, 1])
    command = twist @ of.rolling.T
    late = np.stack([np.interp(time - DELAY, time, c, left=0.0) for c in command.T], axis=1)
    wheel = np.zeros_like(late)
    for k in range(1, rows):  # a speed loop of the first order
        wheel[k] = wheel[k - 1] + (late[k] - wheel[k - 1]) * min(1.0, PERIOD / 0.08)
    grip = 1.0 - rng.uniform(0.1, 0.4) - rng.uniform(-0.05, 0.05, len(of.rolling))
    body = (wheel * grip) @ np.linalg.pinv(of.rolling, rcond=1e-6).T
    body[:, 2] /= of.scrub
    heading = rng.uniform(-3.0, 3.0) + np.cumsum(body[:, 2]) * PERIOD
    c, s = np.cos(heading), np.sin(heading)
    velocity = np.stack([c * body[:, 0] - s * body[:, 1], s * body[:, 0] + c * body[:, 1]], axis=1)
    place = rng.uniform(-2, 2, 2) + np.cumsum(velocity, axis=0) * PERIOD
    pose = np.concatenate([place, heading[:, None]], axis=1)
    pose = np.stack([np.interp(time - 0.06, time, p) for p in pose.T], axis=1)
    pose += rng.normal(0, [0.002, 0.002, 0.005], pose.shape)
    turned = np.cumsum(wheel, axis=0) * PERIOD
    tick = 2 * np.pi / (TICKS * GEAR)
    amps = 0.8 * np.tanh(wheel) + 0.15 * wheel + rng.normal(0, 0.1, wheel.shape)
    return Raw(
        time=time - time[0],
        angle=np.round(turned / tick) * tick,
        speed=np.round(wheel / 0.05) * 0.05 + rng.normal(0, 0.02, wheel.shape),
        command=command,
        twist=twist,
        current=np.round(amps / 0.025) * 0.025,
        voltage=OHM * amps + VOLT_S * wheel,
        gyro=body[:, 2] + rng.normal(0, 0.02, rows),
        pose=pose,
    )


def as_runs(raws: Sequence[Raw], signed: bool = True) -> Runs:
    """The runs as a reader would give them."""
    return collect([_as_log(raw, f"run_{k:02d}.csv", signed) for k, raw in enumerate(raws)])


def _as_log(raw: Raw, name: str, signed: bool) -> Log:
    def maybe(channel: str) -> np.ndarray | None:
        return getattr(raw, channel) if channel in raw.has else None

    fresh = np.any(np.diff(raw.pose, axis=0, prepend=raw.pose[:1] - 1.0) != 0, axis=1)
    return Log(
        name=name,
        path=Path(name),
        sha256="0",
        time=raw.time,
        wheel_angle=raw.angle - raw.angle[0],
        wheel_speed=maybe("speed"),
        wheel_speed_command=maybe("command"),
        twist_command=maybe("twist"),
        current=maybe("current"),
        current_is_signed=signed,
        voltage=maybe("voltage"),
        gyro=maybe("gyro"),
        pose=raw.pose,
        pose_fresh=fresh,
        surface="floor",
        load="as_built",
    )
