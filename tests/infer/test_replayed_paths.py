"""Paths of whole runs: those over several floors have the floor of the map under each wheel."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.data.floor_map import from_polygons, uniform
from slipid.data.runs import Runs, collect
from slipid.fitting import likelihood as lk
from slipid.infer.fit_file import load
from slipid.infer.motion_models import MotionModels
from slipid.infer.replayed_paths import replayed, replayed_over_floors
from slipid.lab.selftest.logs import SimulatedSensors, heading_grid, simulate_logs, true_robot
from slipid.predict.open_loop import chain
from slipid.predict.slip_models import FloorModels
from slipid.support.progress import Reporter

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def fitted(small) -> tuple[MotionModels, Runs]:
    """Models of a fit to runs on one floor, and four of the runs."""
    with Reporter(quiet=True) as report:
        task = read_fit_task(read_config(small[0] / "my.toml"), small[0] / "logs", report)
    return MotionModels.of_fit(load(small[0] / "out")), task.dataset.subset(range(4))


def test_on_a_map_of_one_floor_they_are_those_of_runs_on_it(fitted):
    models, data = fitted
    (alone,), (mapped,) = (
        replayed(models, data),
        replayed_over_floors(models, data, uniform("soft")),
    )
    assert mapped.floor == alone.floor
    assert mapped.scale is None
    assert list(mapped.paths) == list(alone.paths) == ["nominal", "calibrated", "contact"]
    # only the force balance of runs on one floor has the shared effects of neighbouring runs
    within = {"nominal": 1e-9, "calibrated": 1e-9, "contact": 0.02}
    for name, path in alone.paths.items():
        np.testing.assert_allclose(mapped.paths[name], path, rtol=0, atol=within[name])
        np.testing.assert_allclose(mapped.paths[name][:, 0], mapped.measured[:, 0], atol=1e-12)


@pytest.mark.parametrize("on_map", [False, True])
def test_measured_poses_are_those_by_the_sensor_of_the_selected_model(fitted, on_map):
    models, data = fitted
    place = models.contact.robot.camera.marker_place
    seen = eqx.tree_at(lambda r: r.camera.marker_place, models.contact.robot, place + 0.03)
    measured = []
    for name in ("calibrated", "contact"):
        chosen = replace(models, seen=seen, selected={"soft": name})
        maps = (uniform("soft"),) if on_map else ()
        (done,) = (replayed_over_floors if on_map else replayed)(chosen, data, *maps)
        measured.append(done.measured[..., :2])
    apart = np.linalg.norm(measured[0] - measured[1], axis=-1)
    np.testing.assert_allclose(apart, 0.03 * np.sqrt(2), rtol=1e-6)


def test_calibrated_wheels_have_the_radii_of_the_floor_below(fitted):
    models, data = fitted
    soft = models.kinematic["calibrated"].fitted["soft"]
    larger = soft.known + np.r_[np.full(3, np.log(1.25)), np.zeros(len(soft.known) - 3)]
    firm = replace(soft, coefficients=larger)
    both = FloorModels(soft, fitted={"soft": soft, "firm": firm})
    chosen = {"soft": "calibrated", "firm": "calibrated"}
    two = replace(models, contact=None, kinematic={"calibrated": both}, selected=chosen)
    (on_soft,) = replayed_over_floors(two, data, uniform("soft"))
    (alone,) = replayed(two, data)
    np.testing.assert_array_equal(on_soft.measured, alone.measured)  # by the same pose sensor
    line = float(np.median(on_soft.measured[0, :, 0]))  # the first run crosses it halfway
    corners = [(line, -9.0), (9.0, -9.0), (9.0, 9.0), (line, 9.0)]
    floor = from_polygons("soft", [("firm", corners)], (-3.0, -3.0, 3.0, 3.0))
    (mapped,) = replayed_over_floors(two, data, floor)
    steps = [
        np.linalg.norm(np.diff(done.paths["calibrated"][0, :, :2], axis=0), axis=1)
        for done in (mapped, on_soft)
    ]
    ratio = (steps[0] / steps[1])[steps[1] > 0.002]
    assert set(np.round(ratio, 2)) == {1.0, 1.25}
    assert abs(np.flatnonzero(np.diff(ratio))[0] + 1 - len(ratio) / 2) <= 2


def test_each_wheel_has_its_own_floor(fitted):
    setups = (("soft", "as_built"), ("firm", "as_built"))
    drives = heading_grid(setups=setups, headings=2, turns=0)
    true = true_robot(drives)
    logs = simulate_logs(true, drives, 1, SimulatedSensors())
    data = collect([replace(log, surface=None) for log in logs[:2]])
    contact = replace(fitted[0].contact, robot=true)
    models = replace(
        fitted[0], kinematic={}, contact=contact, selected={"soft": "contact", "firm": "contact"}
    )
    line = 0.05  # between the wheels of the robot, which starts at the origin
    corners = [(-9.0, line), (9.0, line), (9.0, 9.0), (-9.0, 9.0)]
    floor = from_polygons("soft", [("firm", corners)], (-3.0, -3.0, 3.0, 3.0), cell=0.002)
    (mapped,) = replayed_over_floors(models, data, floor)
    place = np.asarray(true.geometry.place) * float(true.geometry.base_radius)
    pose = 0.5 * (mapped.measured[:, :-1] + mapped.measured[:, 1:])[:, :, None]
    y = pose[..., 1] + np.sin(pose[..., 2]) * place[:, 0] + np.cos(pose[..., 2]) * place[:, 1]
    names = np.where(y > line, true.surface_index("firm"), true.surface_index("soft"))
    assert (names.min(axis=2) < names.max(axis=2)).any()
    assert mapped.w.parts == 1
    step = lk.predict(true, lk.batch(mapped.w, true, names)).increment
    marker = np.asarray(lk.corrected(true, jnp.asarray(mapped.w.pose)))
    path = np.asarray(chain(jnp.asarray(marker[:, 0]), step))
    moved = np.linalg.norm(path[:, -1, :2] - path[:, 0, :2], axis=1)
    found = np.linalg.norm(np.diff(mapped.paths["contact"][:, [0, -1], :2], axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(found, moved, atol=2e-3)
    for name in ("soft", "firm"):
        (alone,) = replayed_over_floors(models, data, uniform(name))
        gap = alone.paths["contact"][:, -1, :2] - mapped.paths["contact"][:, -1, :2]
        assert np.linalg.norm(gap, axis=1).max() > 0.005
