"""Wheel speeds by the contact model bring the body nearer to the wanted twist."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.control.filter.effects import Told
from slipid.control.filter.hypotheses import hypotheses_of
from slipid.control.interface import Believed
from slipid.control.least_error import FARTHEST, PLAIN, wheel_speeds
from slipid.model import contact
from slipid.model.contact import steered
from slipid.model.contact_balance import stand
from slipid.model.se2 import Planar
from tests.helpers.small_twin import deployed

ROBOT = deployed()
HYPOTHESES = hypotheses_of(ROBOT).under


@jax.jit
def moved(speed):
    """Twist of every hypothesis at these wheel speeds."""
    f = ROBOT
    rim = f.frame.radius * speed
    each = jax.vmap(lambda under: contact.equilibrium(rim, f.frame, f.floors.at(under), f.rest))
    return each(jnp.asarray(HYPOTHESES))


def sure(k: int, unknown: float = 0.0) -> np.ndarray:
    p = np.zeros(len(HYPOTHESES) + 1)
    p[k], p[-1] = 1 - unknown, unknown
    return p


@jax.jit
def speeds(asked, probability, turning, last):
    seen = Believed(jnp.asarray(probability), moved(turning))
    return wheel_speeds(ROBOT, asked, seen, turning, last)


def plain(asked):
    return ROBOT.forward @ asked / ROBOT.frame.radius


def driven(asked, probability, periods=8):
    """Wheel speeds after some periods in which the wheels follow every command at once."""
    turning = plain(asked)
    for _ in range(periods):
        turning = speeds(asked, probability, turning, turning)
    return turning


@pytest.mark.slow
@pytest.mark.parametrize("k", [0, 3, 7])
def test_known_floors_leave_little_of_what_wheels_without_slip_miss(k):
    rng, scale = np.random.default_rng(k), np.array([1.0, 1.0, 0.125])
    missed, left = [], []
    for _ in range(10):
        asked = jnp.asarray(rng.uniform(-1, 1, 3) * [0.2, 0.2, 0.5])
        missed.append(np.linalg.norm(scale * (moved(plain(asked))[k] - asked)))
        left.append(np.linalg.norm(scale * (moved(driven(asked, sure(k)))[k] - asked)))
    assert np.mean(left) < 0.4 * np.mean(missed)
    assert np.max(left) < np.max(missed)


@pytest.mark.slow
def test_periods_lead_to_the_minimum():
    asked, p = jnp.array([0.05, -0.02, 0.1]), np.zeros(len(HYPOTHESES) + 1)
    p[[0, 3]] = 0.6, 0.4
    scale, radius = jnp.array([1.0, 1.0, ROBOT.frame.base]), ROBOT.frame.radius

    @jax.grad
    def slope(speed):
        miss = jnp.sum((scale * (moved(speed) - asked)) ** 2, axis=1)
        return p[:-1] @ miss + PLAIN * radius**2 * jnp.sum((speed - plain(asked)) ** 2)

    found = driven(asked, p, 40)
    assert np.linalg.norm(slope(found)) < 1e-3 * np.linalg.norm(slope(plain(asked)))


@pytest.mark.slow
def test_what_runs_told_of_a_floor_is_made_up_for():
    """Runs told that the robot goes a tenth of its way to the left: it is sent to the right."""
    left = jnp.array([0.0, 0.1, 0.0, 1.0, 1.0, 1.0])
    told = Told(jnp.log(jnp.array([0.2])), jnp.broadcast_to(left, (2, 1, 1, 6)))
    asked = jnp.array([0.2, 0.0, 0.0])
    wheels = plain(asked)
    seen = Believed(jnp.asarray(sure(0)), moved(wheels))
    before = wheel_speeds(ROBOT, asked, seen, wheels, wheels)
    known = eqx.tree_at(lambda r: r.told, ROBOT, told)
    after = wheel_speeds(known, asked, seen, wheels, wheels)
    change = ROBOT.inverse @ (ROBOT.frame.radius * (after - before))
    assert -0.03 < change[1] < -0.01
    assert abs(change[0]) < 0.3 * abs(change[1])


@pytest.mark.slow
@pytest.mark.parametrize("k", range(len(HYPOTHESES)))
def test_wheels_that_follow_late_come_to_rest_too(k):
    rng = np.random.default_rng(k)
    for _ in range(3):
        asked = jnp.asarray(rng.uniform(-1, 1, 3) * [0.2, 0.2, 0.5])
        commands = [plain(asked)] * 4
        for _ in range(60):
            commands.append(speeds(asked, sure(k), commands[-3], commands[-1]))
        assert np.abs(commands[-1] - commands[-2]).max() < 0.05


def test_a_command_is_not_far_from_kinematics_and_never_no_number():
    asked, radius = jnp.array([0.4, 0.3, 0.0]), float(ROBOT.frame.radius)
    wheels = plain(asked)
    far = []
    for turning in (wheels, -wheels, 5 * wheels, jnp.full(3, jnp.nan), jnp.full(3, jnp.inf)):
        found = speeds(asked, sure(3), turning, turning)
        far.append(radius * np.abs(found - wheels).max())
    assert max(far) == pytest.approx(FARTHEST)
    np.testing.assert_allclose(far[3:], 0.0, atol=1e-12)


def test_wheels_that_shall_stand_are_told_to():
    still, wheels = jnp.zeros(3), plain(jnp.array([0.2, 0.1, 0.0]))
    np.testing.assert_allclose(speeds(still, sure(1), wheels, wheels), 0.0, atol=1e-12)


def test_an_unknown_floor_is_driven_by_kinematics():
    asked = jnp.array([0.15, -0.1, 0.3])
    wheels = plain(asked)
    np.testing.assert_allclose(speeds(asked, sure(2, 1.0), wheels, wheels), wheels, atol=1e-12)
    half = speeds(asked, sure(2, 0.5), wheels, wheels) - wheels
    whole = speeds(asked, sure(2), wheels, wheels) - wheels
    np.testing.assert_allclose(half, 0.5 * whole, atol=1e-9)


def test_wheels_that_stand_start_by_kinematics():
    asked, still = jnp.array([0.15, -0.1, 0.3]), jnp.zeros(3)
    np.testing.assert_allclose(speeds(asked, sure(0), still, still), plain(asked), atol=1e-12)


def test_a_belief_that_moves_by_little_moves_the_wheels_by_little():
    asked, every = jnp.array([0.2, 0.0, 0.0]), []
    for part in np.linspace(0, 1, 51):
        p = np.zeros(len(HYPOTHESES) + 1)
        p[0], p[-2] = 1 - part, part
        every.append(np.asarray(speeds(asked, p, plain(asked), plain(asked))))
    apart = np.abs(every[-1] - every[0]).max()
    assert apart > 0.1
    assert np.abs(np.diff(every, axis=0)).max() < 0.15 * apart


def test_the_last_command_holds_the_next_one_back():
    asked = jnp.array([0.2, 0.05, 0.0])
    wheels = plain(asked)
    near = speeds(asked, sure(0), wheels, wheels)
    held = speeds(asked, sure(0), wheels, wheels + 3.0)
    assert (held > near).all()


@pytest.mark.slow
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


@pytest.mark.slow
def test_no_number_comes_out_of_a_belief_that_is_none():
    asked = jnp.array([0.2, 0.0, 0.0])
    seen = Believed(jnp.full(len(HYPOTHESES) + 1, jnp.nan), jnp.full((len(HYPOTHESES), 3), jnp.nan))
    wheels = plain(asked)
    np.testing.assert_allclose(wheel_speeds(ROBOT, asked, seen, wheels, wheels), wheels)
