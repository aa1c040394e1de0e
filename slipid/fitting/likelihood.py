"""Predictions of a robot model for every segment of every run, and their residuals.

A segment is a few neighbouring windows of one run. A residual is the prediction less the
measurement. `slipid.fitting.noise` weights the residuals.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.data.windows import Windows
from slipid.model import contact, se2
from slipid.model.geometry import WheelFrame
from slipid.model.motor import sign_of_motion
from slipid.model.robot import GRAVITY, Robot

Marker = Float[Array, "segment window 3"]
"""Increments of the marker [m, m, rad], or body twists [m/s, m/s, rad/s], of every window."""
NearTwists = Marker | Float[np.ndarray, "segment window 3"]
"""Twists from which the root finder starts, NaN where none is known."""
PerDrive = Float[Array, "segment window drive"]
MotorForce = Float[Array, "segment window drive 2"]
"""Forces of `model.robot.Standing.motor_forces` [mu m g], summed over the wheels of every drive."""
PerChannel = Float[Array, "segment m"]
"""One value per window and drive, in one row per segment: window by window, then drive by drive."""
Std = Float[Array, ""] | float
SMOOTHING_A = 0.03
"""Current magnitude below which the prediction of an unsigned current is smoothed [A]."""
ROUNDING_VARIANCE = {"motion": 1e-9, "current": 1e-6, "voltage": 1e-6}
"""Variance added to every residual for the rounding of the logs, keyed by the kind of residual.

`motion` [m^2] or [rad^2], `current` [A^2], `voltage` [V^2]."""

_AS_THEY_ARE = (
    *("dt", "turn", "speed_change", "direction", "pose"),
    *("current", "voltage", "current_var", "lag"),
)


def with_slope(of: Callable[[Array], Array], z: Array | np.ndarray) -> tuple[Array, Array]:
    """Return the value of function `of` at vector z, and its derivative with respect to z."""
    slope, value = jax.jacfwd(lambda x: (of(x),) * 2, has_aux=True)(z)
    return value, slope


class Batch(eqx.Module):
    """Windows as arrays for compiled functions; names of floors, loads and sessions are indices.

    The indices refer to the robot's stacked parameters. `surface` holds the floor under the whole
    robot (segment,), or under each of its wheels in every window (segment, window, wheel). The
    other fields are those of `slipid.data.windows.Windows`.
    """

    surface: Int[Array, "segment *window_wheel"]
    load: Int[Array, " segment"]
    session: Int[Array, " segment"]
    dt: Float[Array, "segment window"]
    turn: PerDrive
    speed_change: PerDrive
    direction: PerDrive
    pose: Float[Array, "segment edge 3"]
    current: PerDrive
    voltage: PerDrive
    current_var: PerDrive
    lag: Float[Array, ""]
    has_current: bool = eqx.field(static=True)
    has_voltage: bool = eqx.field(static=True)
    signed: bool = eqx.field(static=True)


def indices(of: Callable[[str], int], names: Sequence[str]) -> Int[np.ndarray, " name"]:
    """Return the index of every name; function `of` is called once for each different name."""
    index = {name: of(name) for name in set(names)}
    return np.array([index[name] for name in names], int)


def batch(
    windows: Windows, robot: Robot, floor: Int[np.ndarray, "segment window wheel"] | None = None
) -> Batch:
    """Return the windows as a batch, for a robot that has their floors, loads and sessions.

    `floor` is the surface under each wheel in every window, for windows on several floors.
    """
    if floor is None:
        floor = indices(robot.surface_index, windows.surface)
    return Batch(
        surface=jax.device_put(floor),
        load=jax.device_put(indices(robot.load_index, windows.load)),
        session=jax.device_put(indices(robot.session_index, windows.session)),
        **{name: jax.device_put(np.asarray(getattr(windows, name))) for name in _AS_THEY_ARE},
        has_current=windows.has_current,
        has_voltage=windows.has_voltage,
        signed=windows.current_is_signed,
    )


class ElectricNoise(eqx.Module):
    """Noise that the prediction of voltages depends on.

    Attributes:
        voltage_std: std of the voltmeter noise [V].
        scatter: variance of the true current of every window around the predicted current [A^2],
            without the ammeter's noise.
        resistance: winding resistance R [ohm], which converts the uncertainty of the true current
            to a voltage. It stays fixed during a round of a fit, as the variances do: the variances
            are fitted to the size of the residuals, so that this size cannot inform about R too.
    """

    voltage_std: Std
    scatter: PerChannel
    resistance: Std


class Predicted(eqx.Module):
    """Predicted motion and motor forces of every window.

    Attributes:
        increment: increments of the marker (x, y [m], yaw [rad]).
        twist: body twists (vx, vy [m/s], yaw rate [rad/s]).
        motor_force: contact forces against which each motor works [mu m g].
    """

    increment: Marker
    twist: Marker
    motor_force: MotorForce


def wheel_speed(robot: Robot, b: Batch) -> PerDrive:
    """Return the mean wheel speed of every drive and window at the robot's camera lag [rad/s]."""
    return (b.turn - (robot.camera.lag - b.lag) * b.speed_change) / b.dt[..., None]


