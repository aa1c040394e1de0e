"""One split of one data set: slipid and every row fitted to its runs, and judged on the others."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from slipid.data.runs import Runs
from slipid.fit.problem import Problem
from slipid.lab.benchmark import slipid_rows
from slipid.lab.benchmark.protocols import PROTOCOLS, BenchmarkProtocol, Split, base_of, splits
from slipid.lab.benchmark.rows import rows
from slipid.lab.benchmark.scores import FoldScore, RunScore, scored
from slipid.lab.benchmark.sets import SOURCES, DataSet, LogSource, read_set
from slipid.lab.benchmark.steps import RunBatch, run_batches
from slipid.lab.benchmark.tuning import tuned
from slipid.lab.systems.motion.features import common
from slipid.predict.slip_model import Channel, PredictedRun, RobotSpec, Run, SlipModel
from slipid.search_space import Space
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter

OWN_MAP = "slipid_map"
"""slipid's estimator, told the map of the floors."""


OF_FITS = (
    *("parameter", "search_space", "model", "data", "fit", "predict", "infer", "app"),
    "lab/benchmark/slipid_rows",
)
"""Packages and modules that slipid's fits depend on."""
OF_ROWS = ("lab/systems", "lab/paper2021", "lab/benchmark", "robot", "deploy")
"""Packages that all rows depend on beside these."""
QUICK_RUNS = 60
"""Runs of each data set, where a part is enough."""
QUICK_KIND = "headings"
"""The kind of split that is asked for then."""


@dataclass(frozen=True)
class BenchmarkOptions:
    """What is asked of a benchmark.

    Attributes:
        data: folder of the data sets.
        out: folder to write to.
        only: names of rows; all where there are none.
        quick: whether a part is enough: some runs, one fold of headings, floors that are told.
    """

    data: Path
    out: Path
    only: tuple[str, ...] = ()
    quick: bool = False


@dataclass(frozen=True)
class FoldTask:
    """One split of one data set."""

    wish: BenchmarkOptions
    source: str
    kind: str
    fold: int

    @property
    def name(self) -> str:
        return f"{self.source}/{self.kind}_{self.fold}"

    def run(self) -> str:
        """Fit and judge whatever is not kept yet; its name."""
        setup_jax(quiet=True)
        kept = kept_of(self, fit=False)
        missing = [key for key in keys_of(self) if not _is_done(kept.load_json("_".join(key)))]
        if missing:
            try:
                scene: FoldData | FoldScore = _scene(self)
            except Exception as error:  # other pieces are done all the same
                scene = FoldScore.of_error(error)
            for protocol, name in missing:
                row = scene if isinstance(scene, FoldScore) else _row(scene, protocol, name)
                kept.save_json("_".join((protocol, name)), row.to_json())
        return self.name

    def rows(self) -> dict[tuple[str, str], FoldScore]:
        """What is kept of it, by protocol and row."""
        kept = kept_of(self, fit=False)
        found = {key: kept.load_json("_".join(key)) for key in keys_of(self)}
        return {
            key: FoldScore.of_json(content) for key, content in found.items() if content is not None
        }


def _is_done(content: Content | None) -> bool:
    """Whether a row is kept; one that failed is tried again."""
    return content is not None and not content["failed"]


def source_of(name: str) -> LogSource:
    """A source by its name."""
    return next(source for source in SOURCES if source.name == name)


@lru_cache(maxsize=8)
def data_of(wish: BenchmarkOptions, source: str) -> DataSet:
    """Runs of a source, read once in every process."""
    found = read_set(source_of(source), wish.data, wish.out, Reporter(quiet=True))
    return found.thinned(QUICK_RUNS) if wish.quick else found


@lru_cache(maxsize=8)
def problem_of(wish: BenchmarkOptions, source: str) -> Problem:
    """Fitting problem of all runs of a source, made and compiled once in every process."""
    return data_of(wish, source).job.problem()


