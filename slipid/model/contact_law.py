"""The contact law: the forces between floors and rolling wheels, wheel by wheel.

With xi = (v_x, v_y, W) the body twist, r w_i the rim speed, J_i and K_i the rows that give the
speed of wheel i along its drive and along its rollers' free direction, p_i its position, N_i its
load share, v^ the direction of motion, and forces in units of mu m g:

    N0_i  = (share of the weight) exp(delta_i), scaled to sum 1
    g_i   = (w N0_i)^(p - 1)                           drag grows with the load; w: number of wheels
    q_i   = K_i xi                                     roller speed
    c_i   = sqrt((r w_i)^2 + q_i^2)                    wheel activity
    vs_i  = r w_i - J_i xi                             sliding speed
    N     = N0 - P b v^                                contact patches lead the wheel centres by b;
                                                       P: loads that keep sum N and sum N (p + b v^)
    T_i   =  N_i [sat(vs_i / (v0 + s0 c_i)) + kv vs_i - g_i crr sat1(J_i xi / (v0 + s1 c_i))]
    D_i   = -N_i [g_i cr sat(q_i / (vr + sr c_i)) + kl q_i]
    0     = sum J_i^T T_i + K_i^T D_i + (0, 0, -cz sat1(W / W0))

Forces saturate with the ratio x of a speed to its onset as

    sat(x) = x sqrt(2 / (1 + x^2 + sqrt((1 - x^2)^2 + 4 h^2 x^2)))

where the knee width h is a number of the floor; sat1 has h = `KNEE`, at which sat is nearest to
tanh. sat(x)^2 is the non-rectangular hyperbola in x^2: the root between 0 and 1 of the quadratic
equation (1 - h^2) z^2 - (1 + x^2) z + x^2 = 0. sat(x) is x for small and 1 for large x, and sat(1)
= 1 / sqrt(1 + h); h = 0 would clip the force at x = 1. The function is smooth everywhere, and takes
two square roots. At h = 2^(2/k) - 1 it is within 0.011 of the Rapp model x / (1 + |x|^k)^(1/k) for
k from 1.6 to 7 and equals it for k = 2, but does not need powers, which take ten times as long.

These equations are for omni wheels. Where rollers stand at an angle g to the drive, vs_i is r w_i
sin g less the speed along the direction in which the rollers do not roll, and r w_i cos g is
subtracted from q_i. Ordinary wheels have the same friction sideways as ahead, and it acts against
their total sliding: with m_i = sqrt(vs_i^2 + q_i^2) the first terms of T_i and D_i are

    N_i sat(m_i / (v0 + s0 c_i)) vs_i / m_i,     -N_i sat(m_i / (v0 + s0 c_i)) q_i / m_i

They sink into soft floors: r w_i exp(rho) takes the place of r w_i, with rho = 0 on the firmest
floor, while the lever of the torque stays r. Without rho the fit takes the smaller radius for slip
and predicts too large currents.

Wheels may stand on different floors. Forces are then in units of mean(mu) m g, those of wheel i are
weighted by mu_i / mean(mu), and b and cz are means over the loads. Creep and rolling resistance are
rate-independent (s0 is a slip *ratio*): with a resistance that sets in at a fixed speed of 20 mm/s
instead, runs faster than the fitted ones are predicted worse.

Friction grows linearly with the load and drag faster: with N^(4/3) where bodies deform elastically
(Hertz), up to N^2 where wheels sink in (Bekker). This difference lets motion distinguish a larger
load on a wheel from a larger drag. Errors of the law would bias the load shares that are fitted on
a single floor; the load bias delta of each floor absorbs them.

Every function here is elementwise: it takes arrays of any shapes that broadcast.
"""

from dataclasses import replace
from functools import cached_property, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.model.se2 import Planar
from slipid.parameter import known, parameter