@eqx.filter_jit
def predict(robot: Robot, b: Batch, near: NearTwists | None = None) -> Predicted:
    """Return the motion and motor forces of every window at its contact equilibrium.

    `near` holds twists close to the equilibria, so that the root finder is about ten times faster.
    If it does not converge in some window, for example where `near` is NaN, the equilibria of all
    windows are found without `near`.
    """
    frame, w = robot.geometry.frame(), wheel_speed(robot, b)
    still = jax.lax.stop_gradient((robot, frame, w, b, near))

    def attached(w: Array, xi: Array, surface: Array, load: Array) -> Array:
        on = robot.standing(frame, surface, load)
        return contact.differentiable(on.contact(frame.at_wheels(w)), xi)

    twist = each_window(attached, b, w, _roots(*still))
    increment = marker_increments(robot, twist, b.dt, b.session)
    return Predicted(increment, twist, motor_forces(robot, b, twist))


def _roots(
    robot: Robot, frame: WheelFrame, w: PerDrive, b: Batch, near: NearTwists | None
) -> Marker:
    """Return the twist of every window, without derivatives; `near` is as in `predict`."""

    def window(w: Array, near: Array | None, surface: Array, load: Array) -> Array:
        problem = robot.standing(frame, surface, load).contact(frame.at_wheels(w))
        return contact.root(problem) if near is None else contact.root_near(problem, near)

    def from_anywhere() -> Marker:
        return each_window(window, b, w)

    if near is None:
        return from_anywhere()
    found = each_window(window, b, w, near)
    return jax.lax.cond(jnp.all(jnp.isfinite(found)), lambda: found, from_anywhere)


@eqx.filter_jit
def motor_forces(robot: Robot, b: Batch, twist: Marker) -> MotorForce:
    """Return the forces each motor works against in every window at given body twists [mu m g]."""
    frame = robot.geometry.frame()

    def window(w: Array, xi: Array, surface: Array, load: Array) -> Array:
        force = robot.standing(frame, surface, load).motor_forces(xi, frame.at_wheels(w))
        return frame.at_drives(force.T).T

    return each_window(window, b, wheel_speed(robot, b), twist)


def each_window(
    of: Callable[..., Any], b: Batch, w: PerDrive, near: NearTwists | None = None
) -> Any:
    """Return the results of function `of` for every window, with axes (segment, window, ...).

    `of` takes the wheel speeds of a window [rad/s], its element of `near` or None, and the indices
    of its surface and load. `of` is mapped over one flat axis of all windows: with two nested axes,
    JAX would need 50 % more time for tracing.
    """
    segments, windows = b.dt.shape

    def flat(x: Array | np.ndarray) -> Array:
        return jnp.asarray(x).reshape(segments * windows, *x.shape[2:])

    def of_segment(x: Array) -> Array:
        return jnp.repeat(x, windows, axis=0, total_repeat_length=segments * windows)

    surface = flat(b.surface) if b.surface.ndim > 1 else of_segment(b.surface)
    at = None if near is None else flat(near)
    found = jax.vmap(of, (0, None if near is None else 0, 0, 0))(
        flat(w), at, surface, of_segment(b.load)
    )
    return jax.tree.map(lambda x: x.reshape(segments, windows, *x.shape[1:]), found)


