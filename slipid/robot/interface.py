"""What goes into an estimator and what comes out of it, by name, and what it is told."""

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.robot.deployed import RobotArrays, with_record

Numbers = Array | np.ndarray
Pose = Float[Numbers, "3"] | tuple[float, float, float]
"""x, y [m], heading [rad]."""
Given = Numbers | Sequence[float] | float | None
NO_FLOOR = "unknown"
"""Name of the floor under a wheel where no identified one explains what is measured."""
MIXED_FLOORS_PENALTY = 1.0
"""`Settings.alike` of a robot that is known to drive across the edges of floors."""
UNTIMED_S = 0.01
"""What a step without a time counts as, until readings are stale and while the robot stops [s]."""
State = TypeVar("State", bound=eqx.Module)
Some = TypeVar("Some", bound=eqx.Module)
Scalar = Float[Array, ""] | float


def as_arrays(given: Some) -> Some:
    """The same module with arrays in place of numbers, so that compiled code takes any of them."""
    return jax.tree.map(partial(jnp.asarray, dtype=float), given)


class Settings(eqx.Module):
    """What is not identified.

    Attributes:
        current_is_signed: of the ammeters.
        forget_s: currents nearer than this in time tell the same twice [s].
        filter_s: time constant in which currents are averaged [s].
        patch_m: length on which the floor under a wheel changes.
        doubt_m: length on which what is wrongly believed of the floors stays as wrong.
        alike: how much rarer each further floor under the robot is, in log probability.
        unknown_std: from what it predicts, in stds of a current, a hypothesis loses to "unknown".
        ammeter_std_a, voltmeter_std_v: of the sensors.
        gyro_std, gyro_bias_std: of a reading and of its zero [rad/s].
        gyro_delay_s: age of its readings [s].
        still_m_s: rim speed below which the robot stands [m/s].
        stale_s: without a wheel's reading after which it is stale [s].
        longest_s: time step beyond which the robot's motion is not made up [s].
    """

    current_is_signed: bool = eqx.field(static=True, default=False)
    forget_s: Scalar = 0.4
    filter_s: Scalar = 0.05
    patch_m: Scalar = 0.1
    doubt_m: Scalar = 1.5
    alike: Scalar = 3.0
    unknown_std: Scalar = 3.0
    ammeter_std_a: Scalar = 0.07
    voltmeter_std_v: Scalar = 0.06
    gyro_std: Scalar = 0.004
    gyro_bias_std: Scalar = 0.01
    gyro_delay_s: Scalar = 0.0
    still_m_s: Scalar = 0.003
    stale_s: Scalar = 0.3
    longest_s: Scalar = 0.5

    @classmethod
    def of(cls, robot: RobotArrays) -> "Settings":
        """Those of a robot: the sensors of its logs, and what they were driven over.

        Raises:
            ValueError: it comes without its record.
        """
        record = with_record(robot).record
        return cls(current_is_signed=record.sensors.current_is_signed, alike=record.alike)


class Readings(eqx.Module):
    """A measurement with NaN where there is nothing; attributes as of `Measurement`.

    Those of all robots with so many drives have one structure, whatever they measure.
    """

    wheel_angle: Float[Array, "*batch drive"]
    wheel_speed: Float[Array, "*batch drive"]
    current: Float[Array, "*batch drive"]
    voltage: Float[Array, "*batch drive"]
    gyro: Float[Array, "*batch"]
    fix: Float[Array, "*batch 3"]
    fix_std: Float[Array, "*batch 2"]
    fix_age: Float[Array, "*batch"]

    @classmethod
    def nothing(cls, drives: int) -> "Readings":
        """Of a robot of so many drives that measures nothing."""
        shapes = [(drives,)] * 4 + [(), (3,), (2,), ()]
        return cls(*(jnp.full(shape, jnp.nan, dtype=float) for shape in shapes))

    def filled(self, drives: int) -> "Readings":
        """Themselves."""
        return self


