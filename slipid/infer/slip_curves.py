"""Curves of slip over torque on every floor with 90 % bands, and the ranges that the runs cover."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.log import Log
from slipid.data.runs import Runs
from slipid.fitting import likelihood as lk
from slipid.fitting.noise import travel
from slipid.model import contact_law as law
from slipid.model.contact_law import ContactSurface
from slipid.model.robot import GRAVITY, Robot, Validity, steady_states
from slipid.parameter import as_numbers
from slipid.search_space import Space

CURVE_POINTS = 41
"""Number of points of a curve."""
_STEADY = 0.1
"""Largest deviation of a steady command from the run's median command, relative to the median."""
_MOVED = 0.1
"""Fraction of the fastest window's speed above which a window counts as moving."""
_SECTOR, _COMMON = 30.0, 0.02
"""Width of a sector of headings [deg], and smallest fraction of all windows that a sector must
contain for its heading to count as driven."""
_SLIP = np.concatenate([np.linspace(0, 0.2, 81), np.linspace(0.2, 1.0, 81)[1:]])


@dataclass(frozen=True, eq=False)
class SlipCurve:
    """Slip of a wheel over its torque on one floor, up to the measured torques, with a 90 % band.

    Attributes:
        torque_nm: torque at the wheel [N m].
        slip: slip at each torque.
        slip_lo: lower end of the 90 % band.
        slip_hi: upper end of the 90 % band.
        wheel_speed: wheel speed for which the curve is computed [rad/s].
        load_share: fraction of the weight on the wheel for which the curve is computed.
    """

    torque_nm: Float[np.ndarray, " torque"]
    slip: Float[np.ndarray, " torque"]
    slip_lo: Float[np.ndarray, " torque"]
    slip_hi: Float[np.ndarray, " torque"]
    wheel_speed: float
    load_share: float


LEAST_RANK_CORRELATION = 0.3
"""Smallest rank correlation at which measured slip rises with torque [1]."""
LEAST_SPREAD = 0.2
"""Smallest difference of the tenth and ninetieth percentiles of torque, over the larger of their
magnitudes, at which slip can rise with it [1]."""


def slip_sentence(
    dots: Mapping[str, tuple[Float[np.ndarray, " wheel"], Float[np.ndarray, " wheel"]]],
) -> str:
    """Return a sentence on the floors where the measured slip of wheels rises with their torque.

    Args:
        dots: torques [N m] and measured slips [1] of wheels, keyed by floor.
    """
    from scipy.stats import spearmanr

    rises, others = [], []
    for floor, (torque, slip) in dots.items():
        low, high = np.quantile(torque, [0.1, 0.9]) if len(torque) > 5 else (0.0, 0.0)
        varied = high - low > LEAST_SPREAD * max(abs(low), abs(high)) and np.ptp(slip) > 0
        rank = float(spearmanr(torque, slip).statistic) if varied else 0.0
        (rises if rank > LEAST_RANK_CORRELATION else others).append(floor)
    if not rises:
        return "The measured slip of the wheels does not rise with their torque"
    where = f"The slip of a wheel rises with its torque on {', '.join(rises)}"
    return f"{where}; no rise shows on {', '.join(others)}" if others else where


