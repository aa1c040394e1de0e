"""The Husky of the public logs as its maker has it, and how its motors and ammeters behave.

Without a pose nothing tells what a motor's torque is; frictions of floors are then in units of the
assumed torque constant, and only their ratios mean something.

Runs without poses: a folder per floor, a CSV file per run.

The floors of the Robotino runs of 2022, by wheels and sizes of currents alone.

Runs are split by headings, as elsewhere in the benchmark, and are heard from where the wheels have
moved a centimetre; none of them stands or starts anew in between. slipid is its fit to the training
runs with their poses, and the estimator as it is deployed, with its own settings. It knows how the
robot is loaded, as a robot in service does; the other rows see neither poses nor loads, and are
fitted to runs with all loads together.
"""

import time
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.lab.benchmark.floors.protocol import (
    EvaluationSettings,
    ScoredClassifier,
    answers_after,
    answers_of,
    attempted,
    table_of,
    tuned,
)
from slipid.lab.benchmark.floors.result import Answer, ClassifierRow, ClassifierTable
from slipid.lab.benchmark.protocols import Split, base_of, splits
from slipid.lab.benchmark.sets import DataSet
from slipid.lab.benchmark.slipid_rows import (
    NAME,
    FloorKnowledge,
    SlipidFit,
    estimator_runs,
    fit_slipid,
)
from slipid.lab.benchmark.steps import RunBatch, run_batches
from slipid.lab.benchmark.work import BenchmarkOptions, FoldTask, data_of, kept_of, problem_of
from slipid.lab.systems.floors.cosine_energy import CosineEnergyClassifier, tree_rows
from slipid.lab.systems.floors.gaussian import GaussianClassifier
from slipid.lab.systems.floors.interface import FloorClassifier, FloorSignals
from slipid.model.geometry import skid_steer
from slipid.model.robot import Robot, build
from slipid.predict.slip_model import PredictedRun, RobotSpec, Run
from slipid.support.errors import bad_data

RADIUS = 0.165
"""Of the wheels [m]."""
MASS = 60.0
"""[kg]"""
ZERO_A = 0.59
"""What the ammeters show of wheels that stand [A]; of wheels that brake they show nothing."""
FREE_A, FREE_AS = 0.54, 0.032
"""Friction of a wheel in the air, and its growth with the wheel's speed [A], [A s/rad]."""


def husky() -> Robot:
    """The robot, on no floor yet."""
    robot = build(skid_steer(0.256, 0.275, RADIUS, 78.71, drive_of=(0, 1, 0, 1)), ())
    gain = float(robot.motor.gain)
    motor = replace(
        robot.motor,
        coulomb_friction=jnp.asarray(gain * FREE_A),
        viscous_friction=jnp.asarray(gain * FREE_AS),
    )
    return replace(robot, motor=motor, body=replace(robot.body, mass=jnp.asarray(MASS)))


COLUMNS = ("time", "curL", "curR", "velL", "velR", "gyro_z", "accel_std")
"""Time [s], currents without a sign [A], rim speeds [m/s], yaw rate [rad/s], and the std of the
vertical acceleration since the row before [m/s^2]."""
NEEDED = COLUMNS[:5]
"""Columns in which nothing may be missing."""
LONGEST_S = 0.5
"""Time between two rows beyond which a file holds two runs [s]."""
FEWEST = 3
"""Rows that a run has at least."""


def read_floor_runs(root: Path, wheel_radius: float) -> list[FloorSignals]:
    """Runs of a skid-steer robot below a folder, one folder per floor, as `borealtc` has them.

    A file is one run, or several where rows are more than `LONGEST_S` apart.

    Args:
        root: the folder.
        wheel_radius: [m].

    Raises:
        DataError: no file, or one that cannot be read; names file, row and column.
    """
    files = sorted(root.glob("*/*.csv"))
    if not files:
        raise bad_data(root, "no file FLOOR/RUN.csv", "a folder per floor and a file per run")
    return [run for path in files for run in _runs(path, wheel_radius)]


