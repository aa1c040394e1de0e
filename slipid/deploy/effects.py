"""What the fitted runs tell of the effects of floors, as the table that robot.json has.

The motion per metre along, across and in yaw, of wheels that would not slip, is predicted to be

    contact(z) - told(z),   told(z) = mean + slope (z - z_fit)

as forecasts have it (`slipid.fit.shared_effects`). The mean of the table is what that is beyond
the contact model with the robot's numbers; what is left is the covariance of the effects given the
numbers, grown as forecasts are, and the scatter of this very sum over draws of the numbers: where
runs were near, another number is made up for by another effect.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.deploy.record_of import directions, moved_per_metre, spread_of
from slipid.fit.shared_effects import AXES, SpeedAndLoad, TravelConditions
from slipid.predict.predictive import ForceBalance
from slipid.robot.record import Axes, ToldRecord

DIRECTIONS = 72
"""Of the table; half of the kernel's length apart."""
_Grid = Float[np.ndarray, "floor speed direction 3"]


def told_by_load(
    contact: ForceBalance, center: Float[np.ndarray, " free"], draws: Float[np.ndarray, "draw free"]
) -> dict[str, ToldRecord]:
    """What is told of effects by load set-up; nothing where no runs share any.

    Args:
        contact: the fit as a model that forecasts.
        center: search vector of the deployed numbers; draws: of their posterior.
    """
    paces = [pace for found in contact.shared.values() for pace in found.paces]
    if not paces:
        return {}
    speeds = sorted({pace.log_speed for pace in paces})
    return {
        load: _table(contact, center, draws, load, np.array(speeds))
        for load in contact.robot.body.loads
    }


def _table(
    contact: ForceBalance, center: np.ndarray, draws: np.ndarray, load: str, log_speed: np.ndarray
) -> ToldRecord:
    count, labels = len(log_speed), contact.robot.surfaces.labels
    angle = np.linspace(0.0, 2 * np.pi, DIRECTIONS, endpoint=False)
    paces = tuple(SpeedAndLoad(float(s), load) for s in log_speed for _ in angle)
    way = TravelConditions(np.tile(angle, count), paces, contact.robot.geometry.mirror())
    robots = jax.vmap(contact.space.tree)(jnp.asarray(draws))
    k = jnp.asarray(contact.robot.load_index(load))
    moved = [moved_per_metre(robots, k, jnp.exp(s), directions(DIRECTIONS)) for s in log_speed]
    predicted = np.concatenate([np.asarray(x) for x in moved], axis=2)  # speeds in turn
    shape = (len(labels), count, DIRECTIONS, len(AXES))
    mean, left = np.zeros(shape), np.zeros(shape)
    for n, floor in enumerate(labels):
        found = contact.shared[floor]
        told = found.told(way)
        grown = contact.extrapolation.get(f"{floor}@{load}", 1.0)
        given = np.diagonal(told.covariance, axis1=1, axis2=2) + _of(contact, "session", floor)
        off = predicted[:, n] - np.einsum("nap,kp->kna", told.slope, draws - center)
        at = told.mean + told.slope @ (center - contact.z)
        mean[n] = -at.reshape(shape[1:])
        left[n] = np.sqrt(
            _of(contact, "run", floor) + grown * (given + spread_of(off) ** 2)
        ).reshape(shape[1:])
    speeds = tuple(_short(np.exp(s)) for s in log_speed)
    return ToldRecord(speeds, _rows(mean), _rows(left))


def _of(contact: ForceBalance, kind: str, floor: str) -> Float[np.ndarray, "3"]:
    """Variances of what a run has of its own, or of what a session shares, by axis."""
    return np.array([contact.variance.get(f"{kind}.{floor}.{axis}", 0.0) for axis in AXES])


def _rows(grid: _Grid) -> tuple[tuple[tuple[Axes, ...], ...], ...]:
    def axes(row: np.ndarray) -> Axes:
        along, across, yaw = (_short(x) for x in row)
        return along, across, yaw

    return tuple(tuple(tuple(axes(a) for a in d) for d in s) for s in grid)


def _short(value: float) -> float:
    """To four digits: the table is long, and known no better."""
    return float(f"{value:.4g}")