_LIFTED = 0.03
"""Ratio of load to mean wheel load below which drag is proportional to load: p has no effect."""
V0 = 0.002
"""Sliding speed below which traction is viscous [m/s]."""
VR = 0.001
"""Roller speed below which roller drag is viscous [m/s]."""
S1 = 0.2
"""Ratio of speed along the drive to wheel activity below which rolling resistance is viscous."""
W0 = 0.05
"""Yaw rate below which the scrub moment is viscous [rad/s]."""
KNEE = 0.65
"""Knee width at which saturation is nearest to tanh: it differs by 0.021 at most."""


positive = partial(parameter, lower=0.0)
"""Declaration of a parameter above zero."""


class ContactSurface(eqx.Module):
    """Parameters of a floor under rolling wheels; leaves may be stacked, one row per label.

    In the force balance a leaf is a single number, or an array (wheel,) if wheels are on several
    floors.

    Attributes:
        labels: names of the stacked surfaces.
    """

    friction: Array = positive(
        "1", "mu", "friction coefficient", start=0.4, spread=0.5, electric=True
    )
    creep: Array = positive("1", "s0", "slip ratio of full traction", start=0.3, spread=1.5)
    roller_drag: Array = positive("1", "cr", "drag of sideways rolling", start=0.3, spread=1.5)
    roller_creep: Array = positive(
        "1", "sr", "roller speed ratio of full drag", start=0.2, spread=1.5
    )
    rolling_resistance: Array = positive(
        "1", "crr", "resistance along the drive", start=0.005, spread=2.0
    )
    slide_viscosity: Array = positive(
        "s/m", "kv", "traction per sliding speed", start=0.02, spread=2.0
    )
    roller_viscosity: Array = positive("s/m", "kl", "drag per roller speed", start=0.02, spread=2.0)
    scrub: Array = positive("m", "cz", "moment against turning", start=0.002, spread=2.0)
    lead: Array = parameter("m", "b", "contact ahead of the wheel centre", start=0.002, spread=0.01)
    drag_exponent: Array = positive(
        "1", "p", "power of the load that drag grows with", start=1.15, spread=0.25
    )
    knee_width: Array = positive(
        "1", "h", "width of the knee between creep and full sliding", start=0.9, spread=0.4
    )
    load_bias: Array = parameter(
        "1",
        "delta",
        "log of the apparent load on each wheel over the true one",
        start=0.0,
        spread=0.05,
        deviation=True,
    )
    rolling_radius: Array = known(
        "1",
        "rho",
        "log of the rolling radius relative to the firmest floor (fitted for a skid steer)",
        start=0.0,
        spread=0.1,
    )
    labels: tuple[str, ...] = eqx.field(static=True, default=())

    def at(self, index: Int[Array | np.ndarray, "..."] | int) -> "ContactSurface":
        """Return the surface at `index` of the stack, or the surface under each wheel.

        `index` may be traced. With an index per wheel, wheels are the first axis, and each wheel
        has the load bias that belongs to it and to the floor under it.
        """
        bias = self.load_bias[index]
        if jnp.ndim(index):
            bias = jnp.moveaxis(jnp.diagonal(bias, axis1=0, axis2=-1), -1, 0)
        return replace(jax.tree.map(lambda leaf: leaf[index], self), load_bias=bias)

    def mixed(self, share: Float[Array, "wheel floor"]) -> "ContactSurface":
        """Return the floor under each wheel as a mean of all floors, weighted by `share`."""
        bias = jnp.sum(share * self.load_bias.T, axis=1)
        return replace(jax.tree.map(lambda leaf: share @ leaf, self), load_bias=bias)


class Saturation(NamedTuple):
    """The function sat of the module docstring at a ratio x of speed to onset.

    Attributes:
        chord: sat(x) / x, 1 at x = 0.
        slope: derivative of sat(x).
        bend: (chord - slope) / x^2, finite at x = 0.
    """

    chord: Array
    slope: Array
    bend: Array

    @classmethod
    def at(cls, square: Array, knee: Array | float) -> "Saturation":
        """Return the saturation at x^2 = `square` with the knee width `knee`."""
        width = 2 * knee**2
        root = jnp.sqrt((1 - square) ** 2 + 2 * width * square)
        total = 1 + square + root
        chord = jnp.sqrt(2 / total)
        per = chord / (total * root)
        # neither sum cancels: where 1 - x^2 nearly equals -root or root, the last term is larger
        slope = per * (root + (1 - square) + width * square)
        return cls(chord, slope, per * (root - (1 - square) + width))


