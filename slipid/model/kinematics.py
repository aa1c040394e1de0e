"""Calibrated kinematics: the body twist of wheels with effective sizes, floor by floor.

For drive j on floor k, with wheel speeds w_j [rad/s] and effective rolling radii r_kj [m]:

    xi = S_k J^+ (r_k1 w_1, r_k2 w_2, ...)

where J^+ is the pseudo-inverse of the geometry that the config gives, and S_k corrects its scale in
yaw. Wheels that determine the twist have an effective base, of which L_k / L is the ratio to the
geometry's:

    S_k = diag(1, 1, L / L_k)

Wheels that all point ahead have an effective track b_k, and turn about a point x_k [m] ahead of the
axle's middle:

    v = mean(r w),  W = (mean_right(r w) - mean_left(r w)) / b_k,  v_y = -x_k W

A robot that steers (bicycle, tricycle, Ackermann) turns by its steering angle delta [rad], with an
effective wheelbase l_k. Positions count from the middle of the rear axle:

    v = mean(r w), times cos d if the front axle is driven
    W = v tan(d) / (l_k + K v^2),  d = gain (delta - delta_0)

Source: effective track, the `wheel_separation_multiplier` of ROS controllers; centre of rotation,
Mandow et al. 2007, IROS; rolling omni wheels, Indiveri 2009, IEEE T-RO 25(1);
steady turn with understeer, Gillespie 1992, Fundamentals of Vehicle Dynamics, chapter 6.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from slipid.model.geometry import Geometry
from slipid.parameter import as_numbers

LEAST_TURN, MOST = 1e-6, 1.3
"""Wheel turn below which a step has no steering angle, and largest logged steering angle of a step
[rad]."""


class Steering(NamedTuple):
    """Numbers by which a robot turns at a steering angle; arrays have one common shape.

    Attributes:
        wheelbase: effective wheelbase l [m].
        zero: logged steering angle delta_0 at which the robot drives straight ahead [rad].
        gain: steering angle of the wheel over the logged one [1].
        understeer: K, by which the curvature falls with the speed [s^2/m].
        front: 1 if the front axle is driven, 0 if the rear axle is.
    """

    wheelbase: Any
    zero: Any
    gain: Any
    understeer: Any
    front: Any


def rolled(
    matrix: Float[Any, "3 drive"], turn: Float[Any, "*batch column"], steering: Steering | None
) -> Float[Any, "*batch 3"]:
    """Return body increments [m, m, rad] for wheel turns in short steps, of NumPy or JAX.

    Args:
        matrix: matrix from wheel turns [rad] to body increments, without the turning by steering.
        turn: wheel turns [rad]; those of a robot that steers are followed by the integral of the
            steering angle over their mean [rad^2] and by the duration of the step [s].
        steering: numbers of a robot that steers, all without axes; else None.
    """
    if steering is None:
        return turn @ matrix.T
    xp = turn.__array_namespace__()
    wheel, steered, time = turn[..., :-2], turn[..., -2], turn[..., -1]
    mean = wheel.mean(axis=-1)
    moves = abs(mean) > LEAST_TURN
    # Without the limit, a wheel that turns to and fro in one step would steer at any angle.
    logged = xp.clip(xp.where(moves, steered / xp.where(moves, mean, 1.0), 0.0), -MOST, MOST)
    angle = steering.gain * (logged - steering.zero)
    ahead = (wheel @ matrix.T)[..., 0]
    ahead = ahead * (1 - steering.front * (1 - xp.cos(angle)))
    speed = ahead / xp.where(time > 0, time, 1.0)
    length = steering.wheelbase + steering.understeer * speed**2
    return xp.stack([ahead, xp.zeros_like(ahead), ahead * xp.tan(angle) / length], axis=-1)


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Calibrated kinematics of the drives of a robot on each of its floors; arrays may be batched.

    Attributes:
        labels: names of the floors.
        rolling: pseudo-inverse J^+ of the geometry, from rim speeds to the body twist.
        nominal_base: base or track of the geometry that `rolling` belongs to [m].
        radius: effective rolling radius of every drive on every floor [m].
        base: effective track, effective base of wheels that determine the twist, or effective
            wheelbase of a robot that steers [m].
        centre: point about which the robot turns, ahead of the axle's middle [m]; zero for wheels
            that determine the twist.
        steering: steering on every floor, or None if no wheel is steered.
    """

    labels: tuple[str, ...]
    rolling: Float[np.ndarray, "3 drive"]
    nominal_base: float
    radius: Float[np.ndarray, "*batch floor drive"]
    base: Float[np.ndarray, "*batch floor"]
    centre: Float[np.ndarray, "*batch floor"]
    steering: Steering | None = None

    def matrices(self) -> Float[np.ndarray, "*batch floor 3 drive"]:
        """Return the matrices from wheel speeds [rad/s] to body twists [m/s, m/s, rad/s]."""
        return matrices(self.rolling, self.radius, self.base / self.nominal_base, self.centre)


def matrices(
    rolling: Float[np.ndarray, "3 drive"],
    radius: Float[np.ndarray, "*batch drive"],
    base_ratio: Float[np.ndarray, "*batch"] | float,
    centre: Float[np.ndarray, "*batch"] | float,
) -> Float[np.ndarray, "*batch 3 drive"]:
    """Return the matrices from wheel speeds [rad/s] to body twists; see the module docstring.

    `base_ratio` is the effective base over that of the geometry; lengths are in metres.
    """
    out = rolling * radius[..., None, :]
    out[..., 2, :] /= np.asarray(base_ratio)[..., None]
    out[..., 1, :] -= np.asarray(centre)[..., None] * out[..., 2, :]
    return np.asarray(out)


def nominal_base(shape: Geometry) -> float:
    """Return the length that the yaw rate of the wheels is inversely proportional to [m].

    It is the track of wheels that point ahead, lx + ly of mecanum wheels, the distance of omni
    wheels from the middle, and the wheelbase of a robot that steers.
    """
    if shape.driven is not None:
        return float(shape.base_radius)
    arm = np.abs(np.asarray(shape.forward())[:, 2])
    return float(arm.mean()) * (1.0 if shape.determines_twist else 2.0)


def with_lengths(shape: Geometry, radius: float, base: float) -> Geometry:
    """Return a geometry with equal wheels of another radius, and another track or base [m]."""
    ratio = base / nominal_base(shape)
    return replace(
        shape,
        wheel_radius=as_numbers(radius),
        base_radius=as_numbers(float(shape.base_radius) * ratio),
        radius_deviation=as_numbers(np.zeros(shape.drives)),
    )


def is_axle(shape: Geometry) -> bool:
    """Return whether all ordinary wheels are on one axle, whose middle the robot turns about."""
    place = np.asarray(shape.place) * float(shape.base_radius)
    return all(shape.grips) and float(np.ptp(place[:, 0])) < 1e-3 * float(shape.base_radius)


def nominal_steering(shape: Geometry) -> Steering | None:
    """Return the steering that the config gives, or None if no wheel is steered."""
    if shape.driven is None:
        return None
    return Steering(nominal_base(shape), 0.0, 1.0, 0.0, float(shape.driven == "front"))
