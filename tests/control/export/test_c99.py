"""Generated C says what JAX says: every primitive, and whole steps of estimator and loop."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.control.closed_loop import PERIOD
from slipid.control.export.c99.code import Code, template
from slipid.control.export.c99.folder import c_files
from slipid.control.export.c99.lowering.builder import Names
from slipid.control.export.c99.lowering.function import Argument, function, traced
from slipid.control.export.c99.lowering.lower import UnsupportedError
from slipid.control.export.c99.lowering.text import table
from slipid.control.export.fields import described
from slipid.control.interface import Measurement
from slipid.control.trajectory import rectangle
from slipid.deploy.controllers import ROWS, pilot_of
from tests.control.test_estimator import SENSED, adversary
from tests.helpers import small_twin
from tests.helpers.c_against_jax import Batch, Source, differences, wander
from tests.helpers.compiled_c import NEEDS_COMPILER, QUICK, CompiledC, put, worst

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


def _swapped(x, y):
    def turn(k, c):
        return c[1], jnp.roll(c[0], 1) + 0.1 * c[2], c[0]

    return jax.lax.fori_loop(0, 5, turn, (x, y, x * y))


FUNCTIONS = {
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
    "signs of 0": (lambda x: 1 / jnp.where(x > 0, 0.0, -0.0), LANES),
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
        like = [jnp.ones(shape) for shape in shapes]
        functions.append(function(names, f"f{k}", "", arguments, traced(_real(run), *like)))
    reads = frozenset().union(*(f.reads for f in functions))
    tables = [line for m in names.tables.values() if m.name in reads for line in table(m)]
    head = [
        "#include <float.h>",
        "#include <math.h>",
        "#include <stdbool.h>",
        "#include <stdint.h>",
    ]
    text = [*head, "typedef double slipid_real;", template("prelude.c"), *tables]
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


@pytest.mark.parametrize("name", FUNCTIONS)
def test_c_has_the_numbers_of_jax(library, name):
    run, *shapes = FUNCTIONS[name]
    number = list(FUNCTIONS).index(name)
    outs = _arguments(_real(run), shapes)[1]
    rng = np.random.default_rng(number)
    for _ in range(20):
        given = [rng.normal(size=shape) for shape in shapes]
        found = called(library, number, outs, given)
        wanted = jax.tree.leaves(_real(run)(*map(jnp.asarray, given)))
        for got, want in zip(found, wanted, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["two numbers", "least", "truth", "functions", "reductions"])
def test_c_has_the_numbers_of_jax_where_some_are_none(library, name):
    run, *shapes = FUNCTIONS[name]
    number = list(FUNCTIONS).index(name)
    outs = _arguments(_real(run), shapes)[1]
    rng = np.random.default_rng(number)
    for _ in range(20):
        given = [rng.normal(size=shape) for shape in shapes]
        for x in given:
            broken = rng.random(x.shape) < 0.2
            x[broken] = rng.choice([np.nan, np.inf, -np.inf, 0.0], broken.sum())
        found = called(library, number, outs, given)
        wanted = jax.tree.leaves(_real(run)(*map(jnp.asarray, given)))
        for got, want in zip(found, wanted, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)


def test_a_primitive_without_a_form_in_c_is_refused_by_name_and_line():
    def bad(x):
        return jnp.sort(x)

    with pytest.raises(UnsupportedError, match=r"'sort' has no form in C .*'?add, "):
        function(Names(), "f", "", _arguments(bad, [LANES])[0], traced(bad, jnp.ones(N)))
    robot = small_twin.deployed()

    def own(x):
        return jnp.sort(robot.forward @ x) + robot.motor.current(jnp.cumsum(x), x)

    with pytest.raises(UnsupportedError, match="'sort'"):
        function(Names(), "f", "", _arguments(own, [SMALL])[0], traced(own, jnp.ones(3)))


@pytest.mark.parametrize(
    ("run", "said"),
    [
        (lambda x: x.at[np.array([1, 1])].add(1.0), "a place that is written twice"),
        (lambda x: x.at[jnp.argmin(x)].set(1.0), "places that are not known before"),
        (lambda x: x.at[jnp.argmin(x)].get(mode="fill"), "places out of range that are filled"),
        (lambda x: ~jnp.floor(x).astype(int), "of whole numbers"),
        (lambda x: x.astype(jnp.uint8), "numbers of type uint8"),
        (lambda x: jax.lax.integer_pow(x, 0), "a power of 0"),
        (lambda x: jax.lax.select_n(jnp.argmin(x) * jnp.ones(N, int), x, x, 2 * x), "two cases"),
        (lambda x: jax.lax.scan(lambda c, y: (c + y, c), 0.0, x)[1], "goes through an array"),
    ],
)
def test_what_would_be_other_numbers_in_c_is_refused(run, said):
    with pytest.raises(UnsupportedError, match=said):
        function(Names(), "f", "", _arguments(run, [LANES])[0], traced(run, jnp.ones(N)))


def test_a_product_with_a_constant_0_stops_what_is_no_number(library):
    """Unlike in JAX; no finite number differs by it."""
    number = list(FUNCTIONS).index("constants of few")
    (found,) = called(library, number, [SMALL], [np.array([np.nan, 2.0, 3.0])])
    np.testing.assert_array_equal(found, [np.nan, 2.0, 3.0])


# whole steps ---------------------------------------------------------------------------------


@cache
def code(row: str) -> Code:
    """Of a row of the trial for a small robot."""
    return Code(pilot_of(small_twin.deployed(1.0, 1.0, 0.3), ROWS[row]), rectangle())


@cache
def batches(row: str) -> list[Batch]:
    """Steps of 40 robots by JAX, half of whose sensors lie."""
    usual = wander(3)

    def draw(key, angle):
        one, other = jax.random.split(key)
        good, dt = usual(one, angle[:20])
        z, times, _ = adversary(other, 20, angle[20:])
        # JAX takes numbers that have no full precision for 0, C does not
        z, times = (jnp.where(jnp.abs(x) < 1e-300, 0.0, x) for x in (z, times))
        bad = jax.vmap(SENSED.unravel)(z)
        together = jax.tree.map(lambda *x: jnp.concatenate(x), good, bad)
        return together, jnp.concatenate([dt, times])

    steps = Source(code(row).pilot, draw, 40, 20)
    return [steps.next() for _ in range(3)]


@pytest.mark.slow
@pytest.mark.parametrize("row", ["contact_ahead", "torque"])
def test_a_step_is_that_of_jax(row, tmp_path):
    compiled = CompiledC(code(row), tmp_path)
    found = [differences(compiled, batch) for batch in batches(row)]
    every = {name: np.concatenate([f[name] for f in found]) for name in found[0]}
    for name, gaps in every.items():
        # where the balance is flat, what the last bits make of it is not small
        assert np.mean(gaps > 1e-12) < 0.005, name
        assert np.max(gaps) < 1e-7, name


@pytest.mark.slow
def test_a_step_in_float_is_near_that_of_jax(tmp_path):
    compiled = CompiledC(code("contact_ahead"), tmp_path, (*QUICK, "-DSLIPID_FLOAT"))
    found = differences(compiled, batches("contact_ahead")[0])
    usual = np.arange(len(found["said.twist"])) % 40 < 20
    assert np.quantile(found["said.twist"][usual], 0.9) < 1e-5
    assert np.max(found["said.pose"][usual]) < 1e-3


@pytest.mark.slow
def test_a_robot_starts_as_in_the_library(tmp_path):
    compiled = CompiledC(code("contact"), tmp_path)
    compiled.begin((0.3, -0.2, 1.1))
    begin = code("contact").pilot.init((0.3, -0.2, 1.1))
    assert max(worst(compiled.estimator, begin.seen).values()) == 0
    assert max(worst(compiled.controller, begin.held).values()) == 0


@pytest.mark.slow
def test_a_path_is_followed_as_in_the_library(tmp_path):
    made = code("contact")
    compiled, path, time = CompiledC(made, tmp_path), rectangle(), jnp.zeros(())
    preview = made.pilot.controller.gains.preview
    rng = np.random.default_rng(0)
    for _ in range(100):
        pose = np.asarray(path.at(time))[:3] + 0.04 * rng.normal(size=3)
        compiled.estimate["pose"] = pose
        compiled.follow(PERIOD)
        time, reference = path.follow(time, jnp.asarray(pose), PERIOD, preview)
        np.testing.assert_allclose(compiled.time, time, rtol=1e-13)
        np.testing.assert_allclose(compiled.reference, reference, atol=1e-13)


@pytest.mark.slow
def test_nothing_is_measured_where_nothing_is_filled_in(tmp_path):
    compiled = CompiledC(code("contact"), tmp_path)
    put(compiled.reading, Measurement(wheel_angle=np.ones(3)).filled(3))
    compiled._call("nothing", compiled.reading)
    assert all(np.isnan(compiled.reading[name]).all() for name in compiled.reading.dtype.names)


# the folder ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """C folder of a small robot."""
    place = tmp_path_factory.mktemp("c")
    for name, text in c_files(code("contact").pilot, rectangle()).items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    return place


def built(folder, out, *flags, compiler="cc"):
    """The folder's own test, built in some way."""
    strict = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
    sources = ("test/check.c", "src/slipid.c")
    command = [compiler, *strict, *flags, "-Isrc", "-o", str(out), *sources, "-lm"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("flags", [("-O0",), ("-O2",), ("-O2", "-DSLIPID_FLOAT")])
def test_it_compiles_without_a_warning_and_repeats_the_librarys_steps(
    folder, tmp_path, compiler, flags
):
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler}")
    done = built(folder, tmp_path / "check", *flags, compiler=compiler)
    assert done.returncode == 0, done.stderr
    said = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert said.returncode == 0, said.stdout
    assert re.search(r"48 steps, \d+ numbers each: largest difference", said.stdout)


