"""Controllers compute wheel speed commands from a reference pose and an estimate.

All controllers have the same interface, `init() -> state` and `step(state, reference, estimate, dt)
-> (state, wheel speeds)`, the same limiter, which keeps the direction of motion, and the same safe
stop. They differ in the terms that they add to the pose loop

    v = R(-heading) (v_ref + k (p_ref - p)),   W = W_ref + k_yaw sin(heading_ref - heading)

or in a control law that replaces the pose loop. Here p [m] and heading [rad] are the estimated
pose, p_ref and heading_ref the reference pose, v_ref [m/s] and W_ref [rad/s] its rates, v [m/s] is
the demanded velocity in the body frame, W [rad/s] the demanded yaw rate, k and k_yaw [1/s] are
gains, and R(-heading) rotates from world to body axes.

A robot whose wheels turn while its body stands still enters recovery: it alternates between turning
on the spot and driving, with growing effort. This helps a robot that is far from its path and stuck
because the demands to drive and to turn cancel at the wheels with traction, so that only a wheel
without traction spins. The controller returns to normal operation once the robot has moved for a
while. Otherwise it stops for good and reports that it gave up.

The "2021 paper" here and in other modules is Belyaev, Brylev and Ivanov (2021), see
docs/results.md.
"""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.robot.deployed import RobotArrays
from slipid.robot.gains import Gains
from slipid.robot.interface import UNTIMED_S, StateEstimate, as_arrays
from slipid.robot.limits import Limits

