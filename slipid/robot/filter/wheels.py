"""What encoders, ammeters and voltmeters tell of the wheels, lost and false readings included."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from slipid.robot.deployed import RobotArrays
from slipid.robot.interface import UNTIMED_S, Readings, Settings


class WheelState(eqx.Module):
    """How the wheels turn.

    Attributes:
        speed: of the wheels of each drive [rad/s]; age: of its last reading [s].
        angle: up to which motion is counted [rad]; NaN before the first reading.
    """

    speed: Float[Array, " drive"]
    angle: Float[Array, " drive"]
    age: Float[Array, " drive"]

    @classmethod
    def init(cls, robot: RobotArrays, settings: Settings) -> "WheelState":
        """At rest, and not heard of yet."""
        n = robot.drives
        return cls(
            speed=jnp.zeros(n),
            angle=jnp.full(n, jnp.nan, dtype=float),
            age=jnp.full(n, 10 * settings.stale_s, dtype=float),
        )


class MotorCurrents(eqx.Module):
    """What is known of the motor currents.

    Attributes:
        filtered: [A]; without a sign where `told` is 1.
        told: 0 where nothing was measured, 1 for the size alone, 2 with the sign.
        variance: of the sensors [A^2].
    """

    filtered: Float[Array, " drive"]
    told: Int[Array, " drive"]
    variance: Float[Array, " drive"]


def time_step(dt: Float[Array, ""] | float, settings: Settings) -> Float[Array, ""]:
    """A time step [s] as it counts: 0 where it is no positive number, `longest_s` at most."""
    dt = jnp.asarray(dt, dtype=float)
    passed = jnp.isfinite(dt) & (dt > 0)
    return jnp.where(passed, jnp.clip(dt, 1e-4, settings.longest_s), 0.0)


def read_wheels(
    robot: RobotArrays, settings: Settings, old: WheelState, z: Readings, dt: Array
) -> WheelState:
    """Wheel speeds, angles up to which motion is counted, and how old each wheel's reading is.

    A wheel that is not heard keeps its speed until it is stale, then it counts as standing; when it
    is heard again, what it has turned more than was counted is made up for.
    """
    most = 4.0 * robot.highest[0]
    turned = (z.wheel_angle - old.angle) / jnp.maximum(dt, 1e-3)
    by_angle = jnp.isfinite(turned) & (jnp.abs(turned) < most) & (dt > 0)
    by_speed = jnp.isfinite(z.wheel_speed) & (jnp.abs(z.wheel_speed) < most)
    read = jnp.where(by_angle, turned, jnp.where(by_speed, z.wheel_speed, old.speed))
    known = jnp.isfinite(z.wheel_angle) & (jnp.abs(z.wheel_angle) < 1e7)
    first = known & ~jnp.isfinite(old.angle) & ~by_speed  # nothing to compare with: it stands
    good = by_angle | by_speed | first
    # a clock that stands, or says nothing, tells nothing of wheels either
    age = jnp.where(good & (dt > 0), 0.0, jnp.minimum(old.age + jnp.maximum(dt, UNTIMED_S), 1e3))
    speed = jnp.where(age > settings.stale_s, 0.0, read)
    heard = known & ((dt > 0) | ~jnp.isfinite(old.angle))
    angle = jnp.where(heard, z.wheel_angle, old.angle + speed * dt)
    return WheelState(speed=speed, angle=angle, age=age)


def read_currents(
    robot: RobotArrays, settings: Settings, old: Array, z: Readings, w: Array, dt: Array
) -> MotorCurrents:
    """Currents from ammeters and, through the motor's equation, from voltmeters.

    `old` are the filtered ones before the step [A], `w` wheel speeds [rad/s].
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
    heard = known | volts
    a = 1 - jnp.exp(-dt / s.filter_s)
    # with a voltage the sign is known; without, and unsigned, only the size
    return MotorCurrents(
        filtered=jnp.where(heard, old + a * (now - old), old),
        told=jnp.where(heard, jnp.where(volts | s.current_is_signed, 2, 1), 0),
        variance=share**2 * var_i + (1 - share) ** 2 * var_u,
    )
