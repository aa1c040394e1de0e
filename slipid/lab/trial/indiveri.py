"""Indiveri 2009: any Swedish wheels, a proportional pose loop, and limits that keep the direction.

A wheel at b drives along the unit vector u; its rollers run freely along a line at the angle gamma
from u, and n is across that line. Its speed follows from the speed of its centre along n,

    r w (n . u) = n . (v + W z x b),   n . u = sin gamma

a row of w = A xi for every wheel, of any number of wheels (the same as Gfrerrer 2008 derives by
geometry). The loop commands

    v = R(th)^T (p_d' + k_p (p_d - p)),   W = W_d + k_th (th_d - th),   the turn in (-pi, pi]
    xi <- xi / max(1, max_i |A xi|_i / w_max)

so that a robot whose wheels are too slow moves in the commanded direction, only slower: while the
path rests, errors fall along the same straight line whatever the limit is.

Nothing is tuned: gains are those of the robot's own pose loop set by hand.

Liberties:

- Implemented from its equations as they are quoted; the paper's own text was not at hand. Its other
  measures for wheels at their limit, beside one factor for place and heading together, are left
  out.
- Gains are not those of a paper. With the same ones the row of the encoders differs by the limit,
  which all rows have once more after it, and by the sine of the turn: where no wheel is at its
  limit the two are nearly the same.
- w_max is the limit of all rows, whatever the robot's own is.
- The path waits for a robot that lags, and limits of body speed, acceleration of wheels and voltage
  hold beside w_max, as for all rows.
- It is steered from the pose that the encoders believe in.

Source: Indiveri 2009, "Swedish wheeled omnidirectional mobile robots: kinematics analysis and
control", IEEE T-RO 25(1), and Gfrerrer 2008, both as they are quoted.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

LEAST_SINE = 0.05
"""Sine of a roller's angle to the drive direction below which a wheel hardly drives."""


def inverse_kinematics(
    place: Float[np.ndarray, "wheel 2"],
    drive_angle: Float[np.ndarray, " wheel"],
    roller_angle: Float[np.ndarray, " wheel"],
    radius: Float[np.ndarray, " wheel"],
) -> Float[np.ndarray, "wheel 3"]:
    """Return A: speed of each wheel without slip [rad/s] from the body's twist [m/s, m/s, rad/s].

    Args:
        place: centres of the wheels [m].
        drive_angle: direction of travel at a positive speed [rad].
        roller_angle: angle from the line along which rollers run freely to the drive direction
            [rad].
        radius: radius of each wheel [m].

    Raises:
        ValueError: rollers that run freely along the drive direction, or wheels that leave a motion
            of the body free.
    """
    across = np.sin(roller_angle)
    if np.abs(across).min() < LEAST_SINE:
        wheel = int(np.abs(across).argmin())
        raise ValueError(
            f"wheel {wheel + 1}: rollers at {np.degrees(roller_angle[wheel]):g} deg to the drive "
            "direction, such a wheel cannot drive; expected anything away from 0 and 180"
        )
    normal = drive_angle - roller_angle + 0.5 * np.pi
    n = np.stack([np.cos(normal), np.sin(normal)], axis=1)
    lever = place[:, 0] * n[:, 1] - place[:, 1] * n[:, 0]
    matrix = np.column_stack([n, lever]) / (radius * across)[:, None]
    if np.linalg.matrix_rank(matrix, tol=1e-6 * np.abs(matrix).max()) < 3:
        raise ValueError("wheels that leave a motion of the body free; expected any three it needs")
    return matrix


def pose_loop(
    gains: Float[Array, "2"], reference: Float[Array, "6"], pose: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Return the twist that the pose loop commands [m/s, m/s, rad/s].

    Args:
        gains: gains of place and heading [1/s].
        reference: pose and rates of the path in the world [m, m, rad, m/s, m/s, rad/s].
        pose: believed pose [m, m, rad].
    """
    vx, vy = reference[3:5] + gains[0] * (reference[:2] - pose[:2])
    off = reference[2] - pose[2]
    turn = reference[5] + gains[1] * jnp.arctan2(jnp.sin(off), jnp.cos(off))
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return jnp.stack([c * vx + s * vy, c * vy - s * vx, turn])


def within_limit(
    twist: Float[Array, "3"], matrix: Float[Array, "wheel 3"], limit: Float[Array, ""]
) -> Float[Array, "3"]:
    """Return a twist, scaled down where a wheel would be faster than a limit [rad/s]."""
    over = jnp.max(jnp.abs(matrix @ twist)) / limit
    return twist / jnp.maximum(over, 1.0)


class Indiveri(eqx.Module):
    """The law with its numbers.

    Attributes:
        matrix: matrix of `inverse_kinematics`.
        gains: gains of place and heading [1/s].
        limit: highest speed of the wheels [rad/s].
    """

    matrix: Float[Array, "wheel 3"]
    gains: Float[Array, "2"]
    limit: Float[Array, ""]

    def __call__(self, reference: Float[Array, "6"], pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the commanded twist; arguments as in `pose_loop`."""
        return within_limit(pose_loop(self.gains, reference, pose), self.matrix, self.limit)
