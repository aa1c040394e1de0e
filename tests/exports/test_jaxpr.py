"""Traced functions are read from every supported version of JAX, and from no other."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.exports.c99.builder import Names
from slipid.exports.c99.function import Argument, function, traced
from slipid.exports.c99.jaxpr import Params, ScanParameters, Traced, called
from slipid.support.errors import DataError

UNKNOWN = (
    rf"jax {jax.__version__} represents '?{{}}'? in a way .* does not support.*'jax>=0.10,<0\.\d+'"
)


class _Tree(tuple):
    """A stand-in for JAX's own trees of arguments."""

    def unpack(self):
        return tuple(self)


def _loop(x, y):
    """Two constants, two numbers that are carried, and rows that it goes through."""

    def turn(carry, row):
        return (carry[0] * x[0] + row, carry[1] + y[0]), row

    return jax.lax.scan(turn, (0.0, 1.0), x, length=3)[0]


def _scan():
    """The equation of that loop, as this version of JAX writes it."""
    like = jnp.ones(3), jnp.ones(3)
    (found,) = (e for e in traced(_loop, *like).jaxpr.eqns if e.primitive.name == "scan")
    return found


def _written(**form):
    """Parameters of that loop with other ones for the numbers of its arguments."""
    equation = _scan()
    kept = {k: equation.params[k] for k in ("jaxpr", "length", "reverse", "unroll")}
    return Params(equation.replace(params={**kept, **form}))


def _numbers(params):
    scan = ScanParameters.of(params)
    assert len(scan.body.jaxpr.invars) == 5
    return scan.turns, scan.constants, scan.carried


@pytest.mark.parametrize(
    "params",
    [
        pytest.param(lambda: Params(_scan()), id="of the installed version"),
        pytest.param(lambda: _written(num_consts=2, num_carry=2), id="of jax 0.10"),
        pytest.param(lambda: _written(ft_in=_Tree([(0, 0), (0, 0), (0,)])), id="since jax 0.11"),
    ],
)
def test_a_scan_is_read_the_same_from_every_form(params):
    assert _numbers(params()) == (3, 2, 2)


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"num_carry": 2},
        {"ft_in": 3},
        {"ft_in": _Tree([(0, 0), (0, 0)])},
        {"ft_in": _Tree([2, 2, 1])},
    ],
)
def test_an_unknown_form_of_a_scan_is_refused_with_the_versions_that_are_known(form):
    with pytest.raises(DataError, match=UNKNOWN.format("scan")):
        ScanParameters.of(_written(**form))


def test_a_parameter_that_is_missing_is_refused_in_the_same_words():
    equation = traced(lambda x: x @ x, jnp.ones(3)).jaxpr.eqns[0]
    with pytest.raises(DataError, match=UNKNOWN.format("dot_general")):
        Params(equation.replace(params={}))["dimension_numbers"]


def test_a_function_is_read_with_its_constants_and_refused_without():
    found = traced(lambda x: x + np.arange(3.0), jnp.ones(3))
    assert len(found.constants) == len(found.jaxpr.constvars)
    closed = SimpleNamespace(jaxpr=found.jaxpr, consts=found.constants)
    assert Traced.of(closed) == found
    for other in (None, SimpleNamespace(jaxpr=found.jaxpr, consts=[*found.constants, 1.0])):
        with pytest.raises(DataError, match=UNKNOWN.format("functions")):
            Traced.of(other)
    with pytest.raises(DataError, match=UNKNOWN.format("functions")):
        called(_written(jaxpr=None))


def test_the_export_says_so_instead_of_ending_in_a_traceback(monkeypatch):
    made_of = Params.__init__

    def bare(self, equation):
        made_of(self, equation)
        if self._primitive == "scan":
            self.clear()
            self.update(without)

    def run(x):
        return jax.lax.fori_loop(0, 3, lambda k, c: c * x[0], x[1])

    without = _written()
    monkeypatch.setattr(Params, "__init__", bare)
    arguments = [Argument.plain("x", (3,)), Argument.plain("y", (), False, True)]
    with pytest.raises(DataError, match=UNKNOWN.format("scan")):
        function(Names(), "f", arguments, run)
