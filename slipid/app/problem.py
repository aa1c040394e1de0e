"""From a config and a data folder to a fitting problem.

Load shares follow from scales under the wheels, or from masses whose place is known: a mass m at p
adds weights n_i to wheels at p_i, with sum n_i = m and sum n_i p_i = m p. Three wheels have one
solution; of more, the smallest is taken, as for wheels that yield alike.
"""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.app.bench_priors import bench_of, bench_priors
from slipid.app.config import (
    Config,
    FitSection,
    LogsSection,
    WeightsSection,
    geometry,
    single_floor_sections,
)
from slipid.app.logs import files_of, read_dataset
from slipid.data.align.lag import pose_lag
from slipid.data.check.columns import refuse_misordered
from slipid.data.floor_map import FloorMap, read_map
from slipid.data.log import Log
from slipid.data.runs import Runs
from slipid.data.windows import Windows, windows
from slipid.fitting.problem import Problem, fixed_viscosities
from slipid.infer.bench.motor import BenchRoot
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot
from slipid.parameter import entries
from slipid.search_space import Choice, Space
from slipid.support.errors import DataError, did_you_mean
from slipid.support.files import hash_of
from slipid.support.progress import Reporter


def share_priors(weights: Mapping[str, WeightsSection], shape: Geometry) -> dict[str, Choice]:
    """Return the prior of the load shares of every set-up whose weights are known.

    Raises:
        ValueError: a set-up refers to an unknown one, or a wheel would lift off.
    """
    out = {}
    for name in weights:
        kg, variance = _wheel_weights(weights, name, shape, ())
        whole, std = kg.sum(), float(np.sqrt(variance)) / kg.sum()
        share = (kg / whole).tolist()
        out[name] = Choice(f"robot.load_share@{name}", prior_mean=share, prior_std=[std] * len(kg))
    return out


def _wheel_weights(
    weights: Mapping[str, WeightsSection], name: str, shape: Geometry, above: tuple[str, ...]
) -> tuple[Float[np.ndarray, " wheel"], float]:
    """Return the weight on each wheel [kg] and its variance [kg^2]."""
    known = weights.get(name)
    if known is None or name in above:
        there = ", ".join(k for k in weights if k not in above)
        raise ValueError(f"weights.{above[-1]}.like = {name}: expected one of {there or 'none'}")
    if known.kg is not None:
        if len(known.kg) != shape.wheels:
            raise ValueError(f"weights.{name}.kg: {len(known.kg)}; expected {shape.wheels} numbers")
        return np.asarray(known.kg), known.std_kg**2
    if known.like is None or known.mass_kg is None or known.place_m is None:
        raise ValueError(f"weights.{name}: expected kg, or like, mass_kg and place_m")
    below, variance = _wheel_weights(weights, known.like, shape, (*above, name))
    place = np.asarray(shape.place) * float(shape.base_radius)
    balance = np.concatenate([np.ones((1, shape.wheels)), place.T])
    added = np.linalg.pinv(balance) @ (known.mass_kg * np.array([1.0, *known.place_m]))
    total = below + added
    if (total <= 0).any():
        wheel = int(np.argmin(total)) + 1
        raise ValueError(f"weights.{name}: wheel {wheel} would be lifted; expected weight on all")
    return total, variance + known.std_kg**2


FREE_LENGTH = {"poses": "robot.wheel_radius", "wheels": "camera.scale"}
"""Number that is fitted when the other kind of length is trusted."""
SIZE_STD = 0.1
"""Std of its prior as a part of the nominal value: tyres deform, and cameras are set up by eye."""
RECUT_LAG_S = 0.02
"""Difference between fitted and assumed lag from which windows are cut again [s]."""
LAG_STD, MOST_LAG = 0.1, 3.0
"""Std of the prior of a lag found from the motion, and longest lag that a fit starts from [s]."""