def split_of(piece: FoldTask) -> Split:
    """The fold of a piece."""
    found = splits(data_of(piece.wish, piece.source).facts, piece.kind)
    return next(split for split in found if split.fold == piece.fold)


def kept_of(piece: FoldTask, fit: bool) -> Checkpoint:
    """Where the parts of a piece are kept: its fit, or what rows say."""
    data = data_of(piece.wish, piece.source)
    more = () if fit else (data.crossing_hash, source_hash(*OF_ROWS))
    split = split_of(piece)
    marks = data.job.config.hash, data.job.data_hash, source_hash(*OF_FITS)
    key = key_of(*marks, split.fitted, split.judged, *more)
    # in a folder of its own: what was kept of other work stays
    return Checkpoint(piece.wish.out / "kept" / piece.name / key[:12], key)


def keys_of(piece: FoldTask) -> list[tuple[str, str]]:
    """Protocols and rows that a piece is asked for, slipid's own rows first.

    Where there is one floor only, there is nothing to be found out about it.
    """
    wish, data, split = piece.wish, data_of(piece.wish, piece.source), split_of(piece)
    own = [slipid_rows.NAME] + ([OWN_MAP] if split.kind == "all" else [])
    every = own + [method.name for method in rows(data.spec)]
    wanted = [name for name in every if not wish.only or name in wish.only]
    several = len({base_of(f.floor) for f in data.facts}) > 1
    asked = [p for p in split.protocols if PROTOCOLS[p].told or (several and not wish.quick)]
    return [(protocol, name) for protocol in asked for name in wanted]


@dataclass(frozen=True, eq=False)
class FoldData:
    """All that rows of one split have in common.

    Attributes:
        data, split: runs, and which of them are fitted and judged.
        own: slipid's fit, or why there is none.
        fitted: training runs; cuts: of the runs that are judged; runs: the same, as a list.
        judged: the data set that the cuts are of.
    """

    data: DataSet
    split: Split
    own: slipid_rows.SlipidFit | FoldScore
    fitted: tuple[Run, ...]
    cuts: tuple[RunBatch, ...]
    judged: Runs

    @property
    def runs(self) -> list[Run]:
        return [run for one in self.cuts for run in one.runs]


def _scene(piece: FoldTask) -> FoldData:
    """Runs in the true metres of the camera that slipid fitted to the training runs.

    Where slipid cannot be fitted, in those of the camera as the config has it.
    """
    data, split = data_of(piece.wish, piece.source), split_of(piece)
    own: slipid_rows.SlipidFit | FoldScore
    try:
        problem = problem_of(piece.wish, piece.source)
        own = slipid_rows.fit_slipid(data.job, problem, split.fitted, kept_of(piece, fit=True))
        robot = own.contact.robot
    except Exception as error:  # other rows are judged all the same
        own = FoldScore.of_error(error)
        robot = Space(data.job.robot, data.job.choices).template
    per_step = data.source.poses_per_step
    judged = data.logged.subset(split.judged) if split.kind != "all" else data.crossing
    assert judged is not None
    fitted = _in_order(
        run_batches(data.logged.subset(split.fitted), robot, per_step), data, split.fitted
    )
    cuts = tuple(run_batches(judged, robot, per_step))
    if split.kind != "all":
        cuts = tuple(_named(one, data, split.judged) for one in cuts)
    return FoldData(data, split, own, tuple(fitted), cuts, judged)


def _named(one: RunBatch, data: DataSet, numbers: np.ndarray) -> RunBatch:
    """The cut with what splits go by: floors with loads, commanded directions and speeds."""
    facts = [data.facts[numbers[k]] for k in one.numbers]
    runs = [
        replace(run, floor=f.floor, heading=float(np.radians(f.heading_deg)), speed=f.speed)
        for run, f in zip(one.runs, facts, strict=True)
    ]
    return replace(one, runs=tuple(runs))


