"""Rests of the closed loop away from its path: looked for, robot by robot and floor by floor.

    SLIPID_FIT=demo_out/result .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_rest.py

Needs a folder `slipid identify` wrote. Every case is a robot of the posterior each of whose wheels
stays on a floor of its own for good, beside a path of 0.4 m, up to 0.3 m and 0.8 rad from its
start. Patches of a real site would let a robot go that creeps on; here nothing does. A case may
arrive by its own belief, be on its way, have given up, or rest: stand still for the last 6 s of
60 s, neither arrived nor given up, which is a stable equilibrium of the loop that nobody acts on.
Without freeing there are some, which shows that the search finds them.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

CASES, SEED = 256, 4000
STEPS, LAST_S = 1200, 6.0
STILL_M, STILL_RAD = 0.01, 0.05


@pytest.fixture(scope="module")
def robot():
    folder = os.environ.get("SLIPID_FIT")
    if not folder:
        pytest.skip("no fit: set SLIPID_FIT to a folder that slipid identify wrote")
    from slipid.deploy.deploy import read_robot

    return read_robot(Path(folder))


@pytest.mark.parametrize("told", [True, False], ids=["pose told", "pose estimated"])
def test_nothing_rests_away_from_its_path(robot, told, monkeypatch):
    found = ends(robot, told)
    print(f"\n{'told its pose' if told else 'contact'}: {said(found)}")
    monkeypatch.setattr("slipid.control.controller.STUCK_S", np.inf)
    print(f"without freeing: {said(ends(robot, told))}")
    assert not found["rest"].any()


def said(found):
    return ", ".join(f"{name} {np.mean(one):.1%}" for name, one in found.items())


def ends(robot, told):
    """Whether each case came to this end, by name of the end."""
    from slipid.control import trajectory
    from slipid.control.closed_loop import PERIOD
    from slipid.control.filter.floor import Floor
    from slipid.control.interface import Settings
    from slipid.control.tuning.twin import Twin, rollout
    from slipid.deploy.controllers import ROWS, pilot_of
    from slipid.deploy.deploy import habits_of
    from slipid.deploy.trial_site import one_of

    class OneEach(Floor):
        """A floor under every wheel, wherever the robot is."""

        kept: jax.Array

        def under(self, pose, wheels):
            return self.kept

    class Telling(Twin):
        """A twin that tells its pose."""

        def step(self, state, command, noise):
            new, reading = super().step(state, command, noise)
            std = jnp.full(2, 1e-3)
            return new, replace(reading, fix=new.pose, fix_std=std, fix_age=jnp.zeros(()))

    rng = np.random.default_rng(SEED)
    truths = jax.tree.map(lambda *x: jnp.stack(x), *[one_of(robot, SEED + k) for k in range(CASES)])
    under = jnp.asarray(rng.integers(len(robot.labels), size=(CASES, robot.wheels)))
    gap, way = rng.uniform(0.05, 0.3, CASES), rng.uniform(-np.pi, np.pi, CASES)
    turn, heading = rng.uniform(-0.8, 0.8, CASES), rng.uniform(-np.pi, np.pi, CASES)
    places = jnp.stack([gap * np.cos(way), gap * np.sin(way), heading + turn], axis=1)
    keys = jax.random.split(jax.random.key(SEED), CASES)
    line = trajectory.waypoints([(0.0, 0.0), (0.4, 0.0)], speed=0.1)
    paths = [line.moved((0.0, 0.0, float(a))) for a in heading]
    habits = habits_of(robot, gyro=False)
    pilot = pilot_of(robot, ROWS["contact"], Settings.of(robot))
    plant = Telling if told else Twin

    @eqx.filter_jit
    def one(truth, kept, path, place, key):
        floor = OneEach(jnp.zeros((1, 1), int), jnp.zeros(2), jnp.ones(()), kept)
        return rollout(pilot, path, plant(truth, floor, habits), place, key, STEPS)

    rests, gave_up, arrived = [], [], []
    for k, path in enumerate(paths):
        truth = jax.tree.map(lambda x, k=k: x[k], truths)
        poses, said = one(truth, under[k], path, places[k], keys[k])
        over = bool(said.time[-1] >= path.duration - 1e-6)
        helpless = bool(said.given_up[-1])
        moved = np.ptp(np.asarray(poses[-round(LAST_S / PERIOD) :]), axis=0)
        still = np.hypot(*moved[:2]) < STILL_M and moved[2] < STILL_RAD
        arrived.append(over)
        gave_up.append(helpless and not over)
        rests.append(still and not helpless and not over)
    found = {"arrive": arrived, "give up": gave_up, "rest": rests}
    found["on their way"] = ~np.any([*found.values()], axis=0)
    return {name: np.asarray(v) for name, v in found.items()}
