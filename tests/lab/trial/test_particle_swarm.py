"""A particle swarm moves by its formula, and finds known minima."""

import numpy as np
import pytest

from slipid.lab.trial.published_laws import Swarm, minimise

LOW, HIGH = np.array([-2.0, -1.0, 0.0]), np.array([2.0, 3.0, 5.0])


def sphere(x):
    return ((x - [0.5, 1.0, 4.0]) ** 2).sum(axis=1)


def rosenbrock(x):
    return (1 - x[:, 0]) ** 2 + 100 * (x[:, 1] - x[:, 0] ** 2) ** 2


@pytest.mark.parametrize("seed", range(5))
def test_the_minimum_of_a_sphere_is_found(seed):
    place, costs = minimise(sphere, LOW, HIGH, Swarm(), seed)
    np.testing.assert_allclose(place, [0.5, 1.0, 4.0], atol=2e-3)
    assert costs[-1] == pytest.approx(sphere(place[None])[0], rel=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_minimum_of_rosenbrocks_valley_is_found(seed):
    box = np.full(2, -2.0), np.full(2, 2.0)
    assert minimise(rosenbrock, *box, Swarm(), seed)[1][-1] < 5e-3
    longer, _ = minimise(rosenbrock, *box, Swarm(iterations=300), seed)
    np.testing.assert_allclose(longer, [1.0, 1.0], atol=1e-4)


def test_a_minimum_on_the_edge_is_found_there():
    found, _ = minimise(slope, LOW, HIGH, Swarm())
    np.testing.assert_array_equal(found, [-2.0, 3.0, 0.0])


def test_the_swarm_stays_in_the_box_for_the_given_iterations():
    seen = []

    def cost(x):
        seen.append(x)
        return -(x**2).sum(axis=1)  # the farther the better

    _, costs = minimise(cost, LOW, HIGH, Swarm(particles=7, iterations=9))
    places = np.array(seen)
    assert places.shape == (10, 7, 3)
    assert (places >= LOW).all()
    assert (places <= HIGH).all()
    assert len(costs) == 10
    assert (np.diff(costs) <= 0).all()


def test_what_is_no_number_is_never_best():
    def cost(x):
        return np.where(x[:, 0] > 0, np.nan, sphere(x))

    found, _ = minimise(cost, LOW, HIGH, Swarm())
    np.testing.assert_allclose(found, [0.0, 1.0, 4.0], atol=0.02)


def test_the_same_seed_finds_the_same_and_another_one_another():
    one, two, other = (minimise(sphere, LOW, HIGH, Swarm(), seed)[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def slope(x):
    return x[:, 0] - x[:, 1] + x[:, 2]


@pytest.mark.parametrize("cost_of", [sphere, slope])  # inside, and along the edges of the box
def test_particles_move_by_the_formula(cost_of):
    """Written out particle by particle and coordinate by coordinate, with the same draws."""
    swarm = Swarm(particles=4, iterations=6, inertia=0.6, own=1.2, others=1.7)
    seen = []

    def cost(x):
        seen.append(x.copy())
        return cost_of(x)

    minimise(cost, LOW, HIGH, swarm, 11)
    rng = np.random.default_rng(11)
    x, v = rng.uniform(LOW, HIGH, (4, 3)), np.zeros((4, 3))
    best = [(float(c), tuple(p)) for c, p in zip(cost_of(x), x, strict=True)]
    np.testing.assert_array_equal(seen[0], x)
    for step in range(6):
        one, two = rng.uniform(size=(2, 4, 3))
        lead = min(best)[1]
        for k in range(4):
            for j in range(3):
                to_own, to_lead = best[k][1][j] - x[k, j], lead[j] - x[k, j]
                speed = 0.6 * v[k, j] + 1.2 * one[k, j] * to_own + 1.7 * two[k, j] * to_lead
                half = 0.5 * (HIGH[j] - LOW[j])
                speed = min(max(speed, -half), half)
                place = min(max(x[k, j] + speed, LOW[j]), HIGH[j])
                v[k, j] = speed if place == x[k, j] + speed else 0.0
                x[k, j] = place
        np.testing.assert_allclose(seen[step + 1], x, rtol=1e-12)
        for k, c in enumerate(cost_of(x)):
            best[k] = min(best[k], (float(c), tuple(x[k])))