@eqx.filter_jit
def marker_increments(
    robot: Robot, twist: Marker, dt: Float[Array, "segment window"], session: Int[Array, " segment"]
) -> Marker:
    """Return the marker increments of every window for given body twists."""

    def window(xi: Array, dt: Array, session: Array) -> Array:
        return robot.camera.marker_increment(se2.advance(xi, dt), session)

    return jax.vmap(jax.vmap(window, (0, 0, None)))(twist, dt, session)


@eqx.filter_jit
def predicted_current(robot: Robot, b: Batch, motor_force: MotorForce) -> PerDrive:
    """Return the predicted motor current of every window [A]; its magnitude for unsigned logs.

    It is the mean over the window, in which wheels at rest have no friction and no traction.
    """
    # `motor_force` is in units of mu m g with mu averaged over the wheels; `weight` is that unit.
    friction = robot.surfaces.friction[b.surface]
    friction = friction[:, None] if b.surface.ndim == 1 else friction.mean(axis=-1)
    weight = friction * robot.body.mass_in(b.load)[:, None] * GRAVITY
    torque = (
        robot.geometry.wheel_radius * weight[..., None] * robot.motor.opposing_force(motor_force)
    )
    torque *= _share_of_motion(b)[..., None]
    amps = robot.motor.current(torque, wheel_speed(robot, b), b.direction)
    if b.signed:
        return amps + robot.motor.current_offset
    return jnp.sqrt(amps**2 + SMOOTHING_A**2) + robot.motor.current_offset


def _share_of_motion(b: Batch) -> Float[Array, "segment window"]:
    """Return the factor from the forces at a window's mean wheel speeds to the mean forces [1].

    The forces of the contact law hardly depend on the size of the wheel speeds, but on their
    directions. The factor is the norm of the mean directions over the norm of the directions of the
    mean speeds: 1 at steady speeds, otherwise about the share of the time in motion.
    """
    steady = sign_of_motion(b.turn / b.dt[..., None])
    mean, of_mean = (jnp.sqrt(jnp.sum(x**2, axis=-1) + 1e-12) for x in (b.direction, steady))
    return jnp.minimum(mean / of_mean, 1.0)


@eqx.filter_jit
def corrected(robot: Robot, pose: Float[Array, "segment edge 3"]) -> Float[Array, "segment edge 3"]:
    """Return logged poses as corrected by the robot's camera model (x, y [m], heading [rad])."""
    return jax.vmap(jax.vmap(robot.camera.corrected))(pose)


@eqx.filter_jit
def measured_increments(robot: Robot, pose: Float[Array, "segment edge 3"]) -> Marker:
    """Return measured marker increments in the frame of each window's start [m, m, rad]."""
    p = corrected(robot, pose)
    c, s = jnp.cos(p[:, :-1, 2]), jnp.sin(p[:, :-1, 2])
    x, y, yaw = jnp.moveaxis(p[:, 1:] - p[:, :-1], -1, 0)
    return jnp.stack([c * x + s * y, c * y - s * x, yaw], axis=-1)


@eqx.filter_jit
def motion_residual(robot: Robot, b: Batch, p: Predicted) -> Float[Array, "segment m"]:
    """Return predicted less measured marker increments, a row per segment [m, m, rad]."""
    return (p.increment - measured_increments(robot, b.pose)).reshape(b.dt.shape[0], -1)


