"""A small tree of declared numbers: bounds of every kind, a stack of floors, shares per load."""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from slipid.parameter import Declaration, parameter


def declaration(lower=-math.inf, upper=math.inf, **ties):
    return Declaration(unit="1", symbol="x", start=1.0, lower=lower, upper=upper, **ties)


class Inner(eqx.Module):
    gain: Array = parameter(unit="V", symbol="g", start=2.0, lower=0.0, spread=0.7)
    place: Array = parameter(unit="m", symbol="p", start=0.0, spread=0.1)


class Floors(eqx.Module):
    creep: Array = parameter(unit="1", symbol="s", start=0.3, lower=0.0, closed=True)
    stiff: Array = parameter(unit="1", symbol="k", start=5.0, lower=1.0, upper=9.0, free=False)
    labels: tuple[str, ...] = eqx.field(static=True, default=())


class Tree(eqx.Module):
    inner: Inner
    floors: Floors = eqx.field(metadata={"path": "floor"})
    share: Array = parameter(
        unit="1", symbol="N", start=1 / 3, shares=True, per="loads", spread=0.5
    )
    loads: tuple[str, ...] = eqx.field(static=True, default=("full", "empty"))


def declared_tree():
    return Tree(
        inner=Inner(place=jnp.zeros(2)),
        floors=Floors(creep=jnp.array([0.1, 0.2]), stiff=jnp.array([4.0, 6.0]), labels=("a", "b")),
        share=jnp.full((2, 3), 1 / 3),
    )
