"""Effect tables at their rows, between and beyond them, and in the estimator's results."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.fitting import shared_effects as shared
from slipid.robot.estimator import Estimator
from slipid.robot.filter.effects import LOG_SPEED_STD, EffectLookup, RolledMotion
from slipid.robot.interface import Measurement, Settings
from tests.helpers.small_twin import deployed
from tests.helpers.stepped import stepped
from tests.robot.test_consistency import DT, rolling, settled

BASE = jnp.asarray(0.125)
SPEEDS = (0.1, 0.2, 0.4)


def table():
    """Two floors, three speeds, eight directions: a mean by direction, and a part left by speed."""
    rows = np.zeros((2, 3, 8, 6))
    rows[1, :, :, 0] = 0.01 * np.arange(8)
    rows[..., 3:] = np.array([0.3, 0.5, 0.7])[:, None, None]
    return EffectLookup(jnp.log(jnp.asarray(SPEEDS)), jnp.asarray(rows))


def at(angle, speed, turn=0.0):
    way = jnp.array([speed * np.cos(angle), speed * np.sin(angle), turn])
    return [np.asarray(x) for x in table().at(RolledMotion.of(way, BASE))]


@pytest.mark.slow
def test_the_table_is_met_at_its_rows_and_is_linear_between_them():
    for k in range(8):
        for speed, left in zip(SPEEDS, (0.3, 0.5, 0.7), strict=True):
            mean, part = at(k * np.pi / 4 + 1e-9, speed)
            np.testing.assert_allclose(mean[:, 0], [0.0, 0.01 * k], atol=1e-8)
            np.testing.assert_allclose(part, left, atol=1e-8)
    mean, part = at(-np.pi / 8, np.sqrt(0.1 * 0.2))  # half-way from the last direction to the first
    np.testing.assert_allclose(mean[1], [0.035, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(part**2, 0.4**2, atol=1e-9)


def test_estimates_fade_beyond_the_table_and_on_the_spot():
    mean, part = at(np.pi / 4, 0.4 * np.exp(LOG_SPEED_STD))
    keep = np.exp(-0.5)
    np.testing.assert_allclose(mean[1, 0], keep * 0.01, rtol=1e-6)
    np.testing.assert_allclose(part, np.sqrt(1 - keep**2 * (1 - 0.7**2)), rtol=1e-6)
    for mean, part in (at(1.0, 1e-3), at(1.0, 0.01, turn=2.0)):
        np.testing.assert_allclose(mean, 0.0, atol=1e-6)
        np.testing.assert_allclose(part, 1.0, atol=1e-4)


def test_effects_fade_with_speed_as_the_fit_has_it():
    assert LOG_SPEED_STD == shared.SPEED_LENGTH


MISSED = jnp.asarray([[0.02, -0.01, 0.1], [-0.05, 0.03, -0.2]])
PARTS = jnp.asarray([[0.5, 0.5, 0.5], [0.2, 0.2, 0.2]])
WAY = np.array([0.16, 0.12, 0.0])


def driven(told, hypothesis):
    """The robot, what it says and its state, sure of a hypothesis."""
    robot = deployed(run=1.0)
    if told:
        rows = jnp.concatenate([MISSED, PARTS], axis=1)[:, None, None]
        robot = eqx.tree_at(
            lambda r: r.effect_table, robot, EffectLookup(jnp.log(jnp.asarray([0.2])), rows)
        )
    watched = Estimator(robot, Settings(patch_m=1e9))
    run = partial(stepped(watched), dt=DT)
    belief, state = jnp.full(9, 1e-12).at[hypothesis].set(1.0), watched.init()
    for _ in range(20):
        state = eqx.tree_at(lambda s: s.floors.belief, state, belief)
        state, said = run(state, Measurement(wheel_speed=rolling(robot, WAY)).filled(3))
    return robot, said, state


@pytest.mark.slow
@pytest.mark.parametrize("under", [0, 1])
def test_the_twist_is_the_contact_models_plus_the_effect_of_the_floor(under):
    """Along, across and in yaw, per metre of wheels that do not slip; what is left is the std."""
    robot, said, state = driven(told=True, hypothesis=7 * under)
    along, across, yaw = np.asarray(MISSED[under])
    u, v = np.array([0.8, 0.6]), np.array([-0.6, 0.8])
    more = 0.2 * np.array([*(along * u + across * v), yaw])
    expected = np.asarray(settled(robot, rolling(robot, WAY), under)) + more
    np.testing.assert_allclose(said.twist, expected, atol=1e-3)
    push = np.asarray(state.place.push)[:, 3 * under : 3 * under + 3]
    left = np.sqrt(np.linalg.eigvalsh(push @ push.T))
    np.testing.assert_allclose(left, np.sort(PARTS[under] * robot.effect[under]), rtol=0.01)


@pytest.mark.slow
def test_wheels_on_several_floors_have_no_estimated_effect():
    """Twist and std equal those without an effect table, whose effects are of single floors."""
    (_, said, state), (_, alone, bare) = (driven(told, hypothesis=1) for told in (True, False))
    np.testing.assert_allclose(said.twist, alone.twist, atol=1e-5)
    np.testing.assert_allclose(
        state.place.push[:, :6], bare.place.push[:, :6], rtol=0.03, atol=1e-4
    )
