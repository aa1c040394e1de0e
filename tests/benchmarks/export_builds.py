"""What benchmarks of the exported C code share: robots, builds, and drives on the twin.

    SLIPID_FIT=demo_out/result .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_export*.py

The robot is that of SLIPID_FIT, a folder `slipid identify` wrote, on its first three floors;
without one it is made up.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.deploy.controllers import control_loop_of
from slipid.deploy.deploy import actuator_model_of, read_robot
from slipid.deploy.floors import floor_of
from slipid.deploy.twin_run import starts, twin_floor
from slipid.exports.c99.code import Code
from slipid.lab.trial.controllers import ROWS
from slipid.model.geometry import omni
from slipid.robot import trajectory
from slipid.robot.closed_loop import ControlLoop
from slipid.robot.deployed import DeployedRobot
from slipid.robot.interface import PERIOD
from slipid.robot.twin import Twin
from tests.benchmarks.quick import quick
from tests.helpers.compiled_c import CompiledC
from tests.helpers.exported import known

HERE = Path(__file__).parent
FAST = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
PLAIN = ("-O2",)
KINDS = {"double": (), "float": ("-DSLIPID_FLOAT",)}
SHARE = float(os.environ.get("SLIPID_BENCH_SHARE", quick("1", "0.002")))
"""Part of all steps and runs that is done, to try the benchmark."""
NUDGE = 1e-14
"""What states and inputs of a doubtful step are changed by, relatively."""
THREE = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)


def needs(*names: str) -> pytest.MarkDecorator:
    """Skip where one of these programs is not installed."""
    absent = [name for name in names if shutil.which(name) is None]
    return pytest.mark.skipif(bool(absent), reason=f"not installed: {', '.join(absent)}")


def ran(command: Sequence[object], folder: Path, allowed: Sequence[int] = (0,)) -> str:
    """What a command printed; a failure shows it."""
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode in allowed, f"{' '.join(words)}\n{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


@cache
def three_floors() -> DeployedRobot:
    """A robot of three wheels on three floors."""
    folder = os.environ.get("SLIPID_FIT")
    if folder:
        robot = read_robot(Path(folder))
        return robot.on(*robot.labels[:3])
    return known(THREE, ("firm", "medium", "soft"))


def rounds(count: int) -> trajectory.Path:
    """So many times round a circle to the right, in 11 s each."""
    shape = [trajectory.arc(0.35, -2 * np.pi * count)]
    return trajectory.tangent(shape).without_turning().after_rest(1.0)


PATH = rounds(6)


@cache
def control_loop(row: str) -> ControlLoop:
    """Estimator and controller of a row."""
    return control_loop_of(three_floors(), ROWS[row])


@cache
def code(row: str) -> Code:
    """Their code."""
    return Code(three_floors(), control_loop(row), PATH)


class Fleet(CompiledC):
    """Generated code that drives many robots along its path at once."""

    def __init__(self, made: Code, folder: Path, flags: Sequence[str]):
        super().__init__(made, folder, (*flags, "-I.", str(HERE / "export_fleet.c")))
        parts = [("estimator", self.estimator.dtype), ("controller", self.controller.dtype)]
        self.state = np.dtype([*parts, ("time", self.kinds.real)], align=True)
        assert self.library.fleet_state_size() == self.state.itemsize

    def start(self, count: int) -> np.ndarray:
        """States of robots at 0, 0, 0."""
        out = np.zeros(count, self.state)
        self.library.fleet_init(ctypes.c_int32(count), out.ctypes.data_as(ctypes.c_void_p))
        return out

    def drive(
        self, state: np.ndarray, reading: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Estimates, references and commands one period later; states are changed in place."""
        count = len(state)
        said = np.zeros(count, self.estimate.dtype)
        reference = np.zeros((count, 6), self.kinds.real)
        command = np.zeros((count, len(self.command)), self.kinds.real)
        arrays = (state, reading, said, reference, command)
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in arrays]
        self.library.fleet_drive(ctypes.c_int32(count), self._number(PERIOD), *pointers)
        return said, reference, command


class Plants:
    """Twins of a robot, one for every start, on the patches that `slipid trial` drives on."""

    def __init__(self, robot: DeployedRobot, path: trajectory.Path, count: int):
        ground = twin_floor(robot)
        self.twin = Twin(
            robot, floor_of(ground, robot.labels), actuator_model_of(robot, gyro=False)
        )
        self.starts = jnp.asarray(starts(count, ground, path))
        self.keys = jax.vmap(jax.random.key)(jnp.arange(count))
        noise = self.twin.noise

        def first(start, key):
            state = self.twin.init(start, key)
            return state, self.twin.first(state, noise(key, 0))

        self._first = jax.jit(jax.vmap(first))
        self._step = jax.jit(
            jax.vmap(lambda s, c, k, n: self.twin.step(s, c, noise(k, n)), (0, 0, 0, None))
        )

    def begin(self):
        """States and readings of all robots at rest."""
        return self._first(self.starts, self.keys)

    def step(self, state, command: np.ndarray, number: int):
        """States and readings a period after commands; the number of the step gives the noise."""
        return self._step(state, jnp.asarray(command, float), self.keys, number)


@dataclass(frozen=True)
class Drive:
    """What a robot reads and is asked for on its way, a row per period, as C has them."""

    reading: np.ndarray
    reference: np.ndarray
    dt: np.ndarray

    def write(self, path: Path) -> Path:
        """The rows in a file, as `export_time.c` reads it."""
        arrays = (self.reading, self.reference, self.dt)
        count = np.array([len(self.dt)], np.int64)
        path.write_bytes(b"".join(a.tobytes() for a in (count, *arrays)))
        return path


def driven(made: Code, robot: DeployedRobot, fleet: Fleet, steps: int = 1200) -> Drive:
    """A drive of one robot on its twin."""
    from tests.helpers.c_against_jax import records

    assert made.path is not None
    plants = Plants(robot, made.path, 1)
    state, (plant, read) = fleet.start(1), plants.begin()
    rows, asked = [], []
    for number in range(1, steps + 1):
        rows.append(records(fleet.reading, read, 1))
        _, reference, command = fleet.drive(state, rows[-1])
        asked.append(reference[0])
        plant, read = plants.step(plant, command, number)
    dt = np.full(steps, PERIOD, fleet.kinds.real)
    return Drive(np.concatenate(rows), np.array(asked), dt)


def nudged(given, rng, nudge=NUDGE):
    """The same with every number off by a few roundings."""

    def one(x):
        if x.dtype != float:
            return x
        return x * (1 + nudge * rng.uniform(-1.0, 1.0, x.shape))

    return jax.tree.map(one, given)
