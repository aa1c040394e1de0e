"""Paths of the body between poses, and the regions around their positions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, f

from slipid.data.log import Log
from slipid.data.runs import collect
from slipid.fitting.variances import DEGREES
from slipid.infer.body_path import BodyPath, kinematic_path, measured_path, moved_to_start
from slipid.model.geometry import differential
from slipid.model.robot import build
from slipid.predict import open_loop as replay
from slipid.predict.kinematics import nominal
from slipid.predict.selection import aligned_path
from slipid.predict.slip_model import path_of, turned
from slipid.predict.slip_models import FloorModels

SHAPE = differential(0.15, 0.05)
STEP, LAG, SCALE, YAW, PLACE = 0.02, 0.1, 1.05, 0.2, np.array([0.08, 0.03])
ROBOT = eqx.tree_at(
    lambda r: (r.camera.lag, r.camera.scale, r.camera.marker_yaw, r.camera.marker_place),
    build(SHAPE, ["floor"]),
    (jnp.asarray(LAG), jnp.asarray(SCALE), jnp.asarray(YAW), jnp.asarray(PLACE)),
)
START = np.array([0.5, -0.2, 0.7])


def truth(time):
    """True poses of the body, which is at rest before 0 and drives one arc afterwards."""
    twist = np.array([0.3, 0.0, 0.4]) * np.maximum(time, 0.0)[:, None]
    relative = np.array([path_of(one[None], np.ones(1))[1] for one in twist])
    place = START[:2] + turned(START[2], relative[:, :2])
    return np.column_stack([place, START[2] + relative[:, 2]])


def run(lacks=()):
    """A run without slip whose marker sits aside, is turned, and is seen late and too small."""
    time = np.round(STEP * np.arange(501), 9)
    body = truth(time - LAG)
    pose = np.column_stack(
        [(body[:, :2] + turned(body[:, 2], np.tile(PLACE, (501, 1)))) / SCALE, body[:, 2] + YAW]
    )
    pose[:, list(lacks)] = np.nan
    rolled = np.asarray(SHAPE.forward()) @ [0.3, 0.0, 0.4] / 0.05
    log = Log(
        name="run",
        path=Path("run"),
        sha256="run",
        time=time,
        wheel_angle=time[:, None] * rolled,
        pose=pose,
        pose_fresh=np.arange(501) % 10 == 0,
        surface="floor",
        load="as_built",
        current_is_signed=True,
    )
    return collect([log])


def test_measured_and_predicted_paths_are_those_of_the_body():
    data = run()
    measured = measured_path(data, 0, ROBOT)
    np.testing.assert_allclose(measured.pose, truth(measured.time), atol=1e-6)
    assert measured.time[0] == pytest.approx(0.1)  # no wheel was read before the first row
    w = replay.replay_windows(data, ROBOT)[0]
    model = FloorModels(nominal(SHAPE))
    found = kinematic_path(model, ROBOT, w).at(measured.time)
    assert found.covariance is None
    assert len(found.time) > 40
    np.testing.assert_allclose(found.pose, truth(found.time), atol=1e-6)


def test_between_poses_a_body_moves_on_an_arc():
    time = np.array([0.0, 1.0, 3.0])
    cov = np.array([1.0, 2.0, 4.0])[:, None, None] * np.eye(2)
    wanted = np.array([-1.0, 0.0, 0.25, 1.0, 2.5, 3.0, 3.1])
    found = BodyPath(time, truth(time), cov).at(wanted)
    np.testing.assert_array_equal(found.time, wanted[1:-1])
    np.testing.assert_allclose(found.pose, truth(found.time), atol=1e-12)
    np.testing.assert_allclose(found.covariance[:, 0, 0], [1.0, 1.25, 2.0, 3.5, 4.0])
    assert len(found.rows(np.array([1, 2])).covariance) == 2
    assert len(BodyPath(time, truth(time)).at(np.array([9.0])).time) == 0


@pytest.mark.parametrize(
    ("freedom", "square"),
    [(DEGREES, 2 * f.ppf(0.9, 2, DEGREES)), (np.inf, chi2.ppf(0.9, 2))],
)
def test_outlines_enclose_nine_tenths(freedom, square):
    cov = np.array([[[0.04, 0.01], [0.01, 0.02]], [[0.01, 0.0], [0.0, 0.09]]])
    path = BodyPath(np.arange(2.0), truth(np.arange(2.0)), cov, freedom)
    outlines = path.outlines(16)
    gap = outlines - path.pose[:, None, :2]
    found = np.einsum("epi,eij,epj->ep", gap, np.linalg.inv(cov), gap)
    np.testing.assert_allclose(found, square, rtol=1e-9)
    assert outlines.shape == (2, 16, 2)
    assert BodyPath(path.time, path.pose).outlines(16) is None


def test_regions_on_the_path_are_those_of_paths_that_end_there():
    w = replay.replay_windows(run(), ROBOT)[0].segments(np.zeros(1, int))
    increments = FloorModels(nominal(SHAPE)).increments(w, ROBOT)
    p = replay.tracks_from_increments(ROBOT, w, increments).predicted
    axes = ("along", "across", "yaw")
    variance = {"camera.place": 1e-6, "camera.heading": 1e-5}
    variance |= {f"process.floor.{axis}": 1e-4 * (k + 1) for k, axis in enumerate(axes)}
    variance |= {f"run.floor.{axis}": 1e-3 * (k + 1) for k, axis in enumerate(axes)}
    shared, edges = np.diag([1e-4, 0.0, 1e-3])[None], [0, 5, p.shape[1] - 1]
    found = replay.path_covariance(ROBOT, w, p, variance, shared, edges, p[:, edges, :2])
    none = np.zeros((1, 2, 2))
    np.testing.assert_allclose(found[0, 0], 2e-6 * SCALE**2 * np.eye(2), rtol=1e-12)
    for k, end in enumerate(edges[1:], start=1):
        cut = replay.Tracks(w.run, p[:, : end + 1], p[:, : end + 1])
        alone = replay.end_covariance(ROBOT, shortened(w, end), cut, variance, shared, none)
        np.testing.assert_allclose(found[0, k], alone[0], rtol=1e-9)
    # a point of the robot 1 m ahead of the marker is moved farther by errors of yaw
    far = p[:, edges, :2] + turned(p[:, edges, 2] - YAW, np.tile([1.0, 0.0], (1, 3, 1)))
    ahead = replay.path_covariance(ROBOT, w, p, variance, shared, edges, far)
    assert np.linalg.det(ahead[0, 2]) > np.linalg.det(found[0, 2])
    yaw_alone = dict.fromkeys(variance, 0.0) | {"camera.heading": 1e-5}
    ahead = replay.path_covariance(ROBOT, w, p, yaw_alone, 0 * shared, edges, far)
    lever = far[0] - p[0, 0, :2]
    across = lever[:, ::-1] * [-1.0, 1.0]
    np.testing.assert_allclose(ahead[0], 1e-5 * across[:, :, None] * across[:, None, :], atol=1e-15)


def shortened(w, steps):
    """Windows with the first steps alone."""
    arrays = ("dt", "turn", "speed_change", "direction")
    arrays += ("current", "voltage", "current_var", "voltage_var")
    kept = {name: getattr(w, name)[:, :steps] for name in arrays}
    return replace(w, **kept, pose=w.pose[:, : steps + 1])


@pytest.mark.parametrize("lacks", [[2], [0, 1]])
def test_paths_of_runs_without_all_coordinates_are_moved_to_the_measured_ones(lacks):
    data = run(lacks)
    found = aligned_path(data, 0, nominal(SHAPE), ROBOT)
    expected = truth(found.time)
    assert found.error < 1e-3 if lacks == [2] else found.error < 0.02
    if lacks == [2]:
        np.testing.assert_allclose(found.pose[:, :2], expected[:, :2], atol=2e-3)
        measured = measured_path(data, 0, ROBOT)
        marker = truth(measured.time)
        marker[:, :2] += turned(marker[:, 2], np.tile(PLACE, (len(marker), 1)))
        np.testing.assert_allclose(measured.pose[:, :2], marker[:, :2], atol=1e-6)
        assert not measured.pose[:, 2].any()
    else:
        assert measured_path(data, 0, ROBOT) is None
    np.testing.assert_allclose(found.pose[:, 2], expected[:, 2], atol=5e-3)


@pytest.mark.parametrize("rows", [1, 20, 21])
def test_a_run_that_ends_before_its_second_pose_has_no_path(rows):
    (log,) = run().logs
    names = ("time", "wheel_angle", "pose", "pose_fresh")
    cut = replace(log, **{name: getattr(log, name)[:rows] for name in names})
    found = aligned_path(collect([cut]), 0, nominal(SHAPE), ROBOT)
    assert (found is None) == (rows < 21)  # every tenth row has a pose, 0.1 s late


def test_paths_are_moved_as_rigid_bodies_to_a_start():
    """Compositions of poses, as complex numbers, tell the same."""
    rng = np.random.default_rng(0)
    path, start = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 3))
    moved = moved_to_start(path, start)
    np.testing.assert_allclose(moved[:, 0], start)
    at, old = (x[..., 0] + 1j * x[..., 1] for x in (moved, path))
    turn = np.exp(1j * (start[:, 2] - path[:, 0, 2]))[:, None]
    np.testing.assert_allclose(at - at[:, :1], turn * (old - old[:, :1]))
    np.testing.assert_allclose(np.diff(moved[..., 2]), np.diff(path[..., 2]))
