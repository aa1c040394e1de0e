"""Contact equilibrium: the body moves so that wheel traction, roller drag and scrub balance.

With xi = (v_x, v_y, W) the body twist, r w_i the rim speed, J_i and K_i the rows that give the
speed of wheel i along its drive and along its rollers' free direction, p_i its place, N_i its load
share, v^ the direction of motion, and forces in units of mu m g:

    q_i   = K_i xi                                     roller speed
    c_i   = sqrt((r w_i)^2 + q_i^2)                    wheel activity
    vs_i  = r w_i - J_i xi                             sliding speed
    N     = N0 - P b v^                                contact patches lead the wheel centres by b;
                                                       P: loads that keep sum N and sum N (p + b v^)
    T_i   =  N_i [tanh(vs_i / (v0 + s0 c_i)) + kv vs_i - crr tanh(J_i xi / (v0 + s1 c_i))]
    D_i   = -N_i [cr tanh(q_i / (vr + sr c_i)) + kl q_i]
    0     = sum J_i^T T_i + K_i^T D_i + (0, 0, -cz tanh(W / W0)) - M (xi - xi_before)

M is mass and inertia over the time step, zero in the quasi-static case. This is for omni wheels;
where rollers stand at an angle g to the drive, vs_i is r w_i sin g less the speed along the
direction in which the rollers do not give way, and r w_i cos g is taken off q_i. Ordinary wheels
grip sideways as they do ahead.

Wheels may stand on different floors: a `ContactSurface` whose leaves have one entry per wheel.
Forces are then in units of mean(mu) m g, each wheel's weighted by mu_i / mean(mu), and b and cz are
means over the loads.

Creep and rolling resistance are rate-independent (s0 is a slip *ratio*): with a resistance that
sets in at 20 mm/s instead, runs faster than the fitted ones are predicted worse. The root is found
by a fixed number of chord steps, which come near from anywhere, and then of damped Newton steps
with the analytic 3x3 Jacobian; its derivative comes from the implicit function theorem.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.model.geometry import Frame
from slipid.parameter import parameter

V0 = 0.002
"""Sliding speed below which traction is viscous [m/s]."""
VR = 0.001
"""Roller speed below which roller drag is viscous [m/s]."""
S1 = 0.2
"""Speed along the drive, over wheel activity, below which rolling resistance is viscous."""
W0 = 0.05
"""Yaw rate below which the scrub moment is viscous [rad/s]."""
_CHORD_STEPS = 30
_NEWTON_STEPS = 8
_DAMPING = (1.0, 0.3, 0.05)
_LEAST_LOAD = 1e-3
_ROUNDING = 1e-20
_NEAR = 1e-6
_MOST_NEAR = 12


class ContactSurface(eqx.Module):
    """What a floor does to rolling wheels; leaves may be stacked, one row per label.

    In the force balance leaves are numbers, or one per wheel where wheels stand on several floors.

    Attributes:
        labels: names of the stacked surfaces.
    """

    friction: Array = parameter(
        unit="1", symbol="mu", start=0.4, lower=0.0, spread=0.5, doc="friction coefficient"
    )
    creep: Array = parameter(
        unit="1", symbol="s0", start=0.3, lower=0.0, spread=1.5, doc="slip ratio of full traction"
    )
    roller_drag: Array = parameter(
        unit="1", symbol="cr", start=0.3, lower=0.0, spread=1.5, doc="drag of sideways rolling"
    )
    roller_creep: Array = parameter(
        unit="1",
        symbol="sr",
        start=0.2,
        lower=0.0,
        spread=1.5,
        doc="roller speed ratio of full drag",
    )
    rolling_resistance: Array = parameter(
        unit="1", symbol="crr", start=0.005, lower=0.0, spread=2.0, doc="resistance along the drive"
    )
    slide_viscosity: Array = parameter(
        unit="s/m", symbol="kv", start=0.02, lower=0.0, spread=2.0, doc="traction per sliding speed"
    )
    roller_viscosity: Array = parameter(
        unit="s/m", symbol="kl", start=0.02, lower=0.0, spread=2.0, doc="drag per roller speed"
    )
    scrub: Array = parameter(
        unit="m", symbol="cz", start=0.002, lower=0.0, spread=2.0, doc="moment against turning"
    )
    lead: Array = parameter(
        unit="m", symbol="b", start=0.002, spread=0.01, doc="contact ahead of the wheel centre"
    )
    labels: tuple[str, ...] = eqx.field(static=True, default=())

    def at(self, index: Any) -> "ContactSurface":
        """Surface number `index` of the stack (may be traced), or those under each wheel."""
        picked: ContactSurface = jax.tree.map(lambda leaf: leaf[index], self)
        return picked


class Contact(eqx.Module):
    """Forces on the body, in units of mu m g.

    Attributes:
        traction: along the drive direction of each wheel, what its motor works against.
        drag: along the rolling direction of the rollers.
        load: share of the weight.
    """

    traction: Float[Array, " wheel"]
    drag: Float[Array, " wheel"]
    load: Float[Array, " wheel"]


def loads(
    xi: Float[Array, " 3"], frame: Frame, surface: ContactSurface, rest: Float[Array, " wheel"]
) -> Float[Array, " wheel"]:
    """Load shares in motion: N0 shifted by contact patches that lead along the motion."""
    v = xi[:2]
    return rest - _mean(surface.lead, rest) * (frame.shift @ (v / jnp.sqrt(v @ v + 1e-8)))


def _mean(leaf: Array, rest: Array) -> Array:
    """Of a floor's number over the loads, where it is one per wheel."""
    return leaf if jnp.ndim(leaf) == 0 else rest @ leaf


