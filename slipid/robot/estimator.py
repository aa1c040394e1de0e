"""Estimators of slip, floor and pose from wheel speeds and currents, and odometry without contact.

In `Estimator` a filter over the floors under the wheels (`floor_filter`) turns the wheel readings
into a body motion, from which a second filter computes the pose (`pose_filter`):

    xi = sum_c p_c xi_c,   pose <- pose * exp(xi dt) * (late corrections from the floors)

with p_c the probability of hypothesis c (a floor for each wheel), and xi_c the body twist [m/s,
m/s, rad/s] if hypothesis c is true.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from slipid.model.kinematics import MOST
from slipid.model.se2 import advance, compose
from slipid.parameter import as_numbers
from slipid.robot.deployed import RobotArrays
from slipid.robot.filter.floor import Floor
from slipid.robot.filter.floor_filter import FloorFilter, FloorState, TimeStep, length
from slipid.robot.filter.gyro import GyroState, check_gyro, set_aside
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.filter.pose_filter import PoseFilter, axes_rotation
from slipid.robot.filter.pose_fix import PoseState, apply_map
from slipid.robot.filter.wheels import (
    WheelState,
    largest_current,
    read_currents,
    read_wheels,
    time_step,
)
from slipid.robot.interface import (
    AbstractEstimator,
    Pose,
    Readings,
    Settings,
    StateEstimate,
    as_arrays,
)

SLIP_CURRENT = 0.4
"""Motor current above which the estimator on the 2021 paper's robot subtracts slip [A]."""


class EstimatorState(eqx.Module):
    """State of an estimator between two steps.

    Attributes:
        wheels: angles, speeds and ages of the wheels' readings.
        current: filtered currents of the motors [A].
        refused: number of readings of ammeters and voltmeters that were set aside since the start.
        gyro: readings of the gyro that contradict the model.
        floors: belief about the floors under the wheels.
        place: pose with its covariance.
        stuck: time since the body stopped moving while its wheels turn [s].
        steering: last steering angle of a robot that steers [rad]; None for others.
    """

    wheels: WheelState
    current: Float[Array, " drive"]
    refused: Float[Array, ""]
    gyro: GyroState
    floors: FloorState
    place: PoseState
    stuck: Float[Array, ""]
    steering: Float[Array, ""] | None = None


