"""Tuning: what is minimised, how stable a loop is, and two searches that can be left."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.control.controller import Controller, Gains
from slipid.control.estimator import Odometry
from slipid.control.tuning import objective as tuning
from slipid.control.tuning import optimisers as searching
from slipid.control.tuning.actuation import Habits
from slipid.control.tuning.objective import (
    GAINS,
    HAND,
    HIGHEST,
    LOWEST,
    Task,
    box_of,
    combined,
    evaluate,
    gains_at,
)
from slipid.control.tuning.optimisers import Search
from slipid.control.tuning.stability import Loop, linearised, spectral_radius
from slipid.deploy import tune as app
from slipid.support.checkpoint import Checkpoint
from slipid.support.progress import Reporter
from tests.helpers.kept import kept
from tests.helpers.shared import invoke
from tests.helpers.small_twin import deployed, stacked

HABITS = Habits(smooth=True)


@pytest.fixture
def quick(monkeypatch):
    """Odometry in the filter's place, which takes a minute to compile, and small batches."""
    monkeypatch.setattr(tuning, "Estimator", Odometry)
    for module in (tuning, searching):
        monkeypatch.setattr(module, "BATCH", 4)
    monkeypatch.setattr(searching, "PARTICLES", 6)


@pytest.fixture(scope="module")
def robots():
    return stacked([deployed(1.0, 1.0, 1.0)] * 2)


@pytest.fixture(scope="module")
def cases(robots):
    return app.cases(robots, 8, 5)


def searched(robots, cases, method, rollouts=100, seed=0):
    task = Task(deployed(1.0, 1.0, 1.0), habits=HABITS, steps=40)
    return Search(task, cases, robots, method, rollouts, seed)


def test_help_tells_what_a_step_takes():
    said = " ".join(invoke("tune", "--help").output.replace("│", " ").split())
    cost = [tuning.BATCH * n for n in (searching.GRADIENT, searching.PARTICLES)]
    assert f"a step of gradient takes {cost[0]}, of pso {cost[1]}" in said


def test_the_box_holds_the_gains_and_nothing_else():
    for gains in (HAND, LOWEST, HIGHEST, (0.7, 3.0, 0.2, 0.5, 0.9, 0.3)):
        np.testing.assert_allclose(gains_at(jnp.asarray(box_of(gains))), gains, atol=1e-12)
    beyond = gains_at(jnp.asarray(box_of((9.0, 0.0, -1.0, 2.0, 0.5, 1.0))))
    np.testing.assert_allclose(beyond, [5.0, 0.2, 0.0, 1.5, 0.5, 0.4])


def test_the_worst_tenth_counts_as_much_as_all():
    losses = jnp.arange(20.0)
    assert float(combined(losses)) == pytest.approx(9.5 + 18.5)


def test_spectral_radius_is_that_of_the_eigenvalues():
    rng = np.random.default_rng(0)
    for size in (2, 7, 20):
        a = rng.normal(size=(size, size)) / np.sqrt(size)
        exact = np.abs(np.linalg.eigvals(a)).max()
        assert float(spectral_radius(jnp.asarray(a))) == pytest.approx(exact, rel=1e-3)
    chain = jnp.diag(jnp.ones(4), 1).at[4, 4].set(0.5)  # a delay has no eigenvectors
    assert float(spectral_radius(chain)) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.slow
def test_a_loop_is_stable_where_its_radius_says():
    rates, robot = jnp.asarray([0.1, 0.0, 0.0]), deployed()

    @jax.jit
    def both(gains, surface):
        loop = Loop(Controller(robot, Gains.at(gains)), robot, surface, rates, HABITS)
        a = linearised(loop)
        off = eqx.tree_at(lambda s: s.pose, loop.start(), jnp.array([0.0, 1e-4, 0.0]))
        calm = jax.lax.scan(lambda s, _: (loop.step(s), s.pose[1]), off, None, length=400)[1]
        return spectral_radius(a), a, jnp.max(jnp.abs(calm[-50:])) / 1e-4

    for place, stable in ((1.5, True), (4.0, True), (12.0, False)):
        rho, a, grown = both(jnp.asarray([place, 1.5, 0.0, 0.0, 0.0, 0.0]), jnp.asarray(0))
        assert float(rho) == pytest.approx(np.abs(np.linalg.eigvals(a)).max(), rel=1e-3)
        assert (float(rho) < 1) == stable
        assert (float(grown) < 1) == stable


