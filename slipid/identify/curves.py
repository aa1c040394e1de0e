"""Slip against torque of every floor, with its band, and what range the data saw."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.data.dataset import Dataset
from slipid.identify import likelihood as lk
from slipid.model import robot as model
from slipid.model.contact import V0
from slipid.model.robot import GRAVITY, Robot
from slipid.parameter import Space

POINTS = 41
_SLIP = np.concatenate([np.linspace(0, 0.2, 81), np.linspace(0.2, 1.0, 81)[1:]])


@jax.jit
def seen(robot: Robot, b: lk.Batch) -> tuple[Array, Array, Array]:
    """Wheel speeds [rad/s], torques [N m] and slips of every window (piece, window, wheel).

    The slip is the sliding speed over the wheel's activity, rim and roller speed together, so that
    it stays finite at a wheel that stands.
    """
    frame = robot.geometry.frame()
    speed = lk.wheel_speed(robot, b)

    def one(w: Array, surface: Array, load: Array) -> tuple[Array, Array]:
        xi = model.twist(robot, frame, w, surface, load)
        rim = frame.radius * w
        active = jnp.sqrt(rim**2 + (frame.roll @ xi) ** 2 + 1e-12)
        torque = model.wheel_torque(robot, frame, xi, w, surface, load)
        return torque, (rim * frame.pull - frame.hold @ xi) / active

    return speed, *jax.vmap(jax.vmap(one, (0, None, None)))(speed, b.surface, b.load)


def torque_of_slip(robot: Robot, wheel_speed: Any, share: float) -> Float[Array, "surface slip"]:
    """Torque [N m] of a wheel that slips by `_SLIP` along its drive direction, on every floor.

    tau = r mu m g N (tanh(vs / (v0 + s0 r w)) + kv vs),  vs = s r w

    Args:
        wheel_speed: w (surface,) [rad/s].
        share: N, of the weight on this wheel.

    Source: `slipid.model.contact` without sideways rolling.
    """
    floor = robot.surfaces
    rim = (robot.geometry.wheel_radius * wheel_speed)[:, None]
    slide = jnp.asarray(_SLIP) * rim
    grip = jnp.tanh(slide / (V0 + floor.creep[:, None] * rim))
    grip = grip + floor.slide_viscosity[:, None] * slide
    weight = robot.body.mass * GRAVITY * share
    return robot.geometry.wheel_radius * floor.friction[:, None] * weight * grip


def curves(
    space: Space,
    z: Float[np.ndarray, " free"],
    draws: Float[np.ndarray, "draw free"],
    b: lk.Batch,
) -> dict[str, dict[str, Any]]:
    """Slip over torque per floor with a 90 % band, over the torques that occurred.

    Taken at the median speed of the wheels that turned and an even load.
    """
    robot = space.tree(jnp.asarray(z))
    speed, torque = (np.abs(np.asarray(x)) for x in seen(robot, b)[:2])
    labels, floor = robot.surfaces.labels, np.asarray(b.surface)
    share = 1.0 / speed.shape[-1]
    median = []
    for k in range(len(labels)):
        mine = speed[floor == k]
        turned = mine[mine > 0.05 * max(mine.max(initial=0.0), 1e-9)]
        median.append(float(np.median(turned)) if turned.size else 1.0)
    at = jnp.asarray(median)
    best = np.asarray(torque_of_slip(robot, at, share))
    band = np.asarray(
        jax.jit(jax.vmap(lambda x: torque_of_slip(space.tree(x), at, share)))(jnp.asarray(draws))
    )
    out = {}
    for k, label in enumerate(labels):
        top = min(float(np.quantile(torque[floor == k], 0.98)), 0.999 * float(best[k].max()))
        grid = np.linspace(0.0, top, POINTS)
        each = np.stack([np.interp(grid, row, _SLIP) for row in band[:, k]])
        low, high = np.quantile(each, [0.05, 0.95], axis=0)
        out[label] = {
            "torque_nm": grid.tolist(),
            "slip": np.interp(grid, best[k], _SLIP).tolist(),
            "slip_lo": low.tolist(),
            "slip_hi": high.tolist(),
            "at": {"wheel_speed": median[k], "load_share": share},
        }
    return out


def slip_on(robot: Robot, floor: str, curve: dict[str, Any]) -> Float[np.ndarray, " torque"]:
    """Slip by a robot's own law at the torques, the speed and the load of a curve of `curves`."""
    at = jnp.full(len(robot.surfaces.labels), curve["at"]["wheel_speed"])
    torque = torque_of_slip(robot, at, curve["at"]["load_share"])[robot.surface_index(floor)]
    return np.interp(curve["torque_nm"], np.asarray(torque), _SLIP)


def validity(data: Dataset, robot: Robot, b: lk.Batch) -> dict[str, dict[str, Any]]:
    """What each floor was seen with: outside of it the fit extrapolates."""
    speed, torque, slip = (np.asarray(x) for x in seen(robot, b))
    back = np.linalg.pinv(np.asarray(robot.geometry.forward()))[2] * robot.geometry.wheel_radius
    yaw = np.abs(speed @ np.asarray(back))  # by the encoders: what was driven, not how it slipped
    speed, torque, slip = np.abs(speed), np.abs(torque), np.abs(slip)
    floor = np.asarray(b.surface)
    far = lk.travel(b, robot)[0].sum(axis=1)
    out: dict[str, dict[str, Any]] = {}
    for k, label in enumerate(robot.surfaces.labels):
        runs = [i for i, log in enumerate(data.logs) if (log.surface or "unknown") == label]
        heading = np.degrees(data.heading[runs])
        body = data.speed[runs]
        out[label] = {
            "runs": len(runs),
            "loads": sorted({data.logs[i].load for i in runs}),
            "wheel_speed": [0.0, float(speed[floor == k].max())],
            "torque_nm": [0.0, float(torque[floor == k].max())],
            "slip": [0.0, float(slip[floor == k].max())],
            "yaw_rate": [0.0, float(yaw[floor == k].max())],
            "headings_deg": sorted({round(float(h), 1) for h in heading[np.isfinite(heading)]}),
            "speeds": sorted({round(float(s), 3) for s in body[np.isfinite(body)]}),
            "turn_rates": sorted({round(float(t), 2) for t in data.turn[runs] if np.isfinite(t)}),
            "distance": round(float(far[floor == k].sum()) / max(len(runs), 1), 3),
        }
    return out


def current_trend(robot: Robot, b: lk.Batch) -> tuple[float, float]:
    """Least squares a + b v of measured less predicted sizes of currents, v by the encoders.

    Returns:
        a [A] and b [A s/m], over all floors.
    """
    predicted = lk.predicted_current(robot, b, lk.predict(robot, b).felt)
    gap = np.asarray((b.current - predicted) * jnp.sign(predicted))
    speed = np.broadcast_to((lk.travel(b, robot)[0] / b.dt)[..., None], gap.shape).ravel()
    rows = np.stack([np.ones_like(speed), speed], axis=1)
    known = np.isfinite(gap).ravel() & np.isfinite(speed)
    a, slope = np.linalg.lstsq(rows[known], gap.ravel()[known])[0]
    return float(a), float(slope)