def _runs(path: Path, wheel_radius: float) -> list[FloorSignals]:
    """Runs of one file."""
    rows = _rows(path)
    column = dict(zip(COLUMNS, rows.T, strict=True))
    whole = FloorSignals(
        name=f"{path.parent.name}/{path.stem}",
        floor=path.parent.name.lower(),
        time=column["time"],
        speed=np.stack([column["velL"], column["velR"]], axis=1) / wheel_radius,
        current=np.stack([column["curL"], column["curR"]], axis=1),
        gyro=column["gyro_z"],
        vibration=column["accel_std"],
    )
    edges = [0, *(np.flatnonzero(np.diff(whole.time) > LONGEST_S) + 1), len(whole)]
    parts = [whole.part(int(a), int(b)) for a, b in pairwise(edges)]
    return [part for part in parts if len(part) >= FEWEST]


def _rows(path: Path) -> Float[np.ndarray, "row 7"]:
    """Numbers of a file, columns in the order of `COLUMNS`."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise bad_data(path, f"cannot be read ({error})", "a CSV file") from error
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    for name in COLUMNS:
        if name not in names:
            raise bad_data(path, "no such column", f"columns {', '.join(COLUMNS)}", column=name)
    place = [names.index(name) for name in COLUMNS]
    rows = np.array(
        [_numbers(path, number, line, len(names)) for number, line in enumerate(lines[1:], 2)]
    ).reshape(-1, len(names))[:, place]
    if len(rows) < FEWEST:
        raise bad_data(path, f"{len(rows)} rows", f"{FEWEST} at least")
    for k, name in enumerate(NEEDED):
        missing = np.flatnonzero(~np.isfinite(rows[:, k]))
        if len(missing):
            raise bad_data(path, "no number", "one", row=int(missing[0]) + 2, column=name)
    back = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if len(back):
        row = int(back[0]) + 3
        raise bad_data(path, "does not increase", "growing times", row=row, column="time")
    return np.asarray(rows)


def _numbers(path: Path, number: int, line: str, count: int) -> list[float]:
    """Numbers of a line, NaN where there is nothing."""
    cells = line.split(",")
    if len(cells) != count:
        raise bad_data(path, f"{len(cells)} cells", f"{count}", row=number)
    try:
        return [float(cell) if cell.strip() else float("nan") for cell in cells]
    except ValueError as error:
        raise bad_data(path, str(error), "numbers", row=number) from error


SOURCE, KIND = "robotino2022", "headings"
SECONDS = (0.5, 1.0, 2.0, 4.0)
"""After which classifiers are asked; steps last a third of a second, runs six and more [s]."""
ABOUT = "Robotino on four floors, straight runs: wheel speeds and sizes of currents"


def robotino_classifiers() -> list[FloorClassifier]:
    """Classifiers beside slipid; without a gyro and an accelerometer there is no vibration row."""
    trees = [row for row in tree_rows() if not row.hearing.vibration]
    return [CosineEnergyClassifier(), GaussianClassifier(), *trees]


def robotino_table(wish: BenchmarkOptions) -> ClassifierTable:
    """The table of all classifiers on the Robotino's runs, or of those that are wished for.

    A fit of slipid that is kept of the same runs is not done again.
    """
    data = data_of(wish, SOURCE)
    found = splits(data.facts, KIND)[: 1 if wish.quick else None]
    asked = EvaluationSettings(seconds=SECONDS, inner=1 if wish.quick else 2)
    parts: dict[str, list[ScoredClassifier]] = {}
    judged: list[FloorSignals] = []
    for split in found:
        own = fit_slipid(
            data.job,
            problem_of(wish, SOURCE),
            split.fitted,
            kept_of(FoldTask(wish, SOURCE, KIND, split.fold), fit=True),
        )
        fitted, cuts = _fitted(data, split, own), _judged(data, split, own)
        felts = [floor_signals(run) for one in cuts for run in one.runs]
        judged += felts
        if not wish.only or NAME in wish.only:
            done = attempted(NAME, partial(_own, own, cuts, data, split, felts))
            parts.setdefault(NAME, []).append(done)
        for method in robotino_classifiers():
            if not wish.only or method.name in wish.only:
                work = partial(_published, method, fitted, felts, data.spec, asked)
                done = attempted(method.name, work)
                parts.setdefault(method.name, []).append(done)
    return table_of(
        {name: _joined(each) for name, each in parts.items()}, judged, ABOUT, asked, NAME
    )


def floor_signals(run: Run) -> FloorSignals:
    """A run as classifiers hear it, without its pose.

    Raises:
        ValueError: it has no currents.
    """
    heard = run.signals
    if heard.current is None:
        raise ValueError(f"{heard.name}: no current; floors are felt by it")
    return FloorSignals(
        name=heard.name,
        floor=base_of(run.floor),
        time=np.cumsum(heard.dt),
        speed=heard.speed,
        current=np.abs(heard.current),
        gyro=heard.gyro,
    )


def _fitted(data: DataSet, split: Split, own: SlipidFit) -> list[FloorSignals]:
    cuts = run_batches(
        data.logged.subset(split.fitted), own.contact.robot, data.source.poses_per_step
    )
    runs = {k: run for one in cuts for k, run in zip(one.numbers, one.runs, strict=True)}
    return [floor_signals(runs[k]) for k in sorted(runs)]


def _judged(data: DataSet, split: Split, own: SlipidFit) -> list[RunBatch]:
    return run_batches(
        data.logged.subset(split.judged), own.contact.robot, data.source.poses_per_step
    )


def _own(
    own: SlipidFit, cuts: list[RunBatch], data: DataSet, split: Split, felts: list[FloorSignals]
) -> ScoredClassifier:
    """What the estimator says of the runs that were left out."""
    began = time.perf_counter()
    said = estimator_runs(own, cuts, data.logged.subset(split.judged), FloorKnowledge())
    took = time.perf_counter() - began
    answers: list[Answer] = []
    for felt, one in zip(felts, said, strict=True):
        labels, beliefs = beliefs_of(one)
        answers += answers_after(felt, beliefs, labels, SECONDS)
    rows = sum(len(felt) for felt in felts)
    row = ClassifierRow(NAME, numbers=own.numbers, fit_s=own.seconds, row_us=1e6 * took / rows)
    return ScoredClassifier(row, tuple(answers))


def beliefs_of(said: PredictedRun) -> tuple[tuple[str, ...], np.ndarray]:
    """Floors, and their probabilities given that it is one of them."""
    assert said.floors is not None
    labels = tuple(name for name in said.floors if name != "unknown")
    each = np.stack([said.floors[name] for name in labels], axis=1)
    return labels, each / each.sum(axis=1, keepdims=True)


def _published(
    method: FloorClassifier,
    fitted: list[FloorSignals],
    felts: list[FloorSignals],
    spec: RobotSpec,
    asked: EvaluationSettings,
) -> ScoredClassifier:
    """A classifier fitted to some runs and asked of others, from their starts on."""
    starts = [felt.pieces(max(SECONDS))[0] for felt in felts]
    found = tuned(method, fitted, spec, asked)
    began = time.perf_counter()
    done = found.method.fit(fitted, spec)
    ended = time.perf_counter()
    answers = answers_of(done, starts, spec, SECONDS)
    row = ClassifierRow(
        method.name,
        settings=(found.settings,),
        numbers=done.numbers,
        fit_s=ended - began,
        tune_s=found.seconds,
        row_us=1e6 * (time.perf_counter() - ended) / sum(len(felt) for felt in starts),
    )
    return ScoredClassifier(row, tuple(answers))


def _joined(parts: list[ScoredClassifier]) -> ScoredClassifier:
    """All folds of a classifier; an empty row if it failed in one."""
    if failed := [part for part in parts if part.row.absent]:
        return failed[0]

    def median(name: str) -> float:
        return float(np.median([getattr(part.row, name) for part in parts]))

    row = replace(
        parts[0].row,
        settings=tuple(word for part in parts for word in part.row.settings),
        numbers=int(median("numbers")),
        fit_s=median("fit_s"),
        tune_s=median("tune_s"),
        row_us=median("row_us"),
    )
    return ScoredClassifier(row, tuple(answer for part in parts for answer in part.answers))