Correction = Literal["none", "torque", "paper_print", "paper_code"]
Law = Callable[[Float[Array, "6"], Float[Array, "3"]], Float[Array, "3"]]
"""Function from a reference (see `Path.at`) and a pose to a body twist [m/s, m/s, rad/s]."""
PAPER_GAIN = {"x": (3000.0, 500.0, 3000.0), "y": (2000.0, 2000.0, 2000.0)}
"""Gain of the 2021 paper's torque correction for each of the robot's three wheels, keyed by the
body axis along which the robot mainly drives [motor rpm per N m at the motor shaft]."""
OBSERVER_S = 0.4
"""Time constant of the disturbance observer [s]."""
LARGEST_INTEGRAL = 0.06
"""Largest velocity that the integral term may add to each component [m/s]."""
STUCK_S = 0.5
"""Time without the demanded motion after which a robot counts as stuck, and time with the demanded
motion after which it counts as free again [s]."""
STUCK_SHARE, STUCK_LEAST_SPEED = 0.2, 0.1
"""A robot counts as blocked if the demanded speed exceeds `STUCK_LEAST_SPEED` [m/s] and the
estimated speed is below the fraction `STUCK_SHARE` [1] of the demanded speed."""
RECOVERY_TURN_S, RECOVERY_DRIVE_S = 0.6, 1.2
"""Durations of the alternating phases of a recovery: turning on the spot, then driving [s]."""
RECOVERY_GROWTH = 0.6
"""Relative growth of the demanded twist per second of recovery [1/s]."""
RECOVERY_LIMIT_S = 15.0
"""Duration of a recovery after which the robot stops for good [s]."""


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
        begun: True if a command has been computed already.
    """

    command: Float[Array, " wheel"]
    integral: Float[Array, "2"]
    wanted: Float[Array, "3"]
    miss: Float[Array, "3"]
    still: Float[Array, ""]
    tried: Float[Array, ""]
    begun: Bool[Array, ""]

    @property
    def gave_up(self) -> Bool[Array, ""]:
        """True if the controller has stopped for good because the robot is stuck."""
        return self.tried > RECOVERY_LIMIT_S


def limit_command(
    wanted: Float[Array, " wheel"],
    before: Float[Array, " wheel"],
    current: Float[Array, " wheel"],
    robot: RobotArrays,
    limits: Limits,
    dt: Float[Array, ""] | float,
) -> Float[Array, " wheel"]:
    """Return wheel speeds within all limits, scaled together so that the robot keeps its direction.

    If a wheel exceeds the limits of speed or voltage, the whole command is scaled down. The voltage
    at each motor, U = R |I| + n C_e |w|, must not exceed the supply voltage; R is the resistance
    [Ohm], I the current [A], n the gear ratio, C_e the back-EMF constant [V s/rad] and w the wheel
    speed [rad/s]. If a wheel exceeds the limit of acceleration, the whole change from the last
    command is scaled down. The result is never NaN.

    Args:
        wanted: demanded wheel speeds [rad/s].
        before: last command [rad/s].
        current: motor currents [A]; their voltage drop reduces the largest wheel speed.
        robot: robot with the constants of its motor.
        limits: limits of the command.
        dt: time since the last command [s].
    """
    motor = robot.motor
    wanted = jnp.where(jnp.all(jnp.isfinite(wanted)), wanted, 0.0)
    before = jnp.where(jnp.isfinite(before), before, 0.0)
    dt = jnp.where(jnp.isfinite(jnp.asarray(dt)) & (jnp.asarray(dt) > 0), dt, 0.0)
    drop = motor.resistance * jnp.abs(jnp.where(jnp.isfinite(current), current, 0.0))
    left = jnp.maximum(limits.voltage - drop, 0.2 * limits.voltage)
    most = jnp.minimum(limits.wheel_speed, left / (motor.gear_ratio * motor.back_emf))
    over = jnp.max(jnp.abs(wanted) / most)
    wanted = wanted / jnp.maximum(over, 1.0)
    step = wanted - before
    allowed = limits.acceleration / robot.frame.radius * jnp.minimum(dt, 0.5)
    size = jnp.max(jnp.abs(step))
    out = before + step * jnp.where(size > allowed, allowed / jnp.maximum(size, 1e-9), 1.0)
    return jnp.clip(out, -limits.wheel_speed, limits.wheel_speed)


def _spins(tried: Float[Array, ""]) -> Bool[Array, ""]:
    """Return whether recovery is in its phase of turning on the spot after `tried` seconds."""
    return (tried > 0) & (jnp.mod(tried, RECOVERY_TURN_S + RECOVERY_DRIVE_S) < RECOVERY_TURN_S)


def _recovery_factors(tried: Float[Array, ""]) -> Float[Array, "3"]:
    """Return factors for the three components of the demanded twist after `tried` s of recovery."""
    one = jnp.where(_spins(tried), jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 1.0, 0.0]))
    return jnp.where(tried > 0, one * (1 + RECOVERY_GROWTH * tried), 1.0)


class Controller(eqx.Module):
    """Pose loop with optional correction terms, or another control law that replaces it.

    Attributes:
        robot: identified robot.
        gains: gains; by default those that `Gains.of` returns for the robot.
        limits: limits of the command.
        correction: torque correction of the 2021 paper: "paper_print" as printed in the paper,
            "paper_code" as in the authors' program, "torque" with the errors of both corrected, or
            "none".
        law: control law that replaces the pose loop and its integral term; if it is an equinox
            module, its parameters are arguments of the compiled code.
    """

    robot: RobotArrays
    gains: Gains
    limits: Limits
    correction: Correction = eqx.field(static=True)
    law: Law | None = None

    def __init__(
        self,
        robot: RobotArrays,
        gains: Gains | None = None,
        limits: Limits | None = None,
        correction: Correction = "none",
        law: Law | None = None,
    ):
        self.robot, self.limits = robot.arrays, as_arrays(Limits() if limits is None else limits)
        self.correction, self.law = correction, law
        self.gains = Gains.of(robot) if gains is None else gains

    @eqx.filter_jit
    def init(self) -> ControllerState:
        """Return the controller's state before its first command."""
        none, still, zero = jnp.zeros(self.robot.wheels), jnp.zeros(3), jnp.zeros(())
        return ControllerState(none, jnp.zeros(2), still, still, zero, zero, jnp.zeros((), bool))

    def step(
        self,
        state: ControllerState,
        reference: Float[Array, "6"],
        estimate: StateEstimate,
        dt: Float[Array, ""] | float,
    ) -> tuple[ControllerState, Float[Array, " wheel"]]:
        """Return the next state and the wheel speeds to command [rad/s].

        While the estimate is stale or any input is not finite, the robot stops at the allowed
        deceleration; once the controller has given up, it stops for good. The acceleration limit of
        the first command is relative to the measured wheel speeds.

        Args:
            state: state from `init` or the last step.
            reference: pose and rates in the world, from `slipid.robot.trajectory.Path.at`.
            estimate: output of an estimator.
            dt: time since the last step [s].
        """
        old, e, k = state, estimate, self.gains
        safe = e.finite & jnp.all(jnp.isfinite(reference)) & ~e.stale
        pose = jnp.where(safe, e.pose, 0.0)
        ref = jnp.where(safe, reference, 0.0)
        dt = jnp.asarray(dt, dtype=float)
        dt = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, 0.5), 0.0)
        gap = ref[:2] - pose[:2]
        safe &= ~old.gave_up
        still, tried = self._recovery(old, e, jnp.where(safe, dt, 0.0))
        wanted = self._demanded_twist(old, ref, pose, gap)
        # low-pass filter the disturbance: the estimated twist less the last step's demanded twist
        twist = jnp.where(safe, e.twist, 0.0)
        a = 1 - jnp.exp(-dt / OBSERVER_S)
        miss = old.miss + a * (twist - old.wanted - old.miss)
        demand = wanted - k.observer * miss
        wheels = self.robot.forward @ demand / self.robot.frame.radius + self._torque(wanted, e)
        before = jnp.where(old.begun, old.command, jnp.where(safe, e.wheel_speed, 0.0))
        wheels = jnp.where(safe, wheels, 0.0)
        since = jnp.where(safe, dt, jnp.maximum(dt, UNTIMED_S))
        command = limit_command(wheels, before, e.current, self.robot, self.limits, since)
        # freeze the integral while a limit is active, so that it does not wind up
        free = safe & (jnp.max(jnp.abs(command - wheels)) < 0.05)
        summed = jnp.clip(old.integral + k.integral * gap * dt, -LARGEST_INTEGRAL, LARGEST_INTEGRAL)
        new = ControllerState(
            command=command,
            integral=jnp.where(free, summed, jnp.where(safe, old.integral, 0.0)),
            wanted=jnp.where(safe, demand, 0.0),
            miss=jnp.where(safe, jnp.clip(miss, -0.2, 0.2), 0.0),
            still=still,
            tried=tried,
            begun=jnp.ones((), bool),
        )
        return new, command

    def _recovery(self, old: ControllerState, e: StateEstimate, dt: Array) -> tuple[Array, Array]:
        """Return the new `still` and `tried` of `ControllerState` [s].

        While the robot turns on the spot no translation is demanded, so `still` does not change
        during that phase.
        """
        demand = jnp.sqrt(old.wanted[:2] @ old.wanted[:2] + 1e-12)
        speed = jnp.sqrt(e.twist[:2] @ e.twist[:2] + 1e-12)
        blocked = e.immobilised | ((demand > STUCK_LEAST_SPEED) & (speed < STUCK_SHARE * demand))
        since = jnp.where(_spins(old.tried), 0.0, jnp.where(blocked, dt, -dt))
        still = jnp.clip(old.still + since, 0.0, 2 * STUCK_S)
        tries = still > STUCK_S
        still = jnp.where(tries & (old.tried == 0), 2 * STUCK_S, still)
        return still, jnp.where(tries, old.tried + dt, 0.0)

    def _demanded_twist(self, old: ControllerState, ref: Array, pose: Array, gap: Array) -> Array:
        """Return the twist [m/s, m/s, rad/s] that the pose loop or the control law demands.

        In recovery it is multiplied by `_recovery_factors`; then it is scaled to the speed limit.
        """
        wanted = self._pose_loop(old, ref, pose, gap) if self.law is None else self.law(ref, pose)
        wanted = wanted * _recovery_factors(old.tried)
        fast = jnp.sqrt(wanted[:2] @ wanted[:2] + 1e-12) / self.limits.speed
        return wanted.at[:2].divide(jnp.maximum(fast, 1.0))

    def _pose_loop(self, old: ControllerState, ref: Array, pose: Array, gap: Array) -> Array:
        """Return the twist that the pose loop demands [m/s, m/s, rad/s]."""
        v = ref[3:5] + self.gains.place * gap + old.integral
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        turn = ref[5] + self.gains.yaw * jnp.sin(ref[2] - pose[2])
        return jnp.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], turn])

    def _torque(self, wanted: Array, e: StateEstimate) -> Array:
        """Return the 2021 paper's correction of wheel speeds for forces across the motion [rad/s].

        It is 0 with the correction "none".
        """
        if self.correction == "none":
            return jnp.zeros(self.robot.wheels)
        f = self.robot
        turning = jnp.where(jnp.abs(e.wheel_speed) > 0.1, jnp.sign(e.wheel_speed), 0.0)
        torque = f.motor.characteristic(jnp.abs(e.current) * turning, e.wheel_speed)
        force = f.forward.T @ torque / f.frame.radius
        along_x = jnp.abs(wanted[0]) >= jnp.abs(wanted[1])
        gain = jnp.where(along_x, jnp.asarray(PAPER_GAIN["x"]), jnp.asarray(PAPER_GAIN["y"]))
        if self.correction == "paper_code":
            on_x, on_y = jnp.array([0.0, -1.0, -1.0]), jnp.array([1.0, 0.0, 1.0])
            off = jnp.where(along_x, on_x, on_y) * force
        else:
            u = wanted[:2] / jnp.sqrt(wanted[:2] @ wanted[:2] + 1e-8)
            straight = jnp.where(jnp.abs(wanted[2]) < 0.05, 1.0, 0.0)
            off = force.at[:2].add(-(force[:2] @ u) * u).at[2].multiply(straight)
        if self.correction == "torque":
            moment = f.frame.radius * f.inverse.T @ off
        else:
            # both variants of the paper divide by the lever arm instead of multiplying by it
            printed = f.forward.at[:, 2].divide(f.frame.base**2)
            moment = f.frame.radius * printed @ off
        moves = jnp.max(jnp.abs(e.wheel_speed)) > 0.5
        rpm = jnp.where(moves, gain * moment, 0.0)
        return rpm * (2 * np.pi / 60) / f.motor.gear_ratio
