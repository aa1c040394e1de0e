"""The law of Goswami and Padhy: its proof, and its gains against another search."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import differential_evolution

from slipid.lab.trial.published_laws import (
    HIGH_GAINS,
    LOW_GAINS,
    GoswamiPadhy,
    TuningTask,
    by_gradient,
    by_swarm,
    lyapunov,
    tracking_error,
)

PROMPT = {"delay_weights": np.array([[1.0, 0.0]]), "lag_gain": 1.0, "period": 0.05}
"""Wheels that do at once what they are asked to."""


def moved(pose, twist):
    """Rates in the world of a body that does exactly what it is asked to."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    return jnp.stack([c * twist[0] - s * twist[1], s * twist[0] + c * twist[1], twist[2]])


def v_of(reference, pose):
    return lyapunov(tracking_error(reference[:3], pose))


def test_v_falls_as_proven_at_any_pose_and_rates():
    rng = np.random.default_rng(0)
    gains, pose, reference = rng.uniform(0, 5, (50, 3)), *np.split(rng.normal(size=(50, 9)), [3], 1)

    @jax.jit
    @jax.vmap
    def falls(gains, pose, reference):
        def along(t):
            twist = GoswamiPadhy(gains)(reference, pose)
            later = reference.at[:3].add(t * reference[3:])
            return v_of(later, pose + t * moved(pose, twist))

        return jax.jvp(along, (0.0,), (1.0,))[1]

    (dx, dy, eth), th = (reference[:, :3] - pose).T, pose[:, 2]
    ex, ey = np.cos(th) * dx + np.sin(th) * dy, np.cos(th) * dy - np.sin(th) * dx
    proven = -(gains * np.column_stack([ex**2, ey**2, np.sin(eth) ** 2])).sum(axis=1)
    np.testing.assert_allclose(falls(gains, pose, reference), proven, rtol=1e-10, atol=1e-12)


def wanted(t):
    """A path that bends and turns, with its exact rates."""

    def place(t):
        return jnp.stack([jnp.sin(0.7 * t), 0.5 * jnp.sin(1.1 * t + 0.3), jnp.sin(0.5 * t)])

    return jnp.concatenate(jax.jvp(place, (t,), (jnp.ones(()),)))


@jax.jit
@jax.vmap
def driven(gains, begin):
    """V every hundredth of a second of a robot without slip, by Runge and Kutta."""
    h = 0.01

    def rates(t, pose):
        return moved(pose, GoswamiPadhy(gains)(wanted(t), pose))

    def step(pose, t):
        a = rates(t, pose)
        b = rates(t + 0.5 * h, pose + 0.5 * h * a)
        c = rates(t + 0.5 * h, pose + 0.5 * h * b)
        d = rates(t + h, pose + h * c)
        return pose + h / 6 * (a + 2 * b + 2 * c + d), v_of(wanted(t), pose)

    return jax.lax.scan(step, begin, h * jnp.arange(1500))[1]


def test_v_falls_throughout_for_any_positive_gains():
    rng = np.random.default_rng(1)
    gains = rng.uniform(0.3, 5.0, (40, 3))
    begin = rng.uniform(-1, 1, (40, 3)) * [1.0, 1.0, 2.5]
    v = np.asarray(driven(jnp.asarray(gains), jnp.asarray(begin)))
    assert (v[:, 0] > 0.05).all()
    assert (np.diff(v, axis=1) < 1e-8).all()  # up to the rounding of V near 0
    assert (v[:, -1] < 1e-2 * v[:, 0]).all()


def test_a_robot_on_its_path_is_commanded_the_paths_rates_in_its_own_frame():
    law = GoswamiPadhy(jnp.array([1.0, 2.0, 3.0]))
    pose = jnp.array([1.0, -2.0, 0.5 * np.pi])
    rates = jnp.array([0.2, 0.1, 0.3])  # to a body that looks along y, x is on its right
    np.testing.assert_allclose(law(jnp.concatenate([pose, rates]), pose), [0.1, -0.2, 0.3])
    ahead = pose + jnp.array([0.0, 0.1, 0.0])
    np.testing.assert_allclose(
        law(jnp.concatenate([ahead, 0 * rates]), pose), [0.1, 0.0, 0.0], atol=1e-12
    )
    aside = pose + jnp.array([-0.1, 0.0, -0.5])
    np.testing.assert_allclose(
        law(jnp.concatenate([aside, 0 * rates]), pose), [0.0, 0.2, -3 * np.sin(0.5)], atol=1e-12
    )