@pytest.mark.slow
def test_the_folders_test_fails_where_a_number_is_another_one(folder, tmp_path):
    golden = (folder / "test/golden.h").read_text()
    head, _, rest = golden.partition("golden_command[GOLDEN_STEPS][SLIPID_WHEELS] = {")
    changed = re.sub(r"(\d\.\d{4})\d", lambda m: f"{m[1]}{(int(m[0][-1]) + 1) % 10}", rest, count=1)
    assert changed != rest
    shutil.copytree(folder, tmp_path / "c")
    (tmp_path / "c/test/golden.h").write_text(
        f"{head}golden_command[GOLDEN_STEPS][SLIPID_WHEELS] = {{{changed}"
    )
    assert built(tmp_path / "c", tmp_path / "check", "-O1").returncode == 0
    said = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert said.returncode == 1
    assert "command" in said.stdout


@pytest.mark.slow
def test_no_sanitizer_finds_anything(folder, tmp_path):
    flags = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    done = built(folder, tmp_path / "check", *flags)
    if done.returncode:
        pytest.skip("needs a compiler with sanitizers")
    said = subprocess.run([tmp_path / "check"], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("nm") is None, reason="needs nm")
def test_no_heap_and_no_globals(folder, tmp_path):
    made = tmp_path / "slipid.o"
    subprocess.run(["cc", "-O1", "-c", "-o", made, folder / "src/slipid.c"], check=True)
    lines = subprocess.run(["nm", made], capture_output=True, text=True, check=True).stdout
    symbols = [line.split()[-2:] for line in lines.splitlines()]
    assert {kind for kind, _ in symbols} <= {"T", "t", "r", "U"}  # code, constants, what is called
    called = {name for kind, name in symbols if kind == "U"}
    assert called <= {
        *("sqrt", "exp", "log", "sin", "cos", "sincos", "atan2", "pow", "fmod", "floor"),
        *("memcpy", "memset", "memmove", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"),
    }


@pytest.mark.slow
def test_parts_for_float_and_for_double_cannot_be_linked(folder, tmp_path):
    made, flags = tmp_path / "slipid.o", ["-std=c99", "-O0", "-DSLIPID_FLOAT"]
    subprocess.run(["cc", *flags, "-c", "-o", made, folder / "src/slipid.c"], check=True)
    command = [
        "cc",
        "-I",
        folder / "src",
        "-o",
        tmp_path / "x",
        folder / "test/check.c",
        made,
        "-lm",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "slipid_init" in done.stderr


@pytest.mark.slow
def test_a_clock_that_has_run_for_days_goes_on_in_float(tmp_path):
    """Nothing that grows with the time a robot has driven is kept."""
    compiled = CompiledC(code("contact"), tmp_path, (*QUICK, "-DSLIPID_FLOAT"))
    compiled.begin((0.0, 0.0, 0.0))
    compiled._call("nothing", compiled.reading)
    compiled.reading["wheel_speed"] = [3.0, 0.0, -3.0]
    for _ in range(20_000):
        compiled.observe(0.05)
    before = compiled.estimator
    for name in ("place_noise", "place_far", "place_still", "wheels_age"):
        assert np.max(np.abs(before[name])) < 1.0, name
    ages = before["place_history"].reshape(-1, 15)[:, 0]
    np.testing.assert_allclose(ages, 0.05 * np.arange(len(ages)), rtol=1e-4)


def test_every_field_has_a_unit():
    plain = {f.name for s in code("contact").structs for f in s.fields if f.comment.endswith("[1]")}
    assert plain == {
        *("floors_belief", "floors_expected", "place_toward", "begun", "slip"),
        *("surface_probability", "believed_probability", "stale", "immobilised", "out_of_range"),
    }


def test_a_docstring_says_what_each_attribute_is():
    said = described(Measurement)
    assert said["gyro"] == "yaw rate [rad/s]"
    assert said["fix_std"].startswith("of its place [m] and of its heading [rad]")
    assert set(said) == set(vars(Measurement()))


@pytest.mark.slow
def test_the_loop_closes_in_c_as_it_does_in_the_library(tmp_path):
    from slipid.deploy.export import Place, Wish, recorded
    from slipid.deploy.trial_site import site, starts

    made = code("contact")
    path = rectangle(length=0.4, width=0.2)
    loop = Code(made.pilot, path)
    compiled = CompiledC(loop, tmp_path)
    robot = made.pilot.controller.robot
    floor = site(robot)
    place = Place(floor, starts(20, floor, path)[0], (0.0, 0.0, 0.0))
    kept = recorded(robot, made.pilot, path, Wish(), place)
    compiled.begin((0.0, 0.0, 0.0))
    numbers = [f.size for f in loop.reading.fields]
    for row, command, time in zip(kept.given, kept.command, kept.time, strict=True):
        parts = np.split(row[1:], np.cumsum(numbers)[:-1])
        for field, part in zip(loop.reading.fields, parts, strict=True):
            compiled.reading[field.name] = part.reshape(field.shape)
        compiled.observe(row[0])
        compiled.follow(row[0])
        compiled.control(row[0])
        np.testing.assert_allclose(compiled.command, command, atol=1e-9)
        np.testing.assert_allclose(compiled.time, time, atol=1e-9)
    assert kept.time[-1] > path.duration - 1e-6
