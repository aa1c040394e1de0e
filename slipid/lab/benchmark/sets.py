"""Logs of the benchmark: public data sets in a folder, and recorded runs in the package itself."""

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
"""Denominator of end-point errors: the distance from start to end, or the path length."""


@dataclass(frozen=True)
class LogSource:
    """One set of logs.

    Attributes:
        name: name of the set.
        about: description of the set.
        folder: folder below the data folder; empty for the recorded runs of the package.
        config: file name of the packaged config.
        kinds: kinds of splits, see `slipid.lab.benchmark.protocols`.
        over: denominator of end-point errors.
        poses_per_step: minimum number of poses in a step, see
            `slipid.lab.benchmark.steps.run_batches`.
        currents: columns of currents that published methods use but slipid's fit does not, since
            the config does not read them.
        current_is_signed: True if these currents have a sign.
        crossing: glob of the runs from one floor to another, and file name of the map of floors.
    """

    name: str
    about: str
    folder: str
    config: str
    kinds: tuple[str, ...]
    over: Over = "chord"
    poses_per_step: int = POSES_PER_STEP
    currents: tuple[str, ...] = ()
    current_is_signed: bool = False
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
        about="Robotino over the whole field of 2021, with a gyro, without names of floors",
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
        currents=("il", "ir"),
        current_is_signed=True,
    ),
    LogSource(
        name="husky",
        about="skid-steer Husky on wet grass",
        folder="drive_skid",
        config="husky.toml",
        kinds=("headings",),
        over="path",
        currents=("il", "ir"),
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
    """The runs of a source, with all data for slipid's fit and for the splits.

    Attributes:
        source: source of the logs.
        job: task of slipid's fit to the runs.
        logged: the same runs with all logged channels, including those that slipid's fit ignores.
        facts: floor, heading and speed of each run, by which runs are split.
        crossing: runs from one floor to another, or None.
        map: map of the floors of the runs in `crossing`, or None.
    """

    source: LogSource
    job: ConfigFitTask
    logged: Runs
    facts: tuple[FoldKey, ...]
    crossing: Runs | None = None
    map: FloorMap | None = None

    @property
    def spec(self) -> RobotSpec:
        """Specification of the robot as its config describes it, before any fit."""
        return RobotSpec.of(Space(self.job.robot, self.job.choices).template)

    def thinned(self, most: int) -> "DataSet":
        """Return a data set of at most `most` runs, taken evenly from all floors and speeds."""
        count = len(self.logged)
        if count <= most:
            return self
        order = np.lexsort(
            [np.round([f.speed for f in self.facts], 3), np.array([f.floor for f in self.facts])]
        )
        keep = np.sort(order[np.linspace(0, count - 1, most).round().astype(int)])
        logged = self.logged.subset(keep)
        facts = tuple(self.facts[k] for k in keep)
        return replace(
            self, job=_fit_job(self.job.config, logged, self.source), logged=logged, facts=facts
        )

    @property
    def crossing_hash(self) -> str:
        """Hash of the runs from one floor to another and of their map."""
        logs = [] if self.crossing is None else [(x.name, x.sha256) for x in self.crossing.logs]
        return hash_of([*logs, ("map", repr(self.map))])


def is_available(source: LogSource, data: Path) -> bool:
    """Return True if a source's folder exists; the recorded runs are always available."""
    return not source.folder or (data / source.folder).is_dir()


def read_set(source: LogSource, data: Path, out: Path, report: Reporter) -> DataSet:
    """Read the runs of a source; recorded runs of the package are unpacked below `out`.

    Raises:
        DataError: the config or a log of the source cannot be read.
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
    logged, _ = read_dataset(_with_currents(config, source), sections, root, report)
    job = _fit_job(config, logged, source)
    facts = facts_of(logged, float(job.robot.geometry.base_radius))
    crossing, floor = None, None
    if source.crossing is not None and any(root.glob(source.crossing[0])):
        glob, map_name = source.crossing
        section = sections[0].model_copy(update={"glob": glob, "map": map_name})
        crossing, _ = read_dataset(config, [section], root, report)
        floor = read_map(packaged_path(map_name))
    return DataSet(source, job, logged, tuple(facts), crossing, floor)


def _with_currents(config: Config, source: LogSource) -> Config:
    """Return the config with additional columns of currents in its layouts."""
    if not source.currents:
        return config
    layouts = {}
    for name, layout in config.content.layouts.items():
        columns = layout["columns"]
        assert isinstance(columns, dict)
        channel = {"columns": list(source.currents), "unit": "A"}
        layouts[name] = {
            **layout,
            "columns": {**columns, "current": channel},
            "current_is_signed": source.current_is_signed,
        }
    return replace(config, content=config.content.model_copy(update={"layouts": layouts}))


def _fit_job(config: Config, logged: Runs, source: LogSource) -> ConfigFitTask:
    """Return slipid's fit task for runs, without currents that only published methods use."""
    fitted = logged
    if source.currents:
        logs = [replace(log, current=None, current_fresh=None) for log in logged.logs]
        fitted = collect(logs, logged.session)
    return fit_task(config, fitted, (), Reporter(quiet=True))
