"""Supervision of a robot under control: drives that are off, a robot that is stuck, and re-arming.

Drives that do not turn as they are commanded are off, for example after an emergency stop. They are
then commanded a small speed, which shows that they turn again, and nothing is integrated, so that
the robot drives on with a ramp.

A robot whose wheels turn while its body stands still is stuck. If recovery is switched on, the
robot alternates between turning on the spot and driving, with growing effort. This helps a robot
that is far from its path and stuck because the demands to drive and to turn cancel at the wheels
with traction, so that only a wheel without traction spins. Recovery ends once the robot has moved
for a while. Otherwise the robot gives up: it stops until it is armed again.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from slipid.robot.interface import Scalar, StateEstimate

STUCK_S = 0.5
"""Time without the demanded motion after which a robot counts as stuck, and time with the demanded
motion after which it counts as free again [s]."""
STUCK_SHARE = 0.2
"""A robot counts as blocked if its demanded speed exceeds this fraction of its highest speed, and
its estimated speed is below this fraction of the demanded speed [1]."""
RECOVERY_TURN_S, RECOVERY_DRIVE_S = 0.6, 1.2
"""Durations of the alternating phases of a recovery: turning on the spot, then driving [s]."""
RECOVERY_GROWTH, RECOVERY_MOST = 0.6, 2.0
"""Relative growth of the demanded twist per second of recovery [1/s], and its largest factor."""
RECOVERY_LIMIT_S = 15.0
"""Duration of a recovery after which the robot gives up [s]."""
REARM_S = 1.0
"""Time without any demand after which a robot that gave up is armed again [s]."""
REST_SPEED, REST_YAW_RATE = 0.005, 0.02
"""Speed [m/s] and yaw rate [rad/s] below which no motion is demanded."""
FOLLOW_SHARE = 0.5
"""Fraction of its expected speed below which a wheel does not follow its command [1]."""
FOLLOW_FILTER_S = 0.15
"""Time constant of the comparison of a wheel's speed with its command [s]."""
OFF_S, ON_S = 0.4, 0.2
"""Time without following after which drives count as off, and time with following after which they
count as on again [s]."""
PROBE_S = 0.05
"""Duration of acceleration at its limit, from rest to the speed commanded to drives that are off
[s]."""


class ControllerState(eqx.Module):
    """State of a controller between two steps.

    Attributes:
        command: last command [rad/s].
        integral: velocity that the integral term adds [m/s].
        wanted: twist that was demanded in the last step [m/s, m/s, rad/s].
        miss: smoothed difference, estimated twist less demanded twist [m/s, m/s, rad/s].
        still: time for which the body has not moved as demanded; it counts down while the body
            moves as demanded [s].
        tried: time since the present recovery began; 0 if the robot is not in recovery [s].
        expected: filtered command that the wheels are compared with [rad/s].
        turned: filtered speed of the wheels [rad/s].
        unfollowed: time for which a wheel has not followed its command; it counts down while all
            wheels follow [s].
        resting: time since any motion was demanded [s].
        drives_off: True if wheels do not follow their commands; nothing escalates meanwhile.
        gave_up: True if the robot was stuck and has stopped until it is armed again, by `rearmed`
            or by a demand of no motion for `REARM_S`.
        limited: True if a limit was active in the last command.
        pursues: True while the demanded twist follows a reference, from `Controller.asked` to
            `Controller.drive`.
        begun: True if a command has been computed already.
    """

    command: Float[Array, " drive"]
    integral: Float[Array, "2"]
    wanted: Float[Array, "3"]
    miss: Float[Array, "3"]
    still: Float[Array, ""]
    tried: Float[Array, ""]
    expected: Float[Array, " drive"]
    turned: Float[Array, " drive"]
    unfollowed: Float[Array, ""]
    resting: Float[Array, ""]
    drives_off: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    limited: Bool[Array, ""]
    pursues: Bool[Array, ""]
    begun: Bool[Array, ""]

    @classmethod
    def init(cls, drives: int) -> "ControllerState":
        """Return the state of a robot at rest before its first command."""
        each, twist = jnp.zeros(drives), jnp.zeros(3)
        zero, no = (jnp.zeros(()),) * 2, (jnp.zeros((), bool),) * 5
        return cls(each, jnp.zeros(2), twist, twist, *zero, each, each, *zero, *no)

    def rearmed(self) -> "ControllerState":
        """Return the state of a robot that no longer counts as stuck."""
        zero = jnp.zeros(())
        return replace(self, still=zero, tried=zero, gave_up=jnp.zeros((), bool))


