"""Paths on twins drawn from a fit's posterior: what closes, what limits it, and flawed maps.

    SLIPID_FIT=demo_out/result .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_loop.py

Needs a folder `slipid identify` wrote. Every start has another robot, other noise and another
gyro; all starts of a row are rolled out together. Rows that are told something true get it as a
pose fix in every step, or drive with the true numbers. A flawed map has a tenth of its patches
wrong, or lies 30 mm beside the floor, another way for every start.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.benchmarks.quick import QUICK, quick

STARTS, SEED = quick(60, 2), 9000
STEPS = quick(960, 40)
"""Of a rollout; `slipid trial` gives a run up no later."""


class Row(NamedTuple):
    """A row of the trial, whether it has a gyro, and what it is told beside its readings.

    It may be told the floors under its wheels, or have encoders without ticks. Its map, where it
    has one, may be flawed: `tenth` or `shift`.
    """

    name: str = "contact"
    gyro: bool = False
    numbers: bool = False
    place_std: float = np.nan
    heading_std: float = np.nan
    flaw: str = ""
    floors: bool = False
    smooth: bool = False


ROWS = {
    "encoders": Row("encoder"),
    "contact": Row(),
    "gyro": Row(gyro=True),
    "map": Row("contact_map"),
    "map and gyro": Row("contact_map", gyro=True),
    "map, a tenth wrong": Row("contact_map", flaw="tenth"),
    "map, 30 mm beside": Row("contact_map", flaw="shift"),
    "told the numbers": Row(numbers=True),
    "told the floors": Row("contact_map", floors=True),
    "told floors and numbers": Row("contact_map", floors=True, numbers=True),
    "perfect encoders": Row(smooth=True),
    "told the heading": Row(place_std=10.0, heading_std=1e-3),
    "told the pose": Row(place_std=1e-3, heading_std=1e-3),
    "gyro, told the numbers": Row(gyro=True, numbers=True),
    "map, told the numbers": Row("contact_map", numbers=True),
}
KINDS = quick(tuple(ROWS), ("encoders", "map, a tenth wrong", "told the floors", "told the pose"))
"""Rows that are driven."""


def test_what_closes_and_what_limits_it(robot):
    from slipid.robot import trajectory

    path = trajectory.rectangle()
    found = {name: driven(robot, ROWS[name], path) for name in KINDS}
    base = found["encoders"]
    print(f"\n{STARTS} starts; closure of encoders {np.median(base[:, 0]):.0f} mm")
    for name, one in found.items():
        closure, across = np.median(one, axis=0)[:2] / np.median(base, axis=0)[:2]
        worse, ends = np.mean(one[:, 0] > base[:, 0]), np.mean(one[:, 2])
        print(
            f"{name:24s} closes at {closure:4.0%} of encoders, worse than they in {worse:3.0%},"
            f" cross-track {across:4.0%}, {ends:4.0%} finish, {int(one[:, 3].sum())} give up"
        )
    assert QUICK or np.median(found["told the pose"][:, 0]) < 0.1 * np.median(base[:, 0])


@pytest.mark.parametrize("speed", quick([0.1, 0.2], [0.2]))
@pytest.mark.parametrize("name", quick(["circle", "eight", "turning"], ["turning"]))
def test_other_paths_close(robot, name, speed):
    from slipid.robot import trajectory

    path = trajectory.PATHS[name](speed)
    steps = quick(int(20 * (2 * path.duration + 10)), STEPS)
    rows = "encoders", "contact", "gyro"
    base, contact, gyro = (driven(robot, ROWS[row], path, steps) for row in rows)
    for row, one in (("contact", contact), ("gyro", gyro)):
        closure, across = np.median(one, axis=0)[:2] / np.median(base, axis=0)[:2]
        print(
            f"\n{name} at {speed} m/s, {row}: closes at {closure:4.0%} of encoders'"
            f" {np.median(base[:, 0]):.0f} mm, cross-track {across:4.0%},"
            f" {np.mean(one[:, 2]):4.0%} finish",
            end="",
        )
    assert QUICK or np.mean(contact[:, 2]) > 0.9


def flawed(ground, flaw, seed):
    """The map as it is believed."""
    from slipid.data.floor_map import patchwork
    from slipid.deploy.twin_run import SITE_SEED

    rng = np.random.default_rng(seed)
    if flaw == "shift":
        way = rng.uniform(-np.pi, np.pi)
        shift = 0.03 * np.array([np.cos(way), np.sin(way)])
        return replace(ground, corner=tuple((np.array(ground.corner) + shift).tolist()))
    if flaw == "tenth":
        # patches of the site have the same edges whatever lies on them
        ids = patchwork([str(k) for k in range(10_000)], seed=SITE_SEED, patch=0.35, half=2.0).cells
        every = np.unique(ids)
        wrong = rng.choice(every, len(every) // 10, replace=False)
        other = rng.integers(1, len(ground.surfaces), size=len(every))
        more = np.where(np.isin(every, wrong), other, 0)[np.searchsorted(every, ids)]
        return replace(ground, cells=(ground.cells + more) % len(ground.surfaces))
    return ground


def driven(robot, row, path, steps=STEPS):
    """Closure [mm], cross-track rms [mm], whether it finished and whether it gave up, by start."""
    from slipid.deploy.controllers import control_loop_of
    from slipid.deploy.deploy import actuator_model_of
    from slipid.deploy.floors import floor_of
    from slipid.deploy.twin_run import starts, twin_floor
    from slipid.lab.trial.controllers import ROWS as TRIAL
    from slipid.lab.trial.trial import drawn_robot
    from slipid.robot.closed_loop import ClosedLoopRun, ControlLoop, path_metrics
    from slipid.robot.filter.floor import Floor
    from slipid.robot.interface import PERIOD, Settings
    from tests.helpers.rolled_out import rollout
    from tests.helpers.telling_twin import TellingTwin

    class UnderWheels(Floor):
        """A map that is asked where the robot is, not where it is believed to be."""

        true: jax.Array

        def supports(self, pose, root, wheels, hypotheses, floors):
            there = self.under(self.true, wheels) == jnp.asarray(hypotheses)
            share = jnp.where(jnp.all(there, axis=1), 1.0, 1e-9)
            return jnp.broadcast_to(share, (32, len(hypotheses)))

    class FloorsByFix(ControlLoop):
        """A control loop that learns only from its fix which floors are under its wheels."""

        def step(self, path, state, measurement, dt):
            at, known = measurement.fix, self.estimator.floor
            there = UnderWheels(known.cells, known.corner, known.cell, jnp.nan_to_num(at))
            control_loop = eqx.tree_at(lambda p: p.estimator.floor, self, there)
            blind = replace(measurement, fix=jnp.full(3, jnp.nan))
            return ControlLoop.step(control_loop, path, state, blind, dt)

    ground = twin_floor(robot)
    floor, seeds = floor_of(ground, robot.labels), range(SEED, SEED + STARTS)
    stack = partial(jax.tree.map, lambda *x: jnp.stack(x))
    truths = stack(*[drawn_robot(robot, seed) for seed in seeds])
    believed = stack(*[floor_of(flawed(ground, row.flaw, s), robot.labels) for s in seeds])
    places = starts(STARTS, ground, path)
    paths = [path.moved(place).after_rest(1.0) for place in places]
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    habits = replace(actuator_model_of(robot, gyro=row.gyro), smooth=row.smooth)
    std = jnp.array([row.place_std, row.heading_std])

    @eqx.filter_jit
    def all_of(*cases):
        def one(truth, path, place, key, there):
            known = truth if row.numbers else robot
            control_loop = control_loop_of(known, TRIAL[row.name], Settings.of(robot), floor=there)
            if row.floors:
                control_loop = FloorsByFix(control_loop.estimator, control_loop.controller)
            plant = TellingTwin(truth, floor, habits, fix_std=std)
            return rollout(control_loop, path, plant, place, key, steps)

        return jax.vmap(one)(*cases)

    poses, said = all_of(truths, stack(*paths), jnp.asarray(places), keys, believed)
    out = []
    for k, path in enumerate(paths):
        own = np.asarray(said.time[k])
        ended = np.flatnonzero((own >= path.duration - 1e-6) | np.asarray(said.gave_up[k]))
        end = int(ended[0]) + 1 if len(ended) else steps
        course = ClosedLoopRun(
            path=path,
            time=PERIOD * np.arange(end),
            path_time=own[:end],
            pose=np.asarray(poses[k, :end]),
            command=np.asarray(said.command[k, :end]),
            estimate=said.estimate,
            energy=np.full(end, np.nan),
            recovering=np.zeros(end, bool),
        )
        m = path_metrics(course)
        helpless = bool(said.gave_up[k, end - 1])
        out.append((m.closure_mm, m.cross_track_rmse_mm, m.finished, helpless))
    return np.array(out, float)
