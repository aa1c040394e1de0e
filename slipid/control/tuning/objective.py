"""Gains from rehearsals on the twin: over draws of the robot, floors and noise.

One case is a draw of the robot, a floor, a start and noise; its loss is the root of the mean over
the path of squared true errors in place and, times the base radius, in heading, and of the effort,
in mm. What is minimised is

    mean over cases + mean of their worst tenth + penalty of a loop that is hardly stable
"""

from collections.abc import Sequence
from dataclasses import fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.control.closed_loop import Pilot
from slipid.control.controller import Controller, Gains
from slipid.control.deployed import DeployedRobot
from slipid.control.estimator import Estimator
from slipid.control.filter.floor import Floor
from slipid.control.interface import Numbers
from slipid.control.trajectory import Path
from slipid.control.tuning.actuation import Habits
from slipid.control.tuning.stability import SPARE, radii
from slipid.control.tuning.twin import Twin, rollout

GAINS = tuple(f.name for f in fields(Gains))
"""Names of the gains, in the order of vectors of them."""
HAND = tuple(float(f.metadata["parameter"].start) for f in fields(Gains))
"""Gains set by hand."""
UNITS = tuple(f.metadata["parameter"].unit for f in fields(Gains))
LOWEST = np.array([0.2, 0.2, 0.0, 0.0, 0.0, 0.0])
HIGHEST = np.array([5.0, 5.0, 1.5, 1.5, 1.0, 0.4])
"""Of the gains; the first two are searched in their logarithm."""
BATCH = 16
"""Cases that are rolled out together."""
REACH = 0.02
"""Over which losses are differenced, in parts of the box."""
EFFORT_S, LATE = 0.05, 20.0
"""Rim speed a command changes by in a period, times this, counts as error [s]; each second of the
path that is not reached counts so much [mm]."""
LARGEST_RADIUS, PENALTY = 0.9995, 10_000.0
"""Spectral radius from which, with gains `SPARE` times as large, a loop costs [mm]."""


class Cases(eqx.Module):
    """What gains are tried on, stacked.

    Attributes:
        truth: robots; floor: maps of the same size; path: as they lie for the starts.
        start: poses [m, m, rad]; key: of all that is drawn.
    """

    truth: DeployedRobot
    floor: Floor
    path: Path
    start: Float[Array, "case 3"]
    key: Array

    def __len__(self) -> int:
        return len(self.start)

    def at(self, index: np.ndarray | slice) -> "Cases":
        """Those of an index."""
        return jax.tree.map(lambda x: x[index], self)


class Task(eqx.Module):
    """What is tuned.

    Attributes:
        robot: as the pilot knows it.
        habits: of the twin.
        steps: of a rollout.
    """

    robot: DeployedRobot
    habits: Habits = eqx.field(static=True, default=Habits())
    steps: int = eqx.field(static=True, default=120)

    def loss(self, gains: Gains, case: Cases) -> Float[Array, ""]:
        """Of one case [mm]."""
        pilot = Pilot(Estimator(self.robot), Controller(self.robot, gains))
        twin = Twin(case.truth, case.floor, replace(self.habits, smooth=True))
        pose, said = rollout(pilot, case.path, twin, case.start, case.key, self.steps)
        wanted = jax.vmap(case.path.at)(said.time)
        gap = pose[:, :2] - wanted[:, :2]
        turned = self.robot.frame.base * jnp.sin(pose[:, 2] - wanted[:, 2])
        jump = EFFORT_S * self.robot.frame.radius * jnp.diff(said.command, axis=0)
        squares = jnp.mean(jnp.sum(gap**2, axis=1) + turned**2)
        effort = jnp.mean(jnp.sum(jump**2, axis=1))
        missing = jax.nn.relu(case.path.duration - said.time[-1])
        return 1000.0 * jnp.sqrt(squares + effort + 1e-12) + LATE * missing

    def margins(self, gains: Gains, truths: DeployedRobot) -> Float[np.ndarray, "draw loop"]:
        """1 - spectral radius of every draw, for every floor and direction, gains as they are."""
        rho = np.asarray(radii(Controller(self.robot, gains), truths, self.habits))
        return 1.0 - rho.reshape(len(rho), -1)


