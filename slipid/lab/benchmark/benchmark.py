"""The command `slipid benchmark`: slipid and every published system on the same logs."""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from itertools import zip_longest
from operator import methodcaller

from slipid.lab.benchmark.floors.husky import HuskyFloorTask, husky_classifiers
from slipid.lab.benchmark.floors.protocol import FloorTask
from slipid.lab.benchmark.floors.robotino import RobotinoFloorTask
from slipid.lab.benchmark.protocols import PROTOCOLS, splits
from slipid.lab.benchmark.rectangle import CONTROLLERS, RectangleTask
from slipid.lab.benchmark.rows import ROWS
from slipid.lab.benchmark.scores import FoldScore, RunScore
from slipid.lab.benchmark.sets import SOURCES, is_available
from slipid.lab.benchmark.slipid_rows import NAME
from slipid.lab.benchmark.summary import RowSummary, reading, summary
from slipid.lab.benchmark.work import MAP_ROW, QUICK_KIND, BenchmarkOptions, FoldTask, data_of
from slipid.support.checkpoint import versions
from slipid.support.content import Content
from slipid.support.errors import DataError, did_you_mean
from slipid.support.executor import results
from slipid.support.files import writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SCHEMA = "slipid.benchmark/1"
Tables = dict[str, dict[str, dict[str, RowSummary]]]
"""Row summaries, keyed by name of the data set, then of the protocol, then of the row."""
BenchmarkTask = FoldTask | FloorTask | RectangleTask
"""A part of the benchmark's work that saves its results in a checkpoint."""


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
    tasks: list[BenchmarkTask] = [*folds, *floors]
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