class Friction(eqx.Module):
    """A saturating force against a speed: top sat(m / onset) speed / m + viscosity speed.

    m is the magnitude of the total sliding, of which `speed` and `beside` are components: friction
    acts against the total sliding.

    Attributes:
        speed: sliding or rolling speed [m/s].
        onset: speed at which linear and saturated force intersect [m/s]; it is linear in the
            wheel's activity.
        ratio: derivative of the onset with respect to the activity.
        top: saturated force.
        viscosity: force per speed.
        beside: component of the sliding at right angles to `speed` [m/s]; 0 where friction in one
            direction does not depend on sliding in the other.
        knee: knee width of the saturation.
    """

    speed: Array
    onset: Array | float
    ratio: Array | float
    top: Array | float
    viscosity: Array | float = 0.0
    beside: Array | float = 0.0
    knee: Array | float = KNEE

    @cached_property
    def force(self) -> Array:
        """The force."""
        return self.chord() * self.speed

    def chord(self) -> Array:
        """Return force over speed, an even function of the speed."""
        return self._stiffness * self._saturation.chord + self.viscosity

    def by_speed(self) -> Array:
        """Return the derivative of the force with respect to the speed at a constant activity."""
        across = self._saturation.bend * (self.beside / self.onset) ** 2
        return self._stiffness * (self._saturation.slope + across) + self.viscosity

    def by_beside(self) -> Array:
        """Return the derivative of the force with respect to `beside`."""
        bend = self._saturation.bend / self.onset**2
        return -self._stiffness * bend * self.speed * self.beside

    def by_activity(self) -> Array:
        """Return the derivative of the force with respect to the activity at a constant speed."""
        part = self._stiffness * self._saturation.slope
        return -part * (self.speed / self.onset) * self.ratio

    @cached_property
    def _stiffness(self) -> Array:
        """Slope of the saturating term at rest."""
        return jnp.asarray(self.top / self.onset)

    @cached_property
    def _saturation(self) -> Saturation:
        square = (self.speed / self.onset) ** 2 + (self.beside / self.onset) ** 2
        return Saturation.at(square, self.knee)


class WheelForces(eqx.Module):
    """Forces of a wheel in units of mu N.

    Attributes:
        active: c, rim and roller speed combined [m/s].
        traction: force on the body ahead along the drive.
        resistance: rolling resistance, backward along the drive.
        drag: drag against the speed along the rollers.
    """

    active: Array
    traction: Friction
    resistance: Friction
    drag: Friction

    @cached_property
    def push(self) -> Array:
        """Force on the body along the drive."""
        return self.traction.force - self.resistance.force

    def motor_force(self, drive_share: Array, roller_share: Array) -> Array:
        """Return the force that the motor works against; arguments are those of `WheelFrame`.

        Rolling resistance acts on the body only; the part that acts on the motor is included in the
        motor's own friction. Rollers at an angle (mecanum) transmit a part of the traction and a
        part of their drag to the motor.
        """
        return self.traction.force * drive_share - self.drag.force * roller_share


def wheel_traction(
    slide: Array, active: Array, floor: ContactSurface, beside: Array | float = 0.0
) -> Friction:
    """Return the traction at a sliding speed along the drive.

    `beside` is the sliding speed across, for wheels without rollers.
    """
    onset = V0 + floor.creep * active
    return Friction(slide, onset, floor.creep, 1.0, floor.slide_viscosity, beside, floor.knee_width)


def rolling_fraction(rim: Array, roll: Array, drive_share: Array) -> Array:
    """Return (r w / c) |r w / c|, to which the rolling drag in the drive direction is proportional.

    It is the signed square of the ratio of the rim speed r w to the wheel activity c.
    """
    along = rim * drive_share * jax.lax.rsqrt(rim**2 + roll**2 + 1e-12)
    return along * jnp.abs(along)