class Estimator(AbstractEstimator[EstimatorState]):
    """Estimator of the floors under the wheels, and of the pose with its covariance.

    Attributes:
        robot: identified robot; its `labels` name the floors in the order of
            `StateEstimate.surface_probability`.
        settings: settings; by default `Settings.of(robot)`, for the sensors and floors of the
            robot's logs.
        floor: map of the site, whose surfaces are numbered as in the robot's `labels`; None without
            a map.
    """

    robot: RobotArrays
    settings: Settings
    floor: Floor | None = None

    def __init__(
        self, robot: RobotArrays, settings: Settings | None = None, floor: Floor | None = None
    ):
        self.robot, self.floor = robot.arrays, floor
        self.settings = as_arrays(Settings.of(robot) if settings is None else settings)

    def init(
        self,
        pose: Pose = (0.0, 0.0, 0.0),
        std: tuple[float, float] | Float[Array, "2"] = (0.0, 0.0),
    ) -> EstimatorState:
        """Return the state of a robot at rest at a pose [m, m, rad] with stds [m], [rad]."""
        return self._state_at(as_numbers(pose), as_numbers(std))

    @eqx.filter_jit
    def _state_at(self, pose: Float[Array, "3"], std: Float[Array, "2"]) -> EstimatorState:
        f, s = self.robot, self.settings
        return EstimatorState(
            wheels=WheelState.init(f, s),
            current=jnp.zeros(f.drives),
            refused=jnp.zeros(()),
            gyro=GyroState.init(),
            floors=FloorFilter(f, s).init(),
            place=PoseFilter(f, s).init(pose, std),
            stuck=jnp.zeros(()),
            steering=None if f.steering is None else f.steering.zero[0],
        )

    def advance(
        self, state: EstimatorState, z: Readings, dt: Float[Array, ""]
    ) -> tuple[EstimatorState, StateEstimate]:
        """Return state and estimate one time step `dt` later; see `AbstractEstimator.step`."""
        f, s, old = self.robot, self.settings, state
        dt = time_step(dt, s)
        wheels = read_wheels(f, s, old.wheels, z, dt)
        w = wheels.speed
        currents = read_currents(f, s, old.current, z, w, dt)
        refused = old.refused + currents.rejected
        tick = TimeStep(
            dt=dt,
            moves=jnp.max(jnp.abs(f.frame.radius * w)) > s.still_m_s,
            acceleration=jnp.max(jnp.abs(w - old.wheels.speed)) / jnp.maximum(dt, 1e-3),
        )
        steering = old.steering
        if z.steering_angle is not None and steering is not None:
            read = jnp.isfinite(z.steering_angle) & (jnp.abs(z.steering_angle) < MOST)
            steering = jnp.where(read, z.steering_angle, steering)
        by_floor, by_pose = FloorFilter(f, s, steering), PoseFilter(f, s)
        of = by_floor.predict(old.floors, w, old.wheels.speed)
        gap = by_pose.gyro_gap(old.place, z.gyro, *by_floor.yaw_rate(old.floors, of, tick), tick)
        checking, checked = check_gyro(old.gyro, z.gyro, *gap, s.gyro_std, dt)
        gyro, before = checked.rate, by_pose.turned(old.place, checked.turn, checked.doubt)
        bias = before.nuisance[-1]
        turn = gyro - bias
        if self.floor is None:
            floors, motion = by_floor.step(old.floors, of, currents, turn, tick)
        else:
            hypotheses = hypotheses_of(f).under
            root, supports = by_pose.mapped(before, self.floor, hypotheses)
            mapped = jnp.mean(supports, axis=0)
            floors, motion = by_floor.step(old.floors, of, currents, turn, tick, mapped)
            before, left = apply_map(before, root, supports, motion)
            supports = by_pose.mapped(before, self.floor, hypotheses)[1]
            floors = _corrected(floors, left, before, jnp.mean(supports, axis=0))
        place, twist, left = by_pose.step(before, motion, gyro, z, tick)
        floors = replace(floors, apart=floors.apart @ left.T)
        stuck = self._stuck(old.stuck, w, twist, tick)
        new = EstimatorState(
            wheels=wheels,
            current=currents.filtered,
            refused=refused,
            gyro=set_aside(checking, checked, twist[2], bias, left[2, 2], dt),
            floors=floors,
            place=place,
            stuck=stuck,
            steering=steering,
        )
        unknown = floors.belief[-1]
        none = jnp.full((f.wheels, 1), unknown)
        return new, StateEstimate(
            pose=place.pose,
            twist=twist,
            slip=self._slip(w, twist),
            wheel_speed=w,
            current=currents.filtered,
            surface_probability=jnp.concatenate([motion.under * (1 - unknown), none], axis=1),
            covariance=place.covariance[:3, :3],
            stale=jnp.any(wheels.age > s.stale_s),
            immobilised=stuck > 0.4,
            out_of_range=self._beyond(w, currents.filtered, unknown),
            rejected=jnp.stack([checking.rejected, wheels.rejected, refused, place.fixes.rejected]),
            labels=f.labels,
        )

    def _slip(self, w: Array, twist: Array) -> Array:
        """Return the slip ratio of each drive [1]; it is 0 while the drive is at rest."""
        f, turns = self.robot, jnp.abs(w) > 1e-3
        rim = f.frame.radius * jnp.where(turns, w, 1.0)
        return jnp.where(turns, jnp.clip(1 - f.forward @ twist / rim, -2.0, 2.0), 0.0)

    def _stuck(self, before: Array, w: Array, twist: Array, tick: TimeStep) -> Array:
        """Return the time since the body stopped moving while its wheels turn [s].

        The body counts as stopped if it is slower than a fifth of the speed that it would have if
        no wheel slipped. Source: Ward and Iagnemma 2008.
        """
        f = self.robot
        speed = length((f.inverse @ (f.frame.radius * w))[:2])
        blocked = tick.moves & (speed > 0.02) & (length(twist[:2]) < 0.2 * speed)
        return jnp.where(blocked, jnp.minimum(before + tick.dt, 1e3), 0.0)

    def _beyond(self, w: Array, amps: Array, unknown: Array) -> Bool[Array, ""]:
        """Return whether speed or currents far exceed the fitted runs, or the floor is unknown."""
        highest = self.robot.highest
        fast = jnp.max(jnp.abs(w)) > 1.3 * highest[0]
        return fast | (jnp.max(jnp.abs(amps)) > 1.3 * highest[1]) | (unknown > 0.5)


