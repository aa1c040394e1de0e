"""Time of one control step, dispatch included, and of rollouts beside their twin in C.

Every measurement has a process of its own: checks of types and shapes, which the suite switches on
at import, would be measured too.
"""

from __future__ import annotations

import ctypes
import itertools
import shutil
import subprocess
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.quick import QUICK, quick

TWIN = Path(__file__).with_name("twin.c")
STEPS, SECONDS = quick((1_000_000, 120.0), (300, 20.0))
BARS = {"contact": 100.0, "contact_map": 200.0, "slip_odometry": 15.0}
"""Medians to stay below [us], of rows of `slipid trial`."""


def alone(function, *given):
    """Result of a function in a fresh process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *given).result()


def deployed():
    """A robot of three omni wheels on three floors; JAX is started here, one core, float64."""
    import os

    os.environ["JAX_PLATFORMS"] = "cpu"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    import equinox as eqx
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    jax.config.update("jax_enable_compilation_cache", False)  # the time to compile is told too
    import jax.numpy as jnp

    from slipid.model.geometry import omni
    from slipid.model.robot import build
    from tests.helpers.known_robot import deploy_known

    made = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ("a", "b", "c"))
    numbers = ([0.3, 0.45, 0.6], [0.2, 0.4, 0.9], [0.12, 0.25, 0.4])
    made = eqx.tree_at(
        lambda r: (r.surfaces.friction, r.surfaces.creep, r.surfaces.roller_drag),
        made,
        [jnp.asarray(v) for v in numbers],
    )
    return deploy_known(made, highest_speed=13.0)


# one step ------------------------------------------------------------------------------------


def steps_of(kind):
    """Times of steps and of an empty call in turns [us], and the time to compile [s]."""
    f = deployed()
    import jax
    import jax.numpy as jnp

    from slipid.data.floor_map import patchwork
    from slipid.deploy.controllers import control_loop_of
    from slipid.deploy.floors import floor_of
    from slipid.lab.trial.controllers import ROWS
    from slipid.robot.trajectory import rectangle
    from tests.helpers.compiled_loop import CompiledLoop

    patches = floor_of(patchwork(f.labels, 7, patch=0.35, half=2.0), f.labels)
    control_loop = control_loop_of(f, ROWS[kind], floor=patches)
    rng, compiled = np.random.default_rng(0), CompiledLoop(control_loop, rectangle())
    speed = np.asarray(f.forward @ jnp.array([0.2, 0.05, 0.1]) / f.frame.radius)
    sensed = compiled.measurements
    readings = np.full((1000, sensed.size), np.nan)
    speeds = speed + rng.normal(size=(1000, 3)) * 0.3
    readings[:, sensed.place("wheel_angle")] = np.cumsum(0.05 * speeds, axis=0)
    readings[:, sensed.place("current")] = np.abs(rng.normal(0.4, 0.1, (1000, 3)))
    readings[:, sensed.place("gyro")] = rng.normal(0.1, 0.004, (1000, 1))
    step, state, began = compiled.call, compiled.init(), time.perf_counter()
    state, _ = step(state, readings[0], 0.05)
    compiling, took, end = time.perf_counter() - began, [], time.perf_counter() + SECONDS
    empty, nothing = jax.jit(lambda x: x + 1.0), []
    np.asarray(empty(state))
    for row in itertools.cycle(readings):
        start = time.perf_counter()
        state, _ = step(state, row, 0.05)
        took.append(time.perf_counter() - start)
        if len(took) % 100 == 0:
            start = time.perf_counter()
            np.asarray(empty(state))
            nothing.append(time.perf_counter() - start)
        if len(took) == STEPS or start > end:
            break
    return 1e6 * np.array(took), 1e6 * float(np.median(nothing)), compiling


@pytest.mark.parametrize("kind", BARS)
def test_one_step(kind):
    took, nothing, compiling = alone(steps_of, kind)
    middle, high, higher = np.percentile(took, [50, 99, 99.9])
    print(
        f"\n{kind}: {len(took)} steps, median {middle:.1f} us ({middle / BARS[kind]:.2f} of the bar"
        f" of {BARS[kind]:.0f}), 99 % {high:.1f}, 99.9 % {higher:.1f}, least {took.min():.1f}; an"
        f" empty call {nothing:.1f}; compiled in {compiling:.1f} s"
    )
    # no time is asserted; a tail needs steps
    assert QUICK or len(took) >= 10_000


# rollouts ------------------------------------------------------------------------------------


def rollouts(folder, robots, steps):
    """Best times [s] of the same rollouts, in turns, and the largest difference from C's.

    Robots on all combinations of floors follow wheel speeds of their own: contact settles from the
    step before, motor work is summed, the pose moves on.
    """
    f = deployed()
    import jax
    import jax.numpy as jnp

    from slipid.model import contact
    from slipid.model.contact_balance import stand
    from slipid.model.se2 import advance, compose

    every = np.array(list(itertools.product(range(3), repeat=3)))
    index = every[np.arange(robots) % len(every)]
    on = stand(f.frame, f.floors.at(index.T), f.rest)
    rng = np.random.default_rng(0)
    speed = 3 * rng.normal(size=(1, 3, robots)) + 0.2 * rng.normal(size=(steps, 3, robots)).cumsum(
        0
    )
    rims, dt = jnp.asarray(0.04 * speed), 0.05
    move = jax.vmap(lambda p, x: compose(p, advance(x, dt)), (-1, -1), -1)

    def ours(rims):
        def one(carry, rim):
            twist, pose, sum_ = carry
            twist, pull = contact.settle(twist, rim, rim, on, f.inverse)
            return (twist, move(pose, twist), sum_ + jnp.sum(pull**2, axis=0)), None

        start = (jnp.zeros((3, robots)), jnp.zeros((3, robots)), jnp.zeros(robots))
        return jax.lax.scan(one, start, rims)[0]

    # loops as slipid's commands have XLA write them, and as it does by default
    own = {"xla_cpu_use_fusion_emitters": False}
    fused = {"xla_cpu_use_fusion_emitters": True}
    ways = {
        "jax": jax.jit(ours, compiler_options=own),
        "fused": jax.jit(ours, compiler_options=fused),
    }

    library = Path(folder) / "twin.so"
    compiler = shutil.which("gcc") or shutil.which("cc")
    words = [compiler, "-O3", "-march=native", "-shared", "-fPIC", "-o", library, TWIN, "-lm"]
    subprocess.run(words, check=True)
    rollout = ctypes.CDLL(library).rollout
    one = [f.frame.hold, f.frame.roll, f.frame.shift, f.rest, f.inverse, f.frame.base]
    one = np.concatenate([np.asarray(x).ravel() for x in one])
    under = on.floor
    rows = [under.friction, under.creep, under.roller_drag, under.roller_creep]
    rows += [under.rolling_resistance, under.slide_viscosity, under.roller_viscosity]
    rows += [under.knee_width, under.scrub[None], under.lead[None]]
    columns = np.concatenate([np.asarray(x) for x in rows]).T
    table = np.ascontiguousarray(np.hstack([np.tile(one, (robots, 1)), columns]))
    flat = np.ascontiguousarray(np.asarray(rims).transpose(0, 2, 1))

    def theirs():
        twist, pose, total = np.zeros((robots, 3)), np.zeros((robots, 3)), np.zeros(robots)
        at = [x.ctypes.data_as(ctypes.c_void_p) for x in (flat, table, pose, twist, total)]
        counts = (steps, robots, contact.chord_steps(f.wheels), contact.SETTLE_NEWTON_STEPS)
        rollout(*counts, ctypes.c_double(dt), *at)
        return twist.T, pose.T, total

    ways = {name: lambda run=run: jax.block_until_ready(run(rims)) for name, run in ways.items()}
    ways["c"] = theirs
    took, found = {name: [] for name in ways}, {}
    for _ in range(6):  # the first is not counted: JAX compiles
        for name, run in ways.items():
            began = time.perf_counter()
            found[name] = run()
            took[name].append(time.perf_counter() - began)
    pairs = [zip(found[n], found["c"], strict=True) for n in ("jax", "fused")]
    apart = max(float(np.abs(a - b).max()) for pair in pairs for a, b in pair)
    return {name: min(times[1:]) for name, times in took.items()}, apart


@pytest.mark.skipif(not (shutil.which("gcc") or shutil.which("cc")), reason="no C compiler")
@pytest.mark.parametrize("robots", quick([27, 256, 1024], [27]))
def test_rollouts_beside_their_twin_in_c(tmp_path, robots):
    steps = quick(100_000, 1_000) // robots
    took, apart = alone(rollouts, str(tmp_path), robots, steps)
    each = {name: 1e9 * t / (steps * robots) for name, t in took.items()}
    print(
        f"\n{robots} robots, {steps} steps, ns a robot and step: C {each['c']:.0f}; JAX "
        f"{each['jax']:.0f}, ratio {took['jax'] / took['c']:.2f} (bar 2); with XLA's fusion "
        f"emitters {each['fused']:.0f}, ratio {took['fused'] / took['c']:.2f}; apart {apart:.1e}"
    )
    assert apart < 1e-4  # rounding may take a robot that spins its wheels to the other branch once
