"""Balance of the contact forces of one robot, of many robots at once, or of one on many floors.

Wheels are the first axis of every array; the batch, if there is one, follows. Sums over wheels and
over x, y, yaw are written out instead of matrix products, so that XLA compiles them to few loops
over contiguous numbers: each loop costs at least 0.2 us.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.model import contact_law as law
from slipid.model.contact_law import ContactSurface, WheelForces
from slipid.model.geometry import WheelFrame
from slipid.model.se2 import Columns, Planar, dot, solve3

_LEAST_LOAD = 1e-3
"""Smallest load share in a chord step; a lifted wheel has a negative share."""


class Stance(eqx.Module):
    """A robot on its floors: geometry, loads and floor parameters of every wheel.

    Attributes:
        frame, rest: wheel directions and apparent load shares at rest, with axes for the batch.
        hold, roll, shift: matrices of `frame`, split by component of the twist, each (wheel, *one);
            `*one` are batch axes of length 1.
        floor: floor parameters under each wheel or under all; friction is relative to its mean,
            scrub and lead are means over the loads, and the roller parameters are those of
            `law.sideways`.
        drag_onset: roller speed below which drag is viscous [m/s].
        friction: mean friction coefficient of the wheels; forces are in units of friction m g.
        roller_scale: roller drag of each wheel if all wheels carry the same load.
        rolling: rolling radius on the floor over the radius of the wheel.
    """

    frame: WheelFrame
    hold: Planar
    roll: Planar
    shift: Float[Array, "2 wheel *one"]
    rest: Float[Array, "wheel *batch"]
    floor: ContactSurface
    drag_onset: Float[Array, "wheel *one"]
    friction: Float[Array, "*batch"]
    roller_scale: Float[Array, "wheel *batch"]
    rolling: Float[Array, "wheel *batch"]


def stand(frame: WheelFrame, surface: ContactSurface, rest: Float[Array, " wheel"]) -> Stance:
    """Return a robot's stance on one floor, or on one floor per wheel.

    The leaves of `surface` are single numbers for one floor, otherwise arrays (wheel, *batch).
    """
    floor, friction = replace(surface, friction=jnp.ones(())), surface.friction
    if jnp.ndim(friction) > 0:
        ones = (1,) * (jnp.ndim(friction) - 1)
        frame, rest = jax.tree.map(lambda a: a.reshape(*a.shape, *ones), (frame, rest))
    rest = law.apparent_load(rest, surface.load_bias)
    if jnp.ndim(friction) > 0:
        friction = jnp.mean(surface.friction, axis=0)
        floor = replace(
            surface,
            friction=surface.friction / friction,
            scrub=total(rest * surface.scrub),
            lead=total(rest * surface.lead),
        )
    roller_scale = (1 - frame.grip) * floor.friction * floor.roller_drag / len(rest)
    rolling = jnp.exp(frame.grip * floor.rolling_radius)
    floor, onset = law.sideways(law.at_load(floor, len(rest) * rest), frame.grip)
    # Components are the first axis, so that XLA stores each, and its derivatives, contiguously.
    hold, roll, shift = (jnp.moveaxis(r, 1, 0) for r in (frame.hold, frame.roll, frame.shift))
    scales = friction, roller_scale, rolling
    return Stance(frame, Planar(*hold), Planar(*roll), shift, rest, floor, onset, *scales)


def total(of_wheels: Float[Array, "wheel *batch"]) -> Float[Array, "*batch"]:
    """Return the sum over wheels, written out."""
    return sum(of_wheels[1:], start=of_wheels[0])


class Balance(eqx.Module):
    """The forces on a body as functions of its twist, in units of mean(mu) m g.

    Attributes:
        rim: r w, rim speeds [m/s].
        on: stance of the robot on its floors.
    """

    rim: Float[Array, "wheel *batch"]
    on: Stance

    def at(self, xi: Planar) -> "BalanceAt":
        """Return the forces at a twist."""
        rim = self.rim * self.on.rolling if self.on.frame.ordinary else self.rim
        return BalanceAt(rim, self.on, xi)

    def force(self, xi: Planar) -> Planar:
        """Return the resultant force on the body, zero at equilibrium."""
        return self.at(xi).force

    def size(self, force: Planar) -> Float[Array, "*batch"]:
        """Return the squared size of a force, with its moment divided by the base radius."""
        return force.x**2 + force.y**2 + (force.yaw / self.on.frame.base) ** 2


@dataclass(frozen=True, eq=False)
class BalanceAt:
    """Forces of a `Balance` at one twist; values that several forces need are traced once.

    Attributes:
        rim: rim speeds with the rolling radius on the floor [m/s].
        on: as in `Balance`.
        xi: the twist.
    """

    rim: Float[Array, "wheel *batch"]
    on: Stance
    xi: Planar

    @cached_property
    def speeds(self) -> tuple[Array, Array]:
        """Speed of each wheel centre along its drive, and its roller speed [m/s].

        They are J xi and q of `slipid.model.contact_law`.
        """
        on = self.on
        return dot(on.hold, self.xi), dot(on.roll, self.xi) - self.rim * on.frame.roller_share

    @cached_property
    def wheels(self) -> WheelForces:
        """Forces of the contact law at these speeds."""
        f = self.on.frame
        grip = f.grip if f.ordinary else None
        where = *self.speeds, self.rim, f.drive_share, self.on.drag_onset
        return law.wheel_forces(*where, self.on.floor, grip)

    @cached_property
    def share(self) -> Float[Array, "wheel *batch"]:
        """Load shares in motion."""
        return law.load_shift(self.xi, self.on.rest, self.on.shift, self.on.floor.lead)

    @cached_property
    def load(self) -> Float[Array, "wheel *batch"]:
        """Friction coefficient times load of every wheel, divided by mean(mu) m g."""
        return law.load_force(self.share, self.on.floor)

    @cached_property
    def force(self) -> Planar:
        """Resultant force on the body, zero at equilibrium."""
        w = self.wheels
        x, y, yaw = self._summed(self.load * w.push, -self.load * w.drag.force)
        return Planar(x, y, yaw - law.scrub_moment(self.xi.yaw, self.on.floor.scrub).force)

    def jacobian(self) -> Columns:
        """Return the derivative of the force with respect to the twist.

        It includes the changes of the wheels' speeds and of their load shares with the twist.
        """
        w, load, on = self.wheels, self.load, self.on
        # derivative of the activity with respect to the roller speed
        by_roll = self.speeds[1] / w.active
        by_along = -w.traction.by_speed() - w.resistance.by_speed()
        across = (w.traction.by_activity() - w.resistance.by_activity()) * by_roll
        rolls = -w.drag.by_speed() - w.drag.by_activity() * by_roll
        # derivative of the drag along the rollers with respect to the speed along the drive
        turned: Array | float = 0.0
        if on.frame.ordinary:
            across = across + on.frame.grip * w.traction.by_beside()
            turned = load * on.frame.grip * w.drag.by_beside()
        by_along, across, rolls = load * by_along, load * across, load * rolls

        def column(k: int, pushed: Array | float, dragged: Array | float) -> Planar:
            along = by_along * on.hold[k] + across * on.roll[k] + pushed
            back = rolls * on.roll[k] + turned * on.hold[k] + dragged
            return self._summed(along, back)

        by_x, by_y = (
            law.load_force(slope, on.floor)
            for slope in law.load_shift_slope(self.xi, on.shift, on.floor.lead)
        )
        x = column(0, w.push * by_x, -w.drag.force * by_x)
        y = column(1, w.push * by_y, -w.drag.force * by_y)
        yaw = column(2, 0.0, 0.0)
        scrub = law.scrub_moment(self.xi.yaw, on.floor.scrub).by_speed()
        return Columns(x, y, yaw._replace(yaw=yaw.yaw - scrub))

    @cached_property
    def newton(self) -> Planar:
        """Newton's step, which is to be subtracted from the twist."""
        return solve3(self.jacobian(), self.force)

    def chord(self) -> Planar:
        """Return the twist that balances the forces when each is replaced by its chord.

        A chord is the line through zero at zero speed and through the force at xi (Weiszfeld's
        iteration). Since sat(x) / x falls with |x|, chord steps do not overshoot as Newton's do;
        near the root they converge slowly.
        """
        on, f, w = self.on, self.on.frame, self.wheels
        # A lifted wheel has a negative load share, which would give its chords the wrong sign.
        load = law.load_force(jnp.maximum(self.share, _LEAST_LOAD), on.floor)
        pulls, rolls = load * w.traction.chord(), load * w.drag.chord()
        both = pulls + load * w.resistance.chord()

        def entry(a: int, b: int) -> Array:
            on_hold, on_roll = on.hold[a] * on.hold[b], on.roll[a] * on.roll[b]
            return total(on_hold * both + on_roll * rolls)

        xx, xy, yy = entry(0, 0), entry(0, 1), entry(1, 1)
        x_yaw, y_yaw, turn = entry(0, 2), entry(1, 2), entry(2, 2)
        turn += law.scrub_moment(self.xi.yaw, on.floor.scrub).chord()
        m = Columns(Planar(xx, xy, x_yaw), Planar(xy, yy, y_yaw), Planar(x_yaw, y_yaw, turn))
        drive = self._summed(pulls * self.rim * f.drive_share, rolls * self.rim * f.roller_share)
        return solve3(m, drive)

    @property
    def motor_force(self) -> Float[Array, "wheel *batch"]:
        """Traction against which each motor works [mean(mu) m g]."""
        f = self.on.frame
        return self.load * self.wheels.motor_force(f.drive_share, f.roller_share)

    @property
    def rolling_drag(self) -> Float[Array, "wheel *batch"]:
        """Rolling drag of each wheel in its drive direction if `Motor.rolling_drag` is 1.

        Only the motors work against it; it exerts no force on the body.
        """
        return self.on.roller_scale * law.rolling_fraction(
            self.rim, self.speeds[1], self.on.frame.drive_share
        )

    def _summed(self, along: Array, roll: Array) -> Planar:
        """Return the force on the body from forces along the drives and along the rollers."""
        hold, free = self.on.hold, self.on.roll
        return Planar(*(total(hold[k] * along + free[k] * roll) for k in range(3)))
