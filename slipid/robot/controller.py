"""Controllers compute wheel speed commands from a demanded motion and an estimate.

A controller has two modes: `step(state, reference, estimate, dt) -> (state, wheel speeds)` follows
a reference pose, and `drive(state, twist, estimate, dt) -> (state, wheel speeds)` drives with a
given body twist, such as a `cmd_vel` of ROS. Both have the same limiter, which keeps the direction
of motion, the same safe stop, and the same supervision (`slipid.robot.supervision`). Wheel speeds
follow from the twist through the slip model that was selected for the floors believed to be under
the wheels. The pose loop of a robot that can drive sideways is

    v = R(-heading) (v_ref + k (p_ref - p)),   W = W_ref + k_yaw sin(heading_ref - heading)

and that of any other robot, with errors e in the body frame,

    v = v_ref cos(e_yaw) + k e_x,   W = W_ref + g v_ref e_y + (2 zeta w + k_yaw) 2 sin(e_yaw / 2),
    w^2 = W_ref^2 + g v_ref^2

Here p [m] and heading [rad] are the estimated pose, p_ref and heading_ref the reference pose, v_ref
[m/s] and W_ref [rad/s] its rates, v [m/s] is the demanded velocity in the body frame, W [rad/s] the
demanded yaw rate; k, k_yaw [1/s], g [1/m^2] and zeta [1] are gains, and R(-heading) rotates from
world to body axes. The lateral gain g falls with the speed, see `Gains.lateral_at`. A robot that
cannot drive sideways and stands beside a resting reference first turns towards it.

Source: Kanayama et al. 1990, ICRA; their damping vanishes at rest, which k_yaw prevents.

The "2021 paper" here and in other modules is Belyaev, Brylev and Ivanov (2021), see
docs/history.md.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.robot.deployed import DeployedRobot, RobotArrays
from slipid.robot.gains import Gains
from slipid.robot.interface import UNTIMED_S, StateEstimate, as_arrays
from slipid.robot.limits import Limits
from slipid.robot.record import ActuatorRecord
from slipid.robot.supervision import PROBE_S, ControllerState, Supervisor, recovery_factors
from slipid.robot.trajectory import Path

NO_CONTROLLER = (
    "this robot turns by steered wheels: it has an estimator (slipid.Estimator), but no "
    "controller, so `slipid trial` and `slipid export` are not available; expected omni, mecanum, "
    "differential or skid-steer drives"
)
"""Message for robots that have no controller, see `DeployedRobot.has_controller`."""
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
HEADING_ARM_M = 0.2
"""Lever at which a heading that lags behind the path counts as a distance that lags, for robots
that cannot drive sideways [m]."""
RESPONSE_S = 0.15
"""Delay and lag, together, of wheels whose actuators are unknown [s]."""
BESIDE_M, BESIDE_SPEED = (0.03, 0.08), 0.05
"""Distances beside the reference between which a robot that cannot drive sideways begins to turn
towards it [m], and speed of the reference from which on it does not [m/s]; half the distance
between the axles is added to the distances."""


def limit_command(
    wanted: Float[Array, " drive"],
    before: Float[Array, " drive"],
    current: Float[Array, " drive"],
    robot: RobotArrays,
    limits: Limits,
    dt: Float[Array, ""] | float,
) -> Float[Array, " drive"]:
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


class Controller(eqx.Module):
    """Pose loop with optional correction terms, or another control law that replaces it.

    Attributes:
        robot: identified robot.
        gains: gains; by default those that `Gains.of` returns for the robot.
        limits: limits of the command; by default those of the robot.
        recovery: True if a stuck robot may try to free itself.
        response: delay and lag, together, with which the wheels follow commands [s].
        correction: torque correction of the 2021 paper: "paper_print" as printed in the paper,
            "paper_code" as in the authors' program, "torque" with the errors of both corrected, or
            "none".
        law: control law that replaces the pose loop and its integral term; if it is an equinox
            module, its parameters are arguments of the compiled code.
    """

    robot: RobotArrays
    gains: Gains
    limits: Limits
    recovery: Bool[Array, ""]
    response: Float[Array, ""]
    correction: Correction = eqx.field(static=True)
    law: Law | None = None

    def __init__(
        self,
        robot: RobotArrays,
        gains: Gains | None = None,
        limits: Limits | None = None,
        correction: Correction = "none",
        law: Law | None = None,
        recovery: bool | None = None,
    ):
        """Set up a controller.

        `recovery` is None to try recovery only if the robot's logs have a gyro, since without gyro
        and pose fixes nobody could see whether it works.

        Raises:
            ValueError: the robot has steered wheels.
        """
        if robot.steering is not None:
            raise ValueError(NO_CONTROLLER)
        if recovery is None:
            recovery = isinstance(robot, DeployedRobot) and robot.record.sensors.gyro
        self.robot, self.recovery = robot.arrays, jnp.asarray(recovery)
        actuators = robot.record.actuators if isinstance(robot, DeployedRobot) else ActuatorRecord()
        late = RESPONSE_S if actuators.response_s is None else actuators.response_s
        self.response = jnp.asarray(late, dtype=float)
        self.limits = as_arrays(Limits.of(robot) if limits is None else limits)
        self.correction, self.law = correction, law
        self.gains = Gains.of(robot) if gains is None else gains

    @eqx.filter_jit
    def init(self) -> ControllerState:
        """Return the controller's state before its first command."""
        return ControllerState.init(self.robot.drives)

    def rearmed(self, state: ControllerState) -> ControllerState:
        """Return the state of a robot that gave up and is allowed to drive again."""
        return state.rearmed()

    def follow(
        self,
        path: Path,
        time: Float[Array, ""],
        pose: Float[Array, "3"],
        dt: Float[Array, ""] | float,
    ) -> tuple[Float[Array, ""], Float[Array, "6"]]:
        """Return the time of a path one step later, and the reference for `step`.

        The path waits for a robot that lags, see `Path.follow`; an invalid pose counts as far away.
        """
        here = jnp.where(jnp.isfinite(pose), pose, 1e3)
        arm = 0.0 if self.robot.holonomic else HEADING_ARM_M
        return path.follow(time, here, dt, self.gains.preview, arm, self._sideways())

    def step(
        self,
        state: ControllerState,
        reference: Float[Array, "6"],
        estimate: StateEstimate,
        dt: Float[Array, ""] | float,
    ) -> tuple[ControllerState, Float[Array, " drive"]]:
        """Return the next state and the wheel speeds to command [rad/s] to follow a reference.

        While the estimate is stale or any input is not finite, the robot stops at the allowed
        deceleration; once the controller has given up, it stops until it is armed again. The
        acceleration limit of the first command is relative to the measured wheel speeds.

        Args:
            state: state from `init` or the last step.
            reference: pose and rates in the world, from `follow` or
                `slipid.robot.trajectory.Path.at`. A robot that cannot drive sideways drives at the
                velocity along the reference's heading.
            estimate: output of an estimator.
            dt: time since the last step [s].
        """
        state, twist = self.asked(state, reference, estimate, dt)
        return self.drive(state, twist, estimate, dt)

    def asked(
        self,
        state: ControllerState,
        reference: Float[Array, "6"],
        estimate: StateEstimate,
        dt: Float[Array, ""] | float,
    ) -> tuple[ControllerState, Float[Array, "3"]]:
        """Return the state, and the twist that follows a reference [m/s, m/s, rad/s].

        Arguments are those of `step`, which passes the twist on to `drive`. The twist is NaN if the
        reference or the estimate cannot be used.
        """
        k, usable = self.gains, self._usable(estimate, reference)
        ref, pose = jnp.where(usable, reference, 0.0), jnp.where(usable, estimate.pose, 0.0)
        gap = ref[:2] - pose[:2]
        # the integral rests while a limit is active, so that it does not wind up
        summed = state.integral + k.integral * gap * _time_step(dt)
        summed = jnp.clip(summed, -LARGEST_INTEGRAL, LARGEST_INTEGRAL)
        integral = jnp.where(usable & ~state.limited, summed, state.integral)
        if self.law is not None:
            twist = self.law(ref, pose)
        elif self.robot.holonomic:
            twist = self._free_pose_loop(ref, pose, k.place * gap + integral)
        else:
            twist = self._tangent_pose_loop(ref, pose, gap, integral)
        pursues = jnp.ones((), bool)
        state = replace(state, integral=integral, pursues=pursues)
        return state, jnp.where(usable, twist, jnp.nan)

    def drive(
        self,
        state: ControllerState,
        twist: Float[Array, "3"],
        estimate: StateEstimate,
        dt: Float[Array, ""] | float,
    ) -> tuple[ControllerState, Float[Array, " drive"]]:
        """Return the next state and the wheel speeds to command [rad/s] for a body twist.

        The wheel speeds compensate the slip that is expected on the floors under the wheels. A
        robot that cannot drive sideways ignores the sideways velocity. For the rest see `step`.

        Args:
            state: state from `init` or the last step.
            twist: demanded velocity in the body frame [m/s, m/s, rad/s].
            estimate: output of an estimator.
            dt: time since the last step [s].
        """
        f, k, e, old, dt = self.robot, self.gains, estimate, state, _time_step(dt)
        usable = self._usable(e, twist)
        asked = jnp.where(usable, twist, 0.0)
        if not f.holonomic:
            asked = asked.at[1].set(0.0)
        now = replace(
            e,
            twist=jnp.where(usable, e.twist, 0.0),
            wheel_speed=jnp.where(usable, e.wheel_speed, 0.0),
        )
        probe = PROBE_S * self.limits.acceleration / f.frame.radius
        supervisor = Supervisor(self.recovery, self.limits.speed, probe, self.response)
        new = supervisor.step(old, asked, now, jnp.where(usable, dt, 0.0))
        moves = usable & ~new.gave_up
        wanted = self._limited_twist(asked * recovery_factors(old.tried))
        # low-pass filter the disturbance: the estimated twist less the last step's demanded twist
        a = 1 - jnp.exp(-dt / OBSERVER_S)
        miss = old.miss + a * (now.twist - old.wanted - old.miss)
        demand = wanted - k.observer * miss
        wheels = self._wheel_speeds(demand, e, old.pursues) + self._torque(wanted, e)
        # a small speed shows whether drives that were off turn again
        most = jnp.max(jnp.abs(wheels))
        slower = jnp.where(new.drives_off, jnp.minimum(probe / jnp.maximum(most, 1e-9), 1.0), 1.0)
        wheels = jnp.where(moves, wheels * slower, 0.0)
        before = jnp.where(old.begun, old.command, jnp.where(moves, e.wheel_speed, 0.0))
        since = jnp.where(moves, dt, jnp.maximum(dt, UNTIMED_S))
        command = limit_command(wheels, before, e.current, f, self.limits, since)
        new = replace(
            new,
            command=command,
            integral=jnp.where(old.pursues & ~new.drives_off, old.integral, 0.0),
            wanted=jnp.where(moves, demand, 0.0),
            miss=jnp.where(moves & ~new.drives_off, jnp.clip(miss, -0.2, 0.2), 0.0),
            limited=~moves | (jnp.max(jnp.abs(command - wheels)) >= 0.05),
            pursues=jnp.zeros((), bool),
            begun=jnp.ones((), bool),
        )
        return new, command

    def _usable(self, e: StateEstimate, demand: Array) -> Bool[Array, ""]:
        """Return whether the estimate and the demand can be used."""
        return e.finite & jnp.all(jnp.isfinite(demand)) & ~e.stale

    def _wheel_speeds(
        self, twist: Array, e: StateEstimate, pursues: Bool[Array, ""]
    ) -> Float[Array, " drive"]:
        """Return the wheel speeds that move the body with a twist on the floors believed [rad/s].

        The matrices of the floors are averaged over the belief under all wheels: how much a wheel
        slips depends on its own floor and on the drag that the floors of the others cause. An
        unknown floor is taken for the known floors in proportion to their probabilities; without
        any belief in them, wheels are assumed to roll without slip. So are those of a robot that
        can drive sideways and pursues a reference: its pose loop corrects slip by itself, and
        compensation by a belief about floors that may be wrong does not bring it nearer.
        """
        f = self.robot
        under = jnp.mean(e.surface_probability[:, :-1], axis=0)
        known = jnp.sum(under)
        under = jnp.where(known > 1e-9, under / jnp.maximum(known, 1e-9), 0.0)
        if f.holonomic:
            under = jnp.where(pursues, 0.0, under)
        slipping = jnp.sum(under[:, None] * (f.inverse_kinematics @ twist), axis=0)
        rolling = f.forward @ twist / f.frame.radius
        wheels = slipping + (1 - jnp.sum(under)) * rolling
        return jnp.where(jnp.isfinite(wheels), wheels, 0.0)

    def _limited_twist(self, wanted: Array) -> Float[Array, "3"]:
        """Return a twist within the limits of speed and yaw rate.

        A robot that can drive sideways keeps the direction of its velocity, any other robot the
        curvature of its path.
        """
        fast = jnp.sqrt(wanted[:2] @ wanted[:2] + 1e-12) / self.limits.speed
        quick = jnp.abs(wanted[2]) / self.limits.yaw_rate
        over = jnp.stack([fast, fast, quick])
        if not self.robot.holonomic:
            over = jnp.max(over)
        return wanted / jnp.maximum(over, 1.0)

    def _sideways(self) -> Float[Array, ""]:
        """Return how far a turn may move the middle of a robot that cannot drive sideways [m].

        Such a robot turns about a point that depends on the floors under its wheels, but lies
        between its axles. It corrects the distance to the side while it drives on.
        """
        if self.robot.holonomic:
            return jnp.zeros(())
        ahead = self.robot.places[:, 0]
        return 0.5 * (jnp.max(ahead) - jnp.min(ahead))

    def _free_pose_loop(self, ref: Array, pose: Array, pull: Array) -> Array:
        """Return the twist demanded of a robot that can drive sideways [m/s, m/s, rad/s].

        `pull` is the velocity towards the reference, in world axes [m/s].
        """
        x, y = _rotated(ref[3:5] + pull, -pose[2])
        return jnp.stack([x, y, ref[5] + self.gains.yaw * jnp.sin(ref[2] - pose[2])])

    def _tangent_pose_loop(self, ref: Array, pose: Array, gap: Array, integral: Array) -> Array:
        """Return the twist demanded of a robot that cannot drive sideways [m/s, 0, rad/s]."""
        k = self.gains
        ahead, left = _rotated(gap, -pose[2])
        off = jnp.arctan2(jnp.sin(ref[2] - pose[2]), jnp.cos(ref[2] - pose[2]))
        # a turn moves the middle sideways unless it is the centre of rotation
        speed = ref[3] * jnp.cos(ref[2]) + ref[4] * jnp.sin(ref[2])
        # beside a resting reference the robot first turns towards it, or away to drive in reverse
        near, far = (m + self._sideways() for m in BESIDE_M)
        aside = jnp.clip((jnp.abs(_rotated(gap, -ref[2])[1]) - near) / (far - near), 0.0, 1.0)
        aside *= jnp.clip(1 - jnp.abs(speed) / BESIDE_SPEED, 0.0, 1.0)
        bearing = jnp.arctan2(left * jnp.where(ahead < 0, -1.0, 1.0), jnp.abs(ahead) + 1e-9)
        turn = (1 - aside) * off + aside * bearing
        g = k.lateral_at(speed)
        stiff = 2 * k.damping * jnp.sqrt(ref[5] ** 2 + g * speed**2 + 1e-12) + k.yaw
        yaw_rate = ref[5] + g * speed * left + stiff * 2 * jnp.sin(0.5 * turn)
        v = speed * jnp.maximum(jnp.cos(off), 0.0) + k.place * ahead
        v += _rotated(integral, -pose[2])[0]
        return jnp.stack([v, jnp.zeros(()), yaw_rate])

    def _torque(self, wanted: Array, e: StateEstimate) -> Array:
        """Return the 2021 paper's correction of wheel speeds for forces across the motion [rad/s].

        It is 0 with the correction "none".
        """
        if self.correction == "none":
            return jnp.zeros(self.robot.drives)
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


def _time_step(dt: Float[Array, ""] | float) -> Float[Array, ""]:
    """Return a time step limited to half a second; 0 if it is not a positive number [s]."""
    dt = jnp.asarray(dt, dtype=float)
    return jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.minimum(dt, 0.5), 0.0)


def _rotated(v: Float[Array, "2"], angle: Array) -> tuple[Array, Array]:
    """Return the components of a vector turned by an angle [rad]."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * v[0] - s * v[1], s * v[0] + c * v[1]