def _in_order(cuts: Sequence[RunBatch], data: DataSet, numbers: np.ndarray) -> list[Run]:
    """All runs of some cuts, floors told, in the order of the data set."""
    found = {
        k: run.with_floor(True)
        for one in cuts
        for k, run in zip(one.numbers, _named(one, data, numbers).runs, strict=True)
    }
    return [found[k] for k in sorted(found)]


def _row(scene: FoldData, protocol: str, name: str) -> FoldScore:
    """What a row is worth in a protocol, or why it is not in the table."""
    asked = PROTOCOLS[protocol]
    runs = [run.with_floor(asked.told) for run in scene.runs]
    try:
        if name in (slipid_rows.NAME, OWN_MAP):
            return _own(scene, asked, runs, name)
        method = next(m for m in rows(scene.data.spec) if m.name == name)
        if lacks := method.needs - channels_of(runs, scene.data.spec):
            return FoldScore.lacking(lacks)
        return _published(scene, asked, runs, method)
    except Exception as error:  # a row that fails must not stop the rest
        return FoldScore.of_error(error)


def channels_of(runs: Sequence[Run], spec: RobotSpec) -> frozenset[Channel]:
    """What all these runs have beside encoders."""
    twist: frozenset[Channel] = frozenset({"twist"} if spec.determines_twist else ())
    return common(runs) | twist


def _published(
    scene: FoldData, asked: BenchmarkProtocol, runs: list[Run], method: SlipModel
) -> FoldScore:
    spec = scene.data.spec
    fitted = [run.with_floor(asked.told) for run in scene.fitted]
    began = time.perf_counter()
    found = tuned(method, fitted, spec, asked.split)
    chosen = time.perf_counter()
    done = found.method.fit(fitted, spec)
    ended = time.perf_counter()
    said, each = _timed(lambda: done.predict([run.signals for run in runs], spec), runs)
    return FoldScore(
        runs=_judged(scene, runs, said),
        settings=found.settings,
        tried=found.tried,
        numbers=done.numbers,
        tune_s=chosen - began,
        fit_s=ended - chosen,
        step_us=each,
    )


def _own(scene: FoldData, asked: BenchmarkProtocol, runs: list[Run], name: str) -> FoldScore:
    own = scene.own
    if isinstance(own, FoldScore):
        return own
    if name == OWN_MAP and scene.data.map is None:
        return FoldScore.lacking(["map"])

    has_gyro = all(run.signals.gyro is not None for run in runs)
    place = slipid_rows.FloorKnowledge(
        asked.told, asked.strange, scene.data.map if name == OWN_MAP else None
    )

    drives = not asked.told or has_gyro

    def predict() -> list[PredictedRun]:
        if drives:
            return slipid_rows.estimator_runs(own, scene.cuts, scene.judged, place)
        spec = scene.data.spec
        return [said for one in scene.cuts for said in slipid_rows.forecast(own, one, spec)]

    predict()  # compiles
    said, each = _timed(predict, runs)
    return FoldScore(
        runs=_judged(scene, runs, said),
        numbers=own.numbers,
        fit_s=own.seconds,
        step_us=each,
        converged=own.converged,
    )


def _judged(
    scene: FoldData, runs: Sequence[Run], said: Sequence[PredictedRun]
) -> tuple[RunScore, ...]:
    spec, over = scene.data.spec, scene.data.source.over
    return tuple(scored(run, one, spec, over) for run, one in zip(runs, said, strict=True))


def _timed(
    predict: Callable[[], list[PredictedRun]], runs: Sequence[Run]
) -> tuple[list[PredictedRun], float]:
    """What is predicted, and microseconds per step of it."""
    began = time.perf_counter()
    said = predict()
    steps = sum(len(run.signals) for run in runs)
    return said, 1e6 * (time.perf_counter() - began) / max(steps, 1)