def gains_at(x: Float[Numbers, "*batch gain"]) -> Float[Array, "*batch gain"]:
    """Vectors of gains at places of the unit box."""
    low, high = jnp.asarray(LOWEST), jnp.asarray(HIGHEST)
    ratio = jnp.where(low > 0, high / jnp.where(low > 0, low, 1.0), 1.0)
    return jnp.where(low > 0, low * ratio**x, low + (high - low) * x)


def box_of(gains: Float[Numbers, " gain"] | Sequence[float]) -> Float[np.ndarray, " gain"]:
    """Place of a vector of gains in the unit box, the nearest one."""
    g = np.clip(np.asarray(gains, float), LOWEST, HIGHEST)
    logs = np.log(np.maximum(g, 1e-9) / np.maximum(LOWEST, 1e-9))
    logs = logs / np.log(HIGHEST / np.maximum(LOWEST, 1e-9))
    return np.where(LOWEST > 0, logs, (g - LOWEST) / (HIGHEST - LOWEST))


def combined(losses: Float[Array, " case"]) -> Float[Array, ""]:
    """Mean and mean of the worst tenth together."""
    worst = max(1, -(-len(losses) // 10))
    return jnp.mean(losses) + jnp.mean(jax.lax.top_k(losses, worst)[0])


@eqx.filter_jit
def losses(task: Task, x: Float[Array, " gain"], cases: Cases) -> Float[Array, " case"]:
    """Loss of every case at a place of the box [mm]."""
    gains = Gains.at(gains_at(x))
    return jax.vmap(lambda case: task.loss(gains, case))(cases)


@eqx.filter_jit
def slopes(
    task: Task, x: Float[Array, " gain"], cases: Cases
) -> tuple[Float[Array, "case gain"], Float[Array, " case"]]:
    """Derivatives of the losses by the place, and the losses.

    By differences with the same noise: through the filter, `jax.jvp` by five gains took as long as
    27 rollouts, differences 6, and over `REACH` the jumps at floors' edges, which a derivative
    does not see, count as well.
    """
    step = jnp.where(x + REACH > 1, -REACH, REACH)
    places = x + jnp.concatenate([jnp.zeros((1, len(x))), jnp.diag(step)])
    value = jax.vmap(lambda place: losses(task, place, cases))(places)
    return ((value[1:] - value[0]) / step[:, None]).T, value[0]


@eqx.filter_jit
def penalties(
    task: Task, x: Float[Array, "place gain"], truths: DeployedRobot
) -> Float[Array, " place"]:
    """Of loops that are hardly stable, at places of the box [mm]; goes on below the bound."""

    def of(place: Array) -> Array:
        controller = Controller(task.robot, Gains.at(gains_at(place)))
        rho = radii(controller, truths, task.habits, SPARE)
        return PENALTY * jax.nn.relu(jnp.max(rho) - LARGEST_RADIUS)

    return jax.vmap(of)(x)


def penalty_slope(
    task: Task, x: Float[Numbers, " gain"], truths: DeployedRobot
) -> Float[np.ndarray, " gain"]:
    """Derivative of the penalty by the place, by differences: eigenvalues meet and part [mm]."""
    step = 1e-3
    places = np.asarray(x) + np.concatenate([np.zeros((1, len(x))), step * np.eye(len(x))])
    value = np.asarray(penalties(task, jnp.asarray(places), truths))
    return np.asarray((value[1:] - value[0]) / step)


def evaluate(
    task: Task, gains: Float[Numbers, " gain"] | Sequence[float], cases: Cases
) -> Float[np.ndarray, " case"]:
    """Loss of every case at some gains [mm], `BATCH` cases at a time."""
    x, count = jnp.asarray(box_of(gains)), len(cases)
    rows = np.arange(-(-count // BATCH) * BATCH) % count
    parts = [losses(task, x, cases.at(part)) for part in rows.reshape(-1, BATCH)]
    return np.concatenate([np.asarray(p) for p in parts])[:count]