@eqx.filter_jit
def electric_residuals(
    robot: Robot, b: Batch, motor_force: MotorForce, noise: ElectricNoise
) -> dict[str, Array]:
    """Return predicted less measured `current` [A] and `voltage`, as far as they are logged.

    The voltage residual [V] is divided by `voltage_spread`. Voltages are predicted from the
    expected true current, given the measured and the predicted current. If only the measured
    current were used, its noise would bias R towards small values.
    """
    if not b.has_current:
        return {}
    predicted = predicted_current(robot, b, motor_force)
    out = {"current": _flat(predicted - b.current)}
    if b.has_voltage:
        amps = predicted + _true_current_share(b, noise)[0] * (b.current - predicted)
        w = b.turn / b.dt[..., None]
        flow = (amps - robot.motor.current_offset) * _direction(b)
        volts = robot.motor.voltage(flow, w, b.direction)
        out["voltage"] = _flat(volts - b.voltage) / voltage_spread(b, noise)
    return out


def _flat(x: PerDrive) -> PerChannel:
    return x.reshape(x.shape[0], -1)


def _direction(b: Batch) -> PerDrive:
    """Return the factor that gives a logged current the sign of the wheel speed; 1 if signed.

    The factor of an unsigned current passes smoothly from -1 to 1 around standstill.
    """
    return jnp.ones_like(b.turn) if b.signed else sign_of_motion(b.turn / b.dt[..., None])


def _true_current_share(b: Batch, noise: ElectricNoise) -> tuple[PerDrive, PerDrive]:
    """Return the regression factor k from measured to true current, and the remaining variance.

    The true current is N(predicted, s^2) before it is measured with noise of variance sigma^2.
    After the measurement it is N(predicted + k (measured - predicted), k sigma^2) with
    k = s^2 / (s^2 + sigma^2); k sigma^2 [A^2] is the second result. Source: Kelly 2007, ApJ 665(2);
    his distribution of true values is here the one around the model's prediction.
    """
    scatter = noise.scatter.reshape(b.current.shape)
    share = scatter / (scatter + b.current_var)
    return share, share * b.current_var


@eqx.filter_jit
def log_jacobians(robot: Robot, b: Batch, noise: ElectricNoise) -> tuple[Array, Array]:
    """Return log |d residuals / d data| of motion and of voltages, one value per segment each.

    Both depend on fitted parameters: measured positions are corrected by the camera model, and
    voltage residuals are divided by `voltage_spread`. Without these terms, the likelihood would
    rise for parameter values that merely shrink all residuals, such as a small camera scale.
    """
    camera = camera_log_jacobian(robot, b.pose)
    if not (b.has_current and b.has_voltage):
        return camera, jnp.zeros_like(camera)
    return camera, -jnp.sum(jnp.log(voltage_spread(b, noise)), axis=1)


@eqx.filter_jit
def camera_log_jacobian(
    robot: Robot, pose: Float[Array, "segment edge 3"]
) -> Float[Array, " segment"]:
    """Return log |d motion residuals / d logged poses| of segments whose first pose is fixed."""
    return jnp.sum(jax.vmap(jax.vmap(robot.camera.log_jacobian))(pose[:, 1:]), axis=1)


def voltage_spread(b: Batch, noise: ElectricNoise) -> PerChannel:
    """Return the factor by which the std of the voltage residual exceeds that of the voltmeter.

    The excess comes from the uncertainty of the true current after its measurement, times R.
    """
    unknown = (noise.resistance * _direction(b)) ** 2 * _true_current_share(b, noise)[1]
    return _flat(jnp.sqrt(1.0 + unknown / noise.voltage_std**2))


def voltage_std(log_variance: Float[Array, ""]) -> Float[Array, ""]:
    """Return the std of the voltage noise [V], rounding included, from the log of its variance.

    `voltage_spread` divides by this std, which the rounding (`ROUNDING_VARIANCE`) keeps above zero.
    """
    return jnp.sqrt(jnp.exp(log_variance) + ROUNDING_VARIANCE["voltage"])
