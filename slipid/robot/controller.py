"""Controllers: from where the robot should be and what is estimated to wheel speed commands.

All share one interface, `init() -> state` and `step(state, reference, estimate, dt) -> (state,
wheel speeds)`, one limiter that keeps the direction of motion, and one safe stop. They differ in
what they do beyond the pose loop

    v = R(-heading) (v_ref + k (p_ref - p)),   W = W_ref + k_yaw sin(heading_ref - heading)

or in the law that stands in its place.

A robot whose wheels turn and which does not move turns and goes by turns, ever harder: demands to
go and to turn that cancel at the wheels that have grip, so that only a wheel without any spins, are
a rest of the loop far from its path. It goes on as usual once it has moved for a while; if that
does not come about it stops and says so.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.parameter import parameter
from slipid.robot.deployed import RobotArrays, with_record
from slipid.robot.interface import UNTIMED_S, Numbers, Scalar, StateEstimate, as_arrays

Correction = Literal["none", "torque", "paper_print", "paper_code"]
Law = Callable[[Float[Array, "6"], Float[Array, "3"]], Float[Array, "3"]]
"""Twist of the body to ask for [m/s, m/s, rad/s], of a reference as of `Path.at` and a pose."""
PAPER_GAIN = {"x": (3000.0, 500.0, 3000.0), "y": (2000.0, 2000.0, 2000.0)}
"""Of the 2021 paper's torque correction, motor rpm per N m at the motor shaft, by leg."""
OBSERVE_S = 0.4
"""Time constant of the disturbance observer [s]."""
LONGEST_I = 0.06
"""Largest velocity the integral may ask for [m/s]."""
STUCK_S, SLOW, ASKED = 0.5, 0.2, 0.1
"""A robot that goes at less than this part of what it is asked for, if that is more than so much
[m/s], is stuck after so long, and free once it has gone for as long [s]."""
TURN_S, GO_S = 0.6, 1.2
"""For which a robot that is stuck turns, then goes, by turns [s]."""
HARDER = 0.6
"""By which part it then tries harder each second."""
GIVES_UP_S = 15.0
"""For which it tries before it stops [s]."""


class Gains(eqx.Module):
    """Gains of a controller; by default those set by hand."""

    place: Array = parameter("1/s", "k", "pose loop", start=1.5)
    yaw: Array = parameter("1/s", "k_yaw", "heading loop", start=1.5)
    integral: Array = parameter("1/s^2", "k_i", "pose error's integral", start=0.0)
    observer: Array = parameter("1", "k_d", "disturbance observer", start=0.0)
    preview: Array = parameter(
        "s", "t_p", "how early rates are asked for, as wheels follow late", start=0.2
    )

    @classmethod
    def of(cls, robot: RobotArrays, forced: bool = False) -> "Gains":
        """Those tuned for a robot and its load set-up if they are better, else those set by hand.

        If they are forced, those tuned for them, whether they are better or not.

        Raises:
            ValueError: the robot comes without its record.
        """
        known = with_record(robot)
        tuned = known.record.gains
        if tuned is None or tuned.load != known.load_setup:
            return cls()
        if not (tuned.is_better or forced):
            return cls()
        return cls.at([getattr(tuned.values, f.name).value for f in fields(cls)])

    @classmethod
    def at(cls, values: Sequence[Float[Array, ""] | float] | Float[Numbers, " gain"]) -> "Gains":
        """Those of a vector, in the order in which they are declared."""
        return cls(*(jnp.asarray(value, dtype=float) for value in values))


class Limits(eqx.Module):
    """What a command may not exceed.

    Attributes:
        wheel_speed: [rad/s]; acceleration: of a wheel [rad/s^2].
        voltage: of the supply [V]; twist: largest speed asked of the body [m/s].
    """

    wheel_speed: Scalar = 13.0
    acceleration: Scalar = 25.0
    voltage: Scalar = 22.0
    twist: Scalar = 0.5


