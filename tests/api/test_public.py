"""The example of `docs/python.md`, word by word, and the rest of the public interface."""

from __future__ import annotations

import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np
import pytest

import slipid as sl
from tests.api.conftest import write_runs


@pytest.mark.slow
def test_the_example_of_the_docs_runs(world):
    assert (world["folder"] / "robot.json").is_file()
    assert np.shape(world["estimate"].pose) == (3,)
    assert set(world["estimate"].surface) <= {"gray", "unknown"}
    assert "\nsurface.gray" in str(world["fit"])
    assert world["fit"]["robot.load_share@as_built"].verdict
    assert "not converged" in str(world["posterior"]).lower()


@pytest.mark.slow
def test_pictures_and_predictions(world):
    fit = world["fit"]
    for name in ("slip_by_heading", "slip_by_torque", "current_by_traction", "paths"):
        assert fit.plot(name).axes
    assert {"intervals", "pairs"} == {
        n for n in ("intervals", "pairs") if world["posterior"].plot(n)
    }
    with pytest.raises(ValueError, match="no figure 'nonsense'; expected one of slip_by"):
        fit.plot("nonsense")
    found = fit.validate(world["runs"])
    assert "identified" in str(found)
    assert found.plot().axes
    assert {"posterior", "observed_data"} <= set(world["posterior"].tree.children)
    plt.close("all")


@pytest.mark.slow
def test_what_is_deployed_has_the_numbers_that_are_shown(world):
    robot = sl.DeployedRobot.load(world["folder"] / "robot.json")
    kept = robot.record.parameters["surface.gray.creep"].value
    assert kept == world["posterior"].parameters["surface.gray.creep"].value
    by_curvature = world["fit"].deploy().record
    assert by_curvature.source == "laplace"
    assert (
        by_curvature.parameters["surface.gray.creep"].value
        == world["fit"]["surface.gray.creep"].value
    )


@pytest.mark.slow
def test_a_wrong_name_is_refused_with_the_choices(tmp_path):
    write_runs(tmp_path)
    runs = sl.read_runs(tmp_path, "one_surface/gray/*.csv", layout="robotino2022")
    robot = sl.Robot.omni([60, 180, 300], base_radius=0.125, wheel_radius=0.04, gear_ratio=16)
    with pytest.raises(ValueError, match=r"no parameter 'motor\.nonsense'; there are: robot\."):
        sl.fit(runs, robot, fixed={"motor.nonsense": 1.0}, quiet=True)
    with pytest.raises(sl.DataError, match="no file matches"):
        sl.read_runs(tmp_path, "nothing/*.csv", layout="robotino2022")


def test_every_public_name_is_there():
    for name in sl.__all__:
        assert getattr(sl, name) is not None
    assert set(sl.__all__) <= set(dir(sl))
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        _ = sl.nonsense


@pytest.mark.slow
def test_setting_up_jax_reports_its_settings():
    code = "import slipid, jax; slipid.setup_jax(); print(jax.config.jax_enable_x64)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "float64" in done.stderr
    assert done.stdout.strip() == "True"
