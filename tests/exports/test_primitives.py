"""Generated C says what JAX says, primitive by primitive."""

from __future__ import annotations

import ctypes
import subprocess
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.exports.c99.builder import Names
from slipid.exports.c99.function import Argument, function
from slipid.exports.c99.lower import UnsupportedError
from slipid.exports.c99.text import table
from slipid.exports.text import template
from slipid.model.motor import Motor
from slipid.robot.trajectory import SHAPES, tangent
from tests.helpers import small_twin
from tests.helpers.compiled_c import NEEDS_COMPILER, QUICK

pytestmark = NEEDS_COMPILER

N = 12
SMALL, LANES, WIDE, SQUARE = (3,), (N,), (N, 3), (N, N)


def _loop(x):
    return jax.lax.fori_loop(1, 4, lambda k, c: c - jnp.outer(c[:, k], c[k]) / (2 + k), x)


def _branch(flag, x, y):
    return jax.lax.cond(flag[0] > 0, lambda: (x @ y, x), lambda: (x * 2, y[::-1]))


def _kept(x):
    """What is made before a loop is read in every turn of it, beside much that comes and goes."""
    q = jnp.sin(x) * 2 / jnp.sum(x * x)

    def turn(k, c):
        t = jnp.cos(c + jnp.sum(c * q))
        v = jnp.sin(t + jnp.sum(t))
        return v / jnp.sum(v * v) + 0.1 * c

    return jax.lax.fori_loop(0, 3, turn, x)


def _kept_in_branches(x):
    q = jnp.sin(x) * 2 / jnp.sum(x * x)

    def turn(k, c):
        def one():
            t = jnp.cos(c + jnp.sum(c * q))
            return t / jnp.sum(t * t) + 0.1 * c

        def other():
            t = jnp.sin(c + 1)
            return jnp.sin(t + jnp.sum(t)) * q

        return jax.lax.cond(jnp.sum(c) > 0.2, one, other)

    return jax.lax.fori_loop(0, 4, turn, x) + q


BRUSHES = Motor(
    **{
        f"brush_{k}": jnp.asarray(x)
        for k, x in (("drop", 0.4), ("current", 0.2), ("shape", 0.5), ("tail", 0.2))
    },
    gear_ratio=16.0,
)
LAP = tangent(SHAPES["clothoid"](1.0))


def _followed(x, y):
    """A path at some time, beside which a robot stands that has turned."""
    time = 5 * jnp.abs(y[0])
    beside = 0.03 * x * jnp.array([1.0, 1.0, 8.0])
    return LAP.follow(time, LAP.at(time)[:3] + beside, 0.05, 0.2, 0.2)


def _swapped(x, y):
    def turn(k, c):
        return c[1], jnp.roll(c[0], 1) + 0.1 * c[2], c[0]

    return jax.lax.fori_loop(0, 5, turn, (x, y, x * y))


def _made_in_turns(x):
    def turn(k, c):
        v = jnp.sin(c)
        return v[0] * jnp.cos(v[1]) + 0.1 * v + x[k] * x

    return jax.lax.fori_loop(0, 4, turn, x)


def _read_late(x):
    """Of two arrays alike the first is read once more after the second has been filled."""
    first = jnp.stack([x[k] * x[k - 1] for k in range(N)])
    k = jnp.argmin(x)
    second = jnp.stack([x[j] * (k + j) for j in range(N)])
    return second[k] - jnp.sin(first[k])


def _carried_places(x):
    def turn(k, c):
        return (c[0] + 1) % N, jnp.take(x, c[0], mode="clip") + 0.1 * c[1]

    return jax.lax.fori_loop(0, 3, turn, (jnp.floor(jnp.abs(3 * x)).astype(int) % N, x))[1]


def _across_rows(a, x):
    rows, columns = np.arange(N) // 6, (6 + np.arange(N)) % N
    return [a[rows, columns], jnp.concatenate([x[np.array([0, 1, 3, 7, 2, 9])], jnp.sin(x)])]


