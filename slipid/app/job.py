"""From a config and a data folder to a fitting problem."""

import fnmatch
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

from slipid.app.config import Config, Logs, geometry, one_floor
from slipid.data.dataset import Dataset, collect, default_session, windows
from slipid.data.formats import PRESETS, Layout, layout_from_mapping, preset
from slipid.data.log import DataError, Log
from slipid.data.reader import find_logs, read_logs
from slipid.data.terrain import FloorMap, read_map
from slipid.identify.folds import still_viscosities
from slipid.identify.problem import Problem
from slipid.identify.result import hash_of
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot, build
from slipid.parameter import Choice, Space, entries

Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Job:
    """What a config says about the logs that are there.

    Attributes:
        config: as read.
        dataset: the runs, each on one floor.
        robot: with the geometry of the config and every other number at its declared start.
        choices: free, fixed, priors.
        skipped: what the config names and the folder does not have, one line each.
        mixed: runs over several floors, with the map of each set.
    """

    config: Config
    dataset: Dataset
    robot: Robot
    choices: tuple[Choice, ...]
    skipped: tuple[str, ...]
    mixed: tuple[tuple[Dataset, FloorMap], ...] = ()

    @property
    def logs(self) -> tuple[Log, ...]:
        """Every run, those over several floors last."""
        return self.dataset.logs + tuple(log for data, _ in self.mixed for log in data.logs)

    @property
    def data_hash(self) -> str:
        """Hash of the runs and their files."""
        return hash_of((log.name, log.sha256) for log in self.logs)

    def problem(self) -> Problem:
        """Likelihood of the runs, cut into windows as the config says."""
        fit = self.config.content.fit
        start = Space(self.robot, self.choices).template
        cut = windows(
            self.dataset,
            float(start.geometry.wheel_radius),
            lag=float(start.camera.lag),
            per_piece=fit.windows_per_piece,
            longest=fit.longest_window_s,
        )
        return Problem(cut, self.robot, list(self.choices))


def read_job(config: Config, root: Path, tell: Callable[[int, int], None], line: Tell) -> Job:
    """Read every log of runs on one floor that the config names and set up its robot.

    Args:
        root: data folder the globs are relative to.
        tell: called with (files read, files in all).
        line: takes each sentence for people.

    Raises:
        DataError: what is wrong with config or logs.
    """
    dataset, skipped = read_dataset(config, one_floor(config.content.logs), root, tell)
    return job_of(config, dataset, skipped, line)


def with_mixed(job: Job, root: Path, tell: Callable[[int, int], None], line: Tell) -> Job:
    """The job with the runs over several floors that its config names, arguments as of `read_job`.

    Raises:
        DataError: what is wrong with maps or logs.
    """
    wanted = [section for section in job.config.content.logs if section.map is not None]
    found, absent = _found(job.config, wanted, root)
    sets = []
    for section, _ in found:
        floor = _map(job, section)
        data, short = read_dataset(job.config, [section], root, tell)
        absent += short
        _go_together(job, data)
        sets.append((data, floor))
        job = replace(job, mixed=tuple(sets))
    for sentence in absent:
        line(sentence)
    return replace(job, skipped=(*job.skipped, *absent))


def _map(job: Job, section: Logs) -> FloorMap:
    """Map of a log section.

    Raises:
        DataError: unreadable, or of a floor that no run keeps to.
    """
    path = job.config.path.parent / str(section.map)
    floor = read_map(path)
    known = job.robot.surfaces.labels
    for name in floor.surfaces:
        if name not in known:
            raise DataError(
                f"{path}: surface '{name}': no run on it alone; expected some of {', '.join(known)}"
            )
    return floor


def _go_together(job: Job, data: Dataset) -> None:
    """DataError where runs over several floors need what those on one floor do not tell."""
    seen, first = {log.name for log in job.logs}, job.dataset.logs[0]
    for log in data.logs:
        if log.name in seen:
            raise DataError(
                f"{log.name}: found by two globs of {job.config.path}; expected it once"
            )
        if log.load not in job.robot.body.loads:
            raise DataError(
                f"{log.name}: load set-up '{log.load}': no run with it on one floor; "
                f"expected one of {', '.join(job.robot.body.loads)}"
            )
        if log.wheels != first.wheels:
            raise DataError(f"{log.name}: {log.wheels} wheels; expected {first.wheels}")


def job_of(config: Config, dataset: Dataset, skipped: Sequence[str], line: Tell) -> Job:
    """Job of runs that are there already.

    Raises:
        DataError: config and runs do not belong together.
    """
    shape = shape_of(config)
    if shape.wheels != dataset.logs[0].wheels:
        raise DataError(
            f"{config.path}: robot: {shape.wheels} wheels, but {dataset.logs[0].name} has "
            f"{dataset.logs[0].wheels}; expected the same"
        )
    robot = build(
        shape,
        sorted({log.surface or "unknown" for log in dataset.logs}),
        sorted({log.load for log in dataset.logs}),
        sorted(set(dataset.session)),
        centre=config.content.camera.image_centre_m,
    )
    choices, left_out = _choices(config, robot)
    skipped = [*skipped, *left_out]
    choices = still_viscosities(dataset) + choices  # what the user says comes later and wins
    for sentence in skipped:
        line(sentence)
    return Job(config, dataset, robot, tuple(choices), tuple(skipped))


