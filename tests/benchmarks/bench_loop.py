"""The paper's rectangle on twins drawn from a fit's posterior, and what limits how well it closes.

    SLIPID_FIT=demo_out/result .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_loop.py

Needs a folder `slipid identify` wrote. Every start has another robot, other noise and another
gyro; all starts of a row are rolled out together. Rows that are told something true get it as a
pose fix in every step, or drive with the true numbers.
"""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

STARTS, SEED = 60, 9000
STEPS = 960
"""Of a rollout; `slipid trial` gives a run up no later."""


class Row(NamedTuple):
    """A row of the trial, whether it has a gyro, and what it is told beside its readings."""

    name: str = "contact"
    gyro: bool = False
    numbers: bool = False
    place_std: float = np.nan
    heading_std: float = np.nan


ROWS = {
    "encoders": Row("encoder"),
    "contact": Row(),
    "gyro": Row(gyro=True),
    "map": Row("contact_map"),
    "map and gyro": Row("contact_map", gyro=True),
    "told the numbers": Row(numbers=True),
    "told the heading": Row(place_std=10.0, heading_std=1e-3),
    "told the pose": Row(place_std=1e-3, heading_std=1e-3),
    "gyro, told the numbers": Row(gyro=True, numbers=True),
    "map, told the numbers": Row("contact_map", numbers=True),
}


def test_what_closes_and_what_limits_it():
    folder = os.environ.get("SLIPID_FIT")
    if not folder:
        pytest.skip("no fit: set SLIPID_FIT to a folder that slipid identify wrote")
    from slipid.deploy.deploy import read_robot

    found = {name: driven(read_robot(Path(folder)), row) for name, row in ROWS.items()}
    base = found["encoders"]
    print(f"\n{folder}: {STARTS} starts; closure of encoders {np.median(base[:, 0]):.0f} mm")
    for name, one in found.items():
        closure, across = np.median(one, axis=0)[:2] / np.median(base, axis=0)[:2]
        worse, ends = np.mean(one[:, 0] > base[:, 0]), np.mean(one[:, 2])
        print(
            f"{name:24s} closes at {closure:4.0%} of encoders, worse than they in {worse:3.0%},"
            f" cross-track {across:4.0%}, {ends:4.0%} finish, {int(one[:, 3].sum())} give up"
        )
    assert np.median(found["told the pose"][:, 0]) < 0.1 * np.median(base[:, 0])


def driven(robot, row):
    """Closure [mm], cross-track rms [mm], whether it finished and whether it gave up, by start."""
    from slipid.control import trajectory
    from slipid.control.closed_loop import PERIOD, Course, metrics
    from slipid.control.interface import Settings
    from slipid.control.tuning.twin import Twin, rollout
    from slipid.deploy.controllers import ROWS as TRIAL
    from slipid.deploy.controllers import pilot_of
    from slipid.deploy.deploy import habits_of
    from slipid.deploy.trial_site import floor_of, one_of, site, starts

    class Telling(Twin):
        """A twin that tells its pose as well as the row is to know it."""

        def step(self, state, command, noise):
            new, reading = super().step(state, command, noise)
            std = jnp.array([row.place_std, row.heading_std])
            return new, replace(reading, fix=new.pose, fix_std=std, fix_age=jnp.zeros(()))

    ground = site(robot)
    floor, seeds = floor_of(ground, robot.labels), range(SEED, SEED + STARTS)
    stack = partial(jax.tree.map, lambda *x: jnp.stack(x))
    truths = stack(*[one_of(robot, seed) for seed in seeds])
    places = starts(STARTS, ground)
    paths = [trajectory.rectangle().moved(place).waiting(1.0) for place in places]
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    habits = habits_of(robot, gyro=row.gyro)

    @eqx.filter_jit
    def all_of(truths, paths, places, keys):
        def one(truth, path, place, key):
            known = truth if row.numbers else robot
            pilot = pilot_of(known, TRIAL[row.name], Settings.of(robot), floor=floor)
            return rollout(pilot, path, Telling(truth, floor, habits), place, key, STEPS)

        return jax.vmap(one)(truths, paths, places, keys)

    poses, said = all_of(truths, stack(*paths), jnp.asarray(places), keys)
    out = []
    for k, path in enumerate(paths):
        own = np.asarray(said.time[k])
        ended = np.flatnonzero((own >= path.duration - 1e-6) | np.asarray(said.given_up[k]))
        end = int(ended[0]) + 1 if len(ended) else STEPS
        course = Course(
            path=path,
            time=PERIOD * np.arange(end),
            own=own[:end],
            pose=np.asarray(poses[k, :end]),
            command=np.asarray(said.command[k, :end]),
            estimate=said.estimate,
            energy=np.full(end, np.nan),
        )
        m = metrics(course)
        helpless = bool(said.given_up[k, end - 1])
        out.append((m.closure_mm, m.cross_track_rmse_mm, m.finished, helpless))
    return np.array(out, float)
