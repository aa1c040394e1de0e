"""The logs of the benchmark: public data sets below a folder, and recorded runs that ship."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from slipid.app.config import Config, LogsSection, parsed, single_floor_sections
from slipid.app.logs import packaged_path, read_dataset, unpack
from slipid.app.problem import ConfigFitTask, fit_task
from slipid.data.floor_map import FloorMap, read_map
from slipid.data.runs import Runs, collect
from slipid.lab.benchmark.protocols import facts_of
from slipid.lab.benchmark.steps import POSES_PER_STEP
from slipid.predict.folds import FoldKey
from slipid.predict.slip_model import RobotSpec
from slipid.search_space import Space
from slipid.support.files import hash_of
from slipid.support.progress import Reporter
from slipid.support.toml_file import text_of

Over = Literal["chord", "path"]
"""What end-point errors are divided by: the straight way to the end, or the way driven."""


@dataclass(frozen=True)
class CurrentColumns:
    """Columns of currents that a config leaves out of the fit, and methods hear all the same."""

    columns: tuple[str, ...]
    signed: bool


@dataclass(frozen=True)
class LogSource:
    """One set of logs.

    Attributes:
        name: of the set; about: for people.
        folder: below the data folder; empty for the recorded runs that ship with slipid.
        config: name of the config that ships with slipid.
        kinds: of splits it is for, see `slipid.lab.benchmark.protocols`.
        over: what end-point errors are divided by.
        poses_per_step: see `slipid.lab.benchmark.steps.run_batches`.
        currents: columns that methods hear beside what the config reads.
        crossing: runs from one floor to another: their glob and the file of their map.
    """

    name: str
    about: str
    folder: str
    config: str
    kinds: tuple[str, ...]
    over: Over = "chord"
    poses_per_step: int = POSES_PER_STEP
    currents: CurrentColumns | None = None
    crossing: tuple[str, str] | None = None


SOURCES = (
    LogSource(
        name="robotino2022",
        about="Robotino on four floors, straight runs, unsigned currents",
        folder="robotino2022",
        config="robotino2022.toml",
        kinds=("headings", "sectors", "speeds", "floors", "all"),
        crossing=("two_surfaces/*/*.csv", "maps/green_table.toml"),
    ),
    LogSource(
        name="robotino2021",
        about="Robotino over the whole field of 2021, with a gyro, floors not named",
        folder="robotino2021",
        config="robotino2021_field.toml",
        kinds=("headings",),
        over="path",
        poses_per_step=1,
    ),
    LogSource(
        name="warthog",
        about="skid-steer Warthog on grass and asphalt",
        folder="drive_skid",
        config="warthog.toml",
        kinds=("headings", "speeds", "floors"),
        over="path",
        currents=CurrentColumns(("il", "ir"), signed=True),
    ),
    LogSource(
        name="husky",
        about="skid-steer Husky on wet grass",
        folder="drive_skid",
        config="husky.toml",
        kinds=("headings",),
        over="path",
        currents=CurrentColumns(("il", "ir"), signed=False),
    ),
    LogSource(
        name="testsite",
        about="Robotino on the virtual test site (MuJoCo), two floors, two loads",
        folder="",
        config="robotino.toml",
        kinds=("headings", "sectors", "speeds", "floors"),
    ),
)


@dataclass(frozen=True, eq=False)
class DataSet:
    """The runs of a source.

    Attributes:
        source: where they are from.
        job: as slipid fits them; logged: the same runs, with all that was logged.
        facts: what splits go by, run by run.
        crossing: runs over several floors, where there are some; map: of these floors.
    """

    source: LogSource
    job: ConfigFitTask
    logged: Runs
    facts: tuple[FoldKey, ...]
    crossing: Runs | None = None
    map: FloorMap | None = None

    @property
    def spec(self) -> RobotSpec:
        """The robot as its config has it."""
        return RobotSpec.of(Space(self.job.robot, self.job.choices).template)

    def thinned(self, most: int) -> "DataSet":
        """At most so many runs, evenly taken from every floor and speed."""
        count = len(self.logged)
        if count <= most:
            return self
        order = np.lexsort([np.round([f.speed for f in self.facts], 3), np.array(self.setups)])
        keep = np.sort(order[np.linspace(0, count - 1, most).round().astype(int)])
        logged = self.logged.subset(keep)
        facts = tuple(self.facts[k] for k in keep)
        return replace(
            self, job=_job(self.job.config, logged, self.source), logged=logged, facts=facts
        )

    @property
    def crossing_hash(self) -> str:
        """Of the runs over several floors and their map."""
        logs = [] if self.crossing is None else [(x.name, x.sha256) for x in self.crossing.logs]
        return hash_of([*logs, ("map", repr(self.map))])

    @property
    def setups(self) -> list[str]:
        """Floor of each run, and its load set-up where that is not the main one."""
        return [f.floor for f in self.facts]


def is_available(source: LogSource, data: Path) -> bool:
    """Whether a source's folder is there; the recorded runs always are."""
    return not source.folder or (data / source.folder).is_dir()


def read_set(source: LogSource, data: Path, out: Path, report: Reporter) -> DataSet:
    """Read the runs of a source; what ships with slipid is unpacked below `out`.

    Raises:
        DataError: files of it are wrong.
    """
    path = packaged_path(source.config)
    config = parsed(path, text_of(path))
    root = data / source.folder
    sections: Sequence[LogsSection] = single_floor_sections(config.content.logs)
    if not source.folder:
        root = out / "recorded"
        if not (root / "unseen" / "truth" / "truth.json").is_file():
            unpack(root)
        sections = [
            one.model_copy(update={"glob": f"{part}/logs/{one.glob}"})
            for one in sections
            for part in ("fit", "unseen")
        ]
    logged, _ = read_dataset(_hearing(config, source.currents), sections, root, report)
    job = _job(config, logged, source)
    facts = facts_of(logged, float(job.robot.geometry.base_radius))
    crossing, floor = None, None
    if source.crossing is not None and any(root.glob(source.crossing[0])):
        glob, map_name = source.crossing
        section = sections[0].model_copy(update={"glob": glob, "map": map_name})
        crossing, _ = read_dataset(config, [section], root, report)
        floor = read_map(packaged_path(map_name))
    return DataSet(source, job, logged, tuple(facts), crossing, floor)


def _hearing(config: Config, currents: CurrentColumns | None) -> Config:
    """The config, with columns of currents in its layouts."""
    if currents is None:
        return config
    layouts = {}
    for name, layout in config.content.layouts.items():
        columns = layout["columns"]
        assert isinstance(columns, dict)
        told = {"columns": list(currents.columns), "unit": "A"}
        layouts[name] = {
            **layout,
            "columns": {**columns, "current": told},
            "current_is_signed": currents.signed,
        }
    return replace(config, content=config.content.model_copy(update={"layouts": layouts}))


def _job(config: Config, logged: Runs, source: LogSource) -> ConfigFitTask:
    """What slipid fits of these runs: currents only where its config reads them."""
    fitted = logged
    if source.currents is not None:
        logs = [replace(log, current=None, current_fresh=None) for log in logged.logs]
        fitted = collect(logs, logged.session)
    return fit_task(config, fitted, (), Reporter(quiet=True))
