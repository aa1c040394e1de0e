"""The command `slipid benchmark`: slipid and every published system on the same logs.

The benchmark includes closed-loop runs on the rectangle of the 2021 paper, with published
controllers and slipid's.
"""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import zip_longest
from operator import methodcaller
from pathlib import Path

import numpy as np

from slipid.deploy.deploy import robot_of_force_balance
from slipid.infer.result_folder import ROBOT
from slipid.lab.benchmark.floors.protocol import FloorTask
from slipid.lab.benchmark.floors.tasks import HuskyFloorTask, RobotinoFloorTask, husky_classifiers
from slipid.lab.benchmark.protocols import PROTOCOLS, splits
from slipid.lab.benchmark.rows import ROWS
from slipid.lab.benchmark.scores import FoldScore, RunScore
from slipid.lab.benchmark.sets import SOURCES, is_available
from slipid.lab.benchmark.slipid_rows import NAME, fit_slipid
from slipid.lab.benchmark.summary import RowSummary, reading, summary
from slipid.lab.benchmark.work import (
    FIT_SOURCES,
    MAP_ROW,
    QUICK_KIND,
    BenchmarkOptions,
    FoldTask,
    data_of,
    problem_of,
)
from slipid.lab.trial import trial
from slipid.robot.record import LogSensors
from slipid.support.checkpoint import Checkpoint, key_of, source_hash, versions
from slipid.support.content import Content
from slipid.support.errors import DataError, did_you_mean
from slipid.support.executor import results
from slipid.support.files import read_json, writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SCHEMA = "slipid.benchmark/1"
Tables = dict[str, dict[str, dict[str, RowSummary]]]
"""Row summaries, keyed by name of the data set, then of the protocol, then of the row."""


def benchmark(options: BenchmarkOptions, executor: Executor, report: Reporter) -> Content:
    """Run every row on every available data set, and write benchmark.json.

    Results in checkpoints are not computed again. A row that fails is reported as absent with its
    error, and the other rows are still computed.

    Raises:
        DataError: the data folder or a row does not exist.
    """
    began = time.monotonic()
    setup_jax(quiet=True)
    _check(options)
    sources = [source for source in SOURCES if is_available(source, options.data)]
    for source in SOURCES:
        if source not in sources:
            report.line(f"skipped: {source.name}: no folder {options.data / source.folder}")
    writable(options.out)
    report.stage("reading logs")
    unread: dict[str, str] = {}
    each = []
    for source in sources:
        try:
            each.append(tasks_of(options, source.name))
        except Exception as error:  # the other data sets are compared even if one is unreadable
            unread[source.name] = FoldScore.of_error(error).absent
            report.line(f"skipped: {source.name}: {unread[source.name]}")
    folds = alternating(each)
    floors = [
        task for task in (HuskyFloorTask(options), RobotinoFloorTask(options)) if task.is_requested
    ]
    rectangle = RectangleTask(options)
    # The floor table of the Robotino comes last, since it reuses slipid's fits to the folds by
    # heading.
    tasks: list[FoldTask | FloorTask | RectangleTask] = [*folds, *floors]
    if not options.quick and set(CONTROLLERS) & set(options.only or CONTROLLERS):
        tasks.insert(0, rectangle)
    report.stage(f"{len(tasks)} parts")
    results(executor, methodcaller("run"), {task.name: task for task in tasks}, report)
    closed_loop = rectangle.drive(executor, report) if rectangle in tasks else None
    report.stage("comparing")
    tables = tables_of(folds)
    content = {
        "schema": SCHEMA,
        "quick": options.quick,
        "unread": unread,
        "sets": {name: _set(options, name, protocols) for name, protocols in tables.items()},
        "protocols": {name: p.about for name, p in PROTOCOLS.items()},
        "floors": {task.name: task.table() for task in floors},
        "rectangle": closed_loop,
        "reading": reading(tables),
        "seconds": round(time.monotonic() - began, 1),
        "versions": versions(),
    }
    report.stage("writing")
    write_json(options.out / "benchmark.json", content)
    return content


def tasks_of(options: BenchmarkOptions, name: str) -> list[FoldTask]:
    """Return one task per fold, for all kinds of split of a source that the options request."""
    data = data_of(options, name)
    found = []
    for kind in data.source.kinds:
        if (options.quick and kind != QUICK_KIND) or (kind == "all" and data.crossing is None):
            continue
        folds = splits(data.facts, kind)[: 1 if options.quick else None]
        found += [FoldTask(options, name, kind, split.fold) for split in folds]
    return found