class Measurement(eqx.Module):
    """What the sensors give in one step; None or NaN where there is nothing.

    `Measurement(wheel_angle=angle, current=amps)` is a robot that measures these two.

    Attributes:
        wheel_angle: of every encoder, as the wheel turns, cumulative [rad]; it counts before
            `wheel_speed`.
        wheel_speed: the same, its rate [rad/s].
        current: of every motor [A], signed or not as the estimator's settings say.
        voltage: of every motor [V].
        gyro: yaw rate [rad/s].
        fix: pose from elsewhere, a camera say: x, y [m], heading [rad].
        fix_std: of its place [m] and of its heading [rad]; a fix without it counts for nothing.
        fix_age: for how long the fix has been true [s]; not known counts as 0, and one of more
            than 47 steps ago counts for nothing.
    """

    wheel_angle: Given = None
    wheel_speed: Given = None
    current: Given = None
    voltage: Given = None
    gyro: Given = None
    fix: Given = None
    fix_std: Given = None
    fix_age: Given = None

    def filled(self, drives: int) -> Readings:
        """The same with NaN where there is nothing.

        Raises:
            ValueError: a field has another shape than a robot of so many drives gives.
        """
        given = vars(Readings.nothing(drives))
        for name, value in vars(self).items():
            if value is not None:
                found, shape = jnp.asarray(value, dtype=float), given[name].shape
                if found.shape != shape:
                    of = f"a robot with {drives} encoders"
                    raise ValueError(f"{name} of shape {found.shape}; expected {shape} of {of}")
                given = given | {name: found}
        return Readings(**given)


class StateEstimate(eqx.Module):
    """What an estimator believes after a step; runs have leading axes in front of every array.

    Attributes:
        pose: x, y [m], heading [rad]; twist: of the body [m/s, m/s, rad/s].
        slip: ratio of the wheels of each drive; wheel_speed: of these [rad/s].
        current: of each motor, signed and filtered [A].
        surface_probability: of each floor in the order of `labels`, and of none of them in the last
            column, under each wheel.
        covariance: of the pose in the world frame [m, m, rad, each times each].
        stale: wheels are not heard.
        immobilised: the wheels turn and the body does not move.
        out_of_range: faster, or drawing more, than the fit has seen, or on an unknown floor.
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
    labels: tuple[str, ...] = eqx.field(static=True)

    @property
    def surface(self) -> np.ndarray:
        """Name of the most probable floor under each wheel, `NO_FLOOR` where it is none of them."""
        names = np.array([*self.labels, NO_FLOOR])
        return np.asarray(names[np.argmax(np.asarray(self.surface_probability), axis=-1)])

    @property
    def finite(self) -> Bool[Array, ""]:
        """Whether every number is one."""
        parts = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(self) if x.dtype != bool]
        return jnp.all(jnp.stack(parts))


class AbstractEstimator(eqx.Module, Generic[State]):
    """An estimator as pure functions: `init` gives a state, `step` the next one and an estimate."""

    robot: eqx.AbstractVar[RobotArrays]
    settings: eqx.AbstractVar[Settings]

    @abstractmethod
    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> State:
        """State of a robot at rest at a pose [m, m, rad]."""

    @abstractmethod
    def advance(
        self, state: State, z: Readings, dt: Float[Array, ""]
    ) -> tuple[State, StateEstimate]:
        """As `step`, from readings."""

    def step(
        self, state: State, measurement: Measurement | Readings, dt: Float[Numbers, ""] | float
    ) -> tuple[State, StateEstimate]:
        """State and estimate a time step later.

        Compiled at its first call; within a function that JAX transforms, it is part of that.

        What is None, no number or what no sensor of this robot could read counts as not measured;
        where `dt` [s] is no positive number, no time has passed.
        """
        z, dt = measurement.filled(self.robot.drives), jnp.asarray(dt, dtype=float)
        given = jax.tree.leaves((self, state, z, dt))
        if any(isinstance(x, jax.core.Tracer) for x in given):
            return self.advance(state, z, dt)
        return _advanced(self, state, z, dt)


@eqx.filter_jit
def _advanced(
    estimator: AbstractEstimator[State], state: State, z: Readings, dt: Array
) -> tuple[State, StateEstimate]:
    return estimator.advance(state, z, dt)