def _held(load: Array, s: ContactSurface) -> Array:
    """Loads (.., wheel) as forces count them: times mu_i / mean(mu) on several floors."""
    return load if jnp.ndim(s.friction) == 0 else load * s.friction / jnp.mean(s.friction)


def _speeds(xi: Any, rim: Any, frame: Frame, s: ContactSurface) -> Any:
    """Speeds along drive and rollers, activity, drag coefficients, speeds of full force."""
    along, roll = frame.hold @ xi, frame.roll @ xi - rim * frame.slip_through
    active = jnp.sqrt(rim**2 + roll**2 + 1e-12)
    g = frame.grip  # an ordinary wheel grips sideways as it does ahead
    cr, kl = g + (1 - g) * s.roller_drag, g * s.slide_viscosity + (1 - g) * s.roller_viscosity
    scale_t = V0 + s.creep * active
    scale_r = g * scale_t + (1 - g) * (VR + s.roller_creep * active)
    return along, roll, active, cr, kl, scale_t, scale_r, V0 + S1 * active


def _terms(xi: Any, rim: Any, frame: Frame, s: ContactSurface, rest: Any) -> Any:
    """Traction and drag per unit load, loads, and all their derivatives by xi."""
    v = xi[:2]
    inv = jax.lax.rsqrt(v @ v + 1e-8)
    lead = _mean(s.lead, rest)
    load = _held(rest - lead * (frame.shift @ (v * inv)), s)
    d_load = -lead * (frame.shift * inv - jnp.outer(frame.shift @ v, v) * inv**3)  # (wheel, 2)
    d_load = _held(d_load.T, s).T
    along, roll, active, cr, kl, scale_t, scale_r, scale_1 = _speeds(xi, rim, frame, s)
    slide = rim * frame.pull - along
    slope_r = frame.grip * s.creep + (1 - frame.grip) * s.roller_creep
    t, h, u = jnp.tanh(slide / scale_t), jnp.tanh(roll / scale_r), jnp.tanh(along / scale_1)
    traction = t + s.slide_viscosity * slide - s.rolling_resistance * u
    drag = -(cr * h + kl * roll)
    d_active = roll / active  # times d roll
    t1, h1, u1 = 1 - t * t, 1 - h * h, 1 - u * u
    # d traction = a d along + b d roll;   d drag = c d roll
    brake = s.rolling_resistance * u1 / scale_1
    a = -t1 / scale_t - s.slide_viscosity - brake
    b = -t1 * slide * s.creep * d_active / scale_t**2 + brake * along * S1 * d_active / scale_1
    c = -(cr * h1 * (1 / scale_r - roll * slope_r * d_active / scale_r**2) + kl)
    return traction, drag, load, d_load, a, b, c


