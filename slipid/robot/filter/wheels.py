"""Wheel speeds and motor currents from encoders, ammeters and voltmeters with gaps and outliers.

An encoder's reading is plausible if the wheel turned, since the last reading, by anything between
nothing and as far as at its usual speed, give or take what `Settings.wheel_acceleration` allows.
An encoder that repeats its last angle may be late: what it owes then may come at once. A reading
that is not plausible is set aside and counted, and the wheel coasts. The next reading is compared
both with the last plausible reading and with the one that was set aside: so an outlier is skipped,
and after a lasting offset (a reset or a skip) the motion goes on from the new angle. If neither
fits, but the speed between the last two readings is the one that was set aside, the wheel really
has this speed, and the motion missed in between is added.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from slipid.robot.deployed import RobotArrays
from slipid.robot.interface import UNTIMED_S, Readings, Settings

ANGLE_NOISE = 0.02
"""Plausible error of an encoder's angle in addition to its resolution [rad]."""
COARSEST_TICK = 0.15
"""Resolution of an encoder that is assumed until smaller increments are read [rad]."""
SPEED_NOISE = 0.5
"""Plausible error of a wheel speed that a robot reports [rad/s]."""
SPEED_JITTER = 0.25
"""Plausible relative error of a speed, since time steps are known inaccurately [1]."""
LONGEST_CHANGE_S = 0.1
"""Longest time over which a wheel is assumed to accelerate [s]."""
RATE_S = 0.05
"""Time constant of the low-pass filter of the usual speed [s]."""
LONGEST_LATE_S = 0.5
"""Longest time for which an encoder that repeats its angle may be late [s]."""
LONGEST_GAP_S = 1.0
"""Longest time without readings after which the motion in between is still added [s]."""
NO_SPEED = 1e9
"""Value of `WheelState.aside` if the last reading was believed [rad/s]."""


class WheelState(eqx.Module):
    """Motion of the wheels.

    Attributes:
        speed: speed of the wheels of each drive in the last step, including motion that was missed
            before [rad/s].
        rate: usual speed, at which a wheel without a reading coasts [rad/s].
        angle: last reading of each encoder that was believed [rad]; NaN before the first reading.
        ahead: motion since `angle` that `speed` has accounted for [rad].
        since: time since `angle` was read first [s].
        other: last reading of each encoder [rad].
        other_ahead: motion since `other` that `speed` has accounted for [rad].
        other_since: time since `other` was read [s].
        lag: angle by which the readings are behind the usual speed, which may come at once [rad].
        age: age of the last reading of each drive that was believed [s].
        aside: speed by the last reading if that was set aside, else `NO_SPEED` [rad/s].
        tick: smallest increment of each encoder so far [rad].
        rejected: number of readings of all drives that were set aside since the start.
    """

    speed: Float[Array, " drive"]
    rate: Float[Array, " drive"]
    angle: Float[Array, " drive"]
    ahead: Float[Array, " drive"]
    since: Float[Array, " drive"]
    other: Float[Array, " drive"]
    other_ahead: Float[Array, " drive"]
    other_since: Float[Array, " drive"]
    lag: Float[Array, " drive"]
    age: Float[Array, " drive"]
    aside: Float[Array, " drive"]
    tick: Float[Array, " drive"]
    rejected: Float[Array, ""]

    @classmethod
    def init(cls, robot: RobotArrays, settings: Settings) -> "WheelState":
        """Return the state at rest before the first reading."""
        n = robot.drives
        zero = jnp.zeros(n)
        return cls(
            speed=zero,
            rate=zero,
            angle=jnp.full(n, jnp.nan, dtype=float),
            ahead=zero,
            since=zero,
            other=zero,
            other_ahead=zero,
            other_since=zero,
            lag=zero,
            age=jnp.full(n, 10 * settings.stale_s, dtype=float),
            aside=jnp.full(n, NO_SPEED, dtype=float),
            tick=jnp.full(n, COARSEST_TICK, dtype=float),
            rejected=jnp.zeros(()),
        )