def _corrected(floors: FloorState, left: Array, place: PoseState, expected: Array) -> FloorState:
    """Return the belief over hypotheses after a map has corrected the pose.

    Args:
        floors: belief before the correction.
        left: matrix (3, 3) by which distances of the hypotheses' poses from the estimated pose are
            multiplied, in world axes.
        place: corrected pose.
        expected: probability that the map gives each hypothesis at the corrected pose.
    """
    world = axes_rotation(place.pose[2])
    return replace(floors, apart=floors.apart @ (world.T @ left @ world).T, expected=expected)


class OdometryState(eqx.Module):
    """State of wheel-by-wheel odometry between two steps.

    Attributes:
        pose: x, y [m], heading [rad].
        wheels: angles, speeds and ages of the wheels' readings.
        current: smoothed magnitude of the motors' currents [A].
        refused: number of readings of ammeters that were set aside since the start.
    """

    pose: Float[Array, "3"]
    wheels: WheelState
    current: Float[Array, " drive"]
    refused: Float[Array, ""]


class Odometry(AbstractEstimator[OdometryState]):
    """Wheel-by-wheel odometry: a wheel with speed w and slip ratio s rolls at w_eff = w (1 - s).

    Attributes:
        robot: identified robot.
        settings: settings; by default `Settings.of(robot)`, for the sensors and floors of the
            robot's logs.
        curve: True for the slip ratio a + b |I| of `RobotArrays.wheel_curve` while the smoothed
            current I [A] exceeds `SLIP_CURRENT`, as on the 2021 paper's robot; False for no slip.
    """

    robot: RobotArrays
    settings: Settings
    curve: bool = eqx.field(static=True)

    def __init__(self, robot: RobotArrays, settings: Settings | None = None, curve: bool = False):
        self.robot, self.curve = robot.arrays, curve
        self.settings = as_arrays(Settings.of(robot) if settings is None else settings)

    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> OdometryState:
        """Return the state of a robot at rest at a pose [m, m, rad]."""
        return self._state_at(as_numbers(pose))

    @eqx.filter_jit
    def _state_at(self, pose: Float[Array, "3"]) -> OdometryState:
        return OdometryState(
            pose=pose,
            wheels=WheelState.init(self.robot, self.settings),
            current=jnp.zeros(self.robot.drives),
            refused=jnp.zeros(()),
        )

    def advance(
        self, state: OdometryState, z: Readings, dt: Float[Array, ""]
    ) -> tuple[OdometryState, StateEstimate]:
        """Return state and estimate one time step `dt` later; gyro and pose fixes are not used."""
        f, s, old = self.robot, self.settings, state
        dt = time_step(dt, s)
        wheels = read_wheels(f, s, old.wheels, z, dt)
        w = wheels.speed
        known = jnp.isfinite(z.current) & (jnp.abs(z.current) < largest_current(f, s))
        refused = old.refused + jnp.sum(jnp.isfinite(z.current) & ~known)
        # use the current filter of the 2021 paper's robot, whose factor of 0.97 per row of its logs
        # is a time constant of 0.6 s
        a = 1 - jnp.exp(-dt / 0.6)
        smoothed = old.current + a * (jnp.abs(z.current) - old.current)
        amps = jnp.where(known, smoothed, old.current)
        slip = jnp.zeros_like(w)
        if self.curve:
            line = f.wheel_curve[:, 0] + f.wheel_curve[:, 1] * amps
            slip = jnp.where(amps > SLIP_CURRENT, jnp.clip(line, 0.0, 0.95), 0.0)
        twist = f.inverse @ (f.frame.radius * w * (1 - slip))
        pose = compose(old.pose, advance(twist, dt))
        unknown = jnp.zeros((f.wheels, len(f.labels) + 1)).at[:, -1].set(1.0)
        none = jnp.zeros(())
        new = OdometryState(pose=pose, wheels=wheels, current=amps, refused=refused)
        return new, StateEstimate(
            pose=pose,
            twist=twist,
            slip=slip,
            wheel_speed=w,
            current=amps,
            surface_probability=unknown,
            covariance=jnp.zeros((3, 3)),
            stale=jnp.any(wheels.age > s.stale_s),
            immobilised=jnp.zeros((), bool),
            out_of_range=jnp.max(jnp.abs(w)) > 1.3 * f.highest[0],
            rejected=jnp.stack([none, wheels.rejected, refused, none]),
            labels=f.labels,
        )
