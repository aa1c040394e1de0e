"""`slipid benchmark`: every published system on the same logs, beside slipid itself."""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from itertools import zip_longest
from typing import Protocol

from slipid.lab.benchmark.floors.part import HuskyFloorTask, RobotinoFloorTask, husky_classifiers
from slipid.lab.benchmark.protocols import PROTOCOLS, splits
from slipid.lab.benchmark.rectangle import CONTROLLERS, RectangleTask
from slipid.lab.benchmark.rows import ROWS
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.sets import SOURCES, is_available
from slipid.lab.benchmark.slipid_rows import NAME
from slipid.lab.benchmark.summary import RowSummary, summary
from slipid.lab.benchmark.tuning import reading
from slipid.lab.benchmark.work import OWN_MAP, QUICK_KIND, BenchmarkOptions, FoldTask, data_of
from slipid.support.checkpoint import versions
from slipid.support.content import Content
from slipid.support.errors import DataError, did_you_mean
from slipid.support.executor import results
from slipid.support.files import writable, write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

SCHEMA = "slipid.lab.benchmark/1"
Tables = dict[str, dict[str, dict[str, RowSummary]]]
"""Summaries by data set, protocol and row."""


class BenchmarkTask(Protocol):
    """A part of the work, which keeps what it finds."""

    @property
    def name(self) -> str:
        """Of the part."""
        ...

    def run(self) -> str:
        """Do what is not kept yet; the name of the part."""
        ...


def benchmark(wish: BenchmarkOptions, executor: Executor, report: Reporter) -> Content:
    """Run every row on every data set that is there, and write benchmark.json.

    What is done is kept, and not done again; a row that fails is said, and stops no other.

    Raises:
        DataError: no such folder or row.
    """
    began = time.monotonic()
    setup_jax(quiet=True)
    _known(wish)
    sources = [source for source in SOURCES if is_available(source, wish.data)]
    for source in SOURCES:
        if source not in sources:
            report.line(f"skipped: {source.name}: no folder {wish.data / source.folder}")
    writable(wish.out)
    report.stage("reading logs")
    unread: dict[str, str] = {}
    each = []
    for source in sources:
        try:
            each.append(tasks_of(wish, source.name))
        except Exception as error:  # other data sets are there all the same
            unread[source.name] = FoldScore.of_error(error).absent
            report.line(f"skipped: {source.name}: {unread[source.name]}")
    pieces = in_turn(each)
    felt = [part for part in (HuskyFloorTask(wish), RobotinoFloorTask(wish)) if part.is_asked]
    rectangle = RectangleTask(wish)
    # the Robotino's floors come last: they take the fits that were made for its headings
    parts: list[BenchmarkTask] = [*pieces, *felt]
    if not wish.quick and set(CONTROLLERS) & set(wish.only or CONTROLLERS):
        parts.insert(0, rectangle)
    report.stage(f"{len(parts)} parts")
    results(executor, work, {part.name: part for part in parts}, report)
    driven = rectangle.drive(executor, report) if rectangle in parts else None
    report.stage("comparing")
    tables = tables_of(pieces)
    content = {
        "schema": SCHEMA,
        "quick": wish.quick,
        "unread": unread,
        "sets": {name: _set(wish, name, protocols) for name, protocols in tables.items()},
        "protocols": {name: p.about for name, p in PROTOCOLS.items()},
        "floors": {part.name: part.table() for part in felt},
        "rectangle": driven,
        "reading": reading(tables),
        "seconds": round(time.monotonic() - began, 1),
        "versions": versions(),
    }
    report.stage("writing")
    write_json(wish.out / "benchmark.json", content)
    return content


def tasks_of(wish: BenchmarkOptions, name: str) -> list[FoldTask]:
    """All folds that a source is split into."""
    data = data_of(wish, name)
    found = []
    for kind in data.source.kinds:
        if (wish.quick and kind != QUICK_KIND) or (kind == "all" and data.crossing is None):
            continue
        folds = splits(data.facts, kind)
        found += [FoldTask(wish, name, kind, f.fold) for f in folds[: 1 if wish.quick else None]]
    return found


def in_turn(each: Sequence[Sequence[FoldTask]]) -> list[FoldTask]:
    """Pieces of all sources by turns.

    What one process has compiled for a source lies in the cache when another comes to it.
    """
    return [piece for row in zip_longest(*each) for piece in row if piece is not None]


def work(part: BenchmarkTask) -> str:
    """Do a part."""
    return part.run()


def _known(wish: BenchmarkOptions) -> None:
    if not wish.data.is_dir():
        raise DataError(
            f"{wish.data}: no such folder; expected the folder of the data sets (--data)"
        )
    classifiers = [method.name for method in husky_classifiers()]
    every = list(dict.fromkeys([NAME, OWN_MAP, *ROWS, *classifiers, *CONTROLLERS]))
    for name in wish.only:
        if name not in every:
            raise DataError(
                f"no row '{name}'{did_you_mean(name, every)}; expected some of {', '.join(every)}"
            )


def tables_of(pieces: Sequence[FoldTask]) -> Tables:
    """Summaries of what was kept of all pieces."""
    folds: dict[tuple[str, str], dict[str, list[FoldScore]]] = {}
    for piece in pieces:
        for (protocol, name), row in piece.rows().items():
            folds.setdefault((piece.source, protocol), {}).setdefault(name, []).append(row)
    tables: Tables = {}
    for source in dict.fromkeys(piece.source for piece in pieces):
        tables[source] = {
            protocol: summary(folds[source, protocol], NAME)
            for protocol in PROTOCOLS
            if (source, protocol) in folds
        }
    return tables


def _set(
    wish: BenchmarkOptions, name: str, protocols: Mapping[str, Mapping[str, RowSummary]]
) -> Content:
    data = data_of(wish, name)
    return {
        "about": data.source.about,
        "over": data.source.over,
        "runs": len(data.logged) + (0 if data.crossing is None else len(data.crossing)),
        "hash": data.job.data_hash,
        "protocols": {
            protocol: {row: asdict(one) for row, one in found.items()}
            for protocol, found in protocols.items()
        },
    }
