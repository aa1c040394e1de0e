"""The free numbers as a vector: conversions, choices, priors and refusals."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.search_space import Choice, Space
from tests.helpers.declared import declaration, declared_tree


@pytest.fixture
def tree():
    return declared_tree()


def test_vector_and_tree_are_inverses(tree):
    space = Space(tree)
    z = np.random.default_rng(3).normal(size=space.size)
    np.testing.assert_allclose(space.vector(space.tree(jnp.asarray(z))), z, atol=1e-10)
    np.testing.assert_allclose(space.vector(tree), space.start, atol=1e-12)


def test_each_coordinate_moves_its_own_number_only(tree):
    space = Space(tree, [Choice("floor.*.stiff", free=True)])
    assert space.size == 1 + 2 + 2 + 2 + 2 * 2
    assert space.names[:3] == ["inner.gain", "inner.place[1]", "inner.place[2]"]
    before = {e.path: np.asarray(e.get(tree)) for e in space.all}
    for entry in space.free:
        z = space.start.copy()
        z[space.slices[entry.path]] += 0.3
        after = space.tree(jnp.asarray(z))
        moved = [
            e.path
            for e in space.all
            if not np.allclose(e.get(after), before[e.path], rtol=1e-12, atol=0.0)
        ]
        assert moved == [entry.path]


def test_tree_is_jittable_and_its_gradient_is_the_slope(tree):
    space = Space(tree)
    grad = jax.jit(jax.grad(lambda z: space.tree(z).floors.creep[1]))(jnp.asarray(space.start))
    expected = np.zeros(space.size)
    expected[space.slices["floor.b.creep"]] = 0.2  # d exp(z) / dz
    np.testing.assert_allclose(grad, expected, atol=1e-14)


def test_a_choice_without_wildcard_touches_one_path(tree):
    space = Space(tree, [Choice("floor.a.creep", start=0.7)])
    assert float(space.template.floors.creep[0]) == pytest.approx(0.7)
    assert float(space.template.floors.creep[1]) == pytest.approx(0.2)


def test_wildcards_and_the_later_choice_wins(tree):
    space = Space(tree, [Choice("floor.*.creep", fixed=0.5), Choice("floor.b.creep", free=True)])
    assert "floor.a.creep" not in space.slices
    assert "floor.b.creep" in space.slices
    np.testing.assert_allclose(space.template.floors.creep, 0.5)


def test_a_fixed_number_keeps_its_value(tree):
    space = Space(tree, [Choice("inner.gain", fixed=3.5)])
    z = jnp.asarray(space.start + 1.0)
    assert "inner.gain" not in space.slices
    assert float(space.tree(z).inner.gain) == 3.5


def test_without_choice_the_declared_prior_holds(tree):
    space = Space(tree)
    at = space.slices["floor.b.creep"]
    # the value of the tree is where the search starts, the declared start is the prior's centre
    np.testing.assert_allclose(space.start[at], math.log(0.2))
    np.testing.assert_allclose(space.prior_mean[at], math.log(0.3))
    np.testing.assert_allclose(space.prior_std[space.slices["inner.gain"]], 0.7)


@pytest.mark.parametrize(
    ("path", "mean", "std"),
    [
        ("inner.gain", 5.0, 0.2),
        ("inner.place", 0.3, 0.01),
        ("floor.a.stiff", 3.0, 0.05),
    ],
)
def test_a_prior_given_in_si_has_that_std_in_si(tree, path, mean, std):
    space = Space(tree, [Choice(path, prior_mean=mean, prior_std=std)])
    at = space.slices[path]
    rng = np.random.default_rng(1)
    z = space.prior_mean[at] + space.prior_std[at] * rng.normal(size=(20000, 1))
    d = next(e for e in space.free if e.path == path).declaration
    draws = np.asarray(
        jax.vmap(d.to_si)(jnp.asarray(np.broadcast_to(z, (20000, at.stop - at.start))))
    )
    assert draws.std() == pytest.approx(std, rel=0.03)
    assert draws.mean() == pytest.approx(mean, abs=5 * std / math.sqrt(20000) + 0.02 * std)
    np.testing.assert_allclose(space.start[at], space.prior_mean[at])


@pytest.mark.parametrize("share", [(1 / 3, 1 / 3, 1 / 3), (0.28, 0.27, 0.45)])
def test_a_prior_on_shares_has_that_std_in_si(tree, share):
    space = Space(tree, [Choice("share@full", prior_mean=share, prior_std=0.01)])
    at = space.slices["share@full"]
    rng = np.random.default_rng(2)
    z = space.prior_mean[at] + space.prior_std[at] * rng.normal(size=(20000, 2))
    draws = np.asarray(jax.vmap(declaration(shares=True).to_si)(jnp.asarray(z)))
    assert math.sqrt(draws.var(axis=0).mean()) == pytest.approx(0.01, rel=0.03)
    np.testing.assert_allclose(draws.mean(axis=0), share, atol=0.001)


def test_a_std_alone_is_a_prior_around_the_declared_start(tree):
    space = Space(tree, [Choice("floor.b.creep", prior_std=0.06)])
    at = space.slices["floor.b.creep"]
    np.testing.assert_allclose(space.prior_mean[at], math.log(0.3))
    np.testing.assert_allclose(space.prior_std[at], 0.06 / 0.3)
    np.testing.assert_allclose(space.start[at], math.log(0.2))


def test_nothing_free_is_an_empty_space(tree):
    space = Space(tree, [Choice("*", free=False)])
    assert space.size == 0
    assert space.names == []
    same = jax.tree.map(np.array_equal, space.tree(jnp.zeros(0)), tree)
    assert all(jax.tree.leaves(same))


# refusals


def test_an_unknown_path_is_refused_with_the_choices(tree):
    with pytest.raises(
        ValueError, match=r"no parameter 'floor\.c\.creep'; there are: .*floor\.b\."
    ):
        Space(tree, [Choice("floor.c.creep", fixed=1.0)])


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (Choice("inner.gain", fixed=-1.0), r"inner\.gain = -1\.0: expected inside \(0, inf\) V"),
        (Choice("inner.gain", start=math.nan), r"inner\.gain = nan: expected inside"),
        (Choice("floor.b.stiff", prior_mean=9.5, prior_std=1.0), r"inside \(1, 9\)"),
        (Choice("share@full", fixed=(0.5, 0.5, 0.5)), "positive fractions that sum to 1"),
        (Choice("share@full", fixed=(1.2, -0.1, -0.1)), "positive fractions that sum to 1"),
        (Choice("share@full", start=(0.5, 0.5)), "2 values; expected 3"),
        (Choice("inner.place", start=(1.0, 2.0, 3.0)), "3 values; expected 2"),
        (Choice("inner.gain", fixed=0.0), r"inner\.gain = 0\.0: expected inside"),
        (Choice("inner.gain", prior_std=-1.0), r"inner\.gain: prior std -1\.0; expected one pos"),
        (Choice("inner.place", prior_std=(1.0, 1.0, 1.0)), r"one per element \(2\)"),
        (Choice("floor.a.creep", start=0.2, prior_mean=0.0, prior_std=0.1), r"inside \(0, inf\)"),
    ],
)
def test_values_outside_are_refused_by_name(tree, choice, message):
    with pytest.raises(ValueError, match=message):
        Space(tree, [choice])
