"""Runs that could be driven: commands, grids of them, and the windows they would be logged as."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.windows import Windows
from slipid.fit import likelihood as lk
from slipid.infer.result import Channels
from slipid.model.robot import Robot
from slipid.predict.open_loop import chain

SESSION = "next"
"""The time in which new runs are driven: the marker is put on once more, and stays."""
HEADINGS = tuple(15.0 * k for k in range(24))
"""Headings of candidate runs and of predictions [deg]."""
BEND = 0.5
"""Rim speed of a curved candidate's turn, per speed ahead."""

Setup = tuple[str, str]
"""A floor and a load set-up."""


@dataclass(frozen=True)
class PlannedRun:
    """One run: a constant command on one floor with one load set-up.

    The heading of the motion is in the body frame [rad]; speed [m/s], turn [rad/s]; the distance is
    the commanded length [m], arc of the rim where it only turns.
    """

    surface: str
    load: str
    heading: float
    speed: float
    turn: float = 0.0
    distance: float = 0.7

    @property
    def session(self) -> str:
        """Time in which the marker stayed as it was, as `slipid.data.windows` names it."""
        return f"{self.surface}/{self.load}/{self.speed:.2f}"

    @property
    def command(self) -> Float[np.ndarray, "3"]:
        """Body twist [m/s, m/s, rad/s]."""
        ahead, left = np.cos(self.heading), np.sin(self.heading)
        return np.array([self.speed * ahead, self.speed * left, self.turn])

    def seconds(self, base_radius: float) -> float:
        """Duration [s] of a robot whose rim turns at this radius [m]."""
        return self.distance / (self.speed or abs(self.turn) * base_radius)


def candidates(
    setups: Iterable[Setup],
    speeds: Mapping[str, Sequence[float]],
    distance: Mapping[str, float],
    base_radius: float,
    headings_deg: Sequence[float] = HEADINGS,
    turns: Sequence[float] | None = None,
) -> tuple[PlannedRun, ...]:
    """Every heading at every speed of a floor, straight and turning, and turns on the spot.

    Speeds [m/s] and distances [m] are of each floor. Turning rates [rad/s] are by default none and
    those at which the rim turns with `BEND` of the speed ahead, and on the spot with all of it.
    """
    out = []
    for surface, load in setups:
        far = distance[surface]
        for speed in speeds[surface]:
            bend = BEND * speed / base_radius
            rates = (0.0, bend, -bend) if turns is None else turns
            ways = np.radians(headings_deg)
            if speed > 0:
                found = product(ways, rates)
                out += [PlannedRun(surface, load, float(a), speed, t, far) for a, t in found]
            spin = (speed / base_radius, -speed / base_radius) if turns is None else turns
            out += [PlannedRun(surface, load, 0.0, 0.0, t, far) for t in spin if t != 0]
    return tuple(dict.fromkeys(out))


def paper_grid(setups: Iterable[Setup], distance: Mapping[str, float]) -> tuple[PlannedRun, ...]:
    """The 36 settings of the 2021 paper, each on every set-up before the next.

    Along x and y at 100 to 400 mm/s, on the diagonals at 100 to 300 mm/s in x and in y, on the spot
    at 20 to 50 deg/s. Source: Belyaev, Brylev and Ivanov 2021, commands of its logs.
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
    """Straight runs in headings every 5 degrees at every speed, as the 2022 logs were driven."""
    headings = np.radians(np.arange(0.0, 360.0, 5.0))
    return tuple(
        PlannedRun(f, load, float(heading), speed, 0.0, distance[f])
        for heading, (f, load) in product(headings, setups)
        for speed in speeds[f]
        if speed > 0
    )


def drivable(drives: Iterable[PlannedRun], robot: Robot) -> tuple[PlannedRun, ...]:
    """Those whose commanded twist the wheels can give: not sideways for ordinary wheels."""
    j = np.asarray(robot.geometry.forward())
    reach = np.linalg.pinv(j, rcond=1e-6) @ j
    base = np.array([1.0, 1.0, float(robot.geometry.base_radius)])

    def fits(d: PlannedRun) -> bool:
        lost = (reach @ d.command - d.command) * base
        return bool(np.linalg.norm(lost) < 0.05 * np.linalg.norm(d.command * base))

    return tuple(filter(fits, drives))


def steady_windows(
    drives: Sequence[PlannedRun],
    robot: Robot,
    channels: Channels,
    session: str = SESSION,
) -> Windows:
    """Windows that drives at steady wheel speeds would give without noise, each run one piece.

    However long a run is, it is one piece: its own effect is met once. Runs are centred on the
    middle of the image, the marker's heading is zero at their start. The ammeter counts as exact:
    its noise is not known beforehand, and averages out over a window.
    """
    n, per_piece, motors = len(drives), channels.windows, robot.geometry.drives
    base, radius = float(robot.geometry.base_radius), float(robot.geometry.wheel_radius)
    command = np.stack([d.command for d in drives])
    rate = command @ np.asarray(robot.geometry.forward()).T / radius
    dt = np.array([d.seconds(base) for d in drives])[:, None] / per_piece * np.ones((n, per_piece))
    blank = np.zeros((n, per_piece, motors))
    w = Windows(
        run=np.arange(n),
        surface=tuple(d.surface for d in drives),
        load=tuple(d.load for d in drives),
        session=(session,) * n,
        start=np.zeros(n),
        dt=dt,
        turn=dt[..., None] * rate[:, None],
        speed_change=blank,
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
    """Logged poses, currents and voltages of windows without noise."""
    p = lk.predict(robot, b)
    path = chain(jnp.zeros((b.dt.shape[0], 3)), p.increment)
    middle = 0.5 * (path[:, :1, :2] + path[:, -1:, :2])
    pose = jax.vmap(jax.vmap(robot.camera.logged))(path.at[..., :2].add(-middle))
    amps = lk.predicted_current(robot, b, p.motor_force)
    speed = lk.wheel_speed(robot, b)
    flow = amps - robot.motor.current_offset
    volts = robot.motor.voltage(flow if b.signed else flow * jnp.tanh(speed / 0.2), speed)
    return pose, amps, volts
