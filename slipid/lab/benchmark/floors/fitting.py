"""Fit of each floor's force balance parameters to currents and yaw rates only, without a pose.

Rows of one run at the same wheel speeds form one cell: accelerations, which are not modelled,
cancel in its mean. For every floor, the fit solves

    min  sum_c sum_k rho(a_c ((I_k(w_c) - I_ck) / 1 A)^2)
         + sum_c rho(a_c g_c ((W(w_c) - W_c) / 0.2 rad/s)^2) + prior

over the logarithms of friction, creep and rolling resistance. Cell c has the wheel speeds w_c, the
mean current I_ck of each motor k, the mean yaw rate W_c, the weight a_c, and a yaw rate in the
fraction g_c of its rows. I_k(w) and W(w) are the ammeter readings (`MeteredMotor`) and the yaw rate
that the model predicts in equilibrium at the wheel speeds w, and rho(z) = 2 (sqrt(1 + z) - 1) is a
soft absolute value. Currents are correlated for seconds and differ from run to run. A cell of n
rows therefore has a weight proportional to n / (1 + n / 20), and the weight of a whole run
saturates above `RUN_ROWS` rows.

Ammeters. The Husky's ammeters measure the current that a motor takes from the battery. If the floor
pushes a wheel, as on the inner side of a turn, the motor brakes and the ammeter shows zero. At
constant wheel speeds the current scatters, so the mean reading is that of a clipped normal
variable,

    E[max(I + n, 0)] = I Phi(I / s) + s phi(I / s),   n ~ N(0, s^2)

with I the motor's current, positive when it drives its wheel's motion, s the standard deviation of
the scatter, and Phi and phi the standard normal distribution function and density. The motor of one
side may have more friction than the motor of the other; its current above the mean of all motors is
modelled as the motor's own friction.
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
from slipid.model.motor import Motor, sign_of_motion
from slipid.model.robot import Robot

FITTED = ("friction", "creep", "rolling_resistance")
"""Names of the parameters that are fitted for every floor; the fit is in their logarithms."""
PRIOR_MEANS = np.log([0.6, 0.15, 0.08])
"""Prior means of the logarithms, where the fit also starts; the prior std of each is 1."""
CURRENT_A, YAW_RATE = 1.0, 0.2
"""Scales by which residuals of currents [A] and of the yaw rate [rad/s] are divided."""
CELL_ROWS, RUN_ROWS = 20.0, 300.0
"""Numbers of rows, in one cell and in one run, above which more rows add little weight."""
FLOOR_CELLS = 512
"""Largest number of cells of a floor. Smaller numbers are padded to this one, so that functions are
compiled for a single array size."""
SPEED_STEP = 1e-3
"""Width to which wheel speeds are rounded; rows with equal rounded speeds are one cell [rad/s]."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Means of rows at the same wheel speeds.

    Attributes:
        speed: wheel speed of each drive [rad/s].
        current: current of each motor [A].
        gyro: yaw rate [rad/s], 0 where it is missing.
        weight: factors of the cell's residuals: first for its currents, then for its yaw rate.
        std: standard deviation of the currents in the cell [A].
        rows: number of rows in the cell.
    """

    speed: Float[np.ndarray, "cell drive"]
    current: Float[np.ndarray, "cell drive"]
    gyro: Float[np.ndarray, " cell"]
    weight: Float[np.ndarray, "cell 2"]
    std: Float[np.ndarray, "cell drive"]
    rows: Float[np.ndarray, " cell"]

    @classmethod
    def of(cls, run: FloorSignals) -> "Cells":
        """Return the cells of one run, made of the rows in which the robot moves."""
        take = run.moving & np.isfinite(run.current).all(axis=1)
        speed, amps = run.speed[take], run.current[take]
        gyro = np.full(len(speed), np.nan) if run.gyro is None else run.gyro[take]
        same = np.round(speed / SPEED_STEP)
        first, cell, count = np.unique(
            same, axis=0, return_index=True, return_inverse=True, return_counts=True
        )[1:]
        member = np.eye(len(first))[cell.ravel()].T / count[:, None]
        mean = member @ amps
        turning = np.isfinite(gyro)
        known = member @ turning
        yaw = member @ np.where(turning, gyro, 0.0) / np.maximum(known, 1e-9)
        counts = 3 * count / (1 + count / CELL_ROWS) / (1 + len(speed) / RUN_ROWS)
        return cls(
            speed=speed[first],
            current=mean,
            gyro=yaw,
            weight=np.sqrt(np.stack([counts, counts * known], axis=1)),
            std=np.sqrt(np.maximum(member @ amps**2 - mean**2, 0.0)),
            rows=count.astype(float),
        )

    @classmethod
    def joined(cls, runs: Sequence[FloorSignals]) -> "Cells":
        """Return the cells of several runs, one run after the other."""
        each = [cls.of(run) for run in runs]
        return cls(*(np.concatenate([getattr(c, f.name) for c in each]) for f in fields(cls)))

    def thinned(self, most: int) -> "Cells":
        """Return exactly `most` cells: a random sample, or all of them padded with zero weight."""
        rng = np.random.default_rng(0)
        take = np.sort(rng.permutation(len(self.rows))[:most])

        def padded(x: np.ndarray) -> np.ndarray:
            return np.concatenate([x[take], np.zeros((most - len(take), *x.shape[1:]))])

        return Cells(*(padded(getattr(self, f.name)) for f in fields(self)))


def scatter_of(runs: Sequence[FloorSignals]) -> float:
    """Return the std of currents within cells of at least 5 rows, over all drives [A]."""
    cells = Cells.joined(runs)
    several = cells.rows >= 5
    weight = cells.rows[several, None]
    return float(
        np.sqrt((weight * cells.std[several] ** 2).sum() / weight.sum() / cells.std.shape[1])
    )


def stiffness_of(runs: Sequence[FloorSignals]) -> Float[np.ndarray, " drive"]:
    """Return the excess of each drive's current over the mean of all drives in straight motion [A].

    It is the median over runs, and zero for robots whose wheels never have equal speeds, such as
    one with three omni wheels.
    """
    found = []
    for run in runs:
        fast = np.abs(run.speed).min(axis=1) > 0.5
        straight = fast & (np.ptp(run.speed, axis=1) < 0.1)
        if straight.sum() > 20:
            mean = run.current[straight].mean(axis=0)
            found.append(mean - mean.mean())
    return np.median(found, axis=0) if found else np.zeros(runs[0].speed.shape[1])


def fitted_floors(robot: Robot, runs: Sequence[FloorSignals]) -> Robot:
    """Return the robot with the parameters of each floor fitted to the runs on it."""
    for number, floor in enumerate(robot.surfaces.labels):
        cells = Cells.joined([run for run in runs if run.floor == floor]).thinned(FLOOR_CELLS)
        arrays = (cells.speed, cells.current, cells.gyro, cells.weight)
        index = jnp.asarray(number)
        given = (robot, index, *map(jnp.asarray, arrays))
        solution = least_squares(
            lambda logs, given=given: np.asarray(_residuals(logs, *given)),
            PRIOR_MEANS,
            lambda logs, given=given: np.nan_to_num(np.asarray(_jacobian(logs, *given))),
            loss="soft_l1",
            max_nfev=30,
        )
        robot = on_floor(robot, index, jnp.asarray(solution.x))
    return robot


def currents_off(
    robot: Robot,
    number: int,
    speed: Float[np.ndarray, "row drive"],
    current: Float[np.ndarray, "row drive"],
) -> Float[np.ndarray, "row drive"]:
    """Return modelled less measured current of each row and drive on a floor [A].

    Rows are evaluated in groups of `FLOOR_CELLS`, the last group padded, so that the model is
    compiled for a single array size.
    """
    groups = -(-len(speed) // FLOOR_CELLS)
    padded = np.zeros((groups * FLOOR_CELLS, speed.shape[1]))
    padded[: len(speed)] = speed
    parts = [_shown(robot, jnp.asarray(number), w)[0] for w in np.split(padded, groups)]
    return np.concatenate(parts)[: len(speed)] - current


def on_floor(robot: Robot, number: Array, logs: Float[Array, "3"]) -> Robot:
    """Return the robot with the parameters `FITTED` of floor `number` set to exp(logs)."""
    stacks = {
        name: getattr(robot.surfaces, name).at[number].set(jnp.exp(logs[k]))
        for k, name in enumerate(FITTED)
    }
    return replace(robot, surfaces=replace(robot.surfaces, **stacks))


def shown(
    robot: Robot, number: Array, speed: Float[Array, "row drive"]
) -> tuple[Float[Array, "row drive"], Float[Array, " row"]]:
    """Return the modelled ammeter readings [A] and yaw rates [rad/s] at wheel speeds on a floor."""
    frame = robot.geometry.frame()
    standing = robot.standing(frame, number, jnp.zeros((), int))

    def one(w: Array) -> tuple[Array, Array]:
        xi = standing.twist(frame.at_wheels(w))
        return standing.current(xi, w), xi[2]

    return jax.vmap(one)(speed)


_shown = jax.jit(shown)


@jax.jit
def _residuals(
    logs: Array, robot: Robot, number: Array, w: Array, amps: Array, gyro: Array, weight: Array
) -> Array:
    """Return the residuals of currents, of the yaw rate and of the prior."""
    modelled, turn = shown(on_floor(robot, number, logs), number, w)
    return jnp.concatenate(
        [
            ((modelled - amps) / CURRENT_A * weight[:, :1]).ravel(),
            (turn - gyro) / YAW_RATE * weight[:, 1],
            logs - PRIOR_MEANS,
        ]
    )


_jacobian = jax.jit(jax.jacfwd(_residuals))


STEADY_A = 0.1
"""Standard deviation of the current of a wheel at rest [A]."""


class MeteredMotor(Motor):
    """Motor with an ammeter, whose reading `current` is never negative.

    Attributes:
        stiffness: excess of each drive's current over the mean of all [A].
        scatter: standard deviation of a current about its mean at constant wheel speed [A].
    """

    stiffness: Float[Array, " drive"] = eqx.field(kw_only=True)
    scatter: Float[Array, ""] = eqx.field(kw_only=True)

    @classmethod
    def of(cls, motor: Motor, stiffness: Array, scatter: Array) -> "MeteredMotor":
        """Return `motor` with an ammeter of this stiffness and scatter [A]."""
        same = {f.name: getattr(motor, f.name) for f in fields(Motor)}
        return cls(**same, stiffness=stiffness, scatter=scatter)

    def current(
        self,
        torque: Float[Array, " *w"],
        wheel_speed: Float[Array, " *w"],
        direction: Float[Array, " *w"] | None = None,
    ) -> Float[Array, " *w"]:
        """Return the mean reading of each drive's ammeter [A] at a wheel torque [N m]."""
        sign = sign_of_motion(wheel_speed) if direction is None else direction
        along = sign * super().current(torque, wheel_speed, sign) + jnp.abs(sign) * self.stiffness
        return clipped(along, STEADY_A + jnp.abs(sign) * self.scatter)


def clipped(mean: Array, std: Array) -> Array:
    """Return the mean of a normal variable whose negative values are set to zero."""
    z = mean / std
    return mean * norm.cdf(z) + std * norm.pdf(z)
