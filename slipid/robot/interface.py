"""Inputs, settings and output of an estimator, and the interface that all estimators share."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.robot.deployed import RobotArrays, with_record
from slipid.robot.record import Setting

Numbers = Array | np.ndarray
Pose = Float[Numbers, "3"] | tuple[float, float, float]
"""Pose as x, y [m] and heading [rad]."""
Given = Numbers | Sequence[float] | float | None
"""A reading as users give it; None if there is no reading."""
NO_FLOOR = "unknown"
"""Name used for the floor under a wheel if no identified floor explains the measurements."""
MIXED_FLOORS_PENALTY = 1.0
"""Value of `Settings.further_floor_penalty` for a robot that is known to drive across edges between
floors [1]; it is below the default, since several floors under such a robot are more likely."""
UNTIMED_S = 0.01
"""Duration that is assumed for a step whose `dt` is invalid, so that readings still age and a stop
still makes progress [s]."""
ACCELERATION_MARGIN = 4.0
"""Ratio of the largest plausible acceleration of a wheel to that of a robot's commands [1]."""
LEAST_ACCELERATION = 1.0
"""Smallest acceleration of a rim that is taken for that of a robot's commands here [m/s^2]."""
PERIOD = 0.05
"""Time between two commands [s]."""
State = TypeVar("State", bound=eqx.Module)
Some = TypeVar("Some", bound=eqx.Module)
Scalar = Float[Array, ""] | float


def as_arrays(given: Some) -> Some:
    """Return a module with arrays instead of floats, so that compiled code accepts any values."""
    return jax.tree.map(partial(jnp.asarray, dtype=float), given)


class Settings(eqx.Module):
    """Settings of an estimator; they are chosen instead of identified.

    Attributes:
        current_is_signed: True if the ammeters measure the sign of a current.
        forget_s: time within which all measurements count as one independent piece of evidence
            about the floors [s].
        filter_s: time constant of the low-pass filter of currents [s].
        patch_m: mean path length between changes of the floor under a wheel [m].
        doubt_m: path length over which an error of the belief about floors decays by a factor of e
            [m].
        further_floor_penalty: decrease of the log probability of a hypothesis for each further
            floor under the robot [1].
        unknown_std: weighted residual above which "unknown" is more likely than a hypothesis [1].
        ammeter_std_a: std of an ammeter's noise [A].
        voltmeter_std_v: std of a voltmeter's noise [V].
        gyro_std: std of a gyro's noise [rad/s].
        gyro_bias_std: std of a gyro's bias at the start [rad/s].
        gyro_delay_s: age of a gyro's readings when they arrive [s].
        wheel_acceleration: acceleration of a wheel up to which a single reading of its encoder is
            believed [rad/s^2].
        supply_voltage: voltage of the supply, which limits the plausible currents [V].
        still_m_s: rim speed below which the robot counts as at rest [m/s].
        stale_s: time without readings after which a wheel counts as stale [s].
        longest_s: longest time step; a longer `dt` is limited to it [s].
    """

    current_is_signed: bool = eqx.field(static=True, default=False)
    forget_s: Scalar = 0.4
    filter_s: Scalar = 0.05
    patch_m: Scalar = 0.1
    doubt_m: Scalar = 1.5
    further_floor_penalty: Scalar = 3.0
    unknown_std: Scalar = 3.0
    ammeter_std_a: Scalar = 0.07
    voltmeter_std_v: Scalar = 0.06
    gyro_std: Scalar = 0.004
    gyro_bias_std: Scalar = 0.01
    gyro_delay_s: Scalar = 0.0
    wheel_acceleration: Scalar = 100.0
    supply_voltage: Scalar = 60.0
    still_m_s: Scalar = 0.003
    stale_s: Scalar = 0.3
    longest_s: Scalar = 0.5

    @classmethod
    def of(cls, robot: RobotArrays) -> "Settings":
        """Return the settings for a robot with the sensors and floors of its logs.

        Raises:
            ValueError: the robot consists of arrays without a record.
        """
        record = with_record(robot).record
        acceleration, voltage = record.limits.acceleration.value, record.limits.voltage
        radius = robot.frame.radius
        supply = cls.supply_voltage if voltage.provenance == "assumed" else voltage.value
        parts = vars(record.sensors).items()
        known = {name: part.value for name, part in parts if isinstance(part, Setting)}
        return cls(
            current_is_signed=record.sensors.current_is_signed,
            further_floor_penalty=record.alike,
            wheel_acceleration=ACCELERATION_MARGIN * max(acceleration, LEAST_ACCELERATION) / radius,
            supply_voltage=supply,
            **known,
        )


class Readings(eqx.Module):
    """A measurement with NaN for all absent readings; attributes as in `Measurement`.

    `steering_angle` is None if there is no reading, so that only robots that steer have it.
    Readings have the same structure for all robots with the same number of drives, whatever sensors
    a robot has, so that compiled code is shared.
    """

    wheel_angle: Float[Array, "*batch drive"]
    wheel_speed: Float[Array, "*batch drive"]
    current: Float[Array, "*batch drive"]
    voltage: Float[Array, "*batch drive"]
    gyro: Float[Array, "*batch"]
    fix: Float[Array, "*batch 3"]
    fix_std: Float[Array, "*batch 2"]
    fix_age: Float[Array, "*batch"]
    steering_angle: Float[Array, "*batch"] | None = None

    @classmethod
    @eqx.filter_jit
    def nothing(cls, drives: int) -> "Readings":
        """Return the readings of a robot with `drives` drives and no sensors: NaN everywhere."""
        shapes = [(drives,)] * 4 + [(), (3,), (2,), ()]
        return cls(*(jnp.full(shape, jnp.nan, dtype=float) for shape in shapes))

    def filled(self, drives: int) -> "Readings":
        """Return the readings unchanged, since none of their fields is None."""
        return self