def _balance(xi: Any, args: Any) -> tuple[Any, Any]:
    """Residual of the force balance and its Jacobian by xi; moment row over the base radius."""
    rim, frame, s, rest, mass, before = args
    traction, drag, load, d_load, a, b, c = _terms(xi, rim, frame, s, rest)
    turn = jnp.tanh(xi[2] / W0)
    force = frame.hold.T @ (load * traction) + frame.roll.T @ (load * drag)
    force = force.at[2].add(-_mean(s.scrub, rest) * turn) - mass * (xi - before)
    d_t = (load * a)[:, None] * frame.hold + (load * b)[:, None] * frame.roll
    d_d = (load * c)[:, None] * frame.roll
    d_t = d_t.at[:, :2].add(traction[:, None] * d_load)
    d_d = d_d.at[:, :2].add(drag[:, None] * d_load)
    jac = frame.hold.T @ d_t + frame.roll.T @ d_d - jnp.diag(mass)
    jac = jac.at[2, 2].add(-_mean(s.scrub, rest) * (1 - turn**2) / W0)
    row = jnp.array([1.0, 1.0, 1.0]).at[2].set(1.0 / frame.base)
    return row * force, row[:, None] * jac


def _solve3(m: Float[Array, "3 3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """m^-1 b by the adjugate: no LAPACK call per row under vmap, and it exports to C."""
    r0, r1, r2 = jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])
    det = m[0] @ r0
    det = jnp.where(jnp.abs(det) < 1e-30, 1e-30, det)
    return (r0 * b[0] + r1 * b[1] + r2 * b[2]) / det


def _chord(xi: Any, args: Any) -> Any:
    """Twist that balances the forces when each is drawn as its chord from zero speed to xi.

    tanh(x) / x falls with |x|, so that no step overshoots where Newton's does; near the root it is
    slow (Weiszfeld's iteration).
    """
    rim, frame, s, rest, mass, before = args
    v = xi[:2]
    load = rest - _mean(s.lead, rest) * (frame.shift @ (v * jax.lax.rsqrt(v @ v + 1e-8)))
    load = _held(
        jnp.maximum(load, _LEAST_LOAD), s
    )  # a lifted wheel would push the chord the wrong way
    along, roll, _, cr, kl, scale_t, scale_r, scale_1 = _speeds(xi, rim, frame, s)

    def slope(x: Any, scale: Any) -> Any:
        flat = jnp.abs(x) < 1e-6 * scale
        return jnp.where(flat, 1 / scale, jnp.tanh(x / scale) / jnp.where(flat, 1.0, x))

    pulls = load * (slope(rim * frame.pull - along, scale_t) + s.slide_viscosity)
    holds = load * (cr * slope(roll, scale_r) + kl)
    brakes = load * s.rolling_resistance * slope(along, scale_1)
    m = frame.hold.T @ ((pulls + brakes)[:, None] * frame.hold)
    m += frame.roll.T @ (holds[:, None] * frame.roll) + jnp.diag(mass)
    m = m.at[2, 2].add(_mean(s.scrub, rest) * slope(xi[2], W0))
    drive = frame.hold.T @ (pulls * rim * frame.pull)
    drive += frame.roll.T @ (holds * rim * frame.slip_through) + mass * before
    return _solve3(m, drive)


def _newton(xi: Any, args: Any) -> Any:
    damping = jnp.asarray(_DAMPING)
    f, jac = _balance(xi, args)
    dx = _solve3(jac, f)

    def merit(alpha: Any) -> Any:
        g = _residual(xi - alpha * dx, args)
        return jnp.where(jnp.all(jnp.isfinite(g)), g @ g, jnp.inf)

    tried = jax.vmap(merit)(damping)
    best = jnp.argmin(tried)
    # where all wheels slide the balance is flat and Newton's direction leads far away
    stuck = (tried[best] >= f @ f) & (f @ f > _ROUNDING)
    return jnp.where(stuck, _chord(xi, args), xi - damping[best] * dx)


def _residual(xi: Any, args: Any) -> Any:
    rim, frame, s, rest, mass, before = args
    traction, drag, load, *_ = _terms(xi, rim, frame, s, rest)
    force = frame.hold.T @ (load * traction) + frame.roll.T @ (load * drag)
    force = force.at[2].add(-_mean(s.scrub, rest) * jnp.tanh(xi[2] / W0)) - mass * (xi - before)
    return force.at[2].divide(frame.base)


@jax.custom_jvp
def _root(args: Any) -> Any:
    def repeat(step: Any, xi: Any, times: int) -> Any:
        return jax.lax.scan(lambda x, _: (step(x, args), None), xi, None, length=times)[0]

    near = repeat(_chord, args[-1], _CHORD_STEPS)
    return repeat(_newton, near, _NEWTON_STEPS)


@jax.custom_jvp
def _root_near(args: Any) -> Any:
    def far(state: Any) -> Any:
        _, step, count = state
        return (jnp.max(jnp.abs(step)) > _NEAR) & (count < _MOST_NEAR)

    def newton(state: Any) -> Any:
        xi, _, count = state
        f, jac = _balance(xi, args)
        step = _solve3(jac, f)
        return xi - step, step, count + 1

    start = args[-1]
    xi, step, _ = jax.lax.while_loop(far, newton, (start, jnp.full(3, jnp.inf), 0))
    return jnp.where(jnp.max(jnp.abs(step)) > _NEAR, jnp.nan, xi)


def _implicit(root: Any) -> Any:
    """Derivative of a root of the balance by what it depends on."""

    def rule(primals: Any, tangents: Any) -> Any:
        (args,), (d_args,) = primals, tangents
        xi = root(args)
        _, jac = _balance(xi, args)
        _, d_force = jax.jvp(lambda a: _residual(xi, a), (args,), (d_args,))
        return xi, -_solve3(jac, d_force)

    return rule


_root.defjvp(_implicit(_root))
_root_near.defjvp(_implicit(_root_near))


def guess(rim: Float[Array, " wheel"], frame: Frame) -> Float[Array, "3"]:
    """Start of the root finder: the twist without slip, a little slower (least squares)."""
    j = frame.hold
    m = j.T @ j + 1e-6 * jnp.eye(3)
    return 0.8 * _solve3(m, j.T @ (rim * frame.pull))


def equilibrium(
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Float[Array, "3"]:
    """Body twist (vx [m/s], vy [m/s], yaw rate [rad/s]) at which the contact forces balance.

    Args:
        rim: r w, rim speed of each wheel [m/s].
        frame: wheel directions.
        surface: one floor.
        rest: load shares at rest, sum 1.

    Source: the balance at the head of this module with M = 0.
    """
    start = jax.lax.stop_gradient(guess(rim, frame))
    return _root((rim, frame, surface, rest, jnp.zeros(3), start))


def equilibrium_near(
    start: Float[Array, "3"],
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Float[Array, "3"]:
    """`equilibrium` by plain Newton steps from a twist nearby, NaN where they do not arrive.

    About ten times cheaper; the last step is below 1e-6, which Newton's squares.
    """
    return _root_near((rim, frame, surface, rest, jnp.zeros(3), jax.lax.stop_gradient(start)))


def step_with_inertia(
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
    before: Float[Array, "3"],
    inertia: Float[Array, "3"],
    dt: Float[Array, ""] | float,
) -> Float[Array, "3"]:
    """Twist one implicit Euler step later, with body inertia.

    Args:
        before: twist at the start of the step.
        inertia: (m, m, I_z) / (mu m g) [s^2/m, s^2/m, s^2 m].
        dt: step [s].
    """
    return _root((rim, frame, surface, rest, inertia / dt, before))


def forces(
    xi: Float[Array, "3"],
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Contact:
    """Traction the motors feel, roller drag and load shares at a twist [mu m g].

    Rolling resistance is counted as a force on the body that the motor does not feel; what the
    motor bears of it is in its own friction. Rollers at an angle (mecanum) pass on a part of what
    holds the wheel and a part of their drag.
    """
    traction, drag, load, *_ = _terms(xi, rim, frame, surface, rest)
    along, *_, scale_1 = _speeds(xi, rim, frame, surface)
    held = traction + surface.rolling_resistance * jnp.tanh(along / scale_1)
    felt = load * (held * frame.pull + drag * frame.slip_through)
    share = loads(xi, frame, surface, rest)
    return Contact(traction=felt, drag=load * drag, load=share)


def residual(
    xi: Float[Array, "3"],
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Float[Array, "3"]:
    """Force balance at a twist, the moment over the base radius [mu m g]; zero at equilibrium."""
    return _residual(xi, (rim, frame, surface, rest, jnp.zeros(3), jnp.zeros(3)))
