"""Numbers of floors by currents and turning alone: what makes them at the wheel speeds measured.

Rows of one run at the same wheel speeds are one cell: accelerations, which the model does not know,
cancel in its mean. For every floor

    min  sum_cells w_c^2 rho( ((I(w_c) - I_c) / 1 A)^2 + ((W(w_c) - gyro_c) / 0.2 rad/s)^2 ) + prior

over the logarithms of friction, creep and rolling resistance, with I and W of the contact
equilibrium and of the ammeter (`MeteredMotor`), rho a soft absolute value. Currents stay alike for
seconds and differ from run to run: a cell of n rows counts as n / (1 + n / 20), and a run of many
rows as one of `LONG`.

What ammeters show of motors that also brake: nothing while they do.

The Husky's ammeters measure what a motor takes from the battery. Where the ground pushes a wheel,
as it does on the inner side of a turn, the motor brakes and the meter shows nothing. Over a row the
current scatters, so the mean that is shown is that of a clipped normal variable,

    E[max(I + n, 0)] = I Phi(I / s) + s phi(I / s),   n ~ N(0, s^2)

with I the motor's current along its wheel's motion, Phi and phi the normal distribution and its
density. The motor of one side may be stiffer than that of the other; what it draws more than the
mean of all counts as its own friction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float
from scipy.optimize import least_squares

from slipid.lab.systems.floors.interface import FloorSignals
from slipid.model.motor import Motor
from slipid.model.robot import Robot, motor_current, twist

FITTED = ("friction", "creep", "rolling_resistance")
"""Of every floor, as logarithms."""
START = np.log([0.6, 0.15, 0.08])
SPREAD = np.array([1.0, 1.0, 1.0])
"""Of the priors of the logarithms."""
CURRENT_A, YAW_RATE = 1.0, 0.2
"""By which misfits of currents and turning count [A], [rad/s]."""
ALIKE, LONG = 20.0, 300.0
"""Rows at the same speeds, and rows of a run, beyond which more of them tell little."""
CELLS = 512
"""Of a floor at most; what is compiled has room for so many."""
SAME_SPEED = 1e-3
"""Wheel speeds nearer than this are the same [rad/s]."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Means of rows at the same wheel speeds.

    Attributes:
        speed: of the wheels of each drive [rad/s]; current: of each motor [A].
        gyro: yaw rate [rad/s], and 0 where none was heard.
        weight: of each cell, for currents and for turning.
        std: of the currents in the cell [A]; rows: how many.
    """

    speed: Float[np.ndarray, "cell drive"]
    current: Float[np.ndarray, "cell drive"]
    gyro: Float[np.ndarray, " cell"]
    weight: Float[np.ndarray, "cell 2"]
    std: Float[np.ndarray, "cell drive"]
    rows: Float[np.ndarray, " cell"]

    @classmethod
    def of(cls, felt: FloorSignals) -> "Cells":
        """Cells of one run, of rows in which it moves."""
        take = felt.moves & np.isfinite(felt.current).all(axis=1)
        speed, amps = felt.speed[take], felt.current[take]
        gyro = np.full(len(speed), np.nan) if felt.gyro is None else felt.gyro[take]
        same = np.round(speed / SAME_SPEED)
        first, cell, count = np.unique(
            same, axis=0, return_index=True, return_inverse=True, return_counts=True
        )[1:]
        member = np.eye(len(first))[cell.ravel()].T / count[:, None]
        mean = member @ amps
        turning = np.isfinite(gyro)
        heard = member @ turning
        yaw = member @ np.where(turning, gyro, 0.0) / np.maximum(heard, 1e-9)
        counts = 3 * count / (1 + count / ALIKE) / (1 + len(speed) / LONG)
        return cls(
            speed=speed[first],
            current=mean,
            gyro=yaw,
            weight=np.sqrt(np.stack([counts, counts * heard], axis=1)),
            std=np.sqrt(np.maximum(member @ amps**2 - mean**2, 0.0)),
            rows=count.astype(float),
        )

    @classmethod
    def joined(cls, felts: Sequence[FloorSignals]) -> "Cells":
        """Cells of several runs."""
        each = [cls.of(felt) for felt in felts]
        names = ("speed", "current", "gyro", "weight", "std", "rows")
        return cls(*(np.concatenate([getattr(one, name) for one in each]) for name in names))

    def thinned(self, most: int) -> "Cells":
        """At most so many, drawn at random, and filled up with cells that do not count."""
        rng = np.random.default_rng(0)
        take = np.sort(rng.permutation(len(self.rows))[:most])
        fill = most - len(take)
        names = ("speed", "current", "gyro", "weight", "std", "rows")

        def filled(x: np.ndarray) -> np.ndarray:
            return np.concatenate([x[take], np.zeros((fill, *x.shape[1:]))])

        return Cells(*(filled(getattr(self, name)) for name in names))


def scatter_of(felts: Sequence[FloorSignals]) -> float:
    """Std of currents while wheel speeds are the same [A]."""
    cells = Cells.joined(felts)
    several = cells.rows >= 5
    weight = cells.rows[several, None]
    return float(
        np.sqrt((weight * cells.std[several] ** 2).sum() / weight.sum() / cells.std.shape[1])
    )


def stiffness_of(felts: Sequence[FloorSignals]) -> Float[np.ndarray, " drive"]:
    """Current that each drive takes more than the mean of all, going straight, median of runs [A].

    Zero of robots whose drives have nothing in common, three omni wheels say.
    """
    found = []
    for felt in felts:
        fast = np.abs(felt.speed).min(axis=1) > 0.5
        straight = fast & (np.ptp(felt.speed, axis=1) < 0.1)
        if straight.sum() > 20:
            mean = felt.current[straight].mean(axis=0)
            found.append(mean - mean.mean())
    return np.median(found, axis=0) if found else np.zeros(felts[0].speed.shape[1])


def fitted_floors(robot: Robot, felts: Sequence[FloorSignals]) -> Robot:
    """The robot with numbers of all its floors, each by the runs on it."""
    for number, floor in enumerate(robot.surfaces.labels):
        cells = Cells.joined([felt for felt in felts if felt.floor == floor]).thinned(CELLS)
        left = _FloorMisfit(robot, number, cells)
        logs = least_squares(left.gaps, START, left.slope, loss="soft_l1", max_nfev=30).x
        robot = on_floor(robot, jnp.asarray(number), jnp.asarray(logs))
    return robot


def currents_off(
    robot: Robot,
    number: int,
    speed: Float[np.ndarray, "row drive"],
    current: Float[np.ndarray, "row drive"],
) -> Float[np.ndarray, "row drive"]:
    """How much more motors should draw on a floor, by its numbers, than they do in each row [A].

    By what the fit has compiled.
    """
    logs = np.log([float(getattr(robot.surfaces, name)[number]) for name in FITTED])
    count, drives = speed.shape
    found = []
    for first in range(0, count, CELLS):
        w, amps = np.zeros((2, CELLS, drives))
        rows = min(CELLS, count - first)
        w[:rows], amps[:rows] = speed[first : first + rows], current[first : first + rows]
        every = Cells(
            w, amps, np.zeros(CELLS), np.ones((CELLS, 2)), np.ones_like(w), np.ones(CELLS)
        )
        gaps = _FloorMisfit(robot, number, every).gaps(logs)[: CELLS * drives]
        found.append(CURRENT_A * gaps.reshape(CELLS, drives)[:rows])
    return np.concatenate(found)


def on_floor(robot: Robot, number: Array, logs: Float[Array, "3"]) -> Robot:
    """The robot with other numbers of a floor, given as logarithms."""
    stacks = {
        name: getattr(robot.surfaces, name).at[number].set(jnp.exp(logs[k]))
        for k, name in enumerate(FITTED)
    }
    return replace(robot, surfaces=replace(robot.surfaces, **stacks))


def shown(
    robot: Robot, number: Array, speed: Float[Array, "row drive"]
) -> tuple[Float[Array, "row drive"], Float[Array, " row"]]:
    """Currents that are shown [A] and yaw rates [rad/s] at wheel speeds on a floor."""
    frame, load = robot.geometry.frame(), jnp.zeros((), int)

    def one(w: Array) -> tuple[Array, Array]:
        xi = twist(robot, frame, robot.geometry.at_wheels(w), number, load)
        return motor_current(robot, frame, xi, w, number, load), xi[2]

    return jax.vmap(one)(speed)


class _FloorMisfit:
    """What numbers of a floor leave of currents and turning, with its derivative."""

    def __init__(self, robot: Robot, number: int, cells: Cells):
        self.robot, self.number = robot, jnp.asarray(number)
        every = (cells.speed, cells.current, cells.gyro, cells.weight)
        self.cells = tuple(jnp.asarray(x) for x in every)
        self.kept: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def gaps(self, logs: np.ndarray) -> np.ndarray:
        return self._at(logs)[0]

    def slope(self, logs: np.ndarray) -> np.ndarray:
        return self._at(logs)[1]

    def _at(self, logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Both at once: the solver asks for them one after the other."""
        key = logs.tobytes()
        if key not in self.kept:
            slope, gaps = _both(jnp.asarray(logs), self.robot, self.number, *self.cells)
            self.kept = {key: (np.asarray(gaps), np.nan_to_num(np.asarray(slope)))}
        return self.kept[key]