class Supervisor(eqx.Module):
    """Supervision of a robot's drives and motion.

    Attributes:
        recovery: True if the robot may try to free itself.
        highest_speed: highest speed that is demanded of the body [m/s].
        probe: wheel speed that is commanded to drives that are off [rad/s].
        response: delay and lag with which the wheels follow their commands [s].
    """

    recovery: Bool[Array, ""]
    highest_speed: Scalar
    probe: Scalar
    response: Scalar

    def step(
        self, old: ControllerState, asked: Float[Array, "3"], e: StateEstimate, dt: Array
    ) -> ControllerState:
        """Return the state with its supervision one time step later.

        While a robot in recovery turns on the spot no translation is demanded, so `still` does not
        change during that phase.

        Args:
            old: state after the last step.
            asked: twist that is demanded before any recovery [m/s, m/s, rad/s].
            e: present estimate, without NaN.
            dt: time step; 0 while the estimate cannot be used [s].
        """
        quick, slow = (1 - jnp.exp(-dt / (FOLLOW_FILTER_S + late)) for late in (0, self.response))
        turned = old.turned + quick * (e.wheel_speed - old.turned)
        expected = old.expected + slow * (old.command - old.expected)
        size = jnp.abs(expected)
        lost = (size > 0.5 * self.probe) & (turned * jnp.sign(expected) < FOLLOW_SHARE * size)
        unfollowed = jnp.clip(old.unfollowed + jnp.where(jnp.any(lost), dt, -dt), 0.0, OFF_S)
        drives_off = unfollowed > jnp.where(old.drives_off, OFF_S - ON_S, OFF_S - 1e-6)

        demand, speed = (jnp.sqrt(x[:2] @ x[:2] + 1e-12) for x in (old.wanted, e.twist))
        blocked = (demand > STUCK_SHARE * self.highest_speed) & (speed < STUCK_SHARE * demand)
        since = jnp.where(spins(old.tried), 0.0, jnp.where(e.immobilised | blocked, dt, -dt))
        still = jnp.clip(old.still + since, 0.0, 2 * STUCK_S)
        tries = self.recovery & (still > STUCK_S)
        still = jnp.where(tries & (old.tried == 0), 2 * STUCK_S, still)
        tried = jnp.where(tries, old.tried + dt, 0.0)

        rests = (jnp.sqrt(asked[:2] @ asked[:2]) < REST_SPEED) & (jnp.abs(asked[2]) < REST_YAW_RATE)
        resting = jnp.where(rests, jnp.minimum(old.resting + dt, REARM_S), 0.0)
        # reset what was integrated while drives were off, or once nothing was demanded for a while
        reset = drives_off | (resting >= REARM_S)
        return replace(
            old,
            still=jnp.where(reset, 0.0, still),
            tried=jnp.where(reset, 0.0, jnp.where(old.gave_up, old.tried, tried)),
            expected=expected,
            turned=turned,
            unfollowed=unfollowed,
            resting=resting,
            drives_off=drives_off,
            gave_up=~reset & (old.gave_up | (tried > RECOVERY_LIMIT_S)),
        )


def spins(tried: Float[Array, ""]) -> Bool[Array, ""]:
    """Return whether recovery is in its phase of turning on the spot after `tried` seconds."""
    return (tried > 0) & (jnp.mod(tried, RECOVERY_TURN_S + RECOVERY_DRIVE_S) < RECOVERY_TURN_S)


def recovery_factors(tried: Float[Array, ""]) -> Float[Array, "3"]:
    """Return factors for the three components of the demanded twist after `tried` s of recovery."""
    one = jnp.where(spins(tried), jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 1.0, 0.0]))
    growth = jnp.minimum(1 + RECOVERY_GROWTH * tried, RECOVERY_MOST)
    return jnp.where(tried > 0, one * growth, 1.0)
