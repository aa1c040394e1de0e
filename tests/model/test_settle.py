"""Many floors at once in few steps: the same balance as of one floor by many."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model import contact
from slipid.model.contact import settle
from slipid.model.contact_balance import Balance, stand
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import differential, mecanum, omni
from slipid.model.se2 import Planar

KINDS = {
    "omni 3": omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0),
    "omni 4": omni([45.0, 135.0, 225.0, 315.0], 0.2, 0.05),
    "mecanum": mecanum(0.2, 0.15, 0.05),
    "differential": differential(0.2, 0.05),
}
FLOORS = ContactSurface(
    friction=jnp.array([0.3, 0.5]),
    creep=jnp.array([0.4, 0.1]),
    roller_drag=jnp.array([0.3, 0.12]),
    roller_creep=jnp.array([0.2, 0.3]),
    rolling_resistance=jnp.array([0.006, 0.002]),
    slide_viscosity=jnp.array([0.02, 0.05]),
    roller_viscosity=jnp.array([0.02, 0.01]),
    scrub=jnp.array([0.002, 0.004]),
    lead=jnp.array([0.002, 0.004]),
    drag_exponent=jnp.array([1.1, 1.5]),
    rolling_radius=jnp.array([0.0, -0.03]),
    knee_width=jnp.array([0.5, 1.0]),
    labels=("a", "b"),
)


def robot(kind):
    frame, wheels = KINDS[kind].frame(), KINDS[kind].wheels
    index = np.array(list(itertools.product(range(2), repeat=wheels)))
    rest = jnp.linspace(0.9, 1.1, wheels) / wheels
    bias = jnp.linspace(-0.1, 0.1, wheels)
    floors = replace(FLOORS, load_bias=jnp.stack([bias, -2 * jnp.roll(bias, 1)]))
    plain = jnp.linalg.pinv(KINDS[kind].forward())
    return frame, floors, index, rest, (stand(frame, floors.at(index.T), rest), plain)


@partial(jax.jit, static_argnums=0)
def one_by_one(kind, rim):
    """Equilibrium and tractions of every combination by the solver that comes from anywhere."""
    frame, floors, index, rest, _ = robot(kind)

    def of(under):
        floor = floors.at(under)
        xi = contact.equilibrium(rim, frame, floor, rest)
        return xi, Balance(rim, stand(frame, floor, rest)).at(Planar(*xi)).motor_force

    xi, pull = jax.vmap(of)(index)
    return xi.T, pull.T


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_equilibrium_with_its_tractions(kind):
    *_, floors = robot(kind)
    step = jax.jit(lambda x, r: settle(x, r, r, *floors))
    rng = np.random.default_rng(0)
    for _ in range(6):
        twist = rng.uniform(-1, 1, 3) * [0.3, 0.2, 1.0]
        rim = KINDS[kind].forward() @ twist + rng.normal(size=KINDS[kind].wheels) * 0.01
        xi, _ = step(jnp.zeros((3, len(floors[0].friction))), rim)
        for _ in range(5):
            xi, pull = step(xi, rim)
        want_xi, want_pull = one_by_one(kind, rim)
        np.testing.assert_allclose(xi, want_xi, atol=1e-6)
        np.testing.assert_allclose(pull, want_pull, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "most"), [("omni 3", 1e-9), ("differential", 1e-9), ("mecanum", 1e-4)]
)
def test_it_keeps_up_with_wheels_that_change_speed(kind, most):
    """Wheel speeds of a body whose demand jumps, with 25 rad/s^2 at 20 Hz and noise."""
    frame, *_, floors = robot(kind)
    rng, wheels = np.random.default_rng(1), KINDS[kind].wheels
    goals = rng.uniform(-1, 1, (24, 3)) * [0.4, 0.4, 1.5] * rng.choice([0.1, 1.0], (24, 1))
    speed = [np.zeros(wheels)]
    for goal in np.repeat(goals @ KINDS[kind].forward().T / float(frame.radius), 12, axis=0):
        gap = goal - speed[-1]
        speed.append(speed[-1] + gap * min(1.0, 1.25 / max(np.abs(gap).max(), 1e-9)))
    rims = np.array(speed) + rng.normal(size=(len(speed), wheels)) * 0.05
    rims = frame.radius * jnp.asarray(rims)

    def follow(carry, rim):
        xi, before = carry
        xi, _ = settle(xi, before, rim, *floors)
        return (xi, rim), xi

    begin = jnp.zeros((3, len(floors[0].rest.T))), jnp.zeros(wheels)
    _, got = jax.lax.scan(follow, begin, rims)
    want = jax.lax.map(lambda r: one_by_one(kind, r)[0], rims)
    off = np.abs(got - want) * np.array([1.0, 1.0, float(frame.base)])[:, None]
    assert np.quantile(off, 0.9) < 1e-9
    assert np.quantile(off, 0.99) < most


@pytest.mark.slow
@pytest.mark.parametrize("start", [np.nan, np.inf, 1e300, 1e-300])
def test_nothing_is_lost_to_a_bad_start_or_a_standing_robot(start):
    *_, floors = robot("omni 3")
    for rim in (jnp.zeros(3), jnp.array([0.2, -0.2, 0.0]), jnp.array([1e-310, 0.0, 3.0])):
        xi, pull = settle(jnp.full((3, 8), start), start * rim, rim, *floors)
        assert np.isfinite(xi).all()
        assert np.isfinite(pull).all()
