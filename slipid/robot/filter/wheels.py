"""Wheel speeds and motor currents from encoders, ammeters and voltmeters with gaps and outliers."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from slipid.robot.deployed import RobotArrays
from slipid.robot.interface import UNTIMED_S, Readings, Settings


class WheelState(eqx.Module):
    """Motion of the wheels.

    Attributes:
        speed: speed of the wheels of each drive [rad/s].
        age: age of the last reading of each drive [s].
        angle: encoder angle up to which `speed` has accounted for motion [rad]; NaN before the
            first reading.
    """

    speed: Float[Array, " drive"]
    angle: Float[Array, " drive"]
    age: Float[Array, " drive"]

    @classmethod
    def init(cls, robot: RobotArrays, settings: Settings) -> "WheelState":
        """Return the state at rest before the first reading."""
        n = robot.drives
        return cls(
            speed=jnp.zeros(n),
            angle=jnp.full(n, jnp.nan, dtype=float),
            age=jnp.full(n, 10 * settings.stale_s, dtype=float),
        )


class MotorCurrents(eqx.Module):
    """Motor currents after one step.

    Attributes:
        filtered: filtered current [A]; its magnitude if `measured` is 1.
        measured: 0 if nothing was measured, 1 if only the magnitude, 2 if also the sign.
        variance: variance of the measured current due to noise of the sensors [A^2].
    """

    filtered: Float[Array, " drive"]
    measured: Int[Array, " drive"]
    variance: Float[Array, " drive"]


def time_step(dt: Float[Array, ""] | float, settings: Settings) -> Float[Array, ""]:
    """Return a time step limited to `Settings.longest_s`; 0 if it is not a positive number [s]."""
    dt = jnp.asarray(dt, dtype=float)
    passed = jnp.isfinite(dt) & (dt > 0)
    return jnp.where(passed, jnp.clip(dt, 1e-4, settings.longest_s), 0.0)


def read_wheels(
    robot: RobotArrays, settings: Settings, old: WheelState, z: Readings, dt: Array
) -> WheelState:
    """Return the motion of the wheels one time step `dt` [s] later.

    A wheel without readings keeps its speed until it is stale, then it counts as at rest. When the
    encoder's readings return, the next step includes the motion missed in between.
    """
    most = 4.0 * robot.highest[0]
    turned = (z.wheel_angle - old.angle) / jnp.maximum(dt, 1e-3)
    by_angle = jnp.isfinite(turned) & (jnp.abs(turned) < most) & (dt > 0)
    by_speed = jnp.isfinite(z.wheel_speed) & (jnp.abs(z.wheel_speed) < most)
    read = jnp.where(by_angle, turned, jnp.where(by_speed, z.wheel_speed, old.speed))
    known = jnp.isfinite(z.wheel_angle) & (jnp.abs(z.wheel_angle) < 1e7)
    # the first angle gives no speed yet: accept it as a reading of a wheel at rest
    first = known & ~jnp.isfinite(old.angle) & ~by_speed
    good = by_angle | by_speed | first
    # readings without a valid time step give no speed, so they do not reset the age
    age = jnp.where(good & (dt > 0), 0.0, jnp.minimum(old.age + jnp.maximum(dt, UNTIMED_S), 1e3))
    speed = jnp.where(age > settings.stale_s, 0.0, read)
    counts = known & ((dt > 0) | ~jnp.isfinite(old.angle))
    angle = jnp.where(counts, z.wheel_angle, old.angle + speed * dt)
    return WheelState(speed=speed, angle=angle, age=age)


def read_currents(
    robot: RobotArrays, settings: Settings, old: Array, z: Readings, w: Array, dt: Array
) -> MotorCurrents:
    """Return currents from ammeters and, by the motor's voltage equation, from voltmeters.

    Args:
        robot: robot with the constants of its motor.
        settings: settings with the noise of the sensors and the filter's time constant.
        old: filtered currents before the step [A].
        z: readings.
        w: wheel speeds [rad/s].
        dt: time step [s].
    """
    s, motor, most = settings, robot.motor, 10.0 * robot.highest[1]
    known = jnp.isfinite(z.current) & (jnp.abs(z.current) < most)
    volts = jnp.isfinite(z.voltage) & (jnp.abs(z.voltage) < 1e3)
    by_volts = (z.voltage - motor.voltage(jnp.zeros_like(w), w)) / motor.resistance
    volts &= jnp.abs(by_volts) < most
    var_i, var_u = s.ammeter_std_a**2, (s.voltmeter_std_v / motor.resistance) ** 2
    zero = z.current - motor.current_offset
    sign = jnp.where(by_volts < 0, -1.0, 1.0)
    ammeter = zero if s.current_is_signed else jnp.where(volts, sign * jnp.abs(zero), jnp.abs(zero))
    share = jnp.where(known & volts, var_u / (var_i + var_u), jnp.where(volts, 0.0, 1.0))
    now = share * jnp.where(known, ammeter, 0.0) + (1 - share) * jnp.where(volts, by_volts, 0.0)
    read = known | volts
    a = 1 - jnp.exp(-dt / s.filter_s)
    # a voltage gives the sign; an unsigned ammeter without a voltage gives only the magnitude
    return MotorCurrents(
        filtered=jnp.where(read, old + a * (now - old), old),
        measured=jnp.where(read, jnp.where(volts | s.current_is_signed, 2, 1), 0),
        variance=share**2 * var_i + (1 - share) ** 2 * var_u,
    )