def shape_of(config: Config) -> Geometry:
    """Geometry of the config's robot.

    Raises:
        DataError: it cannot drive.
    """
    try:
        shape: Geometry = geometry(config.content.robot)
    except ValueError as error:
        raise DataError(f"{config.path}: robot: {error}") from error
    return shape


def read_dataset(
    config: Config, sections: Sequence[Logs], root: Path, tell: Callable[[int, int], None]
) -> tuple[Dataset, list[str]]:
    """Runs of some log sections, and a line for each section without files.

    Raises:
        DataError: no file at all, or one that cannot be read.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; expected the folder of the logs (--data)")
    found, skipped = _found(config, sections, root)
    if not found:
        raise DataError("\n".join(s.removeprefix("skipped: ") for s in skipped))
    count = sum(len(paths) for _, paths in found)
    logs: list[Log] = []
    session: dict[str, str] = {}
    done = short = 0
    for section, paths in found:
        layout = layout_of(config, section)
        for path in paths:
            surface = _surface(section, path)
            for log in read_logs(path, layout, root=root, surface=surface, load=section.load):
                if log.samples < section.min_rows:
                    short += 1
                    continue
                if log.name in session:
                    raise DataError(
                        f"{log.name}: found by two globs of {config.path}; expected it once"
                    )
                session[log.name] = _session(section, log)
                logs.append(with_voltage(log))
            done += 1
            tell(done, count)
    if short:
        skipped.append(f"skipped: {short} runs shorter than their min_rows")
    return collect(logs, session=lambda log: session[log.name]), skipped


def _found(
    config: Config, sections: Sequence[Logs], root: Path
) -> tuple[list[tuple[Logs, list[Path]]], list[str]]:
    """Files of every section that has some, and a line for each that has none."""
    found: list[tuple[Logs, list[Path]]] = []
    skipped: list[str] = []
    for section in sections:
        try:
            found.append((section, find_logs(root, section.glob)))
        except DataError as error:
            skipped.append(f"skipped: {error}")
        except (ValueError, NotImplementedError) as error:
            raise DataError(f"{config.path}: logs.glob '{section.glob}': {error}") from error
    return found, skipped


def layout_of(config: Config, section: Logs) -> Layout:
    """Layout a log section names: one of the config's own, else a preset."""
    own = config.content.layouts
    if section.format in own:
        where = f"{config.path} layouts.{section.format}"
        return layout_from_mapping(own[section.format], where)
    if section.format not in PRESETS:
        names = [*own, *PRESETS]
        near = get_close_matches(section.format, names, n=2)
        hint = f", did you mean {' or '.join(near)}?" if near else ""
        raise DataError(
            f"{config.path}: logs.format '{section.format}': no such layout{hint}; "
            f"expected one of {', '.join(names)}"
        )
    return preset(section.format)


def _surface(section: Logs, path: Path) -> str | None:
    """Name of the floor: as the config says, or of the folder the file lies in."""
    if section.map is not None:
        return None
    if section.surface != "folder":
        return section.surface
    return path.parent.name.removesuffix("_surface")


def _session(section: Logs, log: Log) -> str:
    if section.session == "file":
        return log.name
    if section.session == "folder":
        return log.name.rpartition("/")[0] or log.name
    return default_session(log)


def with_voltage(log: Log) -> Log:
    """The log with voltage = duty x bus voltage where only those were logged."""
    if log.voltage is None and log.duty is not None and log.bus_voltage is not None:
        return replace(log, voltage=log.duty * log.bus_voltage[:, None])
    return log


_SAID = ("robot.wheel_radius", "robot.base_radius", "robot.mass")


def _choices(config: Config, robot: Robot) -> tuple[list[Choice], list[str]]:
    """The config's parameter settings, checked, less those of floors and loads that are absent."""
    paths = [e.path for e in entries(robot)]
    choices, skipped = [], []
    # what [robot] says is held, and is the centre of the prior of what [parameters] frees
    said = {e.path: (e, float(e.get(robot))) for e in entries(robot) if e.path in _SAID}
    if config.content.robot.mass_kg is not None:
        said["robot.mass"] = said["robot.mass"][0], config.content.robot.mass_kg
    for path, (e, value) in said.items():
        std = e.declaration.spread * value
        choices.append(Choice(path, prior_mean=value, prior_std=std, free=False))
    for pattern, setting in config.content.parameters.items():
        if not fnmatch.filter(paths, pattern):
            if fnmatch.filter(paths, _any_label(pattern)):
                skipped.append(f"skipped: parameters '{pattern}': no run that has it")
                continue
            near = get_close_matches(pattern, paths, n=2)
            hint = f", did you mean {' or '.join(near)}?" if near else ""
            raise DataError(
                f"{config.path}: parameters.'{pattern}': no such parameter{hint}; "
                f"expected one of {', '.join(paths)}"
            )
        choice = Choice(
            pattern,
            start=setting.start,
            fixed=setting.fixed,
            free=setting.free,
            prior_mean=None if setting.prior is None else setting.prior.mean,
            prior_std=None if setting.prior is None else setting.prior.std,
        )
        try:
            Space(robot, [choice])
        except ValueError as error:
            raise DataError(f"{config.path}: parameters.'{pattern}': {error}") from error
        choices.append(choice)
    return choices, skipped


def _any_label(pattern: str) -> str:
    """The pattern with the name of a floor, load or session replaced by any."""
    head, at, _ = pattern.partition("@")
    parts = head.split(".")
    if parts[0] == "surface" and len(parts) == 3:
        parts[1] = "*"
    return ".".join(parts) + (f"{at}*" if at else "")
