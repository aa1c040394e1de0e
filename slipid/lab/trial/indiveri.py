"""Indiveri 2009: any Swedish wheels, a proportional pose loop, and limits that keep the direction.

A wheel at the position b, with radius r and speed w, drives along the unit vector u. Its rollers
run freely along a line at the angle gamma from u; n is the unit vector across that line. The speed
of the wheel follows from the velocity of its centre along n,

    r w (n . u) = n . (v + W z x b),   n . u = sin gamma

which is one row of w = A xi, for any number of wheels (Gfrerrer 2008 derives the same
geometrically). With the path's pose (p_d, th_d) and turn rate W_d, and the robot's pose (p, th),
the pose loop commands the twist xi = (v, W),

    v = R(th)^T (p_d' + k_p (p_d - p)),   W = W_d + k_th (th_d - th),   th_d - th in (-pi, pi]
    xi <- xi / max(1, max_i |A xi|_i / w_max)

so that a robot whose wheels reach their limit w_max still moves in the commanded direction, only
slower: while the path rests, position errors fall along the same straight line for any limit.

Nothing is tuned: the gains are the hand-set gains of slipid's pose loop.

Liberties:

- The law is implemented from its equations in other papers; the text of the paper itself was not
  available. Its other treatments of wheels at their limit are not included; here one factor scales
  translation and turning together.
- The gains are not those of the paper, but those of the row `encoder`. That row uses the sine of
  the heading error and lacks the scaling above. After the scaling, the limits that all rows share
  apply as well. While no wheel is at its limit, the two rows are nearly the same.
- w_max is the wheel speed limit that all rows share, not that of the actual robot.
- As in all rows, the path waits for a robot that lags behind, and limits of body speed, wheel
  acceleration and voltage apply in addition to w_max.
- The pose is that estimated by the encoders.

Source: Indiveri 2009, "Swedish wheeled omnidirectional mobile robots: kinematics analysis and
control", IEEE T-RO 25(1), and Gfrerrer 2008, both as quoted in other papers.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

LEAST_SINE = 0.05
"""Smallest sine of the angle between drive direction and free rolling line of a usable wheel."""


def inverse_kinematics(
    place: Float[np.ndarray, "wheel 2"],
    drive_angle: Float[np.ndarray, " wheel"],
    roller_angle: Float[np.ndarray, " wheel"],
    radius: Float[np.ndarray, " wheel"],
) -> Float[np.ndarray, "wheel 3"]:
    """Return the matrix A from body twist [m/s, m/s, rad/s] to wheel speeds without slip [rad/s].

    Args:
        place: centres of the wheels [m].
        drive_angle: direction of travel at a positive speed [rad].
        roller_angle: angle from the line along which rollers run freely to the drive direction
            [rad].
        radius: radius of each wheel [m].

    Raises:
        ValueError: rollers run freely along the drive direction, or the wheels do not determine the
            motion of the body.
    """
    across = np.sin(roller_angle)
    if np.abs(across).min() < LEAST_SINE:
        wheel = int(np.abs(across).argmin())
        raise ValueError(
            f"wheel {wheel + 1}: rollers at {np.degrees(roller_angle[wheel]):g} deg to the drive "
            "direction, so that the wheel cannot drive; expected an angle not near 0 or 180"
        )
    normal = drive_angle - roller_angle + 0.5 * np.pi
    n = np.stack([np.cos(normal), np.sin(normal)], axis=1)
    lever = place[:, 0] * n[:, 1] - place[:, 1] * n[:, 0]
    matrix = np.column_stack([n, lever]) / (radius * across)[:, None]
    if np.linalg.matrix_rank(matrix, tol=1e-6 * np.abs(matrix).max()) < 3:
        raise ValueError(
            "the wheel speeds do not determine the motion of the body; expected wheels that push "
            "in x, y and yaw"
        )
    return matrix


def pose_loop(
    gains: Float[Array, "2"], reference: Float[Array, "6"], pose: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Return the twist that the pose loop commands [m/s, m/s, rad/s].

    Args:
        gains: gains of position and heading [1/s].
        reference: pose and rates of the path in the world [m, m, rad, m/s, m/s, rad/s].
        pose: estimated pose [m, m, rad].
    """
    vx, vy = reference[3:5] + gains[0] * (reference[:2] - pose[:2])
    off = reference[2] - pose[2]
    turn = reference[5] + gains[1] * jnp.arctan2(jnp.sin(off), jnp.cos(off))
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return jnp.stack([c * vx + s * vy, c * vy - s * vx, turn])


def within_limit(
    twist: Float[Array, "3"], matrix: Float[Array, "wheel 3"], limit: Float[Array, ""]
) -> Float[Array, "3"]:
    """Return the twist, scaled down if a wheel would be faster than `limit` [rad/s]."""
    over = jnp.max(jnp.abs(matrix @ twist)) / limit
    return twist / jnp.maximum(over, 1.0)


class Indiveri(eqx.Module):
    """Indiveri's control law with its parameters.

    Attributes:
        matrix: matrix A of `inverse_kinematics`.
        gains: gains of position and heading [1/s].
        limit: highest speed of the wheels [rad/s].
    """

    matrix: Float[Array, "wheel 3"]
    gains: Float[Array, "2"]
    limit: Float[Array, ""]

    def __call__(self, reference: Float[Array, "6"], pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """Return the commanded twist; arguments as in `pose_loop`."""
        return within_limit(pose_loop(self.gains, reference, pose), self.matrix, self.limit)
