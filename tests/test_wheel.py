"""Sdist and wheel: what they hold, and that the wheel works in a fresh environment."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import slipid
from slipid.lab.selftest.logs import SimulatedSensors, simulate_logs, true_robot
from tests.helpers.made_logs import write_logs
from tests.helpers.shared import DRIVES, FEW

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.nightly


def run(*words: object, folder: Path, expected: int = 0, **more) -> subprocess.CompletedProcess:
    """A program that ran in a folder, without what the tests' own environment sets."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MPLBACKEND")}
    done = subprocess.run(
        [*map(str, words)], cwd=folder, env=kept, capture_output=True, text=True, **more
    )
    assert done.returncode == expected, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def packages(tmp_path_factory) -> tuple[Path, Path]:
    """Sdist, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("packages")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--no-deps"]
    reached = subprocess.run(
        [*pip, "--dest", folder / "reached", "hatchling"], capture_output=True, text=True
    )
    if reached.returncode:
        pytest.skip(f"no package index: {reached.stderr.strip().splitlines()[-1]}")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, folder=folder)
    [sdist], [wheel] = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


@pytest.fixture(scope="module")
def installed(packages, tmp_path_factory) -> Path:
    """A folder with a fresh environment, in which the wheel is installed without extras."""
    folder = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "venv", ".venv", folder=folder)
    run(".venv/bin/pip", "install", "--quiet", packages[1], folder=folder)
    robot = true_robot(DRIVES)
    runs = simulate_logs(robot, DRIVES, 1, SimulatedSensors())
    write_logs(runs, robot, folder / "logs", folder / "truth")
    return folder


def typed(output: str) -> str:
    """The command that a message names."""
    [command] = set(re.findall(r"install it with: (.*)", output))
    return command


def test_the_packages_pass_the_check_of_the_index(packages):
    run(sys.executable, "-m", "twine", "check", "--strict", *packages, folder=packages[0].parent)


def test_the_packages_hold_every_file(packages):
    sdist, wheel = packages
    tracked = run("git", "ls-files", folder=ROOT).stdout.splitlines()
    inside = {name for name in tracked if name.startswith(("slipid/", "configs/"))}
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {re.sub("^configs/", "slipid/configs/", name) for name in inside} - names == set()
    assert any(name.endswith("licenses/LICENSE") for name in names)
    root = f"slipid-{slipid.__version__}"
    with tarfile.open(sdist) as archive:
        held = {name.removeprefix(f"{root}/") for name in archive.getnames()}
    assert {name for name in tracked if not name.startswith(".")} - held == set()


def test_the_wheel_identifies_without_extras(installed):
    slip = installed / ".venv/bin/slipid"
    assert run(slip, "--version", folder=installed).stdout == f"slipid {slipid.__version__}\n"
    site = next(installed.glob(".venv/lib/python*/site-packages"))
    assert not {"matplotlib", "sklearn", "rosbags", "emcee", "mujoco", "cv2"} & {
        path.name for path in site.iterdir()
    }
    wheels = ("--drive", "omni", "--wheel-radius-m", "0.04", "--base-radius-m", "0.125")
    run(slip, "new", "--yes", *wheels, folder=installed)
    (installed / "my.toml").write_bytes((site / "slipid/configs/robotino.toml").read_bytes())
    words = ("my.toml", "--data", "logs", "--out")
    done = run(slip, "identify", *words, "cal", "--only", "calibration", folder=installed)
    assert "rolling radius" in done.stdout
    done = run(slip, "identify", *words, "out", folder=installed)
    assert typed(done.stderr) == ".venv/bin/pip install 'slipid[report]'"
    assert "all pictures are left out" in done.stderr
    found = json.loads((installed / "out/identified.json").read_text())["parameters"]
    assert found["motor.resistance"]["value"] == pytest.approx(5.5, rel=0.03)
    run(slip, "validate", "out", "--data", "logs", folder=installed)
    run(slip, "export", "out", "--to", "table,c", "--out", "to_go", folder=installed)


def test_what_is_missing_is_installed_by_the_command_of_the_message(installed):
    slip = installed / ".venv/bin/slipid"
    told = run(slip, "sample", "out", *FEW, folder=installed, expected=2)
    for command in (typed(told.stderr), ".venv/bin/pip install 'slipid[report]'"):
        assert run("sh", "-c", f"{command} --quiet", folder=installed).stdout == ""
    run(slip, "sample", "out", *FEW, folder=installed, expected=1)  # too few draws to converge
    assert (installed / "out/posterior.nc").is_file()
    assert (installed / "out/posterior_intervals.png").is_file()
