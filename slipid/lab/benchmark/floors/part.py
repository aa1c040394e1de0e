"""The floors of `borealtc`: a Husky that feels five of them, without a pose.

Telling floors from currents, as parts of the whole benchmark.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slipid.lab.benchmark.floors.logs import (
    RADIUS,
    SOURCE,
    ZERO_A,
    husky,
    read_floor_runs,
    robotino_classifiers,
    robotino_table,
)
from slipid.lab.benchmark.floors.protocol import EvaluationSettings, classifier_table
from slipid.lab.benchmark.floors.result import ClassifierTable
from slipid.lab.benchmark.floors.slipid_row import SlipidFloorClassifier
from slipid.lab.benchmark.scores import FoldScore
from slipid.lab.benchmark.slipid_rows import NAME
from slipid.lab.benchmark.work import OF_FITS, OF_ROWS, BenchmarkOptions, data_of
from slipid.lab.systems.floors.cosine_energy import CosineEnergyClassifier, tree_rows
from slipid.lab.systems.floors.gaussian import GaussianClassifier
from slipid.lab.systems.floors.interface import FloorClassifier
from slipid.predict.slip_model import RobotSpec
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.content import Content
from slipid.support.files import hash_of
from slipid.support.jax_setup import setup_jax

FOLDER = "borealtc"
ABOUT = (
    "Husky on five floors, no pose: wheel speeds, sizes of currents and a gyro, 6.5 rows a second"
)


def husky_classifiers() -> list[FloorClassifier]:
    """All classifiers, slipid first, unfitted."""
    own = SlipidFloorClassifier(robot=husky(), zero_a=ZERO_A)
    return [own, CosineEnergyClassifier(), GaussianClassifier(), *tree_rows()]


def husky_table(data: Path, quick: bool = False, only: tuple[str, ...] = ()) -> ClassifierTable:
    """The table of all classifiers, or of those that are named.

    Args:
        data: folder with the data sets.
        quick: one fold, short times, settings as they are.
        only: names of rows; all where there are none.

    Raises:
        DataError: the folder's files cannot be read.
    """
    felts = read_floor_runs(data / FOLDER, RADIUS)
    spec = RobotSpec.of(husky().on(["any"]))
    methods = [method for method in husky_classifiers() if not only or method.name in only]
    return classifier_table(
        methods,
        felts,
        spec,
        ABOUT,
        EvaluationSettings.quick() if quick else EvaluationSettings(),
    )


@dataclass(frozen=True)
class FloorTask(abc.ABC):
    """A table of classifiers that is made once, and kept."""

    wish: BenchmarkOptions

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Of the part, and of its table in benchmark.json."""

    @property
    @abc.abstractmethod
    def folder(self) -> str:
        """Of its logs, below the data folder."""

    @property
    @abc.abstractmethod
    def rows(self) -> Sequence[str]:
        """Names of its classifiers."""

    @abc.abstractmethod
    def logs(self) -> str:
        """Hash of its logs."""

    @abc.abstractmethod
    def make(self) -> ClassifierTable:
        """Fit and judge the classifiers that are wished for."""

    @property
    def is_asked(self) -> bool:
        """Whether its logs are there, and any of its rows is wished for."""
        asked = not self.wish.only or bool(set(self.wish.only) & set(self.rows))
        return asked and (self.wish.data / self.folder).is_dir()

    @property
    def kept(self) -> Checkpoint:
        """Where its table is kept."""
        code = source_hash(*OF_FITS, *OF_ROWS)
        key = key_of(self.logs(), self.wish.quick, self.wish.only, code)
        return Checkpoint(self.wish.out / "kept" / self.name / key[:12], key)

    def run(self) -> str:
        """Make the table, if it is not kept yet; the name of the part."""
        setup_jax(quiet=True)
        kept = self.kept
        found = kept.load_json(self.name)
        if found is None or "failed" in found or any(row["absent"] for row in found["rows"]):
            try:
                kept.save_json(self.name, self.make().to_json())
            except Exception as error:  # other parts are done all the same
                kept.save_json(self.name, {"failed": FoldScore.of_error(error).absent})
        return self.name

    def table(self) -> Content:
        """What was found, as in benchmark.json."""
        found: Content = self.kept.load_json(self.name) or {"failed": "it was not kept"}
        return found


class HuskyFloorTask(FloorTask):
    """Five floors that a Husky felt, without a pose."""

    name = "husky_floors"
    folder = FOLDER

    @property
    def rows(self) -> Sequence[str]:
        return [method.name for method in husky_classifiers()]

    def logs(self) -> str:
        root = self.wish.data / FOLDER
        files = sorted(root.glob("*/*.csv"))
        return hash_of((str(f.relative_to(root)), f.read_text(errors="replace")) for f in files)

    def make(self) -> ClassifierTable:
        return husky_table(self.wish.data, self.wish.quick, self.wish.only)


class RobotinoFloorTask(FloorTask):
    """Four floors that a Robotino felt; slipid is its fit to the runs with poses."""

    name = "robotino_floors"
    folder = SOURCE

    @property
    def rows(self) -> Sequence[str]:
        return [NAME, *(method.name for method in robotino_classifiers())]

    def logs(self) -> str:
        return data_of(self.wish, SOURCE).job.data_hash

    def make(self) -> ClassifierTable:
        return robotino_table(self.wish)
