"""A floor map informs the estimator about the floors under the wheels, and about the pose."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.robot import trajectory
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.controller import Controller
from slipid.robot.estimator import Estimator
from slipid.robot.filter.floor import MAP_ERROR, SPREAD
from slipid.robot.filter.floor_filter import FloorFilter, TimeStep, _followed
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.filter.pose_filter import PoseFilter
from slipid.robot.filter.pose_fix import apply_map
from slipid.robot.filter.wheels import MotorCurrents
from slipid.robot.gains import Gains
from slipid.robot.interface import MIXED_FLOORS_PENALTY, Measurement, Settings
from slipid.robot.twin import ActuatorModel, Twin
from tests.helpers.rolled_out import rollout
from tests.helpers.small_twin import deployed, floor

CHESS = [[(i + j) % 2 for j in range(6)] for i in range(6)]
SETTINGS = Settings(further_floor_penalty=MIXED_FLOORS_PENALTY)
HABITS = ActuatorModel()
CASES, STEPS = 12, 200
ROBOT = deployed(process=1.0, run=1.0, current=0.3)


def test_poses_drawn_have_the_mean_and_covariance_they_are_drawn_from():
    np.testing.assert_allclose(SPREAD.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(SPREAD.T @ SPREAD / len(SPREAD), np.eye(3), atol=1e-12)


@pytest.mark.slow
def test_a_pose_that_is_known_has_the_floors_of_the_map():
    robot, there = deployed(), floor(CHESS)
    hypotheses = hypotheses_of(robot).under
    pose = jnp.array([0.1, 0.2, 0.3])
    got = there.supports(pose, 1e-9 * jnp.eye(3), robot.places, hypotheses, 2).mean(axis=0)
    under = np.asarray(there.under(pose, robot.places))
    k = int(np.flatnonzero((hypotheses == under).all(axis=1))[0])
    assert float(got[k]) == pytest.approx((1 - MAP_ERROR / 2) ** 3)
    assert float(jnp.sum(got)) == pytest.approx(1.0)


def test_beliefs_follow_a_map_as_it_changes_beneath_the_robot():
    rng = np.random.default_rng(0)
    before, now = (jnp.asarray(rng.dirichlet(np.ones(5))) for _ in range(2))
    no = jnp.zeros(())
    # what believed the map believes it still, and all that is believed stays
    np.testing.assert_allclose(_followed(before[:, None], before, now, no)[:, 0], now, atol=1e-12)
    other = jnp.asarray(rng.dirichlet(np.ones(5)))
    assert float(_followed(other[:, None], before, now, no).sum()) == pytest.approx(1.0)
    np.testing.assert_allclose(
        _followed(other[:, None], before, before, no)[:, 0], other, atol=1e-12
    )


HALVES = floor([[0, 1], [0, 1]])
"""Floor 0 where x is negative, floor 1 where it is positive."""


def met(after, before):
    """Pose filter before and after beliefs about floors, at the origin known to 0.2 m and 0.1 rad.

    Beliefs are by the floor under all wheels, `{floor: probability}`.
    """
    hypotheses = hypotheses_of(deployed()).under

    def of(belief):
        alike = [(hypotheses == k).all(axis=1) * p for k, p in belief.items()]
        return jnp.asarray(np.sum(alike, axis=0, dtype=float))

    return believed(PoseFilter(deployed(), SETTINGS), of(after), of(before))


@eqx.filter_jit
def believed(by_pose, after, before):
    """The same by the probability of every hypothesis."""
    robot = by_pose.robot
    by_floor, hypotheses = FloorFilter(robot, SETTINGS), hypotheses_of(robot).under
    state = by_pose.init(jnp.zeros(3), (0.2, 0.1))
    none, still = jnp.zeros(3), TimeStep(jnp.asarray(0.05), jnp.zeros((), bool), jnp.zeros(()))
    currents = MotorCurrents(none, jnp.zeros(3, int), jnp.ones(3), jnp.zeros(()))
    begin = by_floor.init()
    of = by_floor.predict(begin, none, none)
    _, motion = by_floor.step(begin, of, currents, jnp.asarray(jnp.nan), still)
    motion = replace(motion, known=after, before=before)
    root, supports = by_pose.mapped(state, HALVES, hypotheses)
    return state, *apply_map(state, root, supports, motion)


@pytest.mark.slow
def test_a_floor_met_on_one_side_of_an_edge_puts_the_pose_there():
    state, now, left = met({0: 0.01, 1: 0.99}, {0: 0.5, 1: 0.5})
    assert float(now.pose[0]) > 0.05
    assert abs(float(now.pose[1])) < 0.03
    assert float(now.covariance[0, 0]) < 0.8 * float(state.covariance[0, 0])
    assert float(now.covariance[1, 1]) > 0.8 * float(state.covariance[1, 1])
    np.testing.assert_allclose(
        now.history[:, 1:3] - state.history[:, 1:3], jnp.tile(now.pose[:2], (48, 1)), atol=1e-9
    )
    _, other, _ = met({0: 0.99, 1: 0.01}, {0: 0.5, 1: 0.5})
    assert float(other.pose[0]) < -0.05
    # of how far another pose is off along x, less is left than of how far across
    assert float(left[0, 0]) < 0.8
    assert float(left[1, 1]) > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("belief", [{0: 0.5, 1: 0.5}, {0: 0.99, 1: 0.01}, {1: 1.0}])
def test_beliefs_that_nothing_has_changed_move_no_pose(belief):
    """However far from the map they are: their evidence has counted when it came."""
    state, now, left = met(belief, belief)
    np.testing.assert_allclose(now.pose, state.pose, atol=1e-12)
    np.testing.assert_allclose(now.covariance, state.covariance, atol=1e-9)
    np.testing.assert_allclose(left, np.eye(3), atol=1e-9)


@eqx.filter_jit
def driven(there, paths, starts, keys, habits, known):
    """Return true and estimated poses on chess patches, with the map `known`."""
    robot = ROBOT
    control_loop = ControlLoop(Estimator(robot, SETTINGS, known), Controller(robot, Gains()))

    def one(path, start, key):
        return rollout(control_loop, path, Twin(robot, there, habits), start, key, STEPS)

    return jax.vmap(one)(paths, starts, keys)


def errors(known, habits=HABITS):
    """Return the final position errors [m] and the squared normalized error of the pose."""
    rng = np.random.default_rng(1)
    starts = np.concatenate(
        [rng.uniform(-0.5, 0.2, (CASES, 2)), rng.uniform(-3, 3, (CASES, 1))], axis=1
    )
    one = trajectory.waypoints([(0.0, 0.0), (0.6, 0.0), (0.6, -0.3)])
    every = [one.moved(s) for s in starts.tolist()]
    paths = jax.tree.map(lambda *x: jnp.stack(x), *every)
    keys = jax.random.split(jax.random.key(2), CASES)
    pose, said = driven(floor(CHESS), paths, jnp.asarray(starts), keys, habits, known)
    gap = np.asarray(said.estimate.pose)[:, -1] - np.asarray(pose)[:, -1]
    inside = np.einsum(
        "ki,kij,kj->k",
        gap,
        np.linalg.inv(np.asarray(said.estimate.covariance)[:, -1] + 1e-9 * np.eye(3)),
        gap,
    )
    return np.hypot(*gap[:, :2].T), inside


@pytest.mark.slow
def test_a_map_brings_the_believed_pose_nearer_and_a_wrong_one_takes_it_little_farther():
    there = floor(CHESS)
    without, _ = errors(None)
    right, inside = errors(there)
    assert np.median(right) < 0.7 * np.median(without)
    assert np.median(inside) < 3 * 2.37  # of chi square with 3 degrees of freedom
    cells = np.array(CHESS)
    cells[2, 3] = 1 - cells[2, 3]
    cells[4, 1] = 1 - cells[4, 1]
    wrong, _ = errors(replace(there, cells=jnp.asarray(cells)))
    assert np.median(wrong) < 1.25 * np.median(without)


@pytest.mark.slow
def test_what_is_no_number_leaves_a_robot_with_a_map_sound():
    robot = deployed()
    estimator = Estimator(robot, SETTINGS, floor(CHESS))
    state = estimator.init()
    rng = np.random.default_rng(0)
    for k in range(60):
        bad = rng.random(3) < 0.2
        angle = np.where(bad, np.nan, 0.1 * k * np.array([1.0, -1.0, 0.2]))
        current = np.where(rng.random(3) < 0.2, 1e9, 0.4)
        reading = Measurement(wheel_angle=angle, current=current)
        state, seen = estimator.step(state, reading, 0.05 if k % 7 else np.nan)
        assert bool(seen.finite)
