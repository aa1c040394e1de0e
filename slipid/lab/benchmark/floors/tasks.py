"""Floor classification on two logged data sets: the Husky's, without a pose, and the Robotino's.

In the data set `borealtc` a Husky drives on five floors. The robot is described by data of its
manufacturer and by measurements of its motors and ammeters. Without a pose the torque constant is
not identified: friction coefficients scale with the assumed constant, and only their ratios between
floors are meaningful. Logs have a folder per floor with a CSV file per run.

The Robotino's runs of 2022 are classified from wheel speeds and current magnitudes. They are split
by headings, as elsewhere in the benchmark, and start where the wheels have moved a centimetre; none
of them contains a stop or a second start. The row of slipid is the deployed estimator with its
default settings, from a fit to the training runs with their poses. It is given the load set-up of a
run, which a real robot knows as well. The other rows use neither poses nor loads, and are fitted to
runs with all loads together.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from slipid.data.reading.layout import Channel, Layout
from slipid.data.reading.table import read_table
from slipid.lab.benchmark.floors.protocol import (
    EvaluationSettings,
    FloorTask,
    answers_after,
    attempted,
    classifier_table,
    evaluated,
    table_of,
)
from slipid.lab.benchmark.floors.result import Answer, ClassifierTable
from slipid.lab.benchmark.floors.slipid_row import SlipidFloorClassifier
from slipid.lab.benchmark.protocols import base_of, splits
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.slipid_rows import NAME, FloorKnowledge, estimator_runs
from slipid.lab.benchmark.work import BenchmarkOptions, FoldData, FoldTask, data_of, fold_data
from slipid.lab.systems.floors.cosine_energy import CosineEnergyClassifier
from slipid.lab.systems.floors.interface import FloorClassifier, FloorSignals
from slipid.lab.systems.floors.learned import GaussianClassifier, tree_classifiers
from slipid.model.geometry import skid_steer
from slipid.model.robot import Robot, build
from slipid.predict.slip_model import PredictedRun, RobotSpec, Run
from slipid.support.errors import bad_data
from slipid.support.files import hash_of

RADIUS = 0.165
"""Wheel radius of the Husky [m]."""
MASS = 60.0
"""Mass of the Husky [kg]."""
REST_READING_A = 0.59
"""Reading of the Husky's ammeters for wheels at rest, subtracted from all readings [A]."""
NO_LOAD_A, NO_LOAD_SLOPE = 0.54, 0.032
"""Motor current of a Husky's wheel that turns in the air: at low speed [A], and its increase per
wheel speed [A s/rad]."""

HUSKY_FOLDER = "borealtc"
HUSKY_ABOUT = (
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
    folder = HUSKY_FOLDER

    @property
    def rows(self) -> Sequence[str]:
        return [method.name for method in husky_classifiers()]

    def log_hash(self) -> str:
        root = self.options.data / HUSKY_FOLDER
        files = sorted(root.glob("*/*.csv"))
        return hash_of((str(f.relative_to(root)), f.read_text(errors="replace")) for f in files)

    def make(self) -> ClassifierTable:
        runs, only = read_floor_runs(self.options.data / HUSKY_FOLDER, RADIUS), self.options.only
        spec = RobotSpec.of(husky().on(["any"]))
        methods = [method for method in husky_classifiers() if not only or method.name in only]
        settings = EvaluationSettings.quick() if self.options.quick else EvaluationSettings()
        return classifier_table(methods, runs, spec, HUSKY_ABOUT, settings)


ROBOTINO, KIND = "robotino2022", "headings"
"""Name of the data set, and the kind of its split into folds."""
SECONDS = (0.5, 1.0, 2.0, 4.0)
"""Times after which answers are read [s]; steps last about 0.3 s, runs 6 s or more."""
ROBOTINO_ABOUT = "Robotino on four floors, straight runs: wheel speeds and magnitudes of currents"


def robotino_classifiers() -> list[FloorClassifier]:
    """Return the classifiers other than slipid that need no accelerometer."""
    trees = [row for row in tree_classifiers() if "vibration" not in row.channels]
    return [CosineEnergyClassifier(), GaussianClassifier(), *trees]


def robotino_table(options: BenchmarkOptions) -> ClassifierTable:
    """Return the table of all classifiers, or of those requested, on the Robotino's runs.

    If a checkpoint has a fit of slipid to the same runs, the fit is reused.
    """
    data = data_of(options, ROBOTINO)
    inner = 1 if options.quick else 2
    settings = EvaluationSettings(seconds=SECONDS, inner=inner, first_s=max(SECONDS))
    folds: dict[str, list[FoldScore[Answer]]] = {}
    every: list[FloorSignals] = []
    for split in splits(data.facts, KIND)[: 1 if options.quick else None]:
        fold = fold_data(FoldTask(options, ROBOTINO, KIND, split.fold))
        training, held_out = ([floor_signals(r) for r in rs] for rs in (fold.training, fold.runs))
        every += held_out
        work = {NAME: partial(_slipid_answers, fold, held_out)}
        for method in robotino_classifiers():
            work[method.name] = partial(evaluated, method, training, held_out, data.spec, settings)
        for name, one in work.items():
            if not options.only or name in options.only:
                folds.setdefault(name, []).append(attempted(one))
    return table_of(folds, every, ROBOTINO_ABOUT, settings, NAME)


def floor_signals(run: Run) -> FloorSignals:
    """Return the signals of a run that floor classifiers use, without its pose.

    Raises:
        ValueError: the run has no currents.
    """
    signals = run.signals
    if signals.current is None:
        raise ValueError(
            f"{signals.name}: no currents; expected currents, which floor classifiers need"
        )
    return FloorSignals(
        name=signals.name,
        floor=base_of(run.floor),
        time=np.cumsum(signals.dt),
        speed=signals.speed,
        current=np.abs(signals.current),
        gyro=signals.gyro,
    )


def _slipid_answers(fold: FoldData, runs: list[FloorSignals]) -> FoldScore[Answer]:
    """Return the result of slipid's estimator on the held-out runs of a fold."""
    fit = fold.fit
    if isinstance(fit, FoldScore):
        return FoldScore(absent=fit.absent, failed=True)
    began = time.perf_counter()
    predicted = estimator_runs(fit, fold.batches, fold.held_out, FloorKnowledge())
    took = time.perf_counter() - began
    answers: list[Answer] = []
    for run, one in zip(runs, predicted, strict=True):
        labels, beliefs = beliefs_of(one)
        answers += answers_after(run, beliefs, labels, SECONDS)
    step_us = 1e6 * took / sum(map(len, runs))
    return FoldScore(tuple(answers), numbers=fit.numbers, fit_s=fit.seconds, step_us=step_us)


def beliefs_of(predicted: PredictedRun) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the known floors and their probabilities, given that the true floor is one of them."""
    assert predicted.floors is not None
    labels = tuple(name for name in predicted.floors if name != "unknown")
    each = np.stack([predicted.floors[name] for name in labels], axis=1)
    return labels, each / each.sum(axis=1, keepdims=True)


class RobotinoFloorTask(FloorTask):
    """Task that makes the table of the Robotino on four floors."""

    name = "robotino_floors"
    folder = ROBOTINO

    @property
    def rows(self) -> Sequence[str]:
        return [NAME, *(method.name for method in robotino_classifiers())]

    def log_hash(self) -> str:
        return data_of(self.options, ROBOTINO).job.data_hash

    def make(self) -> ClassifierTable:
        return robotino_table(self.options)