def test_the_integral_of_a_robot_that_does_not_lag_is_a_geometric_series():
    still, begin = np.zeros((200, 6)), np.array([[0.3, 0.0, 0.0], [0.0, -0.2, 0.0]])
    task = TuningTask(still, begin, **PROMPT)
    k = np.array([[1.0, 2.0, 0.0], [3.0, 0.5, 4.0]])
    q = (1 - 0.05 * k[:, :2]) ** 2
    each = 0.5 * np.array([0.3, 0.2]) ** 2 * 0.05 * (1 - q**200) / (1 - q)
    np.testing.assert_allclose(task.integrals(k), each.mean(axis=1), rtol=1e-12)
    turned = TuningTask(still, np.array([[0.0, 0.0, 1.0]]), **PROMPT)
    angle, total = 1.0, 0.0
    for _ in range(200):
        total, angle = total + 0.05 * (1 - np.cos(angle)), angle - 0.05 * 4.0 * np.sin(angle)
    np.testing.assert_allclose(turned.integrals(k)[1], total, rtol=1e-12)


def test_a_robot_that_lags_is_behind_by_delay_and_lag():
    """Without gains it is left behind by its rates times how late it is, on a line or a turn."""
    shares, h, follow = np.array([[0.0, 0.4, 0.6], [0.0, 1.0, 0.0]]), 0.025, 0.6
    lost = (0.05 + 0.6 * h) + h * (1 - follow) / follow
    t = 0.05 * np.arange(200)[:, None]
    straight = np.hstack([0.2 * t, 0 * t, 0 * t, 0.2 + 0 * t, 0 * t, 0 * t])
    begin = np.zeros((1, 3))

    def last(reference):
        """V in the last period."""
        whole, less = (
            TuningTask(r, begin, shares, follow, 0.05).integrals(np.zeros((1, 3)))[0]
            for r in (reference, reference[:-1])
        )
        return (whole - less) / 0.05

    assert last(straight) == pytest.approx(0.5 * (0.2 * lost) ** 2, rel=1e-9)
    turning = np.hstack([0 * t, 0 * t, 0.4 * t, 0 * t, 0 * t, 0.4 + 0 * t])
    assert last(turning) == pytest.approx(1 - np.cos(0.4 * lost), rel=1e-9)


def test_an_ideal_robot_stays_on_a_bend():
    t = 0.05 * np.arange(120)
    places = np.column_stack([np.sin(t), 1 - np.cos(t), t])
    bend = np.hstack([places, np.column_stack([np.cos(t), np.sin(t), np.ones(120)])])
    task = TuningTask(bend, np.zeros((1, 3)), **PROMPT)
    # the twist is the path's own, held for a period: a chord's heading is the half-way one
    assert task.integrals(np.zeros((1, 3)))[0] < 1e-5


LATE = TuningTask(
    np.zeros((60, 6)),
    np.array([[0.3, 0.1, 0.4], [-0.1, 0.3, -0.6]]),
    np.array([[0.0] * 4 + [1.0]]),
    0.8,
    0.05,
)
"""A path that rests, and a robot so late that the best gains are inside the box."""


def test_the_gradient_is_that_of_the_integral():
    gains = np.array([1.0, 2.0, 1.5])
    value, slope = LATE.slope(gains)
    assert value == LATE.integrals(gains[None])[0]
    for k, off in enumerate(1e-3 * np.eye(3)):
        high, low = LATE.integrals(np.array([gains + off, gains - off]))
        assert slope[k] == pytest.approx((high - low) / 2e-3, rel=1e-4)


@pytest.mark.slow
def test_swarm_and_gradient_find_what_another_search_finds():
    other = differential_evolution(
        lambda x: LATE.integrals(x.T),
        list(zip(LOW_GAINS, HIGH_GAINS, strict=True)),
        rng=0,
        vectorized=True,
        updating="deferred",
        tol=1e-8,
    )
    assert (other.x > 0.5).all()
    assert (other.x < 4.5).all()
    np.testing.assert_allclose(by_swarm(LATE), other.x, atol=2e-3)
    np.testing.assert_allclose(by_swarm(LATE, seed=7), other.x, atol=2e-3)
    np.testing.assert_allclose(by_gradient(LATE), other.x, atol=2e-3)


def test_gains_of_a_prompt_robot_are_the_largest_there_are():
    task = TuningTask(np.zeros((20, 6)), np.array([[0.1, 0.1, 0.1]]), **PROMPT)
    np.testing.assert_allclose(by_gradient(task), HIGH_GAINS, atol=1e-6)
