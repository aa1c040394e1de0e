"""Contact equilibrium of many floors at once in a few steps, for a robot's computer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model.contact_balance import Balance, Stance, stand, total
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import Frame
from slipid.model.se2 import Planar

CHORD, NEWTON = 4, 2
"""Steps of each kind from the twist of a moment ago.

Wheel speeds that change by up to 1.25 rad/s a step, three floors: 99 % of all twists are then
within 3 mm/s (20 mm/s with 2 and 3 steps), half of them within rounding.
"""


class Floors(eqx.Module):
    """A robot on each of several combinations of floors.

    Attributes:
        on: how it stands, arrays (wheel, floors).
        plain: twist per rim speed without slip, J^+.
    """

    on: Stance
    plain: Float[Array, "3 wheel"]

    @property
    def friction(self) -> Float[Array, " floors"]:
        """Mean over the wheels; tractions are in units of it times m g."""
        return self.on.friction


def combine(
    frame: Frame,
    stacked: ContactSurface,
    index: np.ndarray,
    rest: Float[Array, " wheel"],
    plain: Float[Array, "3 wheel"],
) -> Floors:
    """A robot on combinations of stacked floors, the index under each wheel given of each."""
    return Floors(stand(frame, stacked.at(index.T), rest), plain)


def settle(
    start: Float[Array, "3 floors"], rim: Array, f: Floors
) -> tuple[Float[Array, "3 floors"], Float[Array, "wheel floors"]]:
    """`contact.equilibrium` from the twist of a moment ago, and the traction its motors feel.

    Chord steps, then Newton's where these come nearer; where a number is lost it is the twist
    without slip. What a jump of the wheel speeds leaves over, the next call settles.

    Args:
        start: twists [m/s, m/s, rad/s].
        rim: rim speeds of one robot (wheel,), or of one for every column (wheel, floors) [m/s].
        f: from `combine`.

    Returns:
        Twists, and tractions [m g mean(mu)].
    """
    rim = rim.reshape(f.plain.shape[1], -1)
    balance, near = Balance(rim, f.on), Planar(*start)
    for _ in range(CHORD):
        near = balance.chord(near)
    xi = near
    for _ in range(NEWTON):
        xi = jax.tree.map(jnp.subtract, xi, balance.newton(xi))
    # NaN is not nearer
    nearer = balance.size(balance.force(xi)) <= balance.size(balance.force(near))
    found = jax.tree.map(lambda x, n: jnp.where(nearer, x, n), xi, near)
    sound = jnp.isfinite(found.x + found.y + found.yaw)
    plain = Planar(*(total(row[:, None] * rim) for row in f.plain))
    twist = jnp.stack(jax.tree.map(lambda x, p: jnp.where(sound, x, p), found, plain))
    felt = jnp.where(nearer, balance.felt(xi), balance.felt(near))
    return twist, jnp.where(jnp.isfinite(felt), felt, 0.0)
