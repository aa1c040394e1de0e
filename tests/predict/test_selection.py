"""Selection of a slip model by held-out runs: the rule itself, on made errors."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slipid.app.config import read_config
from slipid.app.problem import read_fit_task
from slipid.data.log import Log
from slipid.data.runs import collect
from slipid.fitting.calibration.estimate import calibrate
from slipid.predict import open_loop as replay
from slipid.predict.open_loop import Tracks
from slipid.predict.selection import (
    calibrated_model,
    kinematic_fit,
    path_errors,
    selected,
    selection_folds,
)
from slipid.search_space import Space
from slipid.support.progress import Reporter
from tests.benchmarks.every_robot.drive import write
from tests.benchmarks.every_robot.robots import ROBOTS


def runs(floors, heading_deg=None):
    """Runs on floors, with a steady command in a direction if there is one."""
    logs = []
    for k, floor in enumerate(floors):
        way = None if heading_deg is None else np.radians(heading_deg[k])
        command = (
            None if way is None else np.tile([0.1 * np.cos(way), 0.1 * np.sin(way), 0.0], (9, 1))
        )
        logs.append(
            Log(
                name=str(k),
                path=Path(str(k)),
                sha256=str(k),
                time=np.arange(9.0),
                wheel_angle=np.tile(np.arange(9.0)[:, None], 2),
                twist_command=command,
                current_is_signed=False,
                pose=np.zeros((9, 3)),
                surface=floor,
                load="as_built",
            )
        )
    return collect(logs)


def errors(**means):
    """Errors of twelve runs with the given means, which differ from run to run alike."""
    common = np.linspace(-0.2, 0.2, 12)
    own = np.random.default_rng(0).normal(0.0, 0.03, (len(means), 12))
    return {m: x * (1 + common + noise) for (m, x), noise in zip(means.items(), own, strict=True)}


@pytest.mark.parametrize(
    ("means", "contradicted", "model"),
    [
        ({"nominal": 0.01, "calibrated": 0.01, "contact": 0.01}, (), "nominal"),
        ({"nominal": 0.01, "calibrated": 0.01, "contact": 0.01}, ("a",), "calibrated"),
        ({"nominal": 0.05, "calibrated": 0.01, "contact": 0.00999}, (), "calibrated"),
        ({"nominal": 0.05, "calibrated": 0.02, "contact": 0.01}, (), "contact"),
        ({"nominal": 0.01, "calibrated": 0.03, "contact": 0.04}, (), "nominal"),
        ({"nominal": 0.05, "calibrated": 0.02}, (), "calibrated"),
    ],
)
def test_the_simplest_within_a_standard_error_of_the_best_is_selected(means, contradicted, model):
    found = selected(runs("a" * 12), errors(**means), contradicted)["a"]
    assert found.model == model
    assert found.held_out
    assert found.runs == 12
    assert found.errors == pytest.approx(means, rel=0.05)


def test_runs_without_an_error_are_not_counted():
    made = errors(nominal=0.05, calibrated=0.01)
    made["calibrated"][3:] = np.nan
    assert selected(runs("a" * 12), made, ())["a"].runs == 3


def test_the_only_run_of_a_floor_is_not_held_out():
    data = runs(["a"] * 5 + ["b"])
    np.testing.assert_array_equal(selection_folds(data), [0, 1, 2, 3, 4, -1])
    made = {m: x[:6] for m, x in errors(nominal=0.05, calibrated=0.01).items()}
    found = selected(data, made, ())
    assert (found["a"].held_out, found["b"].held_out) == (True, False)


def test_sectors_are_held_out_where_every_floor_was_driven_in_enough_of_them():
    heading = np.tile([10.0, 70.0, 130.0, 190.0], 2)
    np.testing.assert_array_equal(selection_folds(runs("a" * 8, heading)), [0, 1, 2, 3] * 2)


def square(side):
    """A square with rounded-off time: poses along its sides, back at the start."""
    corner = side * np.array([0, 1, 1 + 1j, 1j, 0])
    place = np.concatenate([np.linspace(a, b, 9)[:-1] for a, b in itertools.pairwise(corner)])
    place = np.append(place, 0)
    heading = np.append(np.repeat(np.arange(4) * np.pi / 2, 8), 2 * np.pi)
    return np.stack([place.real, place.imag, heading], -1)


def test_a_closed_path_does_not_hide_a_wrong_scale():
    """Its end is right, but its parts are not: 5 % of scale are 5 % of their chords."""
    tracks = Tracks(np.zeros(1, int), square(1.05)[None], square(1.0)[None])
    assert np.hypot(*tracks.gap[0, :2]) < 1e-12
    assert 0.015 < path_errors(tracks)[0] < 0.05


@pytest.mark.slow
def test_a_run_is_judged_by_a_calibration_without_it(tmp_path):
    """The step without a run goes most of the way to a calibration of the others alone.

    It is exact for right runs. Here the poses of one run have another scale, which its share in
    the variances of all runs makes look like noise.
    """
    write(next(robot for robot in ROBOTS if robot.name == "omni3_marker"), tmp_path, seed=3)
    with Reporter(quiet=True) as report:
        task = read_fit_task(read_config(tmp_path / "robot.toml"), tmp_path / "logs", report)
    space = Space(task.robot, task.choices)
    right = list(task.dataset.logs)
    wrong = [*right[:-1], replace(right[-1], pose=right[-1].pose * [1.02, 1.02, 1.0])]
    last = len(right) - 1
    for logs, least in ((right, 0.95), (wrong, 0.4)):
        data = collect(logs)
        assert selection_folds(data).tolist() == list(range(len(logs)))
        found = kinematic_fit(data, space, task.choices)
        alone = calibrate(data.subset(range(last)), space, task.choices)
        whole, exact = (held_out_error(data, last, c, space) for c in (found.calibration, alone))
        assert found.errors["calibrated"][last] > whole + least * (exact - whole)
        assert found.errors["calibrated"][last] < 1.05 * exact


def held_out_error(data, run, calibration, space):
    """Error of a run over its path length, predicted by a calibration."""
    robot = space.template
    seen, model = calibration.seen(robot), calibrated_model(calibration, robot.geometry)
    (w,) = replay.replay_windows(data.subset([run]), seen)
    tracks = replay.tracks_from_increments(seen, w, model.increments(w, seen))
    return float(path_errors(tracks, w.parts)[0])
