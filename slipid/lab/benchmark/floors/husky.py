"""Floor classification on the data set `borealtc`: a Husky on five floors, without a pose.

The robot is described by data of its manufacturer and by measurements of its motors and ammeters.
Without a pose the torque constant is not identified: friction coefficients scale with the assumed
constant, and only their ratios between floors are meaningful.

Logs have a folder per floor with a CSV file per run.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from slipid.data.reading.layout import Channel, Layout
from slipid.data.reading.table import read_table
from slipid.lab.benchmark.floors.protocol import EvaluationSettings, FloorTask, classifier_table
from slipid.lab.benchmark.floors.result import ClassifierTable
from slipid.lab.benchmark.floors.slipid_row import SlipidFloorClassifier
from slipid.lab.systems.floors.cosine_energy import CosineEnergyClassifier
from slipid.lab.systems.floors.interface import FloorClassifier, FloorSignals
from slipid.lab.systems.floors.learned import GaussianClassifier, tree_classifiers
from slipid.model.geometry import skid_steer
from slipid.model.robot import Robot, build
from slipid.predict.slip_model import RobotSpec
from slipid.support.errors import bad_data
from slipid.support.files import hash_of

RADIUS = 0.165
"""Wheel radius [m]."""
MASS = 60.0
"""Mass of the robot [kg]."""
REST_READING_A = 0.59
"""Reading of the ammeters for wheels at rest, subtracted from all readings [A]."""
NO_LOAD_A, NO_LOAD_SLOPE = 0.54, 0.032
"""Motor current of a wheel that turns in the air: at low speed [A], and its increase per wheel
speed [A s/rad]."""

FOLDER = "borealtc"
ABOUT = (
    "Husky on five floors, without poses: wheel speeds, magnitudes of currents and a gyro, 6.5 "
    "rows per second"
)
COLUMNS = ("time", "curL", "curR", "velL", "velR", "gyro_z", "accel_std")
"""Columns that are read: time [s], magnitudes of the currents of the left and right motors [A], rim
speeds left and right [m/s], yaw rate [rad/s], and the std of the vertical acceleration since the
previous row [m/s^2]."""
LAYOUT = Layout({name: Channel(columns=(name,), unit="1") for name in COLUMNS})
REQUIRED_COLUMNS = COLUMNS[:5]
"""Columns in which a missing value is an error: time, currents and rim speeds."""
LARGEST_GAP_S = 0.5
"""Time between two rows above which a file is split into two runs there [s]."""
FEWEST_ROWS = 3
"""Smallest number of rows of a run; shorter runs are omitted."""


def husky() -> Robot:
    """Return the Husky without floors, from its maker's data and measured motor friction."""
    robot = build(skid_steer(0.256, 0.275, RADIUS, 78.71, drive_of=(0, 1, 0, 1)), ())
    gain = float(robot.motor.gain)
    motor = replace(
        robot.motor,
        coulomb_friction=jnp.asarray(gain * NO_LOAD_A),
        viscous_friction=jnp.asarray(gain * NO_LOAD_SLOPE),
    )
    return replace(robot, motor=motor, body=replace(robot.body, mass=jnp.asarray(MASS)))


def read_floor_runs(root: Path, wheel_radius: float) -> list[FloorSignals]:
    """Read the runs of a skid-steer robot below a folder, one folder per floor, as in `borealtc`.

    A file is one run, or several where rows are more than `LARGEST_GAP_S` apart.

    Args:
        root: the folder.
        wheel_radius: wheel radius [m].

    Raises:
        DataError: there is no file, or one cannot be read; names file, row and column.
    """
    files = sorted(root.glob("*/*.csv"))
    if not files:
        raise bad_data(root, "no file FLOOR/RUN.csv", "a folder per floor and a file per run")
    return [run for path in files for run in _runs(path, wheel_radius)]


def _runs(path: Path, wheel_radius: float) -> list[FloorSignals]:
    """Return the runs of one file; DataError if a value is missing or times do not increase."""
    table = read_table(path, LAYOUT)
    if len(table.values) < FEWEST_ROWS:
        raise bad_data(path, f"{len(table.values)} rows", f"at least {FEWEST_ROWS}")
    for name in REQUIRED_COLUMNS:
        missing = np.flatnonzero(~np.isfinite(table[name]))
        if len(missing):
            row = int(table.lines[missing[0]])
            raise bad_data(path, "no number", "a finite number", row=row, column=name)
    back = np.flatnonzero(np.diff(table["time"]) <= 0)
    if len(back):
        row = int(table.lines[back[0] + 1])
        raise bad_data(path, "does not increase", "increasing times", row=row, column="time")
    whole = FloorSignals(
        name=f"{path.parent.name}/{path.stem}",
        floor=path.parent.name.lower(),
        time=table["time"],
        speed=np.stack([table["velL"], table["velR"]], axis=1) / wheel_radius,
        current=np.stack([table["curL"], table["curR"]], axis=1),
        gyro=table["gyro_z"],
        vibration=table["accel_std"],
    )
    edges = [0, *(np.flatnonzero(np.diff(whole.time) > LARGEST_GAP_S) + 1), len(whole)]
    runs = [whole.rows(int(a), int(b)) for a, b in pairwise(edges)]
    return [run for run in runs if len(run) >= FEWEST_ROWS]


def husky_classifiers() -> list[FloorClassifier]:
    """Return all floor classifiers before their fit, slipid's first."""
    slipid = SlipidFloorClassifier(robot=husky(), zero_a=REST_READING_A)
    return [slipid, CosineEnergyClassifier(), GaussianClassifier(), *tree_classifiers()]


class HuskyFloorTask(FloorTask):
    """Task that makes the table of the Husky on five floors without a pose."""

    name = "husky_floors"
    folder = FOLDER

    @property
    def rows(self) -> Sequence[str]:
        return [method.name for method in husky_classifiers()]

    def log_hash(self) -> str:
        root = self.options.data / FOLDER
        files = sorted(root.glob("*/*.csv"))
        return hash_of((str(f.relative_to(root)), f.read_text(errors="replace")) for f in files)

    def make(self) -> ClassifierTable:
        runs, only = read_floor_runs(self.options.data / FOLDER, RADIUS), self.options.only
        spec = RobotSpec.of(husky().on(["any"]))
        methods = [method for method in husky_classifiers() if not only or method.name in only]
        settings = EvaluationSettings.quick() if self.options.quick else EvaluationSettings()
        return classifier_table(methods, runs, spec, ABOUT, settings)
