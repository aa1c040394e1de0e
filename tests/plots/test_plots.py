"""Pictures: the compared values are correct, and no picture is empty."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.image import imread

from slipid.data.runs import collect
from slipid.data.windows import windows
from slipid.fitting.optimise import Optimum
from slipid.fitting.problem import FitState, Problem
from slipid.infer.design.planned_runs import PlannedRun
from slipid.infer.measured_windows import by_heading, driving_torque, measured_windows
from slipid.infer.result import Fit
from slipid.infer.summary import summarise
from slipid.lab.selftest.logs import (
    SimulatedSensors,
    heading_grid,
    nominal_robot,
    simulate_logs,
    true_robot,
)
from slipid.model.geometry import differential, omni
from slipid.plots import fit as plots
from slipid.plots.compare import MODEL_NAMES, validation_figure
from slipid.plots.drawing import figure, save
from slipid.plots.motion import heading_figure
from slipid.plots.wheels import current_figure, wheel_curve
from slipid.predict.slip_models import slip_models
from slipid.search_space import Choice

pytestmark = pytest.mark.slow  # traces whole fits

DRIVES = heading_grid(setups=(("soft", "as_built"), ("firm", "as_built")), headings=8, turns=0)
ROBOT = true_robot(DRIVES)
QUIET = SimulatedSensors(
    std=dict.fromkeys(SimulatedSensors().std, 0.0), ripple=0.0, voltage_noise=0.0, wobble=0.0
)


@functools.cache
def data():
    return collect(simulate_logs(ROBOT, DRIVES, 0, QUIET))


@functools.cache
def segments():
    return measured_windows(ROBOT, data(), 4)


@functools.cache
def fit() -> Fit:
    """Return a fit that ended at the truth."""
    choices = [Choice("camera.scale", prior_mean=1.117, prior_std=0.002)]
    choices.append(Choice("camera.lag", prior_mean=0.056, prior_std=0.02))
    choices.append(Choice("robot.mass", fixed=12.0))
    problem = Problem(windows(data(), 0.04, lag=0.056), nominal_robot(DRIVES), choices)
    z = problem.space.vector(ROBOT)
    log_v = 2 * np.log(problem.noise.typical)
    _, jacobian = problem.linear(jnp.asarray(z), problem.electric(z, log_v))
    keep = jnp.ones(len(problem.windows))
    info = np.asarray(problem.precision(jacobian, jnp.asarray(log_v), keep))
    state = FitState(z, log_v, 7, -1.5, 0.01, "joint")
    return summarise(
        problem, Optimum(state, np.linalg.inv(info), True, "settled", (0.0,)), data(), choices
    )


def shows_something(path) -> bool:
    picture = imread(path)
    return min(picture.shape[:2]) > 200 and bool(picture[..., :3].std() > 0.02)


def test_camera_of_undisturbed_logs_lies_on_the_predicted_lines():
    p = segments()
    assert p.straight.all()
    for g, (floor, load) in enumerate(p.groups):
        for speed in (0.1, 0.2):
            mine = (p.group == g) & (p.speed == speed)
            assert mine.sum() >= 8
            slip, drift, yaw = by_heading(ROBOT, floor, load, speed, p.heading[mine]).T
            # wheels ramp up and are rounded to ticks, so small residuals remain
            np.testing.assert_allclose(p.slip[mine], slip, atol=0.01)
            np.testing.assert_allclose(p.drift[mine], drift, atol=0.5)
            np.testing.assert_allclose(p.yaw[mine], yaw, atol=1.5)


def test_floors_are_ordered_by_slip():
    assert segments().groups == (("firm", "as_built"), ("soft", "as_built"))


def test_torque_from_unsigned_currents_is_that_of_the_contact():
    p = segments()
    turning = np.abs(p.wheel_speed) > 0.5
    difference = driving_torque(ROBOT, p) - p.torque * np.sign(p.wheel_speed)
    # half a step of 1/39 A is 0.01 N m
    assert np.abs(difference[turning]).max() < 0.02
    assert np.abs(p.torque[turning]).max() > 0.3


def test_wheel_slip_and_torque_lie_on_the_curve_of_a_wheel():
    p = segments()
    k = int(np.argmin(np.where(p.group == 1, p.sideways[:, 0], np.inf)))
    args = float(p.sideways[k, 0]), abs(float(p.wheel_speed[k, 0]))
    slip = np.linspace(0, 1, 201)
    # the contact patch shifts loads by a few percent while the robot moves
    torque = wheel_curve(ROBOT, "soft", slip, *args, float(p.share[k, 0]))
    expected = np.interp(p.wheel_slip[k, 0], slip, torque)
    assert abs(p.torque[k, 0]) == pytest.approx(expected, rel=0.06)


def test_curve_of_a_straight_wheel_is_the_published_one():
    for floor, curve in fit().curves.items():
        place = (curve.wheel_speed, curve.load_share)
        torque = wheel_curve(fit().robot, floor, curve.slip, 0.0, *place)
        np.testing.assert_allclose(torque, curve.torque_nm, rtol=0.01, atol=1e-3)


def test_sideways_rolling_costs_slip():
    slip = np.linspace(0.05, 0.5, 10)
    straight = wheel_curve(ROBOT, "soft", slip, 0.0, 3.0, 1 / 3)
    assert (wheel_curve(ROBOT, "soft", slip, 1.0, 3.0, 1 / 3) < straight).all()


def test_identify_draws_every_picture(tmp_path):
    files = plots.identify_plots(fit(), data(), tmp_path)
    assert {f.name for f in files} == {
        "slip_by_heading.png",
        "paths.png",
        "slip_by_torque.png",
        "current_by_traction.png",
        "load_share.png",
    }
    assert all(shows_something(f) for f in files)
    assert {f.name for f in tmp_path.iterdir()} == {f.name for f in files}  # no part files


def test_an_empty_figure_does_not_pass_for_a_picture(tmp_path):
    assert not shows_something(save(figure(8.0, 6.0, ""), tmp_path / "empty.png"))


def test_without_currents_or_directions_those_pictures_are_left_out():
    assert current_figure(replace(segments(), amps=None)) is None
    one_way = replace(segments(), heading=np.full(len(segments().heading), 90.0))
    assert heading_figure(ROBOT, one_way) is None


def test_turning_segments_have_no_direction():
    drives = (PlannedRun("soft", "as_built", 0.3, 0.2, turn=0.8),)
    robot = true_robot(drives)
    assert not measured_windows(
        robot, collect(simulate_logs(robot, drives, 0, QUIET)), 4
    ).straight.any()


def test_loads_are_written_at_their_wheels():
    made = plots.load_figure(fit())
    texts = {t.get_text().split("\n")[0]: t for t in made.axes[0].texts}
    e = fit().parameters["robot.load_share@as_built"]
    for k, share in enumerate(e.value):
        assert f"{100 * share:.1f} %" in texts[f"wheel {k + 1}"].get_text()
    # wheel 2 stands behind, wheel 1 ahead on the left
    assert texts["wheel 2"].get_position()[1] < 0
    assert texts["wheel 1"].get_position()[0] < 0 < texts["wheel 1"].get_position()[1]


def test_every_slip_model_has_a_readable_name():
    shapes = omni([60.0, 180.0, 300.0], 0.1, 0.04), differential(0.2, 0.04)
    names = {model.name for shape in shapes for model in slip_models(shape, has_current=True)}
    assert set(MODEL_NAMES) == {"identified", *names}


def test_errors_are_drawn_to_scale():
    one = {"endpoint_error_mean": 0.02, "runs": 3}
    other = {"endpoint_error_mean": 0.3, "runs": 3}
    made = validation_figure({"summary": {"soft": {"identified": one, "encoder": other}}}, "3 runs")
    assert [bar.get_width() for bar in made.axes[0].patches] == pytest.approx([2.0, 30.0])
