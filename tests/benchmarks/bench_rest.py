"""Rests of the closed loop away from its path: looked for, robot by robot and floor by floor.

    SLIPID_FIT=demo_out/result .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_rest.py

Needs a folder `slipid identify` wrote. Every case is a robot of the posterior each of whose wheels
stays on a floor of its own for good, beside a path of 0.4 m, up to 0.3 m and 0.8 rad from its
start, told its pose. On real patches a robot that creeps soon reaches another floor; here it
cannot, so every place where the loop can rest shows. A case may have given up; else it has arrived,
rests (stands still for the last 6 s of 60 s, away from the end of its path: a stable equilibrium of
the loop that nobody acts on), or is on its way.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from tests.benchmarks.quick import QUICK, quick

CASES, SEED = quick(256, 2), 4000
STEPS, LAST_S = quick(1200, 160), 6.0
STILL_M, STILL_RAD = 0.01, 0.05
NEAR = 0.02
"""Distance from the end of its path in x and y [m], and in half the angle, at which it is there."""


def test_nothing_rests_away_from_its_path(robot):
    found = ends(robot, recovery=True)
    print(f"\n{shares(found)}")
    print(f"without recovery: {shares(ends(robot, recovery=False))}")
    assert QUICK or not found["rest"].any()


def shares(found):
    return ", ".join(f"{name} {np.mean(one):.1%}" for name, one in found.items())


def ends(robot, recovery):
    """Whether each case came to this end, by name of the end."""
    from slipid.deploy.controllers import control_loop_of
    from slipid.deploy.deploy import actuator_model_of
    from slipid.lab.trial.controllers import ROWS
    from slipid.lab.trial.trial import drawn_robot
    from slipid.robot import trajectory
    from slipid.robot.filter.floor import Floor
    from slipid.robot.interface import PERIOD, Settings
    from tests.helpers.rolled_out import rollout
    from tests.helpers.telling_twin import TellingTwin

    class OneEach(Floor):
        """A floor under every wheel, wherever the robot is."""

        kept: jax.Array

        def under(self, pose, wheels):
            return self.kept

    rng = np.random.default_rng(SEED)
    truths = jax.tree.map(
        lambda *x: jnp.stack(x), *[drawn_robot(robot, SEED + k) for k in range(CASES)]
    )
    under = jnp.asarray(rng.integers(len(robot.labels), size=(CASES, robot.wheels)))
    gap, way = rng.uniform(0.05, 0.3, CASES), rng.uniform(-np.pi, np.pi, CASES)
    turn, heading = rng.uniform(-0.8, 0.8, CASES), rng.uniform(-np.pi, np.pi, CASES)
    places = jnp.stack([gap * np.cos(way), gap * np.sin(way), heading + turn], axis=1)
    keys = jax.random.split(jax.random.key(SEED), CASES)
    line = trajectory.waypoints([(0.0, 0.0), (0.4, 0.0)], speed=0.1)
    paths = [line.moved((0.0, 0.0, float(a))) for a in heading]
    habits = actuator_model_of(robot, gyro=False)
    control_loop = control_loop_of(robot, ROWS["contact"], Settings.of(robot))
    control_loop = eqx.tree_at(lambda x: x.controller.recovery, control_loop, jnp.asarray(recovery))

    @eqx.filter_jit
    def one(truth, kept, path, place, key):
        floor = OneEach(jnp.zeros((1, 1), int), jnp.zeros(2), jnp.ones(()), kept)
        plant = TellingTwin(truth, floor, habits, fix_std=jnp.full(2, 1e-3))
        return rollout(control_loop, path, plant, place, key, STEPS)

    found = {name: np.zeros(CASES, bool) for name in ("arrive", "give up", "rest", "go on")}
    for k, path in enumerate(paths):
        truth = jax.tree.map(lambda x, k=k: x[k], truths)
        poses, said = one(truth, under[k], path, places[k], keys[k])
        poses = np.asarray(poses)
        off = poses[-1] - np.asarray(path.rows[-1, :3])
        off[2] = np.sin(0.5 * off[2])
        moved = np.ptp(poses[-round(LAST_S / PERIOD) :], axis=0)
        if said.gave_up[-1]:
            end = "give up"
        elif said.time[-1] >= path.duration - 1e-6 and np.all(np.abs(off) < NEAR):
            end = "arrive"
        else:
            end = "rest" if np.hypot(*moved[:2]) < STILL_M and moved[2] < STILL_RAD else "go on"
        found[end][k] = True
    return found