def scrub_moment(yaw_rate: Array, scrub: Array) -> Friction:
    """Return the scrub moment at a yaw rate [m]."""
    return Friction(yaw_rate, W0, 0.0, scrub)


def at_load(floor: ContactSurface, relative: Array) -> ContactSurface:
    """Return the floor with the drags of a wheel that carries `relative` times the mean load."""
    grown = jnp.maximum(relative, _LIFTED) ** (floor.drag_exponent - 1)
    return replace(
        floor,
        roller_drag=floor.roller_drag * grown,
        rolling_resistance=floor.rolling_resistance * grown,
    )


def apparent_load(rest: Float[Array, "wheel *one"], bias: Array) -> Float[Array, "wheel *batch"]:
    """Return the apparent load shares at rest: N0 of the module docstring.

    `bias` holds the load biases of the floor (wheel, *batch), or is 0 if there are none.
    """
    seen = rest * jnp.exp(bias)
    return seen / sum(seen[1:], start=seen[0])


def sideways(floor: ContactSurface, grip: Array) -> tuple[ContactSurface, Array]:
    """Return the floor with the sideways friction of each wheel, and the drag's onset at rest.

    The onset is the sideways speed [m/s] below which the drag of a wheel at rest is viscous. `grip`
    is 1 for a wheel without rollers, whose friction sideways is the same as ahead, and 0 for a
    wheel with rollers.
    """
    free = 1 - grip
    out = replace(
        floor,
        roller_drag=grip + free * floor.roller_drag,
        roller_creep=grip * floor.creep + free * floor.roller_creep,
        roller_viscosity=grip * floor.slide_viscosity + free * floor.roller_viscosity,
    )
    return out, grip * V0 + free * VR


def wheel_forces(
    along: Array,
    roll: Array,
    rim: Array,
    drive_share: Array,
    at_rest: Array,
    floor: ContactSurface,
    grip: Array | None = None,
) -> WheelForces:
    """Return the forces of the contact law at the speeds of a wheel [m/s].

    Args:
        along, roll, rim: J xi, q and r w of the module docstring.
        drive_share: `WheelFrame.drive_share`.
        at_rest, floor: onset of the drag at rest, and floor, both from `sideways`.
        grip: `WheelFrame.grip` of a robot that has wheels without rollers, whose friction acts
            against the total sliding; None for a robot with rollers on all wheels.
    """
    active = jnp.sqrt(rim**2 + roll**2 + 1e-12)
    onset, slide = at_rest + floor.roller_creep * active, rim * drive_share - along
    ahead, beside = (0.0, 0.0) if grip is None else (grip * slide, grip * roll)
    drag = floor.roller_creep, floor.roller_drag, floor.roller_viscosity
    return WheelForces(
        active=active,
        traction=wheel_traction(slide, active, floor, beside),
        resistance=Friction(along, V0 + S1 * active, S1, floor.rolling_resistance),
        drag=Friction(roll, onset, *drag, ahead, floor.knee_width),
    )


def load_force(load: Array, floor: ContactSurface) -> Array:
    """Return the friction mu N of a wheel from its load share [m g]."""
    return floor.friction * load


def load_shift(xi: Planar, rest: Array, shift: Float[Array, "2 wheel *one"], lead: Array) -> Array:
    """Return load shares in motion, where contacts lead the wheel centres by `lead` [m]."""
    inv = jax.lax.rsqrt(xi.x**2 + xi.y**2 + 1e-8)
    return rest - lead * (shift[0] * (xi.x * inv) + shift[1] * (xi.y * inv))


def load_shift_slope(
    xi: Planar, shift: Float[Array, "2 wheel *one"], lead: Array
) -> tuple[Array, Array]:
    """Return the derivatives of `load_shift` with respect to the two velocities [s/m]."""
    inv = jax.lax.rsqrt(xi.x**2 + xi.y**2 + 1e-8)
    ahead, left = xi.x * inv, xi.y * inv
    per_speed, mixed = -lead * inv, ahead * left
    by_x = per_speed * (shift[0] * (1 - ahead**2) - shift[1] * mixed)
    return by_x, per_speed * (shift[1] * (1 - left**2) - shift[0] * mixed)
