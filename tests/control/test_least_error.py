"""Wheel speeds by the contact model bring the body nearer to the wanted twist."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.control.filter.floor_filter import hypotheses_of
from slipid.control.interface import Believed
from slipid.control.least_error import wheel_speeds
from slipid.model import contact
from slipid.model.contact import steered
from slipid.model.contact_balance import stand
from slipid.model.se2 import Planar
from tests.helpers.small_twin import deployed

ROBOT = deployed()
HYPOTHESES = hypotheses_of(ROBOT)


def believed(probability) -> Believed:
    return Believed(jnp.asarray(probability), jnp.zeros((len(HYPOTHESES), 3)))


def sure(k: int, unknown: float = 0.0) -> Believed:
    p = np.zeros(len(HYPOTHESES) + 1)
    p[k], p[-1] = 1 - unknown, unknown
    return believed(p)


speeds = jax.jit(lambda asked, seen, last: wheel_speeds(ROBOT, asked, seen, last))


@jax.jit
def moved(speed, under):
    f = ROBOT
    return contact.equilibrium(f.frame.radius * speed, f.frame, f.floors.at(under), f.rest)


def plain(asked):
    return ROBOT.forward @ asked / ROBOT.frame.radius


@pytest.mark.parametrize("k", [0, 3, 7])
def test_known_floors_leave_little_of_what_wheels_without_slip_miss(k):
    rng, scale = np.random.default_rng(k), np.array([1.0, 1.0, 0.125])
    missed, left = [], []
    for _ in range(10):
        asked = jnp.asarray(rng.uniform(-1, 1, 3) * [0.2, 0.2, 0.5])
        kinematic, under = plain(asked), jnp.asarray(HYPOTHESES[k])
        missed.append(np.linalg.norm(scale * (moved(kinematic, under) - asked)))
        found = speeds(asked, sure(k), kinematic)
        left.append(np.linalg.norm(scale * (moved(found, under) - asked)))
    assert np.mean(left) < 0.4 * np.mean(missed)
    assert np.max(left) < np.max(missed)


def test_an_unknown_floor_is_driven_by_kinematics():
    asked = jnp.array([0.15, -0.1, 0.3])
    np.testing.assert_allclose(speeds(asked, sure(2, 1.0), plain(asked)), plain(asked), atol=1e-12)
    half = speeds(asked, sure(2, 0.5), plain(asked)) - plain(asked)
    whole = speeds(asked, sure(2), plain(asked)) - plain(asked)
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-9)


def test_a_belief_that_moves_by_little_moves_the_wheels_by_little():
    asked, every = jnp.array([0.2, 0.0, 0.0]), []
    for part in np.linspace(0, 1, 51):
        p = np.zeros(len(HYPOTHESES) + 1)
        p[0], p[-2] = 1 - part, part
        every.append(np.asarray(speeds(asked, believed(p), plain(asked))))
    apart = np.abs(every[-1] - every[0]).max()
    assert apart > 0.1
    assert np.abs(np.diff(every, axis=0)).max() < 0.15 * apart


def test_the_last_command_holds_the_next_one_back():
    asked = jnp.array([0.2, 0.05, 0.0])
    far = plain(asked) + 3.0
    near = speeds(asked, sure(0), plain(asked))
    held = speeds(asked, sure(0), far)
    assert (held > near).all()


def test_the_derivative_of_the_equilibrium_is_that_of_differences():
    f, under = ROBOT, jnp.asarray([0, 1, 0])
    rim, most = jnp.array([0.1, -0.22, 0.05]), jnp.full(3, 1e3)
    floor = f.floors.at(under)
    on = stand(f.frame, jax.tree.map(lambda x: x[:, None], floor), f.rest)
    xi = contact.equilibrium(rim, f.frame, floor, f.rest)
    found = np.asarray(steered(Planar(*xi[:, None]), rim, on, most))[..., 0]
    h = 1e-6
    for wheel in range(3):
        one = h * jnp.eye(3)[wheel]
        ends = [contact.equilibrium(rim + s * one, f.frame, floor, f.rest) for s in (1, -1)]
        np.testing.assert_allclose(found[wheel], (ends[0] - ends[1]) / (2 * h), rtol=1e-4)


def test_no_number_comes_out_of_a_belief_that_is_none():
    asked = jnp.array([0.2, 0.0, 0.0])
    seen = Believed(jnp.full(len(HYPOTHESES) + 1, jnp.nan), jnp.full((len(HYPOTHESES), 3), jnp.nan))
    np.testing.assert_allclose(speeds(asked, seen, plain(asked)), plain(asked))