def _gaps(
    logs: Array, robot: Robot, number: Array, w: Array, amps: Array, gyro: Array, weight: Array
) -> tuple[Array, Array]:
    """Misfits of currents and turning, and how unusual the numbers are; twice."""
    said, turn = shown(on_floor(robot, number, logs), number, w)
    gaps = jnp.concatenate(
        [
            ((said - amps) / CURRENT_A * weight[:, :1]).ravel(),
            (turn - gyro) / YAW_RATE * weight[:, 1],
            (logs - START) / SPREAD,
        ]
    )
    return gaps, gaps


_both = jax.jit(jax.jacfwd(_gaps, has_aux=True))


TURNING = 0.2
"""Wheel speed beyond which friction is whole, as of `slipid.model.motor` [rad/s]."""
STEADY_A = 0.1
"""Scatter of the current of a wheel that stands [A]."""


class MeteredMotor(Motor):
    """Motor as its ammeter shows it: `current` is never below zero.

    Attributes:
        stiffness: current that each drive's motor takes more than the mean of all [A].
        scatter: std of a current about its mean [A].
    """

    stiffness: Float[Array, " drive"] = eqx.field(kw_only=True)
    scatter: Float[Array, ""] = eqx.field(kw_only=True)

    @classmethod
    def of(cls, motor: Motor, stiffness: Array, scatter: Array) -> "MeteredMotor":
        """A motor with its ammeter."""
        same = {f.name: getattr(motor, f.name) for f in fields(Motor)}
        return cls(**same, stiffness=stiffness, scatter=scatter)

    def current(
        self, torque: Float[Array, " *w"], wheel_speed: Float[Array, " *w"]
    ) -> Float[Array, " *w"]:
        """Mean current [A] that is shown of each drive at a wheel torque [N m]."""
        way = jnp.tanh(wheel_speed / TURNING)
        along = way * super().current(torque, wheel_speed) + jnp.abs(way) * self.stiffness
        return clipped(along, STEADY_A + jnp.abs(way) * self.scatter)


def clipped(mean: Array, std: Array) -> Array:
    """Mean of a normal variable of which what is below zero counts as zero."""
    z = mean / std
    return mean * norm.cdf(z) + std * norm.pdf(z)
