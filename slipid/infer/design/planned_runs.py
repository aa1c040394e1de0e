"""Planned runs: their commands, grids of runs, and the windows that are simulated for them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.infer.result import Channels
from slipid.model.motor import sign_of_motion
from slipid.model.robot import Robot
from slipid.predict.open_loop import chain

SESSION = "next"
"""Name of the session of new runs, for which the marker is mounted anew."""
HEADINGS = tuple(15.0 * k for k in range(24))
"""Default headings of candidate runs and of predictions [deg]."""
BEND_RATIO = 0.5
"""Ratio of yaw rate times base radius to speed in curved candidate runs."""

Setup = tuple[str, str]
"""A floor and a load set-up."""


@dataclass(frozen=True)
class PlannedRun:
    """One run: a constant command on one floor with one load set-up.

    Attributes:
        surface: name of the floor.
        load: name of the load set-up.
        heading: direction of travel in the body frame [rad].
        speed: commanded speed [m/s].
        turn: commanded yaw rate [rad/s].
        distance: commanded path length, or arc length of the rim for a turn on the spot [m].
    """

    surface: str
    load: str
    heading: float
    speed: float
    turn: float = 0.0
    distance: float = 0.7

    @property
    def session(self) -> str:
        """Name of the session of the run; within a session, the marker is not remounted."""
        return f"{self.surface}/{self.load}/{self.speed:.2f}"

    @property
    def command(self) -> Float[np.ndarray, "3"]:
        """Body twist [m/s, m/s, rad/s]."""
        ahead, left = np.cos(self.heading), np.sin(self.heading)
        return np.array([self.speed * ahead, self.speed * left, self.turn])

    def seconds(self, base_radius: float) -> float:
        """Return the duration [s] for a robot with this base radius [m]."""
        return self.distance / (self.speed or abs(self.turn) * base_radius)


def candidates(
    setups: Iterable[Setup],
    speeds: Mapping[str, Sequence[float]],
    distance: Mapping[str, float],
    base_radius: float,
    headings_deg: Sequence[float] = HEADINGS,
    turns: Sequence[float] | None = None,
) -> tuple[PlannedRun, ...]:
    """Return candidates: straight and curved runs in all headings and speeds, turns on the spot.

    Args:
        setups: floors and load set-ups.
        speeds: speeds, keyed by floor [m/s].
        distance: path length, keyed by floor [m].
        base_radius: distance of the wheels from the robot's centre [m].
        headings_deg: directions of travel [deg].
        turns: yaw rates [rad/s]. By default, runs with a speed have zero and plus or minus
            `BEND_RATIO` * speed / base radius; turns on the spot have plus or minus speed / base
            radius.
    """
    out = []
    for surface, load in setups:
        length = distance[surface]
        for speed in speeds[surface]:
            bend = BEND_RATIO * speed / base_radius
            rates = (0.0, bend, -bend) if turns is None else turns
            if speed > 0:
                found = product(np.radians(headings_deg), rates)
                out += [PlannedRun(surface, load, float(a), speed, t, length) for a, t in found]
            spin = (speed / base_radius, -speed / base_radius) if turns is None else turns
            out += [PlannedRun(surface, load, 0.0, 0.0, t, length) for t in spin if t != 0]
    return tuple(dict.fromkeys(out))


def paper_grid(setups: Iterable[Setup], distance: Mapping[str, float]) -> tuple[PlannedRun, ...]:
    """Return the 36 commands of the 2021 paper, each with every set-up before the next command.

    The commands are straight runs along x and y at 100 to 400 mm/s and along the diagonals at 100
    to 300 mm/s per axis, and turns on the spot at 20 to 50 deg/s. Source: Belyaev, Brylev and
    Ivanov 2021, commands in their logs.
    """
    settings = [(a, v, 0.0) for v in (0.1, 0.2, 0.3, 0.4) for a in (0.0, 180.0, 90.0, 270.0)]
    settings += [(0.0, 0.0, s * rate) for rate in (20.0, 30.0, 40.0, 50.0) for s in (1, -1)]
    ahead = [float(np.hypot(v, v)) for v in (0.1, 0.2, 0.3)]
    settings += [(a, v, 0.0) for v in ahead for a in (45.0, 225.0, 135.0, 315.0)]
    return tuple(
        PlannedRun(f, load, float(np.radians(a)), speed, float(np.radians(turn)), distance[f])
        for (a, speed, turn), (f, load) in product(settings, setups)
    )


def heading_grid(
    setups: Iterable[Setup], speeds: Mapping[str, Sequence[float]], distance: Mapping[str, float]
) -> tuple[PlannedRun, ...]:
    """Return straight runs in headings 5 degrees apart at every speed, as in the 2022 logs.

    docs/history.md describes these logs.
    """
    headings = np.radians(np.arange(0.0, 360.0, 5.0))
    return tuple(
        PlannedRun(f, load, float(heading), speed, 0.0, distance[f])
        for heading, (f, load) in product(headings, setups)
        for speed in speeds[f]
        if speed > 0
    )


def drivable(runs: Iterable[PlannedRun], robot: Robot) -> tuple[PlannedRun, ...]:
    """Return the runs whose commanded twist the wheels can produce."""
    j = np.asarray(robot.geometry.forward())
    reach = np.linalg.pinv(j, rcond=1e-6) @ j
    base = np.array([1.0, 1.0, float(robot.geometry.base_radius)])

    def fits(d: PlannedRun) -> bool:
        lost = (reach @ d.command - d.command) * base
        return bool(np.linalg.norm(lost) < 0.05 * np.linalg.norm(d.command * base))

    return tuple(filter(fits, runs))


def steady_windows(
    runs: Sequence[PlannedRun],
    robot: Robot,
    channels: Channels,
    session: str = SESSION,
) -> Windows:
    """Return noise-free windows of runs at steady wheel speeds, one segment per run.

    A run of any length is one segment, as it has one run effect. Runs are centred in the image, and
    the marker's heading is zero at the start of each run. Currents have no ammeter noise, since
    this noise is not known beforehand and averages out over a window.
    """
    n, per_piece, motors = len(runs), channels.windows, robot.geometry.drives
    base, radius = float(robot.geometry.base_radius), float(robot.geometry.wheel_radius)
    command = np.stack([d.command for d in runs])
    rate = command @ np.asarray(robot.geometry.forward()).T / radius
    dt = np.array([d.seconds(base) for d in runs])[:, None] / per_piece * np.ones((n, per_piece))
    blank = np.zeros((n, per_piece, motors))
    w = Windows(
        run=np.arange(n),
        surface=tuple(d.surface for d in runs),
        load=tuple(d.load for d in runs),
        session=(session,) * n,
        start=np.zeros(n),
        dt=dt,
        turn=dt[..., None] * rate[:, None],
        speed_change=blank,
        direction=np.broadcast_to(sign_of_motion(rate[:, None]), blank.shape),
        pose=np.zeros((n, per_piece + 1, 3)),
        current=blank,
        voltage=blank,
        current_var=blank,
        voltage_var=blank,
        has_current=channels.current,
        has_voltage=channels.voltage,
        current_is_signed=channels.signed,
        lag=float(robot.camera.lag),
    )
    pose, amps, volts = _sensed(robot, lk.batch(w, robot))
    return replace(
        w,
        pose=np.asarray(pose),
        current=np.asarray(amps) if channels.current else blank,
        voltage=np.asarray(volts) if channels.voltage else blank,
    )


@jax.jit
def _sensed(robot: Robot, b: lk.Batch) -> tuple[Array, Array, Array]:
    """Return what ideal sensors would log in windows: marker poses, currents and voltages."""
    p = lk.predict(robot, b)
    path = chain(jnp.zeros((b.dt.shape[0], 3)), p.increment)
    middle = 0.5 * (path[:, :1, :2] + path[:, -1:, :2])
    pose = jax.vmap(jax.vmap(robot.camera.logged))(path.at[..., :2].add(-middle))
    amps = lk.predicted_current(robot, b, p.motor_force)
    speed = lk.wheel_speed(robot, b)
    flow = amps - robot.motor.current_offset
    volts = robot.motor.voltage(flow if b.signed else flow * sign_of_motion(speed), speed)
    return pose, amps, volts
