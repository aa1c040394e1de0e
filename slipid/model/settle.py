"""Contact equilibrium of many floors at once in a few steps, for a robot's computer.

The balance is that of `slipid.model.contact`, written for one robot whose wheels may stand on any
of several combinations of floors: combinations are the last axis of every array, wheels the first,
and sums over wheels and over x, y, yaw are written out. Nothing is a matrix product then, so that
XLA makes few loops over contiguous numbers of it; each costs it 0.2 us and more, whatever it does.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model.contact import S1, V0, VR, W0, ContactSurface
from slipid.model.geometry import Frame

CHORD, NEWTON = 4, 2
"""Steps of each kind from the twist of a moment ago.

Wheel speeds that change by up to 1.25 rad/s a step, three floors: 99 % of all twists are then
within 3 mm/s (20 mm/s with 2 and 3 steps), half of them within rounding.
"""
_LEAST_LOAD = 1e-3


class Floors(eqx.Module):
    """Numbers of the balance, a column per combination of floors.

    Attributes:
        frame: wheel directions.
        rest: load shares at rest.
        plain: twist per rim speed without slip, J^+ (3, wheel).
        held: friction of each wheel over its mean; the unit of force is mean(mu) m g.
        creep, drag, roller_creep, resistance, viscosity, roller_viscosity: as in `ContactSurface`,
            of each wheel; an ordinary wheel grips sideways as it does ahead.
        friction, scrub, lead: of the body, means over wheels or loads.
    """

    frame: Frame
    rest: Float[Array, " wheel"]
    plain: Float[Array, "3 wheel"]
    held: Float[Array, "wheel floors"]
    creep: Float[Array, "wheel floors"]
    drag: Float[Array, "wheel floors"]
    roller_creep: Float[Array, "wheel floors"]
    resistance: Float[Array, "wheel floors"]
    viscosity: Float[Array, "wheel floors"]
    roller_viscosity: Float[Array, "wheel floors"]
    friction: Float[Array, " floors"]
    scrub: Float[Array, " floors"]
    lead: Float[Array, " floors"]


def combine(
    frame: Frame,
    stacked: ContactSurface,
    index: np.ndarray,
    rest: Float[Array, " wheel"],
    plain: Float[Array, "3 wheel"],
) -> Floors:
    """The balance for combinations of floors.

    Args:
        frame: wheel directions.
        stacked: the floors, leaves (floor,).
        index: floor under each wheel (combination, wheel).
        rest: load shares at rest.
        plain: twist per rim speed without slip.
    """
    under = jax.tree.map(lambda leaf: leaf[index].T, stacked)
    g = frame.grip[:, None]
    friction = jnp.mean(under.friction, axis=0)
    return Floors(
        frame=frame,
        rest=rest,
        plain=plain,
        held=under.friction / friction,
        creep=under.creep,
        drag=g + (1 - g) * under.roller_drag,
        roller_creep=g * under.creep + (1 - g) * under.roller_creep,
        resistance=under.rolling_resistance,
        viscosity=under.slide_viscosity,
        roller_viscosity=g * under.slide_viscosity + (1 - g) * under.roller_viscosity,
        friction=friction,
        scrub=rest @ under.scrub,
        lead=rest @ under.lead,
    )


def _total(of_wheels: Array) -> Array:
    """Sum over wheels (the first axis), written out."""
    return sum(of_wheels[1:], start=of_wheels[0])


def _moved(rows: Array, xi: Any) -> Array:
    """Speed of every wheel along its direction (wheel, floors)."""
    return rows[:, 0, None] * xi[0] + rows[:, 1, None] * xi[1] + rows[:, 2, None] * xi[2]


def _speeds(xi: Any, rim: Array, f: Floors) -> Any:
    """Speeds along drive and rollers, activity, sliding speed, speeds of full force."""
    frame = f.frame
    along = _moved(frame.hold, xi)
    roll = _moved(frame.roll, xi) - rim * frame.slip_through[:, None]
    active = jnp.sqrt(rim**2 + roll**2 + 1e-12)
    slide = rim * frame.pull[:, None] - along
    g = frame.grip[:, None]
    scale_r = V0 * g + VR * (1 - g) + f.roller_creep * active
    return along, roll, active, slide, V0 + f.creep * active, scale_r, V0 + S1 * active


def _loads(xi: Any, f: Floors) -> tuple[Array, Array]:
    """Load shares in motion, and 1 / speed."""
    inv = jax.lax.rsqrt(xi[0] ** 2 + xi[1] ** 2 + 1e-8)
    shift = f.frame.shift
    ahead = shift[:, 0, None] * (xi[0] * inv) + shift[:, 1, None] * (xi[1] * inv)
    return f.rest[:, None] - f.lead * ahead, inv


def _solve3(m: Any, b: Any) -> tuple[Array, Array, Array]:
    """m^-1 b by the adjugate, entry by entry."""
    (p, q, r), (s, t, u), (v, w, x) = m
    c0, c1, c2 = t * x - u * w, u * v - s * x, s * w - t * v
    det = p * c0 + q * c1 + r * c2
    scale = 1 / jnp.where(jnp.abs(det) < 1e-30, 1e-30, det)
    return (
        (c0 * b[0] + (r * w - q * x) * b[1] + (q * u - r * t) * b[2]) * scale,
        (c1 * b[0] + (p * x - r * v) * b[1] + (r * s - p * u) * b[2]) * scale,
        (c2 * b[0] + (q * v - p * w) * b[1] + (p * t - q * s) * b[2]) * scale,
    )


def _chord(xi: Any, rim: Array, f: Floors) -> tuple[Array, Array, Array]:
    """`contact._chord`: the twist that balances forces drawn as chords from zero speed."""
    along, roll, _, slide, scale_t, scale_r, scale_1 = _speeds(xi, rim, f)
    # a lifted wheel would push the chord the wrong way
    load = jnp.maximum(_loads(xi, f)[0], _LEAST_LOAD) * f.held
    hold, rolls = f.frame.hold, f.frame.roll

    def slope(x: Array, scale: Any) -> Array:
        size = jnp.abs(x) + 1e-12 * scale  # tanh(x) / x is even, and 1 at rest
        return jnp.tanh(size / scale) / size

    pulls = load * (slope(slide, scale_t) + f.viscosity)
    holds = load * (f.drag * slope(roll, scale_r) + f.roller_viscosity)
    both = pulls + load * f.resistance * slope(along, scale_1)
    push, through = (
        pulls * rim * f.frame.pull[:, None],
        holds * rim * f.frame.slip_through[:, None],
    )

    def entry(a: int, b: int) -> Array:
        return _total(
            (hold[:, a] * hold[:, b])[:, None] * both + (rolls[:, a] * rolls[:, b])[:, None] * holds
        )

    m = [[entry(min(a, b), max(a, b)) for b in range(3)] for a in range(3)]
    m[2][2] += f.scrub * slope(xi[2], W0)
    drive = [_total(hold[:, a, None] * push + rolls[:, a, None] * through) for a in range(3)]
    return _solve3(m, drive)


def _balance(xi: Any, rim: Array, f: Floors) -> Any:
    """Force, its Jacobian, and the traction that motors feel [mean(mu) m g]; `contact._terms`."""
    frame = f.frame
    along, roll, active, slide, scale_t, scale_r, scale_1 = _speeds(xi, rim, f)
    load, inv = _loads(xi, f)
    load = load * f.held
    t, h, u = jnp.tanh(slide / scale_t), jnp.tanh(roll / scale_r), jnp.tanh(along / scale_1)
    turn = jnp.tanh(xi[2] / W0)
    grip = t + f.viscosity * slide
    traction = grip - f.resistance * u
    drag = -(f.drag * h + f.roller_viscosity * roll)
    hold, rolls = frame.hold, frame.roll
    force = [
        _total(load * (hold[:, a, None] * traction + rolls[:, a, None] * drag)) for a in range(3)
    ]
    force[2] -= f.scrub * turn

    def jacobian() -> Any:
        d_active = roll / active
        t1, h1, u1 = 1 - t * t, 1 - h * h, 1 - u * u
        brake = f.resistance * u1 / scale_1
        along_by = load * (-t1 / scale_t - f.viscosity - brake)
        across = brake * along * S1 / scale_1 - t1 * slide * f.creep / scale_t**2
        across = load * across * d_active
        slope = 1 / scale_r - roll * f.roller_creep * d_active / scale_r**2
        roll_by = -load * (f.drag * h1 * slope + f.roller_viscosity)
        # loads move with the direction of motion
        ahead = (frame.shift[:, 0, None] * xi[0] + frame.shift[:, 1, None] * xi[1]) * inv**2
        d_load = [
            -f.lead * f.held * inv * (frame.shift[:, b, None] - ahead * xi[b]) for b in range(2)
        ]

        def entry(a: int, b: int) -> Array:
            pull = along_by * hold[:, b, None] + across * rolls[:, b, None]
            push = roll_by * rolls[:, b, None]
            if b < 2:
                pull, push = pull + traction * d_load[b], push + drag * d_load[b]
            return _total(hold[:, a, None] * pull + rolls[:, a, None] * push)

        m = [[entry(a, b) for b in range(3)] for a in range(3)]
        m[2][2] -= f.scrub * (1 - turn**2) / W0
        return m

    felt = load * (grip * frame.pull[:, None] + drag * frame.slip_through[:, None])
    return force, jacobian, felt


def _size(force: Any, f: Floors) -> Array:
    """Square of what does not balance, the moment over the base radius."""
    return force[0] ** 2 + force[1] ** 2 + (force[2] / f.frame.base) ** 2


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
    rim = rim.reshape(len(f.rest), -1)
    near: Any = tuple(start)
    for _ in range(CHORD):
        near = _chord(near, rim, f)
    xi = near
    for k in range(NEWTON):
        force, jacobian, felt = _balance(xi, rim, f)
        if k == 0:
            before, felt_before = _size(force, f), felt
        change = _solve3(jacobian(), force)
        xi = tuple(x - d for x, d in zip(xi, change, strict=True))
    force, _, felt = _balance(xi, rim, f)
    better = _size(force, f) <= before  # NaN is not
    plain = [_total(f.plain[a, :, None] * rim) for a in range(3)]
    found = [jnp.where(better, x, n) for x, n in zip(xi, near, strict=True)]
    sound = jnp.isfinite(found[0] + found[1] + found[2])
    twist = jnp.stack([jnp.where(sound, x, p) for x, p in zip(found, plain, strict=True)])
    felt = jnp.where(better, felt, felt_before)
    return twist, jnp.where(jnp.isfinite(felt), felt, 0.0)