@dataclass(frozen=True, eq=False)
class FitTask:
    """Runs, the robot that drove them, and choices for its numbers: everything a fit needs.

    Attributes:
        dataset: the runs, each on one floor.
        robot: robot with its geometry and every number at its declared start.
        choices: free, fixed and prior values of its numbers.
        settings: how finely runs are cut into windows, and how long to fit.
        mixed: runs over several floors, with the map of each set.
    """

    dataset: Runs
    robot: Robot
    choices: tuple[Choice, ...]
    settings: FitSection
    mixed: tuple[tuple[Runs, FloorMap], ...] = ()

    @property
    def logs(self) -> tuple[Log, ...]:
        """Logs of all runs; those over several floors come last."""
        return self.dataset.logs + tuple(log for data, _ in self.mixed for log in data.logs)

    @property
    def data_hash(self) -> str:
        """Hash of the runs and their files."""
        return hash_of((log.name, log.sha256) for log in self.logs)

    def problem(self, near: Robot | None = None) -> Problem:
        """Return the likelihood of the runs in windows, cut for a robot `near` an optimum."""
        return Problem(self.windows(self.cutting_robot(near)), self.robot, list(self.choices))

    def cutting_robot(self, near: Robot | None) -> Robot:
        """Return the robot whose wheel radius and lag decide where windows are cut.

        It is the robot at the start of a fit, with the lag of a robot `near` an optimum where the
        two lags differ by more than `RECUT_LAG_S`: the wheel angle turned in a window is linear in
        the lag only near the lag at which the window was cut.
        """
        robot = Space(self.robot, self.choices).template
        if near is None or abs(float(near.camera.lag - robot.camera.lag)) <= RECUT_LAG_S:
            return robot
        return replace(robot, camera=replace(robot.camera, lag=near.camera.lag))

    def windows(self, robot: Robot) -> Windows:
        """Return windows of the runs, cut at the wheel radius and the camera lag of a robot."""
        return windows(
            self.dataset,
            float(robot.geometry.wheel_radius),
            lag=float(robot.camera.lag),
            per_segment=self.settings.windows_per_piece,
            longest=self.settings.longest_window_s,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ConfigFitTask(FitTask):
    """Fit task that a config describes.

    Attributes:
        config: the config.
        skipped: a line for each thing that the config names and the data folder lacks.
    """

    config: Config
    skipped: tuple[str, ...]


def read_fit_task(config: Config, root: Path, report: Reporter) -> ConfigFitTask:
    """Read every log of runs on one floor that the config names, and set up its robot.

    The file of its motor's bench is read first, so that a missing one costs no reading of logs.
    """
    bench_of(config)
    report.stage("reading logs")
    dataset, skipped = read_dataset(
        config, single_floor_sections(config.content.logs), root, report
    )
    return fit_task(config, dataset, skipped, report)


def with_mixed(task: ConfigFitTask, root: Path, report: Reporter) -> ConfigFitTask:
    """Return the task with the runs over several floors that its config names."""
    sections = [section for section in task.config.content.logs if section.map is not None]
    found, absent = files_of(task.config, sections, root)
    for section, _ in found:
        floor = _map(task, section)
        data, short = read_dataset(task.config, [section], root, report)
        absent += short
        refuse_misordered(data.logs)
        _go_together(task, data)
        task = replace(task, mixed=(*task.mixed, (data, floor)))
    for sentence in absent:
        report.line(sentence)
    return replace(task, skipped=(*task.skipped, *absent))


def _map(task: ConfigFitTask, section: LogsSection) -> FloorMap:
    """Return the map of a log section; raise `DataError` for a floor that no other run stays on."""
    path = task.config.path.parent / str(section.map)
    floor = read_map(path)
    known = task.robot.surfaces.labels
    for name in floor.surfaces:
        if name not in known:
            raise DataError(
                f"{path}: surface '{name}': no run on it alone; expected some of {', '.join(known)}"
            )
    return floor


def _go_together(task: ConfigFitTask, data: Runs) -> None:
    """Raise `DataError` where runs over several floors need what runs on one floor lack."""
    names, first = {log.name for log in task.logs}, task.dataset.logs[0]
    for log in data.logs:
        if log.name in names:
            raise DataError(
                f"{log.name}: found by two globs of {task.config.path}; expected it once"
            )
        if log.load not in task.robot.body.loads:
            raise DataError(
                f"{log.name}: load set-up '{log.load}': no run with it on one floor; "
                f"expected one of {', '.join(task.robot.body.loads)}"
            )
        if log.wheels != first.wheels:
            raise DataError(f"{log.name}: {log.wheels} wheels; expected {first.wheels}")


def fit_task(
    config: Config, dataset: Runs, skipped: Sequence[str], report: Reporter
) -> ConfigFitTask:
    """Return the fit task of runs that were read already."""
    shape = shape_of(config)
    logged = dataset.logs[0]
    if shape.drives != logged.wheels:
        drives = f"{shape.drives} drives" if shape.drive_of else f"{shape.wheels} wheels"
        shared = "; say which wheels share a motor by robot.drives = [[1, 3], [2, 4]]"
        raise DataError(
            f"{config.path}: robot: {drives}, but {logged.name} has {logged.wheels}; expected the "
            f"same{shared if shape.wheels == 2 * logged.wheels else ''}"
        )
    robot = robot_for_runs(Robot.of(shape), dataset, config.content.camera.image_centre_m)
    choices, left_out = _choices(config, robot)
    # the choices of the config come last and override the others
    given = any(fnmatch.fnmatchcase("camera.lag", p) for p in config.content.parameters)
    lag = [] if given else lag_from_motion(dataset)
    known = [*lag, *without_rollers(shape), *fixed_viscosities(dataset)]
    trusted = config.content.fit.lengths_from
    choices = [*known, *choices]
    if trusted is not None and {*FREE_LENGTH.values()} <= {
        e.path for e in Space(robot, choices).free
    }:
        freed = FREE_LENGTH["wheels" if trusted == "poses" else "poses"]
        raise DataError(
            f"{config.path}: fit.lengths_from = '{trusted}' with {freed} free in parameters; "
            "expected one of the two: no motion tells them apart"
        )
    skipped = (*skipped, *left_out)
    for sentence in skipped:
        report.line(sentence)
    settings = config.content.fit
    return ConfigFitTask(dataset, robot, tuple(choices), settings, config=config, skipped=skipped)


def lag_from_motion(dataset: Runs) -> list[Choice]:
    """Return a choice for a free camera lag near the one that the motion shows, if any."""
    lag = pose_lag(dataset)
    if lag is None or abs(lag.seconds) > MOST_LAG:
        return []
    return [Choice("camera.lag", prior_mean=lag.seconds, prior_std=LAG_STD, free=True)]


def lengths(trusted: str | None, shape: Geometry) -> list[Choice]:
    """Free the wheel radius and hold the scale of the poses, or the other way round."""
    if trusted is None:
        return []
    radius = float(shape.wheel_radius)
    nominal = {"robot.wheel_radius": radius, "camera.scale": 1.0}
    return [
        Choice(path, prior_mean=mean, prior_std=SIZE_STD * mean, free=path == FREE_LENGTH[trusted])
        for path, mean in nominal.items()
    ]


def without_rollers(shape: Geometry) -> list[Choice]:
    """Hold the numbers of rollers fixed where no wheel has rollers."""
    if not all(shape.grips):
        return []
    names = ("roller_drag", "roller_creep", "roller_viscosity")
    return [Choice(f"surface.*.{name}", free=False) for name in names]


def robot_for_runs(robot: Robot, runs: Runs, centre: tuple[float, float]) -> Robot:
    """Return a robot with the floors, load set-ups and sessions of runs; image centre in [m]."""
    floors = {log.surface or "unknown" for log in runs.logs}
    loads = {log.load for log in runs.logs}
    return robot.on(sorted(floors), sorted(loads), sorted(set(runs.session)), centre)


def shape_of(config: Config) -> Geometry:
    """Return the geometry of the config's robot; raise `DataError` where it cannot drive."""
    try:
        return geometry(config.content.wheels)
    except ValueError as error:
        raise DataError(f"{config.path}: robot: {error}") from error


_STATED = ("robot.wheel_radius", "robot.base_radius", "robot.mass")


def stated_sizes(robot: Robot, mass: float) -> list[Choice]:
    """Hold size and mass at their stated values, the prior means of those the config frees."""
    choices = []
    for e in entries(robot):
        if e.path in _STATED:
            value = mass if e.path == "robot.mass" else float(e.get(robot))
            std = e.declaration.spread * value
            choices.append(Choice(e.path, prior_mean=value, prior_std=std, free=False))
    return choices


def _choices(config: Config, robot: Robot) -> tuple[list[Choice], list[str]]:
    """Return the config's choices for numbers, and lines about floors and loads that are absent."""
    paths, skipped = [e.path for e in entries(robot)], []
    choices = stated_sizes(robot, config.content.wheels.mass_kg or float(robot.body.mass))
    choices += lengths(config.content.fit.lengths_from, robot.geometry)
    measured, lines = bench_priors(config, float(robot.motor.gear_ratio))
    choices += measured
    skipped += lines
    try:
        known = share_priors(config.content.weights, robot.geometry)
    except ValueError as error:
        raise DataError(f"{config.path}: {error}") from error
    for load, prior in known.items():
        if load in robot.body.loads:
            choices.append(prior)
        else:
            skipped.append(f"skipped: weights.{load}: no run that has it")
    for pattern in config.content.parameters:
        if not fnmatch.filter(paths, pattern):
            if fnmatch.filter(paths, _any_label(pattern)):
                skipped.append(f"skipped: parameters '{pattern}': no run that has it")
                continue
            raise unknown_parameter(config, pattern, pattern, paths)
        choices.append(checked_choice(config, pattern, pattern, robot))
    return choices, skipped


def unknown_parameter(config: Config, pattern: str, name: str, paths: list[str]) -> DataError:
    """Return the error about a pattern of `[parameters]` whose `name` matches no path."""
    return DataError(
        f"{config.path}: parameters.'{pattern}': no such parameter{did_you_mean(name, paths)}; "
        f"expected one of {', '.join(paths)}"
    )


def checked_choice(config: Config, pattern: str, name: str, root: Robot | BenchRoot) -> Choice:
    """Return the choice in `[parameters]` at a pattern for `name`; `DataError` where impossible."""
    setting = config.content.parameters[pattern]
    gauss = (setting.prior.mean, setting.prior.std) if setting.prior else (None, None)
    choice = Choice(name, setting.start, setting.fixed, setting.free, *gauss)
    try:
        Space(root, [choice])
    except ValueError as error:
        raise DataError(f"{config.path}: parameters.'{pattern}': {error}") from error
    return choice


def _any_label(pattern: str) -> str:
    """Return the pattern with the name of a floor, load or session replaced by `*`."""
    head, at, _ = pattern.partition("@")
    parts = head.split(".")
    if parts[0] == "surface" and len(parts) == 3:
        parts[1] = "*"
    return ".".join(parts) + (f"{at}*" if at else "")
