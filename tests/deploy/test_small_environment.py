"""robot.json where there is jax, equinox and nothing else of slipid: a real environment."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from slipid.data.floor_map import uniform
from slipid.deploy.floors import floor_of
from slipid.model.geometry import omni
from slipid.model.robot import build
from tests.helpers.known_robot import deploy_known

ROOT = Path(__file__).resolve().parents[2]
ON_THE_ROBOT = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
from slipid.robot.controller import Controller
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator
from slipid.robot.filter.floor import Floor
from slipid.robot.interface import Measurement
from slipid.robot.trajectory import rectangle

robot = DeployedRobot.load(sys.argv[1])
floor = Floor.load(sys.argv[2], robot.labels)
estimator, controller, path = Estimator(robot, floor=floor), Controller(robot), rectangle()
state, held = estimator.init(), controller.init()
for k in range(3):
    z = Measurement(wheel_angle=[0.1 * k, 0.0, -0.1 * k], current=[0.1, 0.0, 0.1])
    state, seen = estimator.step(state, z, 0.05)
    held, command = controller.step(held, path.at(0.05 * k), seen, 0.05)
print(seen.surface.tolist(), bool(seen.finite), command.shape)
"""


@pytest.mark.nightly  # installs packages
def test_a_robot_is_loaded_and_driven_with_jax_and_equinox_alone(tmp_path):
    made = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["firm", "soft"])
    deploy_known(made, highest_speed=8.0).save(tmp_path / "robot.json")
    floor_of(uniform("soft"), ("soft",)).save(tmp_path / "lab.npz", ("soft",))
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    install = [python, "-m", "pip", "install", "-q", "jax", "equinox", "numpy"]
    got = subprocess.run(install, capture_output=True, text=True, check=False)
    if got.returncode:
        pytest.skip(f"no packages to be had: {got.stderr.strip().splitlines()[-1]}")
    bare = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    listed = subprocess.run(
        [python, "-m", "pip", "list"], capture_output=True, text=True, check=True
    )
    for absent in ("optimistix", "lineax", "pydantic", "typer", "rich", "pint", "matplotlib"):
        assert absent not in listed.stdout.lower()
    assert sys.prefix not in str(python)
    done = subprocess.run(
        [python, "-c", ON_THE_ROBOT, str(tmp_path / "robot.json"), str(tmp_path / "lab.npz")],
        env=bare | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    surface, rest = done.stdout.strip().split("] ")
    assert surface.count("'") == 6
    assert rest == "True (3,)"
