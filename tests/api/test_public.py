"""The README's example, word by word, and the rest of the public interface."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import slipid as sl
from slipid.data.write import robotino2022_csv
from slipid.infer.posterior import blocks, sample
from slipid.infer.posterior.blocks import Plan
from slipid.lab.selftest.logs import SimulatedSensors, heading_grid, simulate_logs, true_robot

ROOT = Path(__file__).resolve().parents[2]
FLOORS = (("gray", "as_built"),)
DRIVES = heading_grid(setups=FLOORS, headings=6, speeds=(0.1, 0.3), turns=0)


def example() -> str:
    """The Python example of the README."""
    return re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)[0]


def write_runs(folder: Path) -> None:
    """Made logs of the drives, laid out as those of 2022."""
    for k, log in enumerate(simulate_logs(true_robot(DRIVES), DRIVES, 1, SimulatedSensors())):
        path = folder / "one_surface" / str(log.surface) / f"exp{k:02d}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            robotino2022_csv(replace(log, wheel_speed_command=log.wheel_speed), 16.0, 2000)
        )


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict:
    """Names that the README's example leaves behind, run where its logs are; few steps sampled."""
    folder = tmp_path_factory.mktemp("readme")
    write_runs(folder / "logs")
    around = sample.sampled
    names: dict = {"angle": [0.0, 0.1, 0.2], "amps": [0.3, 0.1, 0.4]}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        few = Plan(ensembles=2, walkers=6, block=4, warm_up=(1, 2), most=3)
        patch.setattr(blocks, "Plan", lambda seed, most: replace(few, seed=seed))
        patch.setattr(
            sample, "sampled", lambda fit, plan, draws, *rest: around(fit, plan, 16, *rest)
        )
        exec(compile(example(), "README.md", "exec"), names)
    names["folder"] = folder
    return names


@pytest.mark.slow
def test_the_example_of_the_readme_runs(world, capsys):
    assert (world["folder"] / "robot.json").is_file()
    assert np.shape(world["estimate"].pose) == (3,)
    assert set(world["estimate"].surface) <= {"gray", "unknown"}
    assert "surface.gray.creep" in str(world["fit"])
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
    with pytest.raises(ValueError, match="no picture 'nonsense'; there are slip_by"):
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
