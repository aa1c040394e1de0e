"""Declared numbers: conversion between SI and search space, and names."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.parameter import entries, share_basis
from tests.helpers.declared import declaration, declared_tree

BIJECTIONS = {
    "unbounded": (declaration(), [-1e6, -0.3, 0.0, 2.0, 1e6]),
    "positive": (declaration(lower=0.0), [1e-9, 0.05, 1.0, 5.3, 1e6]),
    "above two": (declaration(lower=2.0), [2.001, 3.0, 1e4]),
    "between": (declaration(lower=-1.0, upper=3.0), [-0.9999, 0.0, 1.0, 2.9999]),
}


# bijections


@pytest.mark.parametrize("name", BIJECTIONS)
def test_si_to_search_and_back_is_the_identity(name):
    d, values = BIJECTIONS[name]
    np.testing.assert_allclose(
        d.to_si(jnp.asarray(d.to_search(values))), values, rtol=1e-9, atol=1e-12
    )


@pytest.mark.parametrize("name", [*BIJECTIONS, "shares", "deviation"])
def test_numpy_and_jax_say_the_same_of_one_and_of_many(name):
    tied = {n: declaration(**{n: True}) for n in ("shares", "deviation")}
    d = tied[name] if name in tied else BIJECTIONS[name][0]
    z = np.random.default_rng(0).normal(scale=3.0, size=(50, 2))
    many = d.to_si(z)
    assert isinstance(many, np.ndarray)
    np.testing.assert_allclose(many, d.to_si(jnp.asarray(z)), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(many[7], d.to_si(z[7]), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", BIJECTIONS)
def test_search_to_si_stays_inside_the_bounds(name):
    d, _ = BIJECTIONS[name]
    z = jnp.linspace(-30.0, 30.0, 61)
    values = np.asarray(d.to_si(z))
    assert (values >= d.lower).all()
    assert (values <= d.upper).all()
    assert (np.diff(values) >= 0).all()


@pytest.mark.parametrize("name", BIJECTIONS)
def test_slope_is_the_derivative_of_the_bijection(name):
    d, values = BIJECTIONS[name]
    for value in values:
        z = float(d.to_search(value)[0])
        exact = jax.grad(lambda z, d=d: d.to_si(z[None])[0])(jnp.asarray(z))
        assert d.slope(value) == pytest.approx(float(exact), rel=1e-7)


@pytest.mark.parametrize("wheels", [2, 3, 4, 5])
def test_shares_round_trip_are_positive_and_sum_to_one(wheels):
    rng = np.random.default_rng(wheels)
    d = declaration(shares=True)
    for _ in range(20):
        share = rng.dirichlet(np.full(wheels, 2.0))
        z = d.to_search(share)
        assert z.shape == (wheels - 1,)
        np.testing.assert_allclose(d.to_si(jnp.asarray(z)), share, rtol=1e-10)
    far = np.asarray(d.to_si(jnp.asarray(rng.normal(0, 30, wheels - 1))))
    assert (far >= 0).all()
    assert far.sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("wheels", [2, 3, 4, 6])
def test_share_basis_is_orthonormal_and_sums_to_zero(wheels):
    basis = share_basis(wheels)
    np.testing.assert_allclose(basis.T @ basis, np.eye(wheels - 1), atol=1e-14)
    np.testing.assert_allclose(np.ones(wheels) @ basis, 0.0, atol=1e-14)


def test_no_wheel_is_favoured_by_the_prior_of_shares():
    d = declaration(shares=True)
    draws = np.random.default_rng(0).normal(0.0, 0.5, (20000, 2))
    share = np.asarray(jax.vmap(d.to_si)(jnp.asarray(draws)))
    np.testing.assert_allclose(share.mean(0), 1 / 3, atol=5 * share.std() / math.sqrt(len(share)))
    np.testing.assert_allclose(share.std(0), share.std(), rtol=0.03)


# names


def test_every_number_has_one_path():
    tree = declared_tree()
    assert [e.path for e in entries(tree)] == [
        "inner.gain",
        "inner.place",
        "floor.a.creep",
        "floor.b.creep",
        "floor.a.stiff",
        "floor.b.stiff",
        "share@full",
        "share@empty",
    ]
    assert {e.path: e.coordinates for e in entries(tree)}["share@full"] == 2


def test_paths_of_the_contract():
    robot = build(
        omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["gray"], ("as_built", "moved"), ("one",)
    )
    paths = [e.path for e in entries(robot)]
    assert len(set(paths)) == len(paths)
    for path in (
        "motor.resistance",
        "motor.back_emf",
        "robot.load_share@as_built",
        "robot.load_share@moved",
        "robot.mass_ratio@moved",
        "robot.wheel_radius",
        "robot.drive_offset",
        "surface.gray.creep",
        "camera.scale",
        "camera.lag",
        "camera.session_yaw@one",
    ):
        assert path in paths


def test_every_declaration_has_a_unit_and_starts_inside_its_bounds():
    robot = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["gray"], sessions=("one",))
    for e in entries(robot):
        d = e.declaration
        assert d.unit
        assert d.symbol
        assert d.doc
        assert d.lower < d.start < d.upper
        assert d.spread > 0
        value = np.asarray(e.get(robot))
        assert ((value > d.lower) & (value < d.upper)).all(), e.path


def test_a_fixed_value_may_be_the_bound_of_a_closed_range():
    zero = np.zeros(1)
    closed = declaration(lower=0.0, closed=True)
    assert closed.broken_rule(zero, fixed=True) is None
    assert closed.broken_rule(zero) == "inside (0, inf) 1"
    assert closed.broken_rule(-zero - 1.0, fixed=True) == "inside [0, inf) 1"
    assert declaration(lower=0.0).broken_rule(zero, fixed=True) == "inside (0, inf) 1"
