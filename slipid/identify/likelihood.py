"""What a robot predicts of every piece of every run, and how the difference is weighed.

A piece is a few neighbouring windows of one run. Its residuals have the covariance

    V = sum_c v_c B_c,   B from: camera place and heading noise, shared by neighbouring windows;
                         process noise along, across and in yaw, growing with distance, per floor;
                         the run's own effect along, across and in yaw, per floor

so the run effects are marginalised. Structural numbers move the residuals, variances the weights.
"""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.data.dataset import Windows
from slipid.model import robot as model
from slipid.model.robot import Robot

SMOOTH = 0.03
"""Magnitude below which the mean of an unsigned current levels off [A]."""


class Batch(eqx.Module):
    """Windows as arrays for a jitted function; names are indices of the robot's stacks.

    Attributes:
        surface: under the robot (piece,), or under each of its wheels (piece, wheel).
    """

    surface: Int[Array, "piece *wheel"]
    load: Int[Array, " piece"]
    session: Int[Array, " piece"]
    dt: Float[Array, "piece window"]
    turn: Float[Array, "piece window wheel"]
    faster: Float[Array, "piece window wheel"]
    pose: Float[Array, "piece edge 3"]
    current: Float[Array, "piece window wheel"]
    voltage: Float[Array, "piece window wheel"]
    current_var: Float[Array, "piece window wheel"]
    lag: Float[Array, ""]
    has_current: bool = eqx.field(static=True)
    has_voltage: bool = eqx.field(static=True)
    signed: bool = eqx.field(static=True)


def batch(
    windows: Windows, robot: Robot, floor: Int[np.ndarray, "piece wheel"] | None = None
) -> Batch:
    """Batch for a robot that knows the floors, loads and sessions of the windows.

    Args:
        floor: surface under each wheel, where the windows do not know theirs.
    """
    if floor is None:
        floor = np.asarray([robot.surface_index(s) for s in windows.surface])
    return Batch(
        surface=jnp.asarray(floor),
        load=jnp.asarray([robot.load_index(s) for s in windows.load]),
        session=jnp.asarray([robot.session_index(s) for s in windows.session]),
        dt=jnp.asarray(windows.dt),
        turn=jnp.asarray(windows.turn),
        faster=jnp.asarray(windows.faster),
        pose=jnp.asarray(windows.pose),
        current=jnp.asarray(windows.current),
        voltage=jnp.asarray(windows.voltage),
        current_var=jnp.asarray(windows.current_var),
        lag=jnp.asarray(windows.lag),
        has_current=windows.has_current,
        has_voltage=windows.has_voltage,
        signed=windows.current_is_signed,
    )


class Predicted(eqx.Module):
    """What the robot says of each window.

    Attributes:
        increment: of the marker (x, y [m], yaw [rad]).
        twist: of the body.
        felt: traction of each wheel's motor in units of mu m g.
    """

    increment: Float[Array, "piece window 3"]
    twist: Float[Array, "piece window 3"]
    felt: Float[Array, "piece window wheel"]


def wheel_speed(robot: Robot, b: Batch) -> Float[Array, "piece window wheel"]:
    """Mean wheel speed of every window at the robot's camera lag [rad/s]."""
    return (b.turn - (robot.camera.lag - b.lag) * b.faster) / b.dt[..., None]


def predict(
    robot: Robot, b: Batch, near: Float[Array, "piece window 3"] | None = None
) -> Predicted:
    """Contact equilibrium of every window.

    Args:
        near: twists close to it, see `slipid.model.robot.twist`.
    """
    frame = robot.geometry.frame()

    def window(w: Any, dt: Any, near: Any, surface: Any, load: Any, session: Any) -> Any:
        xi = model.twist(robot, frame, w, surface, load, near)
        increment = robot.camera.seen(model.advance(xi, dt), session)
        return increment, xi, model.felt(robot, frame, xi, w, surface, load)

    piece = jax.vmap(window, (0, 0, None if near is None else 0, None, None, None))
    lanes = (0, 0, None if near is None else 0, 0, 0, 0)
    return Predicted(
        *jax.vmap(piece, lanes)(wheel_speed(robot, b), b.dt, near, b.surface, b.load, b.session)
    )


