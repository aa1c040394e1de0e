"""The contact law solved for the wheels: which speeds give a wanted twist."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.model import contact_law as law
from slipid.model.contact_balance import Balance, stand
from slipid.model.contact_law import V0, ContactSurface
from slipid.model.geometry import Frame
from slipid.model.se2 import Planar

_PASSES = 3
"""99 % of twists are then met within 0.1 mm/s, with one pass within 10 mm/s."""
_LEAST_LOAD = 0.02


def inverse_contact(
    frame: Frame,
    floors: ContactSurface,
    rest: Float[Array, " wheel"],
    inverse: Float[Array, "3 wheel"],
    xi: Float[Array, "3"],
    surface: Float[Array, "wheel floor"],
) -> Float[Array, " wheel"]:
    """Wheel speeds at which the contact forces balance at a wanted twist [rad/s].

    The twist fixes roller speeds and so drag; balance gives the tractions, least ones beyond three
    wheels; each traction gives the sliding speed of its wheel on its floor:

        T = -(J^T)^+ (K^T D(xi) + scrub),   r w = J xi + (v0 + s0 c) atanh(T / N)

    weighted by the probability of every floor. A traction above 0.9 of what the floor holds is
    taken for 0.9. Drag falls with the rim speed, and so with the sliding that it causes: each pass
    goes by the last one's.

    Args:
        floors: stacked.
        rest: load shares at rest.
        inverse: J^+, twist per rim speed without slip.
        surface: probability of each floor under each wheel, sums 1.

    Source: `slipid.model.contact_law`; rollers at right angles.
    """
    stance = stand(frame, floors.mixed(surface), rest)
    share = Balance(rest, stance).share(Planar(*xi))
    floors = law.at_load(floors, len(rest) * stance.rest[:, None])
    floors, onset = law.sideways(floors, frame.grip[:, None])
    mu = law.load_force(jnp.maximum(share, _LEAST_LOAD)[:, None], floors)  # (wheel, floor), in m g
    along, roll = (frame.hold @ xi)[:, None], (frame.roll @ xi)[:, None]
    scrub = stance.friction * law.scrub_moment(xi[2], stance.floor.scrub).force()
    slide = jnp.zeros_like(mu)
    for _ in range(_PASSES):
        wheels = law.wheel_forces(along, roll, along + slide, jnp.ones(()), onset, floors)
        dragged = jnp.sum(surface * mu * wheels.drag.force(), axis=1)
        total = (frame.roll.T @ -dragged).at[2].add(-scrub)
        pull = jnp.sum(surface * mu * wheels.resistance.force(), axis=1) - inverse.T @ total
        held = pull[:, None] / mu - floors.slide_viscosity * slide
        slide = _sliding(held, along, roll, floors.creep)
    return (along[:, 0] + jnp.sum(surface * slide, axis=1)) / frame.radius


def _sliding(ratio: Array, along: Array, roll: Array, creep: Array) -> Array:
    """Sliding speed at which a wheel has so much of its traction [m/s].

    vs = (v0 + s0 c) atanh(ratio) with c^2 = (along + vs)^2 + roll^2, a quadratic in the rim speed;
    which has no root where s0 atanh(ratio) reaches 1: the wheel spins on the spot.
    """
    held = jnp.arctanh(jnp.clip(ratio, -0.9, 0.9))
    k = jnp.clip(creep * held, -0.9, 0.9)
    at = along + V0 * held
    left = 1 - k * k
    return (at + k * jnp.sqrt(at**2 + left * roll**2 + 1e-12)) / left - along