class ControllerState(eqx.Module):
    """What a controller keeps from step to step.

    Attributes:
        command: the last one [rad/s]; integral: velocity it asks for [m/s].
        wanted: twist asked for last [m/s, m/s, rad/s]; miss: what the robot was seen to do beyond
            it, smoothed [m/s, m/s, rad/s].
        still: for how long it has not gone where it was asked to go; going counts back [s].
        tried: for how long it has tried to free itself, since it was last free [s].
        begun: whether anything was commanded.
    """

    command: Float[Array, " wheel"]
    integral: Float[Array, "2"]
    wanted: Float[Array, "3"]
    miss: Float[Array, "3"]
    still: Float[Array, ""]
    tried: Float[Array, ""]
    begun: Bool[Array, ""]

    @property
    def given_up(self) -> Bool[Array, ""]:
        """Whether it has stopped for good, being stuck."""
        return self.tried > GIVES_UP_S


def limit_command(
    wanted: Float[Array, " wheel"],
    before: Float[Array, " wheel"],
    current: Float[Array, " wheel"],
    robot: RobotArrays,
    limits: Limits,
    dt: Float[Array, ""] | float,
) -> Float[Array, " wheel"]:
    """Wheel speeds within all limits, scaled together so that the robot keeps its direction.

    Speed and voltage scale the command, U = R |I| + n C_e |w| at most the supply's; acceleration
    scales the change from the last command. Never NaN.

    Args:
        wanted, before: this command and the last one [rad/s].
        current: of the motors, for what is left of the supply [A].
        robot, limits: the motor's numbers, and what is allowed.
        dt: since the last command [s].
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
    allowed = limits.acceleration * jnp.minimum(dt, 0.5)
    size = jnp.max(jnp.abs(step))
    out = before + step * jnp.where(size > allowed, allowed / jnp.maximum(size, 1e-9), 1.0)
    return jnp.clip(out, -limits.wheel_speed, limits.wheel_speed)


def _turns(tried: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a robot that has tried to free itself for so long [s] is turning on the spot."""
    return (tried > 0) & (jnp.mod(tried, TURN_S + GO_S) < TURN_S)


def _freeing(tried: Float[Array, ""]) -> Float[Array, "3"]:
    """What it makes of the twist it is asked for."""
    one = jnp.where(_turns(tried), jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 1.0, 0.0]))
    return jnp.where(tried > 0, one * (1 + HARDER * tried), 1.0)


