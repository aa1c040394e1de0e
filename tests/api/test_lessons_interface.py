"""The public interface beside fits: simulated runs, steady motion, check, comparison, drive."""

from __future__ import annotations

import numpy as np
import pytest

import slipid as sl


@pytest.mark.slow
def test_simulated_runs_have_the_requested_channels_and_truth():
    slippery = {"surface.gray.creep": 0.4}
    made = sl.made_runs(["gray"], headings=3, speeds=[0.2], turns=0, truth=slippery, current=False)
    log = made.runs.logs[0]
    assert (len(made.runs), log.surface, log.current) == (3, "gray", None)
    assert log.voltage is not None
    assert made.truth["surface.gray.creep"] == 0.4
    with pytest.raises(ValueError, match=r"no parameter 'surface\.grey\.creep'; there are: robot"):
        sl.made_runs(["gray"], truth={"surface.grey.creep": 0.4})


@pytest.mark.slow
def test_a_move_has_the_slip_of_its_own_twist():
    robot = sl.made_runs(["soft"], headings=1, speeds=[0.2], turns=0).robot
    commands = np.array([[0.2, 0.0, 0.0], [0.1, 0.1, 0.4]])
    moved = sl.move(robot, "soft", commands)
    rows = np.asarray(robot.geometry.forward())
    np.testing.assert_allclose(moved.wheel_speed * 0.04, commands @ rows.T, atol=1e-12)
    slip = 1 - moved.twist @ rows.T / (0.04 * moved.wheel_speed)
    np.testing.assert_allclose(moved.slip[1], slip[1], rtol=1e-9)
    assert np.isnan(moved.slip[0, 1])  # the rear wheel stands when it drives ahead
    assert (moved.torque[0, [0, 2]] > 0).all()
    assert (moved.current[0, [0, 2]] > 0).all()
    with pytest.raises(ValueError, match="no surface 'ice'; identified: soft"):
        sl.move(robot, "ice", commands)


@pytest.fixture(scope="module")
def fit(world):
    return world["fit"]


@pytest.mark.slow
def test_a_check_counts_runs_and_forecasts_verdicts(fit):
    robot = sl.Robot.omni([60, 180, 300], base_radius=0.125, wheel_radius=0.04, gear_ratio=16)
    check = sl.check(fit.data, robot, fixed={"camera.scale": 1.117})
    assert check["motor.resistance"].verdict == "not_identified"
    assert check["camera.scale"].verdict == "fixed"
    assert "current (unsigned)" in str(check)
    assert sum(group["runs"] for group in check.content["groups"]) == 12
    assert sl.plot_runs(fit.data, [0, 1], "two runs").axes


@pytest.mark.slow
def test_a_comparison_ranks_every_model_on_left_out_runs(fit):
    found = fit.compare("sectors", parts=2, quiet=True)
    floor = found.floors["gray"]
    assert floor.runs == 12
    assert floor.models[floor.best].verdict == "best"
    assert str(found) == floor.sentence
    assert found.plot().axes
    with pytest.raises(sl.DataError, match="no such question"):
        fit.compare("moons", quiet=True)


@pytest.mark.slow
def test_a_proposal_has_the_requested_runs(fit):
    proposal = fit.design("surface.gray.creep", runs=2)
    assert len(proposal.runs) == 2
    assert str(proposal).startswith("run,floor,load,vx_m_s")
    assert proposal.plot().axes
    with pytest.raises(sl.DataError, match="matches no parameter"):
        fit.design("surface.gray.nonsense")


@pytest.mark.slow
def test_a_closed_loop_run_prints_its_path_errors(fit):
    robot = fit.deploy()
    found = sl.drive(robot, "encoder", start=1, seed=2)
    assert found.run.pose.shape == found.run.estimated_pose.shape
    assert f"{found.metrics.closure_mm:.0f} mm from the end of the path" in str(found)
    with pytest.raises(
        ValueError, match="unknown controller 'magic' or start 0; expected one of encoder"
    ):
        sl.drive(robot, "magic")
    with pytest.raises(sl.DataError, match="no path 'square'"):
        sl.drive(robot, "encoder", path="square")


@pytest.mark.slow
def test_a_drive_on_a_map_of_ones_own_is_on_that_map(fit, tmp_path):
    robot = fit.deploy()
    there, far = tmp_path / "lab.toml", "[-1, -1, 1, 1]"
    there.write_text(f'schema = "slipid.map/1"\nbase = "gray"\nextent_m = {far}\ncell_m = 0.1\n')
    found = sl.drive(robot, "contact_map", map=there, path="circle", speed=0.1)
    assert found.floor.surfaces == ("gray",)
    assert found.run.path.duration > 20
    seen = found.run.estimate.surface_probability[-1]
    assert seen[:, robot.labels.index("gray")].min() > 0.8
    there.write_text(there.read_text().replace("gray", "ice"))
    with pytest.raises(sl.DataError, match=r"lab\.toml: surface 'ice' was not identified"):
        sl.drive(robot, "contact_map", map=there)
