"""Contact equilibrium by theorem: it is a root, with the symmetries, limits and losses of one."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from slipid.model import contact
from slipid.model import contact_law as law
from slipid.model.contact_balance import Balance, stand
from slipid.model.contact_law import KNEE, S1, V0, W0, ContactSurface
from slipid.model.geometry import mecanum, omni, skid_steer
from slipid.model.se2 import Planar
from slipid.parameter import entries
from tests.helpers.numpy_model import saturated

ROBOTINO = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
OMNI4 = omni([45.0, 135.0, 225.0, 315.0], 0.2, 0.05)
MECANUM = mecanum(0.2, 0.15, 0.05)
SKID = skid_steer(0.2, 0.15, 0.05)
GEOMETRIES = {"omni 3": ROBOTINO, "omni 4": OMNI4, "mecanum": MECANUM, "skid steer": SKID}
EVEN = jnp.full(3, 1 / 3)
# Of hard cases, and of what floors of real logs were found to be, with room on both sides.
RANGES = {
    "hard": {
        "creep": (0.005, 2.0),
        "roller_drag": (0.01, 0.45),
        "roller_creep": (0.02, 1.0),
        "lead": 0.02,
        "load_bias": 0.2,
    },
    "ordinary": {
        "creep": (0.03, 2.0),
        "roller_drag": (0.01, 0.4),
        "roller_creep": (0.08, 1.0),
        "lead": 0.01,
        "load_bias": 0.1,
    },
}


def surface(**values):
    return ContactSurface(**{k: jnp.asarray(float(v)) for k, v in values.items()})


FLOORS = {
    "gray": surface(creep=0.40, roller_drag=0.31, roller_creep=0.15, lead=0.004),
    "green": surface(creep=0.98, roller_drag=0.50, roller_creep=0.50, lead=0.005),
    "table": surface(creep=0.04, roller_drag=0.14, roller_creep=0.20, lead=0.0015),
}


def cases(kind, count, geometry=ROBOTINO, seed=0):
    """Random floors, loads and rim speeds: straight, turning, a wheel at rest, and at random."""
    rng = np.random.default_rng(seed)
    ranges = RANGES[kind]

    def log_uniform(lower, upper):
        return jnp.asarray(np.exp(rng.uniform(math.log(lower), math.log(upper), count)))

    floors = ContactSurface(
        friction=jnp.full(count, 0.4),
        creep=log_uniform(*ranges["creep"]),
        roller_drag=log_uniform(*ranges["roller_drag"]),
        roller_creep=log_uniform(*ranges["roller_creep"]),
        rolling_resistance=log_uniform(1e-4, 0.05),
        slide_viscosity=log_uniform(1e-3, 1.0),
        roller_viscosity=log_uniform(1e-3, 1.0),
        scrub=log_uniform(1e-4, 0.02),
        lead=jnp.asarray(rng.uniform(-1, 1, count) * ranges["lead"]),
    )
    speed, way = np.asarray(log_uniform(1e-3, 1.0)), rng.uniform(0, 2 * np.pi, count)
    turn = np.where(rng.random(count) < 0.3, rng.normal(size=count) * speed, 0.0)
    xi = np.stack([speed * np.cos(way), speed * np.sin(way), turn / float(geometry.base_radius)], 1)
    rim = xi @ np.asarray(geometry.forward()).T
    rim[rng.random(count) < 0.15, rng.integers(geometry.wheels)] = 0.0
    wild = rng.random(count) < 0.1
    rim[wild] = rng.normal(size=(wild.sum(), geometry.wheels)) * speed[wild, None]
    rim[rng.random(count) < 0.01] = 0.0
    rest = rng.dirichlet(np.full(geometry.wheels, 20.0), count)
    bias = rng.normal(size=rest.shape) * ranges["load_bias"]
    floors = replace(
        floors,
        drag_exponent=jnp.asarray(rng.uniform(1.0, 1.6, count)),
        load_bias=jnp.asarray(bias - bias.mean(axis=1, keepdims=True)),
        rolling_radius=jnp.asarray(rng.uniform(-0.1, 0.0, count)),
        knee_width=jnp.asarray(np.exp(rng.uniform(math.log(0.2), math.log(2.0), count))),
    )
    fast = np.abs(rim).max(axis=1) > 1.5
    rim[fast] *= 1.5 / np.abs(rim[fast]).max(axis=1, keepdims=True)
    return floors, jnp.asarray(rim), jnp.asarray(rest)


# jitted once: by itself every call would be traced anew
equilibrium = eqx.filter_jit(contact.equilibrium)


@eqx.filter_jit
def solve(rim, frame, floors, rest):
    return jax.vmap(contact.equilibrium, (0, None, 0, 0))(rim, frame, floors, rest)


class Forces(NamedTuple):
    """Along the drive of each wheel as its motor feels it, along its rollers; loads; no balance."""

    traction: jax.Array
    drag: jax.Array
    load: jax.Array
    residual: jax.Array


def forces_of(xi, rim, frame, floor, rest):
    at = Balance(rim, stand(frame, floor, rest)).at(Planar(*xi))
    drag = at.wheels.drag.force
    x, y, moment = at.force
    residual = jnp.stack([x, y, moment / frame.base])
    return Forces(at.motor_force, -at.load * drag, at.share, residual)


@eqx.filter_jit
def forces(xi, rim, frame, floors, rest):
    return jax.vmap(forces_of, (0, 0, None, 0, 0))(xi, rim, frame, floors, rest)


@eqx.filter_jit
def gap(xi, rim, frame, floors, rest):
    return jnp.abs(forces(xi, rim, frame, floors, rest).residual).max(axis=1)


def spread(floor, count):
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count,)), floor)


def headings(speed, count=36):
    way = np.linspace(0, 2 * np.pi, count, endpoint=False)
    xi = np.stack([speed * np.cos(way), speed * np.sin(way), np.zeros(count)], axis=1)
    return jnp.asarray(xi @ np.asarray(ROBOTINO.forward()).T)


# it is a root


@pytest.mark.slow
def test_forces_balance_wherever_floors_are_as_found():
    floors, rim, rest = cases("ordinary", 20000)
    frame = ROBOTINO.frame()
    open_ = np.asarray(gap(solve(rim, frame, floors, rest), rim, frame, floors, rest))
    assert np.quantile(open_, 0.999) < 1e-12
    assert (open_ > 1e-9).mean() <= 1e-4


@pytest.mark.slow
def test_forces_balance_in_all_but_a_few_of_the_hardest_cases():
    """Near a fold of the balance the root finder can be left behind: fewer than 1 in 2000."""
    floors, rim, rest = cases("hard", 50000)
    frame = ROBOTINO.frame()
    xi = solve(rim, frame, floors, rest)
    assert np.isfinite(np.asarray(xi)).all()
    open_ = np.asarray(gap(xi, rim, frame, floors, rest))
    assert np.mean(open_ > 1e-9) < 5e-4
    assert open_.max() < 0.1  # and what it leaves is no nonsense


@pytest.mark.parametrize("name", ["omni 4", "mecanum", "skid steer"])
@pytest.mark.slow
def test_forces_balance_on_other_wheels(name):
    g = GEOMETRIES[name]
    floors, rim, rest = cases("ordinary", 5000, g)
    if name == "skid steer":  # with a lead it has two mirrored roots when it turns on the spot
        floors = eqx.tree_at(lambda f: f.lead, floors, jnp.zeros(5000))
    frame = g.frame()
    open_ = np.asarray(gap(solve(rim, frame, floors, rest), rim, frame, floors, rest))
    assert np.mean(open_ > 1e-9) < 2e-3


@pytest.mark.slow
def test_forces_balance_where_wheels_hardly_creep_and_rollers_drag():
    """There chord steps approach slowly, and Newton steps after them can end beside the root."""
    floors, rim, rest = cases("ordinary", 5000, MECANUM)
    stiff = replace(floors, creep=0.1 * floors.creep, roller_drag=3.0 * floors.roller_drag)
    frame = MECANUM.frame()
    open_ = np.asarray(gap(solve(rim, frame, stiff, rest), rim, frame, stiff, rest))
    assert np.mean(open_ > 1e-7) < 1e-3


@pytest.mark.slow
def test_another_root_finder_finds_the_same_twist():
    floors, rim, rest = cases("ordinary", 200, seed=5)
    frame = ROBOTINO.frame()
    ours = solve(rim, frame, floors, rest)
    scale = jnp.array([1.0, 1.0, 8.0])

    @jax.vmap
    def oracle(start, rim, floor, rest):
        def balance(y, _):
            return forces_of(scale * y, rim, frame, floor, rest).residual

        solver = optx.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
        found = optx.least_squares(balance, solver, start / scale, max_steps=2000, throw=False)
        return scale * found.value, balance(found.value, None)

    start = jnp.asarray(np.asarray(rim) @ np.asarray(ROBOTINO.pseudo_inverse()).T)
    theirs, left = jax.jit(oracle)(start, rim, floors, rest)
    done = np.abs(np.asarray(left)).max(axis=1) < 1e-10
    assert done.mean() > 0.9
    np.testing.assert_allclose(ours[done], theirs[done], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_jacobian_is_the_derivative_of_the_balance(name):
    g = GEOMETRIES[name]
    floors, rim, rest = cases("hard", 200, g, seed=1)
    frame = g.frame()
    rng = np.random.default_rng(2)
    xi = jnp.asarray(rng.normal(size=(200, 3)) * [0.2, 0.2, 1.0])

    def both(x, rim, floor, rest):
        balance = Balance(rim, stand(frame, floor, rest))

        def force(x):
            return jnp.stack(balance.force(Planar(*x)))

        return jnp.stack([jnp.stack(c) for c in balance.at(Planar(*x)).jacobian()], 1), jax.jacfwd(
            force
        )(x)

    ours, exact = jax.jit(jax.vmap(both))(xi, rim, floors, rest)
    np.testing.assert_allclose(ours, exact, rtol=1e-8, atol=1e-9)


# its derivative


NUMBERS = [e.path for e in entries(ContactSurface()) if e.path not in ("friction", "load_bias")]
BIAS = jnp.array([0.1, -0.15, 0.05])


def everything(rim, floor, rest):
    """Everything a twist depends on, as one vector."""
    floor = jnp.stack([getattr(floor, n) for n in NUMBERS])
    return jnp.concatenate([rim, rest, floor, BIAS, jnp.array([0.125]), jnp.zeros(3)])


@jax.jit
def twist(vector):
    sizes = [3, 3, len(NUMBERS), 3, 1]
    rim, rest, values, bias, base, offset = jnp.split(vector, np.cumsum(sizes))
    g = eqx.tree_at(lambda g: (g.base_radius, g.drive_offset), ROBOTINO, (base[0], offset))
    floor = ContactSurface(**dict(zip(NUMBERS, values, strict=True)), load_bias=bias)
    return contact.equilibrium(rim, g.frame(), floor, rest)


forward = jax.jit(jax.jacfwd(twist))
reverse = jax.jit(jax.jacrev(twist))


@pytest.mark.slow
@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize(
    "rim",
    [
        (0.10, -0.02, -0.08),
        (0.17, 0.0, -0.17),  # a wheel at rest
        (0.0, 0.0, 0.1),  # two of them
        (0.2, 0.2, 0.2),  # turning on the spot
        (1e-3, -4e-4, -6e-4),
        (1e-5, 0.0, -1e-5),
        (0.0, 0.0, 0.0),
    ],
)
def test_the_implicit_derivative_is_that_of_finite_differences(floor, rim):
    rim = jnp.asarray(rim)
    vector = everything(rim, FLOORS[floor], jnp.array([0.3, 0.28, 0.42]))
    jacobian = np.asarray(forward(vector))
    assert np.isfinite(jacobian).all()
    step = 1e-6 * max(1e-3, float(jnp.abs(rim).max()))
    for k, e in enumerate(step * np.eye(len(vector))):
        numeric = np.asarray((twist(vector + e) - twist(vector - e)) / (2 * step))
        tolerance = 1e-5 * max(1.0, np.abs(numeric).max())
        np.testing.assert_allclose(jacobian[:, k], numeric, atol=tolerance, err_msg=f"number {k}")


@pytest.mark.slow
def test_reverse_and_forward_derivatives_agree():
    vector = everything(jnp.array([0.1, 0.0, -0.1]), FLOORS["gray"], EVEN)
    np.testing.assert_allclose(reverse(vector), forward(vector), rtol=1e-9, atol=1e-12)


# symmetries and limits


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.slow
def test_turning_the_travel_by_120_degrees_turns_the_twist(floor):
    rim = headings(0.2) + jnp.array([0.03, 0.03, 0.03])
    frame, count = ROBOTINO.frame(), len(rim)
    floors, rest = spread(FLOORS[floor], count), jnp.broadcast_to(EVEN, (count, 3))
    here = np.asarray(solve(rim, frame, floors, rest))
    there = np.asarray(solve(jnp.roll(rim, 1, axis=1), frame, floors, rest))
    c, s = math.cos(2 * math.pi / 3), math.sin(2 * math.pi / 3)
    turned = here @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    np.testing.assert_allclose(there, turned, atol=1e-10)


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.slow
def test_mirrored_wheels_and_loads_mirror_the_twist(floor):
    rim = headings(0.2) + jnp.array([0.03, 0.03, 0.03])
    frame, count = ROBOTINO.frame(), len(rim)
    floors = spread(FLOORS[floor], count)
    rest = jnp.broadcast_to(jnp.array([0.25, 0.3, 0.45]), (count, 3))
    here = np.asarray(solve(rim, frame, floors, rest))
    there = np.asarray(solve(-rim[:, ::-1], frame, floors, rest[:, ::-1]))
    np.testing.assert_allclose(there, here * [1.0, -1.0, -1.0], atol=1e-10)


@pytest.mark.slow
def test_centred_loads_go_straight_along_the_axes_of_symmetry_only():
    frame, gray = ROBOTINO.frame(), FLOORS["gray"]
    drift = lambda rim, rest: np.asarray(equilibrium(rim, frame, gray, rest))  # noqa: E731
    ahead, askew = headings(0.2)[0], headings(0.2)[2]
    np.testing.assert_allclose(drift(ahead, EVEN)[1:], 0.0, atol=1e-10)
    assert abs(drift(askew, EVEN)[2]) > 1e-3
    assert abs(drift(ahead, jnp.array([0.25, 0.3, 0.45]))[2]) > 1e-3


@pytest.mark.parametrize("name", ["omni 3", "omni 4", "mecanum"])
@pytest.mark.slow
def test_without_drag_there_is_no_slip(name):
    g = GEOMETRIES[name]
    free = surface(
        creep=0.3,
        roller_drag=1e-9,
        rolling_resistance=1e-9,
        roller_viscosity=1e-9,
        scrub=1e-9,
        lead=0.005,
    )
    xi = np.random.default_rng(3).normal(size=(20, 3)) * [0.2, 0.2, 1.0]
    rim = jnp.asarray(xi @ np.asarray(g.forward()).T)
    rest = jnp.full((20, g.wheels), 1 / g.wheels)
    np.testing.assert_allclose(solve(rim, g.frame(), spread(free, 20), rest), xi, atol=1e-7)


def test_slip_falls_with_creep():
    frame, rim = ROBOTINO.frame(), headings(0.2)[3]
    lost = [
        0.2 - float(jnp.hypot(*equilibrium(rim, frame, floor, EVEN)[:2]))
        for floor in (
            surface(creep=creep, roller_drag=0.3) for creep in (1.0, 0.3, 0.1, 0.03, 0.01)
        )
    ]
    assert (np.diff(lost) < 0).all()
    assert 0 < lost[-1] < 0.01 * 0.2 * 2


def test_slip_is_a_ratio_once_speeds_are_above_the_regularisation():
    floor = surface(
        creep=0.4,
        roller_drag=0.3,
        roller_creep=0.2,
        rolling_resistance=0.05,
        slide_viscosity=1e-12,
        roller_viscosity=1e-12,
        scrub=1e-12,
        lead=0.004,
    )
    frame, count = ROBOTINO.frame(), 36
    floors, rest = spread(floor, count), jnp.broadcast_to(jnp.array([0.3, 0.3, 0.4]), (count, 3))

    def unlike(speed):
        once = np.asarray(solve(headings(speed), frame, floors, rest)) / speed
        twice = np.asarray(solve(headings(2 * speed), frame, floors, rest)) / (2 * speed)
        return np.abs(once - twice).max()

    # what is left is the regularisation's: of the size of its speed over that of the wheels
    left = np.array([unlike(speed) for speed in (0.2, 2.0, 20.0)])
    np.testing.assert_allclose(left[:-1] / left[1:], 10.0, rtol=0.02)
    assert left[-1] < V0 / 20.0


@pytest.mark.slow
def test_wheels_at_rest_hold_the_robot():
    for g in GEOMETRIES.values():
        rim = jnp.zeros(g.wheels)
        rest = jnp.full(g.wheels, 1 / g.wheels)
        xi = equilibrium(rim, g.frame(), FLOORS["gray"], rest)
        np.testing.assert_allclose(xi, 0.0, atol=1e-12)


# forces


def test_loads_carry_the_weight_at_the_centre_of_pressure():
    """sum N = 1 and sum N (p + b v) = sum N0 p for the unit vector v of the motion."""
    rest = jnp.array([0.25, 0.3, 0.45])
    places = np.asarray(ROBOTINO.place) * 0.125
    for xi in np.random.default_rng(4).normal(size=(10, 3)):
        frame = ROBOTINO.frame()
        got = np.asarray(forces_of(jnp.asarray(xi), jnp.zeros(3), frame, FLOORS["gray"], rest).load)
        ahead = 0.004 * xi[:2] / np.linalg.norm(xi[:2])
        assert got.sum() == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(got @ (places + ahead), np.asarray(rest) @ places, atol=1e-9)


def test_drag_grows_with_a_power_of_the_load():
    """A wheel under k times an even load drags k^(p - 1) times as much per load."""
    floor = surface(roller_drag=0.3, rolling_resistance=0.01, drag_exponent=1.6)
    for relative in (0.25, 1.0, 1.0 + 1 / 3, 2.5):
        found = law.at_load(floor, jnp.asarray(relative))
        np.testing.assert_allclose(found.roller_drag, 0.3 * relative**0.6, rtol=1e-14)
        np.testing.assert_allclose(found.rolling_resistance, 0.01 * relative**0.6, rtol=1e-14)
        for e in entries(floor):
            if e.path not in ("roller_drag", "rolling_resistance"):
                assert e.get(found) == e.get(floor)
    for lifted in (0.0, -0.1):  # no wheel that is lifted drags without bounds
        flat = replace(floor, drag_exponent=jnp.asarray(0.5))
        assert np.isfinite(law.at_load(flat, jnp.asarray(lifted)).roller_drag)


@pytest.mark.parametrize("power", [1.0, 1.15, 1.6])
def test_drag_of_a_wheel_goes_with_that_power_of_its_load(power):
    """N g sat with g = (w N)^(p - 1): from one load to another as the ratio to the power p."""
    floor = surface(roller_drag=0.3, roller_viscosity=1e-300, lead=0.0, drag_exponent=power)
    frame, xi = ROBOTINO.frame(), jnp.array([0.2, 0.05, 0.3])
    rim = jnp.array([0.15, -0.02, -0.1])
    loads = jnp.array([0.25, 0.3, 0.45]), jnp.array([0.5, 0.3, 0.2])
    one, other = (np.asarray(forces_of(xi, rim, frame, floor, rest).drag) for rest in loads)
    assert (np.abs(one) > 1e-3).all()
    np.testing.assert_allclose(other / one, np.asarray(loads[1] / loads[0]) ** power, rtol=1e-12)


def test_a_load_bias_is_a_load_that_the_floor_alone_sees():
    rest, bias = jnp.array([0.25, 0.3, 0.45]), jnp.array([0.2, -0.3, 0.1])
    np.testing.assert_array_equal(law.apparent_load(rest, jnp.zeros(3)), rest)
    np.testing.assert_array_equal(law.apparent_load(rest, jnp.asarray(0.0)), rest)
    seen = law.apparent_load(rest, bias)
    assert float(seen.sum()) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(seen / seen[0], rest / rest[0] * np.exp(bias - bias[0]), rtol=1e-14)
    frame, rim = ROBOTINO.frame(), jnp.array([0.1, 0.03, -0.12])
    biased = replace(FLOORS["gray"], load_bias=bias)
    here = equilibrium(rim, frame, biased, rest)
    np.testing.assert_allclose(here, equilibrium(rim, frame, FLOORS["gray"], seen), atol=1e-14)
    assert abs(here - equilibrium(rim, frame, FLOORS["gray"], rest)).max() > 1e-3


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.slow
def test_energy_is_lost_at_every_wheel_and_the_motors_pay_for_it(name):
    """Power of the rims = sliding + rollers + rolling resistance + scrub, each of them positive."""
    g = GEOMETRIES[name]
    floors, rim, rest = cases("ordinary", 2000, g, seed=7)
    frame = g.frame()
    xi = solve(rim, frame, floors, rest)
    found = forces(xi, rim, frame, floors, rest)
    solved = np.asarray(
        (gap(xi, rim, frame, floors, rest) < 1e-9) & (np.asarray(found.load) > 0).all(axis=1)
    )
    assert solved.mean() > 0.98
    drive_share, through = np.asarray(frame.drive_share), np.asarray(frame.roller_share)
    along = np.asarray(xi) @ np.asarray(frame.hold).T
    roll = np.asarray(xi) @ np.asarray(frame.roll).T
    traction, drag = np.asarray(found.traction), np.asarray(found.drag)
    radius = np.exp(np.asarray(frame.grip) * np.asarray(floors.rolling_radius)[:, None])
    rim = np.asarray(rim) * radius
    held = (
        traction - drag * through
    ) / drive_share  # along the direction the rollers do not give way in
    sliding = held * (rim * drive_share - along)
    rollers = -drag * (roll - rim * through)
    active = np.hypot(rim, roll - rim * through)
    seen = np.asarray(rest) * np.exp(np.asarray(floors.load_bias))
    even = g.wheels * seen / seen.sum(axis=1, keepdims=True)
    rolling = (
        np.asarray(floors.rolling_resistance)[:, None]
        * even ** (np.asarray(floors.drag_exponent)[:, None] - 1)
        * np.asarray(found.load)
        * saturated(along / (V0 + S1 * active), KNEE)[0]
        * along
    )
    turned = saturated(np.asarray(xi)[:, 2] / W0, KNEE)[0]
    scrub = np.asarray(floors.scrub) * turned * xi[:, 2]
    for loss in (sliding, rollers, rolling):
        assert (loss[solved] >= -1e-15).all()
    assert (scrub >= 0).all()
    paid = (traction * rim).sum(axis=1)
    lost = (sliding + rollers + rolling).sum(axis=1) + np.asarray(scrub)
    np.testing.assert_allclose(paid[solved], lost[solved], atol=1e-8)


@pytest.mark.slow
def test_no_wheel_pushes_harder_than_friction_allows():
    floors, rim, rest = cases("hard", 2000, seed=8)
    floors = eqx.tree_at(lambda f: f.slide_viscosity, floors, jnp.zeros(2000))
    frame = ROBOTINO.frame()
    xi = solve(rim, frame, floors, rest)
    felt = forces(xi, rim, frame, floors, rest)
    assert (np.abs(felt.traction) <= np.abs(felt.load) * (1 + 1e-12)).all()


# saturation

KNEES = jnp.array([1e-3, 0.2, KNEE, 1.0, 1.0 + 1e-9, 3.0, 100.0])


def sat(x, knee):
    return x * law.Saturation.at(x * x, knee).chord


@pytest.fixture(scope="module")
def saturations():
    """For each knee width and x: slope and bend, and derivatives of x chord up to the second."""
    x = jnp.concatenate([jnp.array([0.0, 1.0]), jnp.logspace(-12, 6, 100)])

    def derivatives(x, knee):
        first = jax.grad(sat, (0, 1))(x, knee)
        return sat(x, knee), first, jax.hessian(sat, (0, 1))(x, knee)

    def of_all(knee):
        found = law.Saturation.at(x * x, knee)
        return found, jax.vmap(derivatives, (0, None))(x, knee)

    return np.asarray(x), *jax.tree.map(np.asarray, jax.jit(jax.vmap(of_all))(KNEES))


def test_saturation_is_the_root_of_its_quadratic_equation(saturations):
    """(1 - h^2) y^4 - (1 + x^2) y^2 + x^2 = 0 with y = sat(x), and y rises from 0 to 1."""
    x, _, (y, _, _) = saturations
    a = 1 - np.asarray(KNEES)[:, None] ** 2
    size = np.abs(a) * y**4 + (1 + x**2) * y**2 + x**2
    assert (np.abs(a * y**4 - (1 + x**2) * y**2 + x**2) <= 1e-14 * size).all()
    # the larger of both roots is above 1
    assert (y <= 1 + 1e-15).all()
    assert (np.diff(y[:, 2:]) >= -1e-15).all()
    np.testing.assert_allclose(y[:, 1], 1 / np.sqrt(1 + KNEES), rtol=1e-14)


def test_slopes_and_bends_are_derivatives_of_the_saturation(saturations):
    x, found, (_, (by_x, _), _) = saturations
    np.testing.assert_allclose(found.slope, by_x, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.chord - found.bend * x**2, by_x, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(found.slope[:, 0], 1.0)


def test_saturation_is_smooth_in_the_speed_and_in_the_knee(saturations):
    """At rest it is x - h^2 x^3 / 2: its second derivatives are 0 there, and finite everywhere."""
    _, _, (_, (_, by_knee), second) = saturations
    for each in (by_knee, *(part for row in second for part in row)):
        assert np.isfinite(each).all()
        np.testing.assert_array_equal(each[:, 0], 0.0)
    third = jax.vmap(jax.grad(jax.grad(jax.grad(sat))), (None, 0))(0.0, KNEES)
    np.testing.assert_allclose(third, -3 * KNEES**2, rtol=1e-12, atol=1e-15)


def test_a_wider_knee_saturates_later():
    widths, x = jnp.linspace(0.1, 3.0, 30), jnp.asarray(2.0)
    assert (np.diff(jax.vmap(lambda h: sat(x, h))(widths)) < 0).all()


def test_the_usual_knee_is_nearest_to_the_hyperbolic_tangent():
    x, widths = jnp.linspace(0.0, 6.0, 1000), jnp.linspace(0.5, 0.8, 31)
    worst = jnp.abs(jax.vmap(lambda h: sat(x, h))(widths) - jnp.tanh(x)).max(axis=1)
    assert float(widths[worst.argmin()]) == pytest.approx(KNEE, abs=0.011)
    assert float(worst.min()) < 0.022


def test_friction_in_two_directions_has_the_derivatives_of_its_force():
    """Speeds down to 0; in the direction of the speed, beside it and in the activity."""
    rng = np.random.default_rng(0)
    speeds = jnp.asarray(np.concatenate([np.zeros((1, 2)), rng.normal(0, 0.1, (200, 2))]))

    def made(v, active):
        return law.Friction(v[0], 0.002 + 0.3 * active, 0.3, 0.7, 0.2, v[1], 0.9)

    def both(v):
        at, active = made(v, 0.1), jnp.asarray(0.1)
        exact = jax.grad(lambda v, active: made(v, active).force, (0, 1))(v, active)
        return jnp.stack([at.by_speed(), at.by_beside(), at.by_activity()]), jnp.append(*exact)

    ours, exact = jax.jit(jax.vmap(both))(speeds)
    np.testing.assert_allclose(ours, exact, rtol=1e-9, atol=1e-12)


def test_each_floor_has_its_own_knee():
    """It shapes traction and roller drag, where speeds are near their onsets."""
    frame, rim = ROBOTINO.frame(), jnp.array([0.1, 0.03, -0.12])
    sharp, broad = (replace(FLOORS["gray"], knee_width=jnp.asarray(h)) for h in (0.2, 1.5))
    xi = jnp.array([0.05, 0.02, 0.1])
    one, other = (forces_of(xi, rim, frame, floor, EVEN) for floor in (sharp, broad))
    for name in ("traction", "drag"):
        assert (np.abs(getattr(one, name)) > 1.02 * np.abs(getattr(other, name))).any()


# several floors

STACK = ContactSurface(
    **{e.path: jnp.full(3, e.get(ContactSurface())) for e in entries(ContactSurface())}
    | {
        "friction": jnp.array([0.3, 0.45, 0.6]),
        "creep": jnp.array([0.05, 0.4, 0.9]),
        "roller_drag": jnp.array([0.14, 0.3, 0.45]),
        "lead": jnp.array([0.0015, 0.004, 0.005]),
        "drag_exponent": jnp.array([1.0, 1.2, 1.6]),
        "load_bias": jnp.array([[0.1, -0.15, 0.05], [-0.2, 0.05, 0.15], [0.0, 0.1, -0.1]]),
    },
    labels=("a", "b", "c"),
)


def test_every_wheel_has_its_own_load_bias_of_the_floor_beneath_it():
    bias = np.asarray(STACK.load_bias)
    np.testing.assert_array_equal(STACK.at(1).load_bias, bias[1])
    np.testing.assert_array_equal(jax.jit(lambda k: STACK.at(k).load_bias)(2), bias[2])
    under = np.array([[2, 0, 1], [1, 1, 0], [2, 2, 2]])
    own = np.array([[bias[floor, wheel] for wheel, floor in enumerate(row)] for row in under])
    for row, want in zip(under, own, strict=True):
        found = STACK.at(row)
        np.testing.assert_array_equal(found.load_bias, want)
        np.testing.assert_array_equal(found.drag_exponent, STACK.drag_exponent[row])
    many = STACK.at(under.T)  # wheels first
    np.testing.assert_array_equal(many.load_bias, own.T)
    np.testing.assert_array_equal(many.creep, STACK.creep[under.T])


def test_the_mean_floor_of_sure_shares_is_the_floor_itself():
    under = np.array([2, 0, 1])
    sure, one = STACK.mixed(jnp.eye(3)[under]), STACK.at(under)
    for a, b in zip(jax.tree.leaves(sure), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-15)
    even = STACK.mixed(jnp.full((3, 3), 1 / 3))
    np.testing.assert_allclose(even.load_bias, STACK.load_bias.mean(axis=0), atol=1e-16)
    np.testing.assert_allclose(even.drag_exponent, 3 * [1.9 / 1.5], rtol=1e-15)


@pytest.mark.parametrize("floor", range(3))
def test_one_floor_under_every_wheel_is_that_floor(floor):
    frame, rest = ROBOTINO.frame(), jnp.array([0.25, 0.3, 0.45])
    for rim in headings(0.2, 5):
        each = equilibrium(rim, frame, STACK.at(np.full(3, floor)), rest)
        np.testing.assert_allclose(each, equilibrium(rim, frame, STACK.at(floor), rest), atol=1e-12)


@pytest.mark.parametrize("under", [1, (2, 0, 1), (0, 0, 2)])
def test_wheels_in_another_order_move_the_robot_as_before(under):
    """With their loads, the floors beneath them and what these see of the loads."""
    order, angles = np.array([2, 0, 1]), np.array([60.0, 180.0, 300.0])
    there = omni(angles[order].tolist(), 0.125, 0.04, 16.0)
    moved = replace(STACK, load_bias=STACK.load_bias[:, order])
    rest = jnp.array([0.25, 0.3, 0.45])
    on = np.array(under)
    beneath = STACK.at(on), moved.at(on[order] if on.ndim else on)
    for rim in headings(0.2, 7) + jnp.array([0.03, 0.01, -0.02]):
        here = equilibrium(rim, ROBOTINO.frame(), beneath[0], rest)
        again = equilibrium(rim[order], there.frame(), beneath[1], rest[order])
        np.testing.assert_allclose(again, here, atol=1e-12)
        kept = equilibrium(rim[order], there.frame(), STACK.at(on), rest[order])
        assert abs(kept - here).max() > 1e-4  # the order of the biases counts


# other vehicles


def test_skid_steer_turns_slower_than_its_wheels_say():
    frame, rest = SKID.frame(), jnp.full(4, 0.25)
    left_back = jnp.array([-0.3, 0.3, -0.3, 0.3])
    floor = eqx.tree_at(lambda f: f.lead, FLOORS["gray"], jnp.asarray(0.0))
    xi = np.asarray(equilibrium(left_back, frame, floor, rest))
    np.testing.assert_allclose(xi[:2], 0.0, atol=1e-9)
    assert 0.05 * 0.3 / 0.15 < xi[2] < 0.95 * 0.3 / 0.15  # scrubbing sideways costs turning


def test_skid_steer_drives_straight_and_stays_in_its_tracks():
    frame, rest = SKID.frame(), jnp.full(4, 0.25)
    xi = np.asarray(equilibrium(jnp.full(4, 0.3), frame, FLOORS["table"], rest))
    np.testing.assert_allclose(xi[1:], 0.0, atol=1e-9)
    assert 0.98 * 0.3 < xi[0] < 0.3


def test_longer_skid_steers_turn_less():
    def rate(half_length):
        g = skid_steer(half_length, 0.15, 0.05)
        rim = jnp.array([-0.3, 0.3, -0.3, 0.3])
        return float(equilibrium(rim, g.frame(), FLOORS["gray"], jnp.full(4, 0.25))[2])

    assert rate(0.05) > rate(0.1) > rate(0.2) > 0


@pytest.mark.parametrize("creep", [0.02, 0.3, 2.0])
@pytest.mark.parametrize("half_length", [0.05, 0.15, 0.3])
def test_four_wheels_that_turn_on_the_spot_have_one_effective_track(creep, half_length):
    """W = r w b / (a^2 + b^2), whatever the friction: it is against the sliding as a whole."""
    frame = skid_steer(half_length, 0.15, 0.05).frame()
    floor = surface(creep=creep, rolling_resistance=1e-9, scrub=1e-9, lead=0.0)
    xi = np.asarray(equilibrium(jnp.array([-0.3, 0.3, -0.3, 0.3]), frame, floor, jnp.full(4, 0.25)))
    np.testing.assert_allclose(xi[2], 0.3 * 0.15 / (half_length**2 + 0.15**2), rtol=1e-6)
    np.testing.assert_allclose(xi[:2], 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_friction_of_an_ordinary_wheel_is_no_larger_than_its_load(seed):
    """Traction and drag together point against the sliding, and reach mu N at most."""
    rng = np.random.default_rng(seed)
    along, roll, rim = (jnp.asarray(rng.normal(0, 0.5, 50)) for _ in range(3))
    floor, onset = law.sideways(surface(creep=0.1, slide_viscosity=1e-12), jnp.ones(()))
    w = law.wheel_forces(along, roll, rim, jnp.ones(()), onset, floor, jnp.ones(()))
    push, drag = np.asarray(w.traction.force), -np.asarray(w.drag.force)
    slide = np.asarray(rim - along)
    assert (np.hypot(push, drag) <= 1 + 1e-9).all()
    assert np.hypot(push, drag).max() > 0.9
    np.testing.assert_allclose(push * -np.asarray(roll), drag * slide, atol=1e-9)


def test_a_fourth_wheel_at_odds_is_overruled():
    """Three wheels ask for a translation, one stands still: the body moves, and turns."""
    rim = np.asarray(OMNI4.forward()) @ [0.3, 0.0, 0.0]
    rest = jnp.full(4, 0.25)
    agreed = equilibrium(jnp.asarray(rim), OMNI4.frame(), FLOORS["table"], rest)
    np.testing.assert_allclose(agreed, [0.3, 0.0, 0.0], atol=0.02)
    rim[2] = 0.0
    xi = np.asarray(equilibrium(jnp.asarray(rim), OMNI4.frame(), FLOORS["table"], rest))
    assert 0.05 < np.hypot(*xi[:2]) < 0.29
    assert abs(xi[2]) > 0.01


def test_mecanum_goes_sideways():
    rim = jnp.asarray(np.asarray(MECANUM.forward()) @ [0.0, 0.3, 0.0])
    np.testing.assert_allclose(rim, [-0.3, 0.3, 0.3, -0.3], atol=1e-12)
    floor = surface(creep=0.05, roller_drag=0.02, roller_creep=0.2, scrub=1e-6, lead=0.0)
    xi = np.asarray(equilibrium(rim, MECANUM.frame(), floor, jnp.full(4, 0.25)))
    np.testing.assert_allclose(xi, [0.0, 0.3, 0.0], atol=0.01)
    assert xi[1] < 0.3


def rolling_drag(xi, rim, frame, floor, rest):
    """Drag of each wheel along its drive that only its motor works against."""
    return Balance(rim, stand(frame, floor, rest)).at(Planar(*xi)).rolling_drag


def test_a_wheel_drags_along_its_drive_as_far_as_it_rolls_that_way():
    frame, floor = ROBOTINO.frame(), FLOORS["gray"]
    xi = jnp.asarray([0.3, -0.1, 0.2])
    rim = frame.hold @ xi
    found = rolling_drag(xi, rim, frame, floor, jnp.asarray([0.2, 0.5, 0.3]))
    share = np.asarray(rim) / np.hypot(np.asarray(rim), np.asarray(frame.roll @ xi))
    np.testing.assert_allclose(found, 0.31 / 3 * share * np.abs(share), rtol=1e-6)
    back = rolling_drag(-xi, -rim, frame, floor, EVEN)
    np.testing.assert_allclose(back, -found, rtol=1e-6)


def test_only_wheels_with_rollers_drag_along_their_drive_as_rollers_do():
    xi = jnp.asarray([0.3, 0.0, 0.2])
    rim = SKID.forward() @ xi
    rest = jnp.full(4, 0.25)
    assert not np.any(rolling_drag(xi, rim, SKID.frame(), FLOORS["gray"], rest))