def alternating(each: Sequence[Sequence[FoldTask]]) -> list[FoldTask]:
    """Return the tasks interleaved: the first of every source, then the second of every source.

    Parallel processes then start on different sources, and a function that one of them compiled
    for a source is in the compilation cache when another process needs it.
    """
    return [task for row in zip_longest(*each) for task in row if task is not None]


def _check(options: BenchmarkOptions) -> None:
    """Raise `DataError` if the data folder or a requested row does not exist."""
    if not options.data.is_dir():
        raise DataError(
            f"{options.data}: no such folder; expected the folder of the data sets (--data)"
        )
    classifiers = [method.name for method in husky_classifiers()]
    every = list(dict.fromkeys([NAME, MAP_ROW, *ROWS, *classifiers, *CONTROLLERS]))
    for name in options.only:
        if name not in every:
            raise DataError(
                f"no row '{name}'{did_you_mean(name, every)}; expected one of {', '.join(every)}"
            )


def tables_of(tasks: Sequence[FoldTask]) -> Tables:
    """Return summaries of all scores that the tasks saved in their checkpoints."""
    folds: dict[tuple[str, str], dict[str, list[FoldScore[RunScore]]]] = {}
    for task in tasks:
        for (protocol, name), score in task.rows().items():
            folds.setdefault((task.source, protocol), {}).setdefault(name, []).append(score)
    return {
        source: {
            protocol: summary(folds[source, protocol], NAME)
            for protocol in PROTOCOLS
            if (source, protocol) in folds
        }
        for source in dict.fromkeys(task.source for task in tasks)
    }


def _set(
    options: BenchmarkOptions, name: str, protocols: Mapping[str, Mapping[str, RowSummary]]
) -> Content:
    """Return the part of benchmark.json about one data set."""
    data = data_of(options, name)
    return {
        "about": data.source.about,
        "over": data.source.over,
        "runs": len(data.logged) + (0 if data.crossing is None else len(data.crossing)),
        "hash": data.job.data_hash,
        "protocols": protocols,
    }


ROBOT_SOURCE = "testsite"
"""Name of the data set from which the robot of the closed-loop runs is identified."""
CONTROLLERS = (
    "encoder",
    "goswami_padhy",
    "indiveri",
    "paper_print",
    "paper_code",
    "torque",
    "contact",
    "contact_gyro",
)
STARTS = 8
"""Number of starts of every controller."""


@dataclass(frozen=True)
class RectangleTask:
    """Task that identifies the test site's robot and drives it in closed-loop runs.

    Attributes:
        options: options of the benchmark.
        name: name of the task.
    """

    options: BenchmarkOptions
    name: str = "rectangle"

    @property
    def folder(self) -> Path:
        """Folder of robot.json and of the trial's results."""
        return self.options.out / self.name

    def run(self) -> str:
        """Identify the robot of the test site from all its runs, and return the task's name."""
        setup_jax(quiet=True)
        self._failure.unlink(missing_ok=True)
        try:
            self._identify()
        except Exception as error:  # the other tasks run even if this one fails
            write_json(self._failure, {"failed": FoldScore.of_error(error).absent})
        return self.name

    @property
    def _failure(self) -> Path:
        """Path of the file that records why the robot could not be identified."""
        return self.folder / "failed.json"

    def _identify(self) -> None:
        """Fit slipid to all runs, and write robot.json."""
        data = data_of(self.options, ROBOT_SOURCE)
        code = source_hash(*FIT_SOURCES)
        key = key_of(data.job.config.hash, data.job.data_hash, code)
        everybody = np.arange(len(data.logged))
        kept = Checkpoint(self.folder, key)
        fit = fit_slipid(data.job, problem_of(self.options, ROBOT_SOURCE), everybody, kept)
        sensors = LogSensors(current_is_signed=data.logged.current_is_signed, voltage=True)
        robot_of_force_balance(fit.contact, fit.highest_speed, fit.trend, sensors).save(
            self.folder / ROBOT
        )

    def drive(self, executor: Executor, report: Reporter) -> Content:
        """Run all controllers on the virtual test site, or on the twin if MuJoCo is missing.

        Returns:
            Content that `slipid trial` writes, or the reason for a failure under the key `failed`.
        """
        if self._failure.is_file():
            return read_json(self._failure, "the reason why there is no robot")
        plant = "testsite" if find_spec("mujoco") is not None else "twin"
        only = self.options.only or CONTROLLERS
        controllers = [name for name in CONTROLLERS if name in only]
        try:
            options = trial.TrialOptions(plant, controllers=tuple(controllers), starts=STARTS)
            return trial.trial(self.folder, options, executor, report).content
        except Exception as error:  # the benchmark goes on if the trial fails
            return {"failed": FoldScore.of_error(error).absent}