class MotorCurrents(eqx.Module):
    """Motor currents after one step.

    Attributes:
        filtered: filtered current [A]; its magnitude if `measured` is 1.
        measured: 0 if nothing was measured, 1 if only the magnitude, 2 if also the sign.
        variance: variance of the measured current due to noise of the sensors [A^2].
        rejected: number of readings that were set aside.
    """

    filtered: Float[Array, " drive"]
    measured: Int[Array, " drive"]
    variance: Float[Array, " drive"]
    rejected: Float[Array, ""]


def time_step(dt: Float[Array, ""] | float, settings: Settings) -> Float[Array, ""]:
    """Return a time step limited to `Settings.longest_s`; 0 if it is not a positive number [s]."""
    dt = jnp.asarray(dt, dtype=float)
    passed = jnp.isfinite(dt) & (dt > 0)
    return jnp.where(passed, jnp.clip(dt, 1e-4, settings.longest_s), 0.0)


def read_wheels(
    robot: RobotArrays, settings: Settings, old: WheelState, z: Readings, dt: Array
) -> WheelState:
    """Return the motion of the wheels one time step `dt` [s] later.

    A wheel without plausible readings keeps its speed until it is stale, then it counts as at rest.
    When the encoder's readings return within `LONGEST_GAP_S`, the next step includes the motion
    missed in between.
    """
    timed, most, stale_s = dt > 0, 4.0 * robot.highest[0], settings.stale_s
    since, other_since, age = old.since + dt, old.other_since + dt, old.age + dt
    known = jnp.isfinite(z.wheel_angle) & (jnp.abs(z.wheel_angle) < 1e7)
    # the first angle, also that after a long gap, gives no speed yet
    first = known & (~jnp.isfinite(old.angle) | (other_since > LONGEST_GAP_S))
    compared = known & timed & ~first
    total, other_total = (
        jnp.where(compared, z.wheel_angle - angle, 0.0) for angle in (old.angle, old.other)
    )
    in_a_row = (old.other_since == 0) & (jnp.abs(other_total) > 1e-6)
    tick = jnp.where(in_a_row, jnp.minimum(old.tick, jnp.abs(other_total)), old.tick)

    jitter = SPEED_JITTER * jnp.abs(old.rate)

    def change(time: Array) -> Array:
        """Return by how much a speed may change in a time [rad/s]."""
        return settings.wheel_acceleration * jnp.minimum(time, LONGEST_CHANGE_S) + jitter

    def fit(moved: Array, time: Array, age: Array, speed: Array) -> Array:
        """Return whether a motion [rad] in a time is plausible, at up to the usual or this speed.

        `age` is the age of the last reading that was believed.
        """
        usual, other = old.rate * time, speed * time
        low = jnp.minimum(jnp.minimum(jnp.minimum(usual, usual + old.lag), other), 0.0)
        high = jnp.maximum(jnp.maximum(jnp.maximum(usual, usual + old.lag), other), 0.0)
        far = ANGLE_NOISE + 2 * tick + jitter * time
        far += settings.wheel_acceleration * jnp.minimum(age, LONGEST_CHANGE_S) ** 2
        return jnp.abs(moved - jnp.clip(moved, low, high)) <= far

    raw = other_total / jnp.maximum(other_since, 1e-4)
    near = change(other_since) + (ANGLE_NOISE + 2 * tick) / jnp.maximum(other_since, 1e-4)
    again = (jnp.abs(raw - old.aside) <= near) & (jnp.abs(raw) < most)
    fits = fit(total, since, age, jnp.where(again, raw, 0.0))
    doubted = old.aside < NO_SPEED
    other_fits = again | (doubted & fit(other_total, other_since, other_since, raw * 0.0))
    nearer = jnp.abs(other_total - old.rate * other_since) < jnp.abs(total - old.rate * since)
    skips = other_fits & ((nearer & ~again) | ~fits)
    by_angle = compared & (fits | other_fits)
    aside, accepted = compared & ~by_angle, by_angle | first
    moved, time = jnp.where(skips, other_total, total), jnp.where(skips, other_since, since)
    turned = moved - jnp.where(skips, old.other_ahead, old.ahead)
    # an encoder that repeats its angle may be late, until it counts as at rest
    late = by_angle & fits & (total == 0.0) & (since <= LONGEST_LATE_S) & (old.rate != 0.0)

    given = jnp.where(jnp.isfinite(z.wheel_speed), z.wheel_speed, 0.0)
    close = change(age) + SPEED_NOISE
    close = (jnp.abs(given - old.rate) <= close) | (jnp.abs(given - old.aside) <= close)
    by_speed = jnp.isfinite(z.wheel_speed) & ~by_angle & (jnp.abs(given) < most)
    by_speed &= close | (old.age > stale_s)
    lost = timed & jnp.isfinite(z.wheel_speed) & ~(accepted | by_speed)
    beyond = timed & jnp.isfinite(z.wheel_angle) & ~known

    # readings without a valid time step give no speed, so they do not reset the age
    good = (accepted | by_speed) & timed
    age = jnp.where(good, 0.0, jnp.minimum(old.age + jnp.maximum(dt, UNTIMED_S), 1e3))
    mean = moved / jnp.maximum(time, 1e-4)
    usual = jnp.where(again, raw, old.rate + (1 - jnp.exp(-dt / RATE_S)) * (mean - old.rate))
    rest = compared & (total == 0.0) & (since > LONGEST_LATE_S)
    usual = jnp.where(rest, 0.0, jnp.clip(usual, -most, most))
    rate = jnp.where(by_angle & ~late, usual, jnp.where(by_speed, given, old.rate))
    coast = jnp.where(age > stale_s, 0.0, rate)
    fastest = jnp.clip(turned / jnp.maximum(dt, 1e-4), -most, most)
    speed = jnp.where(by_angle, fastest, coast)
    owed = old.rate * time + jnp.where(skips, 0.0, old.lag) - moved
    most_late = old.rate * LONGEST_LATE_S
    lag = jnp.clip(owed, jnp.minimum(most_late, 0.0), jnp.maximum(most_late, 0.0))
    lag = jnp.where(again, 0.0, jnp.exp(-dt / LONGEST_LATE_S) * lag)
    anew, begun = accepted & ~late, accepted | aside
    ahead, other_ahead = old.ahead + speed * dt, old.other_ahead + speed * dt
    # what exceeds the largest speed is accounted for in the next steps
    left = jnp.where(by_angle, speed * dt - turned, 0.0)
    asides = jnp.where(aside, raw, jnp.where(lost, given, old.aside))
    believed = (accepted | by_speed) & ~aside
    return WheelState(
        speed=speed,
        rate=jnp.where(first & ~by_speed, 0.0, rate),
        angle=jnp.where(accepted, z.wheel_angle, old.angle),
        ahead=jnp.where(accepted, left, ahead),
        since=jnp.where(anew, 0.0, jnp.minimum(since, 1e3)),
        other=jnp.where(begun, z.wheel_angle, old.other),
        other_ahead=jnp.where(accepted, left, jnp.where(aside, 0.0, other_ahead)),
        other_since=jnp.where(begun, 0.0, jnp.minimum(other_since, 1e3)),
        lag=jnp.where(first | rest, 0.0, jnp.where(by_angle & ~late, lag, old.lag)),
        age=age,
        aside=jnp.where(believed, NO_SPEED, jnp.clip(asides, -NO_SPEED, NO_SPEED)),
        tick=tick,
        rejected=old.rejected + jnp.sum(aside | lost | beyond),
    )


def largest_current(robot: RobotArrays, settings: Settings) -> Float[Array, ""]:
    """Return the largest plausible current of a motor [A].

    It is 1.2 times what the supply drives through the resistance of a motor at rest, or ten times
    the largest current that the model predicts, whichever is smaller.
    """
    stalled = settings.supply_voltage / robot.motor.resistance
    return jnp.minimum(10.0 * robot.highest[1], 1.2 * stalled)


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
    s, motor = settings, robot.motor
    most = largest_current(robot, s)
    known = jnp.isfinite(z.current) & (jnp.abs(z.current) < most)
    volts = jnp.isfinite(z.voltage) & (jnp.abs(z.voltage) < 1e3)
    by_volts = motor.current_at(z.voltage, w)
    volts &= jnp.abs(by_volts) < most
    # The variance of a current from a voltage is smaller than this where a drop rises steeply.
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
        rejected=jnp.sum(
            (jnp.isfinite(z.current) & ~known) | (jnp.isfinite(z.voltage) & ~volts)
        ).astype(float),
    )