FUNCTIONS = {
    "made in turns": (_made_in_turns, LANES),
    "carried places": (_carried_places, LANES),
    "read late": (_read_late, LANES),
    "across rows": (_across_rows, SQUARE, LANES),
    "kept over turns": (_kept, LANES),
    "kept over branches": (_kept_in_branches, LANES),
    "swapped": (_swapped, LANES, LANES),
    "a number over many": (lambda x, y: [jnp.tanh(x[0]) / y, jnp.tanh(y) / x[0]], SMALL, LANES),
    "whole numbers reduced": (
        lambda x: [
            jnp.max(jnp.floor(9 * x).astype(int)),
            jnp.min(jnp.floor(9 * x).astype(int)),
            jnp.prod(jnp.where(x > 0, 1, 2)),
            jnp.sum(jnp.where(x > 0, 1, 2)),
        ],
        LANES,
    ),
    "signs of 0": (
        lambda x: [
            1 / jnp.where(x > 0, 0.0, -0.0),
            1 / jnp.where(x > 9, x, jnp.array([0.0, -0.0] * (N // 2))),
        ],
        LANES,
    ),
    "large": (lambda x: jnp.minimum(1e305, jnp.where(x > 0, 1e301, 2.0)), LANES),
    "arithmetic": (lambda x, y: x + y * x - x / (3 + y * y), SMALL, SMALL),
    "arithmetic of lanes": (lambda x, y: -(x + y * x - x / (3 + y * y)), LANES, LANES),
    "broadcast": (lambda x, y: x[:, None] * y[None, :] + x[0], SMALL, LANES),
    "functions": (
        lambda x: (
            *(jnp.sin(x), jnp.cos(x), jnp.exp(x), jnp.log(jnp.abs(x)), jnp.sqrt(jnp.abs(x))),
            *(jnp.floor(x), jnp.sign(x), jax.lax.rsqrt(1 + x * x), jnp.abs(x) ** 1.3, x**3, x**-2),
        ),
        LANES,
    ),
    "two numbers": (
        lambda x, y: [jnp.arctan2(x, y), jax.lax.rem(x, y), jnp.maximum(x, y), jnp.minimum(x, y)],
        LANES,
        LANES,
    ),
    "tangents": (
        lambda x, y: [jnp.tanh(9 * x), jnp.tanh(x) / y, jnp.tanh(x * y) / 3],
        LANES,
        LANES,
    ),
    "tangents of few": (lambda x, y: [jnp.tanh(30 * x), jnp.tanh(1e-9 * x) / y], SMALL, SMALL),
    "truth": (
        lambda x, y: [
            jnp.where((x > 0) & ~(y > x) | (x == y), x, y),
            ((x >= 0) != (y <= 0)).astype(float),
            jnp.where(jnp.isfinite(x / y) & (x < y), 1.0, 2.0),
        ],
        LANES,
        LANES,
    ),
    "truth after a loop": (lambda x: jnp.where(x > jnp.mean(x), x - jnp.sum(x), x), LANES),
    "whole numbers": (
        lambda x: jnp.floor(4 * x).astype(int) % 3 + jnp.minimum(jnp.floor(x).astype(int), 1),
        LANES,
    ),
    "reductions": (
        lambda x: [jnp.sum(x), jnp.prod(x, axis=1), jnp.max(x, axis=0), jnp.min(x), jnp.sum(x, 0)],
        WIDE,
    ),
    "reductions of truth": (
        lambda x: [jnp.all(x > -9) * 1.0, jnp.any(x > 1, axis=0) * 1.0, jnp.any(x > 9) * 1.0],
        WIDE,
    ),
    "least": (lambda x: jnp.argmin(jnp.abs(x)) * 1.0, LANES),
    "least of few": (
        lambda x, y: [jnp.argmin(y) * 1.0, jnp.argmin(jnp.concatenate([x[:5], y])) * 1.0],
        LANES,
        SMALL,
    ),
    "softmax": (jax.nn.softmax, LANES),
    "vectors": (lambda x, y: [x @ y, jnp.outer(x, y)], LANES, LANES),
    "matrices": (lambda a, b: [a @ b, b.T @ a, b.T @ b, a @ a], SQUARE, WIDE),
    "small matrices": (lambda a: [a[:3] @ a[3:6], a[:3] @ a[3:6].T, a[0] @ a[:3]], WIDE),
    "batches": (lambda a, b: jnp.einsum("nk,nk->n", a, b), WIDE, WIDE),
    "products of several": (lambda a, b: jnp.einsum("c,wac,vac->wv", a, b, b), LANES, (3, 2, N)),
    "constants": (lambda x: jnp.eye(N)[:3] @ x + jnp.arange(3.0), LANES),
    "constants of few": (lambda x: jnp.eye(3) @ x, SMALL),
    "transposed": (lambda a: 0.5 * (a + a.T) - a.T[::-1], SQUARE),
    "moves": (
        lambda a: [
            jnp.roll(a, 1, axis=0).at[0].set(a[3]),
            jnp.concatenate([a[2:5], a[:2], a[-1:]]),
            jnp.stack([a[:, 0], a[:, 2]], axis=1),
            jnp.pad(a[:3, 1], (1, 2)),
            a.reshape(-1)[5:29],
            a[np.array([3, 1, 1, 0])],
            a.T.reshape(3, 2, -1),
        ],
        WIDE,
    ),
    "places": (
        lambda a, x: [
            a.at[:, 1:].add(a[:, :2]),
            a.at[2].set(x),
            x.at[1].multiply(3.0),
            a.at[np.array([4, 1])].set(0.0),
        ],
        WIDE,
        SMALL,
    ),
    "places at run time": (
        lambda a, x: [
            a[jnp.argmin(a[:, 0])],
            a[jnp.clip((3 * x).astype(int), 0, 11)],
            jax.lax.dynamic_slice(a, ((9 * x[0]).astype(int), 0), (4, 3)),
            jnp.arange(40.0)[jnp.floor(20 + 9 * a[:, 1]).astype(int)],
        ],
        WIDE,
        SMALL,
    ),
    "a path that waits": (_followed, SMALL, SMALL),
    "brushes": (lambda u, w: BRUSHES.current_at(u, w), SMALL, SMALL),
    "several times": (_loop, SQUARE),
    "one or the other": (_branch, SMALL, SQUARE, SQUARE),
}


def _arguments(run, shapes):
    outs = jax.tree.leaves(jax.eval_shape(run, *(jax.ShapeDtypeStruct(s, float) for s in shapes)))
    given = [Argument.plain(f"x{k}", shape) for k, shape in enumerate(shapes)]
    found = [Argument.plain(f"y{k}", out.shape, False, True) for k, out in enumerate(outs)]
    return [*given, *found], [out.shape for out in outs]


def _real(run):
    return lambda *x: [jnp.asarray(y, float) for y in jax.tree.leaves(run(*x))]


@cache
def _library(folder: Path) -> ctypes.CDLL:
    """All functions above in one library."""
    names, functions = Names(), []
    for k, (run, *shapes) in enumerate(FUNCTIONS.values()):
        arguments, _ = _arguments(_real(run), shapes)
        functions.append(function(names, f"f{k}", arguments, _real(run)))
    return _compiled(names, functions, folder)


def _compiled(names: Names, functions, folder: Path) -> ctypes.CDLL:
    reads = frozenset().union(*(f.reads for f in functions))
    tables = [line for m in names.tables.values() if m.name in reads for line in table(m)]
    head = [f"#include <{name}.h>" for name in ("float", "math", "stdbool", "stdint")]
    text = [*head, "typedef double slipid_real;", template("c99/prelude.c"), *tables]
    text += [line for f in functions for line in (f"{f.head};", *f.text)]
    (folder / "all.c").write_text("\n".join(text))
    flags = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-shared", "-fPIC")
    command = ["cc", *QUICK, *flags, "-o", "all.so", "all.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "all.so"))


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return _library(tmp_path_factory.mktemp("functions"))


def called(library, number, shapes, given):
    """Results of a function of the library."""
    found = [np.full(shape, 77.0) for shape in shapes]
    parts = [*(np.ascontiguousarray(x, float) for x in given), *found]
    pointers = [
        a.ctypes.data_as(ctypes.c_void_p) if a.shape or a is found[0] or k >= len(given) else a
        for k, a in enumerate(parts)
    ]
    getattr(library, f"f{number}")(*pointers)
    return found


def same(library, name, given):
    """Compare 20 results of a function of the library with those of JAX."""
    run, *shapes = FUNCTIONS[name]
    number = list(FUNCTIONS).index(name)
    outs = _arguments(_real(run), shapes)[1]
    rng = np.random.default_rng(number)
    for _ in range(20):
        numbers = [given(rng, shape) for shape in shapes]
        found = called(library, number, outs, numbers)
        wanted = jax.tree.leaves(_real(run)(*map(jnp.asarray, numbers)))
        for got, want in zip(found, wanted, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_c_has_the_numbers_of_jax(library, name):
    same(library, name, lambda rng, shape: rng.normal(size=shape))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two numbers", "least", "truth", "functions", "reductions"])
def test_c_has_the_numbers_of_jax_where_some_are_none(library, name):
    def broken(rng, shape):
        x, off = rng.normal(size=shape), rng.random(shape) < 0.2
        x[off] = rng.choice([np.nan, np.inf, -np.inf, 0.0], off.sum())
        return x

    same(library, name, broken)


def text_of(run, *shapes):
    """Body of a function in C."""
    made = function(Names(), "f", _arguments(run, shapes)[0], run)
    return "\n".join(made.lines)


def test_what_is_the_same_in_every_turn_is_computed_once():
    def run(x, y):
        return jax.lax.scan(lambda c, _: (jnp.cos(c) * jnp.sin(x), None), y, length=5)[0]

    before, loop, after = text_of(run, LANES, LANES).partition("turn < 5")
    assert loop
    assert "r_sin" in before
    assert "r_sin" not in after
    assert "r_cos" in after


def test_what_only_a_branch_needs_is_computed_there():
    def run(x, y):
        return jax.lax.cond(y[0] > 0, lambda: jnp.sin(x), lambda: x)

    before, branch, after = text_of(run, LANES, LANES).partition("if (")
    assert branch
    assert "r_sin" not in before
    assert "r_sin" in after


def test_long_constants_are_copied_in_a_loop():
    assert text_of(lambda: jnp.zeros((N, 2))).count("=") < N
    assert text_of(lambda: jnp.arange(1.0 * N)).count("=") < N


def test_arguments_that_are_filled_in_place_are_read_first(tmp_path):
    names = Names()
    arguments = [Argument.plain(name, LANES, True, True) for name in ("x", "y")]
    made = function(names, "f", arguments, lambda x, y: [y[::-1], x])
    x, y = np.arange(1.0 * N), np.arange(1.0 * N) ** 2
    pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (x, y)]
    _compiled(names, [made], tmp_path).f(*pointers)
    np.testing.assert_array_equal(x, np.arange(1.0 * N)[::-1] ** 2)
    np.testing.assert_array_equal(y, np.arange(1.0 * N))


def test_a_primitive_without_a_form_in_c_is_refused_by_name_and_line():
    def bad(x):
        return jnp.sort(x)

    with pytest.raises(UnsupportedError, match=r"'sort' has no form in C .*'?add, "):
        function(Names(), "f", _arguments(bad, [LANES])[0], bad)
    robot = small_twin.deployed()

    def own(x):
        return jnp.sort(robot.forward @ x) + robot.motor.current(jnp.cumsum(x), x)

    with pytest.raises(UnsupportedError, match="'sort'"):
        function(Names(), "f", _arguments(own, [SMALL])[0], own)


@pytest.mark.parametrize(
    ("run", "reason"),
    [
        (lambda x: x.at[np.array([1, 1])].add(1.0), "an index that occurs twice"),
        (lambda x: x.at[jnp.argmin(x)].set(1.0), "indices that are not constant"),
        (lambda x: x.at[jnp.argmin(x)].get(mode="fill"), "indices out of range give"),
        (lambda x: ~jnp.floor(x).astype(int), "for integers"),
        (lambda x: jnp.abs(jnp.floor(x).astype(int)), "for integers"),
        (lambda x: jnp.bitwise_and.reduce(jnp.floor(x).astype(int)), "for integers"),
        (lambda x: x.astype(jnp.uint8), "numbers of type uint8"),
        (lambda x: x.astype(jnp.float32), "numbers of type float32"),
        (lambda x: jax.lax.integer_pow(x, 0), "an exponent of 0"),
        (lambda x: jax.lax.select_n(jnp.argmin(x) * jnp.ones(N, int), x, x, 2 * x), "two cases"),
        (lambda x: jax.lax.scan(lambda c, y: (c + y, c), 0.0, x)[1], "a scan over an array"),
    ],
)
def test_operations_with_other_results_in_c_are_refused(run, reason):
    with pytest.raises(UnsupportedError, match=reason):
        function(Names(), "f", _arguments(run, [LANES])[0], run)


def test_a_product_with_a_constant_0_stops_what_is_no_number(library):
    """Unlike in JAX; no finite number differs by it."""
    number = list(FUNCTIONS).index("constants of few")
    (found,) = called(library, number, [SMALL], [np.array([np.nan, 2.0, 3.0])])
    np.testing.assert_array_equal(found, [np.nan, 2.0, 3.0])