def test_the_same_budget_is_the_same_number_of_rollouts(robots, cases):
    counts = {m: searched(robots, cases, m, 3360).rollouts for m in ("gradient", "pso")}
    assert counts == {"gradient": 3360, "pso": 3360}


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("method", kept(["gradient", "pso"], ["pso"]))
def test_a_search_betters_gains_by_hand_and_can_be_left(
    robots, cases, method, tmp_path, monkeypatch
):
    search = searched(robots, cases, method, 200)
    state = search.start()
    while not search.done(state):
        state = search.step(state)
    best = search.best(state)
    assert np.all(best >= LOWEST - 1e-12)
    assert np.all(best <= HIGHEST + 1e-12)
    assert search.spread(state).shape == (len(GAINS),)
    before, after = (evaluate(search.task, g, cases) for g in (HAND, best))
    assert float(combined(jnp.asarray(after))) < float(combined(jnp.asarray(before)))

    class Left(Reporter):
        def advance(self, done, total, what=None):
            if done == 2 * search.cost:
                raise KeyboardInterrupt

    kept, path = Checkpoint(tmp_path, "key"), tmp_path / "tuning.npz"
    with pytest.raises(KeyboardInterrupt):
        app._searched(search, kept, Left(quiet=True))
    assert path.is_file()
    assert int(kept.load(app.CHECKPOINT)["count"]) == 2
    resumed = app._searched(search, kept, Reporter(quiet=True))
    for name in state:
        np.testing.assert_array_equal(resumed[name], state[name])


@pytest.mark.slow
def test_gains_that_are_handed_over_are_stable(robots, cases):
    search = searched(robots, cases, "gradient")

    def push(gains):
        place = jnp.asarray(box_of(gains))[None].repeat(6, axis=0)
        return float(tuning.penalties(search.task, place, robots)[0])

    assert push(HIGHEST) > 0
    assert push(HAND) == 0
    found = search.best({**search.start(), "way": np.ones((3, len(GAINS)))})
    assert push(found) == 0
    assert np.all(found >= HAND)  # on the way there
    assert np.any(found > HAND)


@pytest.mark.parametrize(
    ("gain", "scatter", "verdict"),
    [
        (4.0, 2.0, "better than by hand"),
        (0.3, 20.0, "no better than by hand"),
        (-4.0, 2.0, "worse than by hand"),
    ],
)
def test_gains_are_better_only_by_more_than_chance(gain, scatter, verdict):
    """Worlds differ far more from each other than gains do: the error is of paired differences."""
    rng = np.random.default_rng(1)
    hand = rng.uniform(20.0, 200.0, 48)
    tuned = hand - gain - scatter * rng.normal(size=48)
    gained, error = app.improvement({"hand": hand, "tuned": tuned})
    assert app.verdict(gained, error) == verdict
    by = [float(combined(jnp.asarray(x))) for x in (hand, tuned)]
    assert gained == pytest.approx(by[0] - by[1])
    # as large as that of twice the mean would be, roughly: the worst tenth has a larger one
    assert scatter / 48**0.5 < error < 6 * scatter / 48**0.5


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_what_is_written_names_every_gain(robots, cases):
    search = searched(robots, cases, "pso", 40)
    content = app.judged(search, search.step(search.start()), cases, robots).to_json()
    assert content["schema"] == "slipid.gains/1"
    assert tuple(content["gains"]) == GAINS
    assert set(content["gains"]["yaw"]) == {"value", "unit", "spread"}
    assert content["loss"].keys() == {"hand", "tuned"}
    assert content["improvement"].keys() == {"value", "se"}
    assert content["verdict"].endswith("than by hand")
    low, high = content["loss_interval90"]["tuned"]
    assert low <= content["loss_mean"]["tuned"] <= high
    margin = content["stability_margin"]
    assert margin["worst"] <= margin["median"] < 1
    assert len(margin["draws"]) == len(robots.mass)
    assert min(margin["draws"]) == margin["worst"]