class Controller(eqx.Module):
    """Pose loop with whatever a row of the trial adds to it.

    Attributes:
        gains: by default those tuned for the robot where they are better, else those set by hand.
        correction: torque correction of the 2021 paper, in the form it prints, the form its authors
            ran, or corrected.
        law: in place of the pose loop and its integral; a module, so that numbers of another law of
            its kind need no other compilation.
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

    def init(self) -> ControllerState:
        """State of a controller that has commanded nothing yet."""
        none, still, zero = jnp.zeros(self.robot.wheels), jnp.zeros(3), jnp.zeros(())
        return ControllerState(none, jnp.zeros(2), still, still, zero, zero, jnp.zeros((), bool))

    def step(
        self,
        state: ControllerState,
        reference: Float[Array, "6"],
        estimate: StateEstimate,
        dt: Float[Array, ""] | float,
    ) -> tuple[ControllerState, Float[Array, " wheel"]]:
        """Wheel speeds to command [rad/s].

        Stops, at the allowed deceleration, while the estimate is stale or anything is no number,
        and for good once it has given up; starts from the speed the wheels have.

        Args:
            state, estimate: from `init` or the last step; of an estimator.
            reference: pose and rates in the world, `slipid.robot.trajectory.Path.at`.
            dt: since the last step [s].
        """
        old, e, k = state, estimate, self.gains
        safe = e.finite & jnp.all(jnp.isfinite(reference)) & ~e.stale
        pose = jnp.where(safe, e.pose, 0.0)
        ref = jnp.where(safe, reference, 0.0)
        dt = jnp.asarray(dt, dtype=float)
        dt = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, 0.5), 0.0)
        gap = ref[:2] - pose[:2]
        safe &= ~old.given_up
        still, tried = self._held(old, e, jnp.where(safe, dt, 0.0))
        wanted = self._wanted(old, ref, pose, gap)
        # what the robot does less what it was asked to do, as far as the estimator sees it
        twist = jnp.where(safe, e.twist, 0.0)
        a = 1 - jnp.exp(-dt / OBSERVE_S)
        miss = old.miss + a * (twist - old.wanted - old.miss)
        asked = wanted - k.observer * miss
        wheels = self.robot.forward @ asked / self.robot.frame.radius + self._torque(wanted, e)
        before = jnp.where(old.begun, old.command, jnp.where(safe, e.wheel_speed, 0.0))
        wheels = jnp.where(safe, wheels, 0.0)
        since = jnp.where(safe, dt, jnp.maximum(dt, UNTIMED_S))
        command = limit_command(wheels, before, e.current, self.robot, self.limits, since)
        free = safe & (jnp.max(jnp.abs(command - wheels)) < 0.05)  # the integral rests at a limit
        summed = jnp.clip(old.integral + k.integral * gap * dt, -LONGEST_I, LONGEST_I)
        new = ControllerState(
            command=command,
            integral=jnp.where(free, summed, jnp.where(safe, old.integral, 0.0)),
            wanted=jnp.where(safe, asked, 0.0),
            miss=jnp.where(safe, jnp.clip(miss, -0.2, 0.2), 0.0),
            still=still,
            tried=tried,
            begun=jnp.ones((), bool),
        )
        return new, command

    def _held(self, old: ControllerState, e: StateEstimate, dt: Array) -> tuple[Array, Array]:
        """For how long the body has not gone where it should, and has tried to free itself [s].

        While it turns on the spot it is asked to go nowhere, which tells nothing of that.
        """
        asked = jnp.sqrt(old.wanted[:2] @ old.wanted[:2] + 1e-12)
        goes = jnp.sqrt(e.twist[:2] @ e.twist[:2] + 1e-12)
        held = e.immobilised | ((asked > ASKED) & (goes < SLOW * asked))
        since = jnp.where(_turns(old.tried), 0.0, jnp.where(held, dt, -dt))
        still = jnp.clip(old.still + since, 0.0, 2 * STUCK_S)
        tries = still > STUCK_S
        still = jnp.where(tries & (old.tried == 0), 2 * STUCK_S, still)
        return still, jnp.where(tries, old.tried + dt, 0.0)

    def _wanted(self, old: ControllerState, ref: Array, pose: Array, gap: Array) -> Array:
        """Twist that the pose loop or the law asks for, its speed limited [m/s, m/s, rad/s]."""
        wanted = self._pose_loop(old, ref, pose, gap) if self.law is None else self.law(ref, pose)
        wanted = wanted * _freeing(old.tried)
        fast = jnp.sqrt(wanted[:2] @ wanted[:2] + 1e-12) / self.limits.twist
        return wanted.at[:2].divide(jnp.maximum(fast, 1.0))

    def _pose_loop(self, old: ControllerState, ref: Array, pose: Array, gap: Array) -> Array:
        """Twist that the pose loop asks for [m/s, m/s, rad/s]."""
        v = ref[3:5] + self.gains.place * gap + old.integral
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        turn = ref[5] + self.gains.yaw * jnp.sin(ref[2] - pose[2])
        return jnp.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], turn])

    def _torque(self, wanted: Array, e: StateEstimate) -> Array:
        """The 2021 paper's correction by the forces off the commanded direction [rad/s]."""
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
        else:  # as printed: the lever is divided by, not multiplied
            printed = f.forward.at[:, 2].divide(f.frame.base**2)
            moment = f.frame.radius * printed @ off
        moves = jnp.max(jnp.abs(e.wheel_speed)) > 0.5
        rpm = jnp.where(moves, gain * moment, 0.0)
        return rpm * (2 * np.pi / 60) / f.motor.gear_ratio