def wheel_states(robot: Robot, b: lk.Batch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return wheel speeds [rad/s], torques [N m] and slips (segment, window, wheel).

    Slip is the sliding speed divided by the wheel activity, sqrt(rim speed^2 + roller speed^2), so
    that it is finite for a wheel at rest.
    """
    frame, driven = robot.geometry.frame(), np.asarray(lk.wheel_speed(robot, b))
    places = (np.repeat(np.asarray(x), driven.shape[1]) for x in (b.surface, b.load))
    found = steady_states(robot, driven.reshape(-1, driven.shape[-1]), *places)
    speed = np.asarray(robot.geometry.at_wheels(as_numbers(driven)))
    rim, xi = float(frame.radius) * speed, found.twist.reshape(*driven.shape[:2], 3)
    active = np.sqrt(rim**2 + (xi @ np.asarray(frame.roll).T) ** 2 + 1e-12)
    sliding = rim * np.asarray(frame.drive_share) - xi @ np.asarray(frame.hold).T
    return speed, found.torque.reshape(speed.shape), sliding / active


def torque_of_slip(
    robot: Robot, wheel_speed: Float[Array, " surface"], share: float
) -> Float[Array, "surface slip"]:
    """Return the torque [N m] of a wheel that slips by `_SLIP` in its rolling direction.

    The contact law is that of `slipid.model.contact_law` without sideways rolling; the mass is that
    of the first load set-up.

    Args:
        robot: fitted robot.
        wheel_speed: speed of the wheel on each floor [rad/s].
        share: fraction of the weight on the wheel.
    """
    radius, weight = robot.geometry.wheel_radius, robot.body.mass * GRAVITY

    def one(floor: ContactSurface, speed: Array) -> Array:
        rim = radius * speed
        traction = law.wheel_traction(jnp.asarray(_SLIP) * rim, rim, floor).force
        return radius * weight * law.load_force(jnp.asarray(share), floor) * traction

    return jax.vmap(one)(robot.surfaces, wheel_speed)


def curves(
    space: Space, z: np.ndarray, draws: Float[np.ndarray, "draw free"], b: lk.Batch
) -> dict[str, SlipCurve]:
    """Return slip over torque, keyed by floor, with a 90 % band, up to the measured torques.

    Curves are computed at the median speed of the wheels that turned, with equal normal forces on
    all wheels.
    """
    robot = space.tree(jnp.asarray(z))
    speed, torque = (np.abs(x) for x in wheel_states(robot, b)[:2])
    labels, floor = robot.surfaces.labels, np.asarray(b.surface)
    share = 1.0 / speed.shape[-1]
    median = []
    for k in range(len(labels)):
        mine = speed[floor == k]
        turned = mine[mine > 0.05 * max(mine.max(initial=0.0), 1e-9)]
        median.append(float(np.median(turned)) if turned.size else 1.0)
    at = jnp.asarray(median)
    best = np.asarray(torque_of_slip(robot, at, share))
    drawn = jax.jit(jax.vmap(lambda x: torque_of_slip(space.tree(x), at, share)))
    band = np.asarray(drawn(jnp.asarray(draws)))
    out = {}
    for k, label in enumerate(labels):
        top = min(float(np.quantile(torque[floor == k], 0.98)), 0.999 * float(best[k].max()))
        grid = np.linspace(0.0, top, CURVE_POINTS)
        each = np.stack([np.interp(grid, row, _SLIP) for row in band[:, k]])
        low, high = np.quantile(each, [0.05, 0.95], axis=0)
        slip = np.interp(grid, best[k], _SLIP)
        out[label] = SlipCurve(grid, slip, low, high, median[k], share)
    return out


def slip_on(robot: Robot, floor: str, curve: SlipCurve) -> Float[np.ndarray, " torque"]:
    """Return the slip of a robot's contact law at the torques, speed and load of a curve."""
    at = jnp.full(len(robot.surfaces.labels), curve.wheel_speed)
    torque = torque_of_slip(robot, at, curve.load_share)[robot.surface_index(floor)]
    return np.interp(curve.torque_nm, np.asarray(torque), _SLIP)


def validity(data: Runs, robot: Robot, b: lk.Batch) -> dict[str, Validity]:
    """Return the ranges of speed, torque, slip and motion that the runs on each floor cover."""
    speed, torque, slip = wheel_states(robot, b)
    back = np.asarray(robot.geometry.pseudo_inverse()) * float(robot.geometry.wheel_radius)
    # The ranges refer to the motion by the encoders, as if no wheel slipped.
    twist = np.asarray(lk.wheel_speed(robot, b)) @ back.T
    yaw = twist[..., 2]
    floor, length = np.asarray(b.surface), travel(b, robot)[0].sum(axis=1)
    out: dict[str, Validity] = {}
    for k, label in enumerate(robot.surfaces.labels):
        runs = [i for i, surface in enumerate(data.surface) if surface == label]
        mine = floor == k
        most = [float(np.abs(x[mine]).max()) for x in (speed, torque, slip, yaw)]
        if 2 * sum(has_steady_command(data.logs[i]) for i in runs) > len(runs):
            driven = np.degrees(data.heading[runs]), data.speed[runs], data.turn[runs]
        else:
            driven = by_encoders(twist[mine].reshape(-1, 3))
        out[label] = Validity(
            runs=len(runs),
            loads=tuple(sorted({data.logs[i].load for i in runs})),
            wheel_speed=(0.0, most[0]),
            torque_nm=(0.0, most[1]),
            slip=(0.0, most[2]),
            yaw_rate=(0.0, most[3]),
            headings_deg=distinct(driven[0], 1),
            speeds=distinct(driven[1], 3),
            turn_rates=distinct(driven[2], 2),
            distance=round(float(length[mine].sum()) / max(len(runs), 1), 3),
        )
    return out


def has_steady_command(log: Log) -> bool:
    """Return True if a run had nearly the same command in more than half of its rows."""
    if log.twist_command is None:
        return False
    gap = np.linalg.norm(log.twist_command - np.median(log.twist_command, axis=0), axis=1)
    usual = float(np.linalg.norm(np.median(log.twist_command, axis=0)))
    return usual > 0.0 and float((gap < _STEADY * usual).mean()) > 0.5


def by_encoders(
    twist: Float[np.ndarray, "window 3"],
) -> tuple[
    Float[np.ndarray, " heading"], Float[np.ndarray, " speed"], Float[np.ndarray, " yaw_rate"]
]:
    """Return frequent headings [deg], and quantiles of speeds [m/s] and of yaw rates [rad/s].

    All are computed from encoder twists; the quantiles are 10, 50 and 90 %.
    """
    speed = np.linalg.norm(twist[:, :2], axis=1)
    ahead = speed > _MOVED * speed.max(initial=0.0)
    turned = np.abs(twist[:, 2])
    on = turned > _MOVED * turned.max(initial=0.0)
    angle = np.degrees(np.arctan2(twist[ahead, 1], twist[ahead, 0]))
    headings, count = np.unique((np.round(angle / _SECTOR) * _SECTOR) % 360.0, return_counts=True)
    common = headings[count >= _COMMON * count.sum()]
    # Headings by encoders get the range of commanded ones, (-180, 180] deg.
    signed = np.where(common > 180.0, common - 360.0, common)
    parts = (0.1, 0.5, 0.9)
    speeds = np.quantile(speed[ahead], parts) if ahead.any() else np.zeros(0)
    rates = np.quantile(twist[on, 2], parts) if on.any() else np.zeros(0)
    return signed, speeds, rates


def distinct(x: np.ndarray, digits: int) -> tuple[float, ...]:
    """Return the distinct finite values, rounded to `digits`, in rising order."""
    return tuple(sorted({round(float(v), digits) + 0.0 for v in x[np.isfinite(x)]}))


def current_trend(robot: Robot, b: lk.Batch) -> tuple[float, float]:
    """Return a [A] and b [A s/m] of the line a + b v fitted to current residuals.

    v is the speed of the body. A residual is measured less predicted current, times the sign of the
    predicted current; all floors are fitted together.
    """
    predicted = lk.predicted_current(robot, b, lk.predict(robot, b).motor_force)
    residual = np.asarray((b.current - predicted) * jnp.sign(predicted))
    speed = np.broadcast_to((travel(b, robot)[0] / b.dt)[..., None], residual.shape).ravel()
    rows = np.stack([np.ones_like(speed), speed], axis=1)
    known = np.isfinite(residual).ravel() & np.isfinite(speed)
    a, slope = np.linalg.lstsq(rows[known], residual.ravel()[known])[0]
    return float(a), float(slope)
