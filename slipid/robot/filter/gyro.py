"""Plausibility of a gyro's readings: wrong ones are set aside, and a robot turned by hand is seen.

A reading is plausible if it differs from the yaw rate of the model by at most `MOST_STDS` stds of
this difference. Others are set aside and counted. While they are, the model alone tells how the
robot turns. Readings that were set aside in a row and agree with each other for `AGREE_S` are
believed, and so are those after them which agree: the robot is bumped, turned by hand, or slips as
no floor explains. Then the rotation that was set aside is added to the heading.

If the readings return to the model earlier, the robot may have turned or not. The rotation that
was set aside, without that of the first reading, is then added to the std of the heading.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

MOST_STDS = 6.0
"""Largest plausible difference of a reading from its expected value, in stds."""
AGREE_S = 0.2
"""Duration for which readings must agree with each other to be believed against the model [s]."""
HIGHEST_RATE = 50.0
"""Yaw rate above which a reading is never believed [rad/s]."""
YAW_ACCELERATION = 40.0
"""Largest angular acceleration of a robot that a person turns by 90 deg in half a second
[rad/s^2]."""
LONGEST_CHANGE_S = 0.1
"""Longest time over which agreeing readings may differ by the acceleration above [s]."""
LEAST_STD = 0.02
"""Least std of a plausible reading, for vibration and errors of scale [rad/s]."""


class GyroState(eqx.Module):
    """Readings that contradict the model.

    Attributes:
        last: last reading that contradicted the model [rad/s].
        time: duration of the last readings that contradict the model and agree; 0 if the last
            reading was plausible [s].
        turned: rotation by these readings, relative to the estimate, that was set aside [rad].
        doubt: rotation by all readings in a row that were set aside, but the first [rad].
        rejected: number of readings that were set aside since the start.
    """

    last: Float[Array, ""]
    time: Float[Array, ""]
    turned: Float[Array, ""]
    doubt: Float[Array, ""]
    rejected: Float[Array, ""]

    @classmethod
    def init(cls) -> "GyroState":
        """Return the state before the first reading."""
        return cls(*[jnp.zeros(())] * 5)


class CheckedGyro(eqx.Module):
    """Result of checking a reading.

    Attributes:
        rate: reading if it is believed, else NaN [rad/s].
        aside: reading if it was set aside, else NaN [rad/s].
        again: True if the reading before was set aside, too.
        turn: rotation by earlier readings that is believed now [rad].
        doubt: rotation by earlier readings that is never believed but may have happened [rad].
    """

    rate: Float[Array, ""]
    aside: Float[Array, ""]
    again: Bool[Array, ""]
    turn: Float[Array, ""]
    doubt: Float[Array, ""]


def check_gyro(
    old: GyroState, reading: Array, off: Array, var: Array, std: Array | float, dt: Array
) -> tuple[GyroState, CheckedGyro]:
    """Return the state after a reading, and whether it is believed.

    Args:
        old: state before the reading.
        reading: yaw rate by the gyro; NaN without a reading [rad/s].
        off: difference of the reading, less the gyro's bias, from the model's yaw rate [rad/s].
        var: variance of this difference [rad^2/s^2].
        std: std of the gyro's noise [rad/s].
        dt: time step [s].
    """
    there = jnp.isfinite(reading) & (jnp.abs(reading) < HIGHEST_RATE)
    fits = there & (off**2 <= MOST_STDS**2 * var)
    most = YAW_ACCELERATION * jnp.minimum(dt, LONGEST_CHANGE_S) + MOST_STDS * 1.5 * std
    same = there & (old.time > 0) & (jnp.abs(reading - old.last) < most)
    time = jnp.where(same, jnp.minimum(old.time + dt, 1e3), dt)
    taken = same & ~fits & (time > AGREE_S - 1e-6)
    believed = fits | taken
    new = GyroState(
        last=jnp.where(there, reading, old.last),
        time=jnp.where(there, jnp.where(fits, 0.0, time), old.time),
        turned=jnp.where(believed | (there & ~same), 0.0, old.turned),
        doubt=jnp.where(believed, 0.0, old.doubt),
        rejected=old.rejected + (jnp.isfinite(reading) & ~believed),
    )
    return new, CheckedGyro(
        rate=jnp.where(believed, reading, jnp.nan),
        aside=jnp.where(there & ~believed, reading, jnp.nan),
        again=old.time > 0,
        turn=jnp.where(taken, old.turned, 0.0),
        doubt=jnp.where(fits, old.doubt, 0.0),
    )


def set_aside(
    state: GyroState, checked: CheckedGyro, rate: Array, bias: Array, left: Array, dt: Array
) -> GyroState:
    """Return the state after a step in which a reading may have been set aside.

    Args:
        state: state that `check_gyro` returned.
        checked: result of `check_gyro`.
        rate: estimated yaw rate of the step [rad/s].
        bias: bias of the gyro [rad/s].
        left: fraction of the heading's error that a pose fix left in this step; 1 without one [1].
        dt: time step [s].
    """
    more = jnp.where(jnp.isfinite(checked.aside), (checked.aside - bias - rate) * dt, 0.0)
    doubt = state.doubt + jnp.where(checked.again, more, 0.0)
    return replace(state, turned=left * (state.turned + more), doubt=left * doubt)