class Measurement(eqx.Module):
    """Readings of the sensors in one step; None or NaN if there is no reading.

    Example: `Measurement(wheel_angle=angle, current=amps)` for a robot with encoders and ammeters.

    Attributes:
        wheel_angle: cumulative angle of every encoder, scaled to turns of the wheel [rad]; it takes
            precedence over `wheel_speed`.
        wheel_speed: rate of change of the wheel angle [rad/s].
        current: current of every motor [A], with or without sign according to the settings.
        voltage: voltage of every motor [V].
        gyro: yaw rate [rad/s].
        fix: pose from another source such as a camera: x, y [m], heading [rad].
        fix_std: std of the fix's position [m] and heading [rad]; a fix without it is ignored.
        fix_age: age of the fix [s]; an unknown age counts as 0. A fix older than the estimator's
            history of poses, which goes back 47 steps, is ignored.
        steering_angle: steering angle of a robot that steers, as logged, positive to the left
            [rad]; without a reading the last one counts.
    """

    wheel_angle: Given = None
    wheel_speed: Given = None
    current: Given = None
    voltage: Given = None
    gyro: Given = None
    fix: Given = None
    fix_std: Given = None
    fix_age: Given = None
    steering_angle: Given = None

    def filled(self, drives: int) -> Readings:
        """Return the same measurement with NaN for all absent readings.

        Raises:
            ValueError: a field does not have the shape for this number of drives.
        """
        given = vars(Readings.nothing(drives))
        for name, value in vars(self).items():
            if value is not None:
                array = jnp.asarray(value, dtype=float)
                shape = () if name == "steering_angle" else given[name].shape
                if array.shape != shape:
                    of = f"a robot with {drives} encoders"
                    raise ValueError(f"{name} of shape {array.shape}; expected {shape} for {of}")
                given = given | {name: array}
        return Readings(**given)


class StateEstimate(eqx.Module):
    """Output of an estimator after a step; in a run every array has a leading axis of steps.

    Attributes:
        pose: x, y [m], heading [rad].
        twist: velocity of the body in body axes [m/s, m/s, rad/s].
        slip: slip ratio of the wheels of each drive [1].
        wheel_speed: speed of the wheels of each drive [rad/s].
        current: signed, filtered current of each motor [A].
        surface_probability: probability of each floor under each wheel, in the order of `labels`;
            the last column is the probability of a floor that is none of them [1].
        covariance: covariance of the pose in the world frame, in products of [m, m, rad].
        stale: True if readings of a wheel have been missing for too long.
        immobilised: True if the wheels turn while the body stands still.
        out_of_range: True if speed or currents far exceed those of the fitted runs, or the floor is
            unknown.
        rejected: number of readings since the start that were set aside as implausible, of the
            gyro, of all encoders, of all ammeters and voltmeters, and of the pose fixes.
        labels: names of the floors.
    """

    pose: Float[Array, "3"]
    twist: Float[Array, "3"]
    slip: Float[Array, " drive"]
    wheel_speed: Float[Array, " drive"]
    current: Float[Array, " drive"]
    surface_probability: Float[Array, "wheel floor_or_none"]
    covariance: Float[Array, "3 3"]
    stale: Bool[Array, ""]
    immobilised: Bool[Array, ""]
    out_of_range: Bool[Array, ""]
    rejected: Float[Array, "4"]
    labels: tuple[str, ...] = eqx.field(static=True)

    @property
    def surface(self) -> np.ndarray:
        """Name of the most probable floor under each wheel; `NO_FLOOR` if that is none of them."""
        names = np.array([*self.labels, NO_FLOOR])
        return np.asarray(names[np.argmax(np.asarray(self.surface_probability), axis=-1)])

    @property
    def finite(self) -> Bool[Array, ""]:
        """True if every number of the estimate is finite."""
        parts = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self) if x.dtype != bool]
        return jnp.all(jnp.stack(parts))


class AbstractEstimator(eqx.Module, Generic[State]):
    """An estimator as pure functions: `init` returns a state, `step` a state and an estimate."""

    robot: eqx.AbstractVar[RobotArrays]
    settings: eqx.AbstractVar[Settings]

    @abstractmethod
    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> State:
        """Return the state of a robot at rest at a pose [m, m, rad]."""

    @abstractmethod
    def advance(
        self, state: State, z: Readings, dt: Float[Array, ""]
    ) -> tuple[State, StateEstimate]:
        """Return the result of `step` for complete readings and a time step `dt` [s]."""

    def step(
        self, state: State, measurement: Measurement | Readings, dt: Float[Numbers, ""] | float
    ) -> tuple[State, StateEstimate]:
        """Return state and estimate one time step later.

        The step is compiled at its first call; inside a function that JAX transforms it becomes
        part of that function. Readings that are None, not finite, or outside the range of the
        robot's sensors are treated as missing; a `dt` [s] that is not a positive number is treated
        as 0.
        """
        z, dt = measurement.filled(self.robot.drives), jnp.asarray(dt, dtype=float)
        angle = z.steering_angle
        if self.robot.steering is None:
            z = replace(z, steering_angle=None)
        elif angle is None:
            z = replace(z, steering_angle=jnp.asarray(jnp.nan))
        given = jax.tree.leaves((self, state, z, dt))
        if any(isinstance(x, jax.core.Tracer) for x in given):
            return self.advance(state, z, dt)
        return _advanced(self, state, z, dt)


@eqx.filter_jit
def _advanced(
    estimator: AbstractEstimator[State], state: State, z: Readings, dt: Array
) -> tuple[State, StateEstimate]:
    return estimator.advance(state, z, dt)