def seen(
    robot: Robot, b: Batch, twist: Float[Array, "piece window 3"]
) -> Float[Array, "piece window 3"]:
    """Marker increments of every window for given body twists."""

    def window(xi: Any, dt: Any, session: Any) -> Array:
        return robot.camera.seen(model.advance(xi, dt), session)

    return jax.vmap(jax.vmap(window, (0, 0, None)))(twist, b.dt, b.session)


def predicted_current(
    robot: Robot, b: Batch, felt: Float[Array, "piece window wheel"]
) -> Float[Array, "piece window wheel"]:
    """Motor current of every window [A] given the traction, a magnitude where the log has those."""
    friction = robot.surfaces.friction[b.surface].reshape(b.dt.shape[0], -1).mean(axis=1)
    weight = friction * robot.body.mass * model.GRAVITY
    torque = robot.geometry.wheel_radius * weight[:, None, None] * felt
    amps = robot.motor.current(torque, wheel_speed(robot, b))
    if b.signed:
        return amps + robot.motor.current_offset
    return jnp.sqrt(amps**2 + SMOOTH**2) + robot.motor.current_offset


def measured(robot: Robot, pose: Float[Array, "piece edge 3"]) -> Float[Array, "piece window 3"]:
    """Marker increments in the frame of each window's start, in corrected metres."""

    def piece(edges: Float[Array, "edge 3"]) -> Float[Array, "window 3"]:
        p = jax.vmap(robot.camera.corrected)(edges)
        c, s = jnp.cos(p[:-1, 2]), jnp.sin(p[:-1, 2])
        d = p[1:] - p[:-1]
        return jnp.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], axis=-1)

    return jax.vmap(piece)(pose)


def motion_residual(robot: Robot, b: Batch, p: Predicted) -> Float[Array, "piece m"]:
    """Predicted less measured marker increments, a row per piece [m, m, rad]."""
    return (p.increment - measured(robot, b.pose)).reshape(b.dt.shape[0], -1)


def electric_residuals(
    robot: Robot,
    b: Batch,
    felt: Float[Array, "piece window wheel"],
    voltage_std: Float[Array, ""] | float,
) -> dict[str, Array]:
    """Predicted less measured `current` [A] and `voltage` [V], as far as they are logged.

    Args:
        felt: traction of each wheel's motor in units of mu m g.
        voltage_std: of the voltage noise [V]; the noise of the measured current is carried into the
            voltage equation by R, which keeps R from being attenuated.
    """
    n = b.dt.shape[0]
    out = {}
    if b.has_current:
        out["current"] = (predicted_current(robot, b, felt) - b.current).reshape(n, -1)
    if b.has_current and b.has_voltage:
        w = b.turn / b.dt[..., None]
        amps = b.current - robot.motor.current_offset
        if not b.signed:
            amps = amps * jnp.tanh(w / 0.2)
        gap = robot.motor.voltage(amps, w) - b.voltage
        out["voltage"] = (gap / _spread(robot, b, voltage_std)).reshape(n, -1)
    return out


def log_jacobians(
    robot: Robot, b: Batch, voltage_std: Float[Array, ""] | float
) -> tuple[Float[Array, " piece"], Float[Array, " piece"]]:
    """Log |d residuals / d data| of the motion and of the voltage of every piece.

    The camera corrects measured places and the voltage residual is scaled by its own spread:
    without these terms a smaller scale would fit better only because it shrinks the residuals.
    """
    camera = camera_log_jacobian(robot, b.pose)
    if not (b.has_current and b.has_voltage):
        return camera, jnp.zeros_like(camera)
    return camera, -jnp.sum(jnp.log(_spread(robot, b, voltage_std)), axis=(1, 2))


