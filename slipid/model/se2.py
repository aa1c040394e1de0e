"""Planar motion and forces: exact SE(2) poses, and 3x3 linear algebra without LAPACK."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Planar(NamedTuple):
    """A twist, a force or a matrix column: three arrays (x, y, yaw) of any batch shape."""

    x: Array
    y: Array
    yaw: Array


class Columns(NamedTuple):
    """A 3x3 matrix by its columns, such as the derivative of a force with respect to a twist."""

    x: Planar
    y: Planar
    yaw: Planar


def dot(a: Planar, b: Planar) -> Array:
    """Return the scalar product, written out because XLA makes a loop of every matrix product."""
    return a.x * b.x + a.y * b.y + a.yaw * b.yaw


def cross(a: Planar, b: Planar) -> Planar:
    """Return the cross product of two triples."""
    x, y = a.y * b.yaw - a.yaw * b.y, a.yaw * b.x - a.x * b.yaw
    return Planar(x, y, a.x * b.y - a.y * b.x)


def solve3(m: Columns, b: Planar) -> Planar:
    """Return m^-1 b by Cramer's rule, which needs no LAPACK call per matrix and exports to C."""
    first = cross(m.y, m.yaw)
    det = dot(m.x, first)
    scale = 1 / jnp.where(jnp.abs(det) < 1e-30, 1e-30, det)
    x, y, yaw = dot(first, b), dot(cross(m.yaw, m.x), b), dot(cross(m.x, m.y), b)
    return Planar(x * scale, y * scale, yaw * scale)


def advance(xi: Float[Array, "3"], dt: Float[Array, ""] | float) -> Float[Array, "3"]:
    """Return the pose increment after moving for dt at a constant twist (exact SE(2)).

    The increment is in the frame of the start pose.
    """
    w = xi[2] * dt
    small = jnp.abs(w) < 1e-6
    safe = jnp.where(small, 1.0, w)
    a = jnp.where(small, 1.0 - w * w / 6, jnp.sin(safe) / safe)
    b = jnp.where(small, 0.5 * w, (1 - jnp.cos(safe)) / safe)
    return jnp.stack([(a * xi[0] - b * xi[1]) * dt, (b * xi[0] + a * xi[1]) * dt, w])


def compose(pose: Float[Array, "3"], increment: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the pose after a body-frame increment."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = increment[0], increment[1]
    return jnp.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y, pose[2] + increment[2]])


def chain(start: Float[Array, "3"], increments: Float[Array, "step 3"]) -> Float[Array, "edge 3"]:
    """Return a start pose and the poses after every body-frame increment."""
    _, poses = jax.lax.scan(lambda pose, d: (compose(pose, d),) * 2, start, increments)
    return jnp.concatenate([start[None], poses])


def path(
    xi: Float[Array, "step 3"], dt: Float[Array, " step"], start: Float[Array, "3"]
) -> Float[Array, "edge 3"]:
    """Return the poses before the first and after every step at constant twists (exact SE(2))."""
    return chain(start, jax.vmap(advance)(xi, dt))
