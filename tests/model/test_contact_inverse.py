"""The contact law solved for the wheels is undone by the law."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model import contact, contact_inverse
from slipid.model.contact_balance import Balance, stand
from slipid.model.contact_inverse import inverse_contact
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import omni
from slipid.model.se2 import Planar

GEOMETRY = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
FLOORS = ContactSurface(
    friction=jnp.array([0.3, 0.45, 0.6]),
    creep=jnp.array([0.2, 0.4, 0.9]),
    roller_drag=jnp.array([0.12, 0.25, 0.4]),
    roller_creep=jnp.array([0.15, 0.2, 0.4]),
    rolling_resistance=jnp.full(3, 0.005),
    slide_viscosity=jnp.full(3, 0.02),
    roller_viscosity=jnp.full(3, 0.02),
    scrub=jnp.full(3, 0.002),
    lead=jnp.full(3, 0.002),
    drag_exponent=jnp.array([1.6, 1.3, 1.0]),
    load_bias=jnp.array([[0.1, -0.15, 0.05], [-0.2, 0.05, 0.15], [0.0, 0.1, -0.1]]),
    labels=("a", "b", "c"),
)
REST = jnp.full(3, 1 / 3)


@pytest.mark.parametrize("mixed", [False, True])
def test_the_inverse_model_inverts_the_contact(mixed):
    frame, rng, checked = GEOMETRY.frame(), np.random.default_rng(1), 0
    plain = GEOMETRY.inverse()
    there = jax.jit(lambda xi, p: inverse_contact(frame, FLOORS, REST, plain, xi, p))
    back = jax.jit(lambda rim, s: contact.equilibrium(rim, frame, s, REST))
    pull = jax.jit(lambda xi, rim, s: contact.traction(xi, rim, frame, s, REST))
    load = jax.jit(lambda xi, s: Balance(REST, stand(frame, s, REST)).share(Planar(*xi)))
    for _ in range(20):
        index = rng.integers(0, 3, 3) if mixed else np.full(3, rng.integers(0, 3))
        floor = FLOORS.at(jnp.asarray(index))
        xi = jnp.asarray(rng.uniform(-1, 1, 3) * [0.3, 0.3, 0.8])
        rim = frame.radius * there(xi, jnp.eye(3)[index])
        grip = load(xi, floor) * floor.friction / jnp.mean(floor.friction)
        held = pull(xi, rim, floor) / grip
        if jnp.max(floor.creep * jnp.arctanh(jnp.clip(jnp.abs(held), 0.0, 0.99))) > 0.85:
            continue  # a wheel about to spin on the spot
        checked += 1
        off = jnp.abs(back(rim, floor) - xi) * jnp.array([1.0, 1.0, frame.base])
        assert off.max() < 0.001, (index, xi, off)
    assert checked > 15


@pytest.mark.parametrize("floor", range(3))
def test_more_passes_invert_it_to_rounding(floor, monkeypatch):
    monkeypatch.setattr(contact_inverse, "_PASSES", 15)
    frame, on = GEOMETRY.frame(), FLOORS.at(floor)
    rest, sure = jnp.array([0.3, 0.25, 0.45]), jnp.eye(3)[np.full(3, floor)]
    plain = GEOMETRY.inverse()

    @jax.jit
    def there_and_back(xi):
        speed = inverse_contact(frame, FLOORS, rest, plain, xi, sure)
        return contact.equilibrium(frame.radius * speed, frame, on, rest)

    for xi in np.random.default_rng(2).uniform(-1, 1, (10, 3)) * [0.2, 0.2, 0.5]:
        np.testing.assert_allclose(there_and_back(jnp.asarray(xi)), xi, atol=1e-9)