def camera_log_jacobian(robot: Robot, pose: Float[Array, "piece edge 3"]) -> Float[Array, " piece"]:
    """Log |d motion residuals / d logged poses| of every piece; its first pose is given."""
    return jnp.sum(jax.vmap(jax.vmap(robot.camera.log_jacobian))(pose[:, 1:]), axis=1)


def _spread(robot: Robot, b: Batch, voltage_std: Any) -> Float[Array, "piece window wheel"]:
    """Std of the voltage residual over that of the voltage noise."""
    return jnp.sqrt(1.0 + robot.motor.resistance**2 * b.current_var / voltage_std**2)


def residuals(robot: Robot, b: Batch, voltage_std: Float[Array, ""] | float) -> dict[str, Array]:
    """Every block of residuals, `motion` first."""
    p = predict(robot, b)
    motion = {"motion": motion_residual(robot, b, p)}
    return motion | electric_residuals(robot, b, p.felt, voltage_std)


@dataclass(frozen=True, eq=False)
class Components:
    """Covariance pieces of one block.

    Attributes:
        base: B_c (piece, component, m, m).
        which: number of the variance each belongs to (piece, component).
    """

    base: Float[np.ndarray, "piece component m m"]
    which: Int[np.ndarray, "piece component"]


@dataclass(frozen=True, eq=False)
class Noise:
    """Variance components: their names, units, typical values and the matrices of each block.

    Attributes:
        names: `camera.place`, `process.<floor>.along`, `run.<floor>.yaw`, ...
        unit: of the std, as text.
        typical: std that the weak log-normal prior is centred on.
        blocks: per block of residuals.
    """

    names: tuple[str, ...]
    unit: tuple[str, ...]
    typical: Float[np.ndarray, " variance"]
    blocks: dict[str, Components]


_MOTION = (
    ("along", "m/sqrt(m)", 0.002),
    ("across", "m/sqrt(m)", 0.002),
    ("yaw", "rad/sqrt(m)", 0.01),
)
_EFFECT = (("along", "m/m", 0.01), ("across", "m/m", 0.01), ("yaw", "rad/m", 0.03))


def noise(windows: Windows, robot: Robot) -> Noise:
    """Variance components for these windows, with distances and directions from the encoders."""
    floors = robot.surfaces.labels
    table = [("camera.place", "m", 0.0005), ("camera.heading", "rad", 0.003)]
    for floor in floors:
        table += [(f"process.{floor}.{n}", u, v) for n, u, v in _MOTION]
        table += [(f"run.{floor}.{n}", u, v) for n, u, v in _EFFECT]
    blocks = {"motion": _motion_components(windows, robot)}
    if windows.has_current:
        start = len(table)
        for floor in floors:
            table += [(f"current.{floor}.window", "A", 0.05), (f"current.{floor}.run", "A", 0.05)]
        blocks["current"] = _current_components(windows, robot, start)
    if windows.has_current and windows.has_voltage:
        n, m = len(windows), windows.turn.shape[1] * windows.turn.shape[2]
        base = np.broadcast_to(np.eye(m), (n, 1, m, m)).copy()
        blocks["voltage"] = Components(base, np.full((n, 1), len(table)))
        table.append(("voltage.window", "V", 0.05))
    return Noise(
        names=tuple(t[0] for t in table),
        unit=tuple(t[1] for t in table),
        typical=np.array([t[2] for t in table]),
        blocks=blocks,
    )


def travel(windows: Windows | Batch, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each window by the encoders (piece, window) [m], and its unit direction."""
    j = np.linalg.pinv(np.asarray(robot.geometry.forward()))
    step = np.asarray(windows.turn) * float(robot.geometry.wheel_radius) @ j.T
    far = np.linalg.norm(step[..., :2], axis=-1)
    turned = np.abs(step[..., 2]) * float(robot.geometry.base_radius)
    u = np.where(
        far[..., None] > 1e-6, step[..., :2] / np.maximum(far, 1e-9)[..., None], [1.0, 0.0]
    )
    return far + turned, u


def _motion_components(windows: Windows, robot: Robot) -> Components:
    far, u = travel(windows, robot)
    n, k = far.shape
    scale = float(robot.camera.scale)
    place, heading = np.zeros((n, 3 * k, 2 * (k + 1))), np.zeros((n, 3 * k, k + 1))
    for j in range(k):
        th = windows.pose[:, j, 2]
        back = (
            np.stack([np.cos(th), np.sin(th), -np.sin(th), np.cos(th)], -1).reshape(n, 2, 2) * scale
        )
        place[:, 3 * j : 3 * j + 2, 2 * j : 2 * j + 2] = -back
        place[:, 3 * j : 3 * j + 2, 2 * j + 2 : 2 * j + 4] = back
        move = np.einsum("nij,nj->ni", back, windows.pose[:, j + 1, :2] - windows.pose[:, j, :2])
        heading[:, 3 * j, j], heading[:, 3 * j + 1, j] = move[:, 1], -move[:, 0]
        heading[:, 3 * j + 2, j], heading[:, 3 * j + 2, j + 1] = -1.0, 1.0
    axes = _axes(u)
    grown = axes * np.sqrt(far)[None, :, None, :]
    effect = effects(windows, robot).transpose(2, 0, 1)[..., None]
    parts = [place, heading, *grown, *effect]
    base = np.stack([p @ p.transpose(0, 2, 1) for p in parts], axis=1)
    floor = np.array([robot.surface_index(s) for s in windows.surface])
    which = np.concatenate(
        [np.zeros((n, 1), int), np.ones((n, 1), int), 2 + 6 * floor[:, None] + np.arange(6)], axis=1
    )
    return Components(base, which)


def _axes(u: np.ndarray) -> np.ndarray:
    """Direction of along, across and yaw in each window (axis, piece, 3 window, window)."""
    n, k, _ = u.shape
    axes = np.zeros((3, n, 3 * k, k))
    for j in range(k):
        axes[0, :, 3 * j : 3 * j + 2, j] = u[:, j]
        axes[1, :, 3 * j, j], axes[1, :, 3 * j + 1, j] = -u[:, j, 1], u[:, j, 0]
        axes[2, :, 3 * j + 2, j] = 1.0
    return axes


def effects(windows: Windows, robot: Robot) -> Float[np.ndarray, "piece m 3"]:
    """What one unit of an effect along, across and in yaw moves in the residuals of a piece."""
    far, u = travel(windows, robot)
    return (_axes(u) * far[None, :, None, :]).sum(-1).transpose(1, 2, 0)


def _current_components(windows: Windows, robot: Robot, start: int) -> Components:
    n, k, w = windows.turn.shape
    same = np.kron(np.ones((k, k)), np.eye(w))
    base = np.broadcast_to(np.stack([np.eye(k * w), same]), (n, 2, k * w, k * w)).copy()
    floor = np.array([robot.surface_index(s) for s in windows.surface])
    return Components(base, start + 2 * floor[:, None] + np.arange(2))


FLOOR = {"motion": 1e-9, "current": 1e-6, "voltage": 1e-6}
"""Variance added to every residual: rounding of the logs [m^2, A^2, V^2]."""


def voltage_std(log_variance: Any) -> Array:
    """Std of the voltage noise, rounding included, from the log of its variance [V].

    The voltage residual is in units of it: without the floor it would vanish with the noise.
    """
    return jnp.sqrt(jnp.exp(log_variance) + FLOOR["voltage"])


def voltage_share(
    robot: Robot, b: Batch, voltage_std: Float[Array, ""] | float
) -> Float[Array, "piece m"]:
    """Part that the voltage's own noise has in the variance of every voltage residual."""
    return (1 / _spread(robot, b, voltage_std) ** 2).reshape(b.dt.shape[0], -1)


def covariance(c: Components, variance: Any, block: str) -> Any:
    """V of every piece from the variances (variance,) ."""
    v = jnp.asarray(variance)[jnp.asarray(c.which)]
    m = c.base.shape[-1]
    return jnp.einsum("nc,ncij->nij", v, jnp.asarray(c.base)) + FLOOR[block] * jnp.eye(m)
