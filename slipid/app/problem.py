"""Set-up of the fit task and of the likelihood from a config and a data folder.

Priors of the load shares follow from readings of scales under the wheels, or from masses at known
positions: a mass m at position p adds weights n_i on the wheels at p_i, with sum n_i = m and sum
n_i p_i = m p. For three wheels the solution is unique; for more wheels, the minimum-norm solution
is used, as if all wheels were equally stiff.
"""

import fnmatch
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float

from slipid.app.bench_priors import bench_of, bench_priors
from slipid.app.config import (
    Config,
    FitSection,
    LogsSection,
    WeightsSection,
    given_settings,
    shape_of,
    single_floor_sections,
)
from slipid.app.floor_maps import map_path
from slipid.app.logs import files_of, read_dataset
from slipid.data.align.lag import pose_lag
from slipid.data.check.columns import refuse_misordered
from slipid.data.check.findings import by_reason
from slipid.data.check.own_settings import own_settings
from slipid.data.check.short_runs import short_runs
from slipid.data.floor_map import FloorMap, read_map
from slipid.data.log import Log
from slipid.data.runs import Runs
from slipid.data.windows import Windows, incomplete_poses, steady_duration, windows
from slipid.fitting.calibration.result import Calibration
from slipid.fitting.problem import Problem, fixed_viscosities
from slipid.infer.bench.motor import BenchRoot
from slipid.model.geometry import Geometry
from slipid.model.kinematics import is_axle
from slipid.model.robot import Robot
from slipid.parameter import entries
from slipid.search_space import Choice, Space
from slipid.support.errors import DataError, did_you_mean
from slipid.support.files import hash_of
from slipid.support.progress import Reporter


def weight_priors(
    weights: Mapping[str, WeightsSection], shape: Geometry, first: str
) -> dict[str, tuple[Choice, ...]]:
    """Return priors for each load set-up with known weights, keyed by its name.

    They are priors of the load shares, and of the mass over that of the load set-up `first` if its
    weights are known as well.

    Raises:
        ValueError: a set-up refers to an unknown one or to itself, or a wheel would have no weight
            on it.
    """
    known = {name: _wheel_weights(weights, name, shape, ()) for name in weights}
    out: dict[str, tuple[Choice, ...]] = {}
    for name, (kg, variance) in known.items():
        whole, std = kg.sum(), float(np.sqrt(variance)) / kg.sum()
        share = (kg / whole).tolist()
        out[name] = (
            Choice(f"robot.load_share@{name}", prior_mean=share, prior_std=[std] * len(kg)),
        )
        if name != first and first in known:
            ratio = float(whole / known[first][0].sum())
            spread = _ratio_std(weights, known, name, first)
            mass = Choice(f"robot.mass_ratio@{name}", prior_mean=ratio, prior_std=spread)
            out[name] += (mass,)
    return out


def _ratio_std(
    weights: Mapping[str, WeightsSection],
    known: Mapping[str, tuple[Float[np.ndarray, " wheel"], float]],
    name: str,
    first: str,
) -> float:
    """Return the std of the mass in a load set-up over that in `first`.

    If one of both set-ups is like the other, its weights contain the errors of the other's.
    """
    (kg, own), (kg_first, of_first) = known[name], known[first]
    ratio = kg.sum() / kg_first.sum()
    if first in _likes(weights, name) or name in _likes(weights, first):
        shared = min(own, of_first)
        variance = own + of_first - 2 * shared + (ratio - 1) ** 2 * shared
    else:
        variance = own + ratio**2 * of_first
    return float(np.sqrt(len(kg) * variance) / kg_first.sum())


def _likes(weights: Mapping[str, WeightsSection], name: str) -> list[str]:
    """Return the load set-ups that one refers to, directly or by others."""
    out = []
    while (like := weights[name].like) is not None:
        out.append(like)
        name = like
    return out


def _wheel_weights(
    weights: Mapping[str, WeightsSection], name: str, shape: Geometry, above: tuple[str, ...]
) -> tuple[Float[np.ndarray, " wheel"], float]:
    """Return the weight on each wheel [kg] and its variance [kg^2] in a load set-up.

    Args:
        weights: known weights, keyed by the name of the load set-up.
        name: name of the set-up.
        shape: geometry of the robot.
        above: names of the set-ups that refer to this one, to detect circles.
    """
    known = weights.get(name)
    if known is None or name in above:
        there = ", ".join(k for k in weights if k not in above)
        raise ValueError(
            f"weights.{above[-1]}.like = {name}: not in [weights], or it refers back to this one; "
            f"known: {there or 'none'}"
        )
    if known.kg is not None:
        if len(known.kg) != shape.wheels:
            raise ValueError(f"weights.{name}.kg: {len(known.kg)} numbers; expected {shape.wheels}")
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
"""Length that is fitted because the other length is trusted, keyed by the config's
`fit.lengths_from`: with "poses" the poses' scale is trusted, with "wheels" the wheel radius."""
SIZE_STD = 0.1
"""Std of the fitted length's prior relative to its nominal value [1]: tyres deform, and cameras are
set up by eye."""
RECUT_LAG_S = 0.02
"""Difference between fitted and assumed lag above which windows are cut again [s]."""
LAG_STD, MOST_LAG = 0.1, 3.0
"""Std of the prior of a lag that was found from the motion, and largest such lag that is used
[s]."""


@dataclass(frozen=True, eq=False)
class FitTask:
    """Everything that a fit needs: runs, the robot that drove them, and choices for parameters.

    Attributes:
        dataset: runs that stay on one floor each.
        robot: robot with its geometry and every parameter at its declared start value.
        choices: free, fixed and prior values of parameters.
        settings: length of the windows, and limits of the optimisation.
        mixed: sets of runs over several floors, each with the map of the floors.
        user_choices: number of the last choices that the user made.
    """

    dataset: Runs
    robot: Robot
    choices: tuple[Choice, ...]
    settings: FitSection
    mixed: tuple[tuple[Runs, FloorMap], ...] = ()
    user_choices: int = 0

    @property
    def calibration_only(self) -> str | None:
        """Reason why no force balance can be fitted, but a calibration can be; else None."""
        if self.robot.geometry.driven is not None:
            return NO_BALANCE
        reasons = (incomplete_poses(self.dataset, run) for run in range(len(self.dataset)))
        return next(filter(None, reasons), None)

    @cached_property
    def longest_window(self) -> float:
        """Longest duration of a window [s]: the one set, or as long as the wheels are steady."""
        return self.settings.longest_window_s or steady_duration(self.dataset)

    def started_from(self, found: Calibration) -> Self:
        """Return the same task, starting from a calibration.

        Lengths, lag and the place of the pose sensor that the calibration has determined are fitted
        with priors around the config's lengths, unless the user decided otherwise.
        """
        split = len(self.choices) - self.user_choices
        space = Space(self.robot, self.choices)
        more = geometry_choices(found, self.robot.geometry, {e.path for e in space.free})
        return replace(self, choices=(*self.choices[:split], *more, *self.choices[split:]))

    @property
    def logs(self) -> tuple[Log, ...]:
        """Return the logs of all runs; those over several floors come last."""
        return self.dataset.logs + tuple(log for data, _ in self.mixed for log in data.logs)

    @property
    def data_hash(self) -> str:
        """Return the hash of the names and files of all runs."""
        return hash_of((log.name, log.sha256) for log in self.logs)

    @property
    def robot_settings(self) -> dict[str, tuple[float, str]]:
        """Limits and noise of sensors that the logs show, see `Fit.robot_settings`."""
        shown = own_settings(self.logs, self.robot.geometry)
        return {path: (value, "logs") for path, value in shown.items()}

    def problem(self, near: Robot | None = None) -> Problem:
        """Return the likelihood of the runs that stay on one floor each.

        `near` is a robot close to the optimum, or None; windows are cut for `cutting_robot(near)`.

        Raises:
            DataError: the robot steers.
        """
        refuse_steered(self.robot.geometry)
        return Problem(self.windows(self.cutting_robot(near)), self.robot, list(self.choices))

    def cutting_robot(self, near: Robot | None) -> Robot:
        """Return the robot for whose wheel radius and lag windows are cut.

        The result is the robot at the start of a fit. If a robot `near` an optimum is given whose
        lag differs from that of the start by more than `RECUT_LAG_S`, the result has the lag of
        `near`, because the wheel angle turned in a window is linear in the lag only near the lag
        for which the window was cut.
        """
        robot = Space(self.robot, self.choices).template
        if near is None or abs(float(near.camera.lag - robot.camera.lag)) <= RECUT_LAG_S:
            return robot
        return replace(robot, camera=replace(robot.camera, lag=near.camera.lag))

    def windows(self, robot: Robot) -> Windows:
        """Return the runs in windows, cut for the wheel radius and the camera lag of a robot."""
        return windows(
            self.dataset,
            float(robot.geometry.wheel_radius),
            lag=float(robot.camera.lag),
            per_segment=self.settings.windows_per_piece,
            longest=self.longest_window,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ConfigFitTask(FitTask):
    """Fit task that a config describes.

    Attributes:
        config: the config.
        skipped: one line about each log, pattern or weight in the config that was not found or not
            used.
    """

    config: Config
    skipped: tuple[str, ...]

    @property
    def robot_settings(self) -> dict[str, tuple[float, str]]:
        """Limits, noise and delays that the config gives, and those that only the logs show."""
        given = given_settings(self.config.content.wheels)
        return super().robot_settings | {path: (v, "config") for path, v in given.items()}


NO_BALANCE = (
    "no force balance for steered wheels: radius, wheelbase and steering are calibrated from "
    "poses, and forces, motors and loads are not fitted"
)
"""Sentence about what is not fitted of a robot that steers."""


def refuse_steered(shape: Geometry) -> None:
    """Raise `DataError` if a wheel is steered, which no force balance describes."""
    if shape.driven is not None:
        raise DataError(NO_BALANCE)


def read_fit_task(config: Config, root: Path, report: Reporter) -> ConfigFitTask:
    """Return the fit task of a config, after reading all its runs that stay on one floor each.

    The bench file of the motor, if the config names one, is read first, so that an error in this
    file appears before logs are read.
    """
    bench_of(config)
    report.stage("reading logs")
    dataset, skipped = read_dataset(
        config, single_floor_sections(config.content.logs), root, report
    )
    dataset, short = without_short_runs(config, dataset)
    skipped += short
    return fit_task(config, dataset, skipped, report)


def without_short_runs(config: Config, data: Runs) -> tuple[Runs, list[str]]:
    """Return the runs without those in which the robot hardly moves, and a line about each such."""
    fewest = config.content.fit.windows_per_piece + 1
    short = short_runs(data, config.content.wheels.wheel_radius_m, fewest)
    if not short:
        return data, []
    lines = [f"set aside: {sentence}" for sentence in short.values()]
    kept = data.subset([run for run in range(len(data)) if run not in short])
    return replace(kept, aside=(*data.aside, *lines)), lines


def with_mixed(task: ConfigFitTask, root: Path, report: Reporter) -> ConfigFitTask:
    """Return the task with the runs over several floors that its config names, if any.

    `root` is the data folder.
    """
    sections = [section for section in task.config.content.logs if section.map is not None]
    found, absent = files_of(task.config, sections, root)
    for section, _ in found:
        floor = _map(task, section)
        data, left_out = read_dataset(task.config, [section], root, report)
        data, short = without_short_runs(task.config, data)
        absent += [*left_out, *short]
        refuse_misordered(data.logs)
        _go_together(task, data)
        task = replace(task, mixed=(*task.mixed, (data, floor)))
    for sentence in absent:
        report.line(sentence)
    return replace(task, skipped=(*task.skipped, *absent))


def _map(task: ConfigFitTask, section: LogsSection) -> FloorMap:
    """Return the floor map that a log section names.

    Raises:
        DataError: the map cannot be read, or has a floor on which there is no single-floor run.
    """
    path = map_path(task.config, section)
    assert path is not None, "the section has a map"
    floor = read_map(path)
    known = task.robot.surfaces.labels
    for name in floor.surfaces:
        if name not in known:
            raise DataError(
                f"{path}: surface '{name}': no single-floor run is on it; expected one of "
                f"{', '.join(known)}"
            )
    return floor


def _go_together(task: ConfigFitTask, data: Runs) -> None:
    """Raise `DataError` if runs that cross floors are inconsistent with the single-floor runs.

    They are inconsistent if a run is in both sets, has a load set-up that no single-floor run has,
    or has another number of wheels.
    """
    names, first = {log.name for log in task.logs}, task.dataset.logs[0]
    for log in data.logs:
        if log.name in names:
            raise DataError(
                f"{log.name}: found by two globs of {task.config.path}; expected it once"
            )
        if log.load not in task.robot.body.loads:
            raise DataError(
                f"{log.name}: load set-up '{log.load}': no single-floor run has it; "
                f"expected one of {', '.join(task.robot.body.loads)}"
            )
        if log.wheels != first.wheels:
            raise DataError(
                f"{log.name}: {log.wheels} wheels; expected {first.wheels}, as in {first.name}"
            )


def fit_task(
    config: Config, dataset: Runs, skipped: Sequence[str], report: Reporter
) -> ConfigFitTask:
    """Return the fit task of a config with runs that were read already.

    `skipped` has a line about each log that was not found or not used. Lines about patterns and
    weights that apply to no run are added to it.
    """
    shape = shape_of(config)
    logged = dataset.logs[0]
    if shape.drives != logged.wheels:
        drives = f"{shape.drives} drives" if shape.drive_of else f"{shape.wheels} wheels"
        hint = "; say which wheels share a motor by robot.drives = [[1, 3], [2, 4]]"
        hint = hint if shape.wheels == 2 * logged.wheels else ""
        if shape.driven is not None:
            plural = "" if shape.wheels == 1 else "s"
            drives = f"{shape.wheels} encoder{plural} on the {shape.driven} axle"
            hint = f": set robot.encoders = {logged.wheels}, or give columns for {shape.wheels}"
        raise DataError(
            f"{config.path}: robot: {drives}, but {logged.name} has {logged.wheels}; expected the "
            f"same{hint}"
        )
    if shape.driven is not None and dataset.steering is None:
        log = next(log for log in dataset.logs if log.steering is None)
        raise DataError(
            f"{log.name}: no steering angle; expected the channel steering_angle in the layout of "
            "every log, since robot.drive is 'steered'"
        )
    if shape.driven is None and dataset.steering is not None:
        raise DataError(
            f"{config.path}: robot.drive is '{config.content.wheels.drive}', which has no steered "
            "wheel, but a layout has the channel steering_angle; remove this channel, or describe "
            "the robot with drive = 'steered'"
        )
    robot = robot_for_runs(Robot.of(shape), dataset, config.content.camera.image_centre_m)
    choices, left_out, by_user = _choices(config, robot)
    # A lag that the config sets is not replaced by the lag that the motion shows.
    given = any(fnmatch.fnmatchcase("camera.lag", p) for p in config.content.parameters)
    lag = [] if given else lag_from_motion(dataset)
    known = [*lag, *without_rollers(shape), *fixed_viscosities(dataset)]
    trusted = config.content.fit.lengths_from
    # The choices of the config come last, since later choices override earlier ones.
    choices = [*known, *choices, *of_torques(dataset, robot)]
    if trusted is not None and {*FREE_LENGTH.values()} <= {
        e.path for e in Space(robot, choices).free
    }:
        freed = FREE_LENGTH["wheels" if trusted == "poses" else "poses"]
        raise DataError(
            f"{config.path}: fit.lengths_from = '{trusted}' with {freed} free in parameters; "
            "expected only one of the two: motion determines only the ratio of wheel radius to "
            "camera scale"
        )
    skipped = (*skipped, *left_out)
    for sentence in by_reason(skipped):
        report.line(sentence)
    settings = config.content.fit
    return ConfigFitTask(
        dataset,
        robot,
        tuple(choices),
        settings,
        user_choices=by_user,
        config=config,
        skipped=skipped,
    )


PLACE_STD = 0.5
"""Std of the prior of the pose sensor's place, as a fraction of the track or base [1]."""
BASE_STD, SIDES_STD = 0.1, 0.02
"""Stds of the priors of the base radius, relative to the config's, and of the deviations of the
drives' radii from their mean [1]."""


def geometry_choices(found: Calibration, shape: Geometry, free: Collection[str]) -> list[Choice]:
    """Return choices that fit the geometry which a calibration has determined, starting from it.

    The base radius is that of the force balance only for wheels on one axle and for wheels that
    determine the twist: the effective track of a skid steer follows from its slip. Radii of the
    drives are fitted for wheels that point ahead only, since on omni wheels slip that depends on
    the load looks the same. Rolling radii on all floors but the firmest are fitted for a skid steer
    only, whose turns show how much its wheels slip: on one axle, slip against a rolling resistance
    looks the same as a smaller radius.

    Args:
        found: the calibration.
        shape: geometry of the config.
        free: paths of the parameters that are fitted anyway.
    """
    known = ("identified", "weak")
    radii = np.array([v.value for v in found.radius[found.firmest]])
    base, out = found.base[found.firmest], []
    if found.lag.verdict in known:
        lag = found.lag.value
        out.append(Choice("camera.lag", start=lag, prior_mean=lag, prior_std=LAG_STD, free=True))
    if all(v.verdict in known for v in found.offset):
        place = [v.value for v in found.offset]
        std = PLACE_STD * found.nominal_base
        out.append(
            Choice(
                "camera.marker_place", start=place, prior_mean=[0.0] * 2, prior_std=std, free=True
            )
        )
    if "robot.wheel_radius" in free:
        out.append(Choice("robot.wheel_radius", start=float(radii.mean())))
    if not shape.determines_twist and all(v.verdict in known for v in found.radius[found.firmest]):
        deviation = (radii / radii.mean() - 1).tolist()
        zero = [0.0] * len(deviation)
        out.append(
            Choice(
                "robot.radius_deviation",
                start=deviation,
                prior_mean=zero,
                prior_std=SIDES_STD,
                free=True,
            )
        )
        if all(shape.grips) and not is_axle(shape):
            mean = np.log(radii.mean())
            for floor in sorted(found.radius.keys() - {found.firmest}):
                soft = found.radius[floor]
                if any(v.verdict not in known for v in soft):
                    continue
                ratio = float(np.log(np.mean([v.value for v in soft])) - mean)
                out.append(Choice(f"surface.{floor}.rolling_radius", start=ratio, free=True))
    if base.verdict in known and (shape.determines_twist or is_axle(shape)):
        nominal = float(shape.base_radius)
        out.append(
            Choice(
                "robot.base_radius",
                start=nominal * base.value / found.nominal_base,
                prior_mean=nominal,
                prior_std=BASE_STD * nominal,
                free=True,
            )
        )
    return out


def lag_from_motion(dataset: Runs) -> list[Choice]:
    """Return a choice that frees the camera lag, with a prior at the lag found from the motion.

    The list is empty if the motion shows no clear lag, or a lag whose magnitude exceeds `MOST_LAG`.
    """
    lag = pose_lag(dataset)
    if lag is None or abs(lag.seconds) > MOST_LAG:
        return []
    return [Choice("camera.lag", prior_mean=lag.seconds, prior_std=LAG_STD, free=True)]


def lengths(trusted: str | None, shape: Geometry) -> list[Choice]:
    """Return choices that free one of wheel radius and camera scale, and hold the other fixed.

    `trusted` is the kind of lengths that are known, as in `FitSection.lengths_from`: "poses" frees
    the wheel radius, "wheels" the camera scale, and None returns no choices.
    """
    if trusted is None:
        return []
    radius = float(shape.wheel_radius)
    nominal = {"robot.wheel_radius": radius, "camera.scale": 1.0}
    return [
        Choice(path, prior_mean=mean, prior_std=SIZE_STD * mean, free=path == FREE_LENGTH[trusted])
        for path, mean in nominal.items()
    ]


def of_torques(runs: Runs, robot: Robot) -> list[Choice]:
    """Return choices that hold the electric parameters fixed if the runs have torques.

    The motor is then one whose torque at the wheel [N m] is equal to its current.
    """
    if not runs.current_is_torque:
        return []
    values = {"back_emf": 1.0 / float(robot.motor.gear_ratio), "efficiency": 1.0}
    brushes = ("brush_drop", "brush_current", "brush_shape", "brush_tail")
    held = ("resistance", "inductance", *brushes)
    return [
        *(Choice(f"motor.{name}", fixed=value) for name, value in values.items()),
        *(Choice(f"motor.{name}", free=False) for name in held),
    ]


def without_rollers(shape: Geometry) -> list[Choice]:
    """Return choices that hold the parameters of rollers fixed, if no wheel has rollers."""
    if not all(shape.grips):
        return []
    names = ("roller_drag", "roller_creep", "roller_viscosity")
    return [Choice(f"surface.*.{name}", free=False) for name in names]


def robot_for_runs(robot: Robot, runs: Runs, centre: tuple[float, float]) -> Robot:
    """Return a robot with the floors, load set-ups and sessions of runs.

    `centre` is the centre of the image, in the frame of the poses [m].
    """
    loads = {log.load for log in runs.logs}
    return robot.on(sorted(set(runs.surface)), sorted(loads), sorted(set(runs.session)), centre)


_STATED = ("robot.wheel_radius", "robot.base_radius", "robot.mass")


def stated_sizes(robot: Robot, mass: float) -> list[Choice]:
    """Return choices that hold sizes and mass [kg] at the values stated in the config.

    If the config frees one of them, its stated value is the mean of the prior.
    """
    choices = []
    for e in entries(robot):
        if e.path in _STATED:
            value = mass if e.path == "robot.mass" else float(e.get(robot))
            std = e.declaration.spread * value
            choices.append(Choice(e.path, prior_mean=value, prior_std=std, free=False))
    return choices


def _choices(config: Config, robot: Robot) -> tuple[list[Choice], list[str], int]:
    """Return choices for parameters, lines about them, and the number of those in `[parameters]`.

    The lines name the parameters with a prior from the bench file, and choices that apply to no
    run.
    """
    paths, skipped = [e.path for e in entries(robot)], []
    choices = stated_sizes(robot, config.content.wheels.mass_kg or float(robot.body.mass))
    choices += lengths(config.content.fit.lengths_from, robot.geometry)
    measured, lines = bench_priors(config, float(robot.motor.gear_ratio))
    choices += measured
    skipped += lines
    try:
        first = robot.body.loads[0]
        known = weight_priors(config.content.weights, robot.geometry, first)
    except ValueError as error:
        raise DataError(f"{config.path}: {error}") from error
    for load, priors in known.items():
        if load in robot.body.loads:
            choices += priors
        else:
            skipped.append(f"skipped: weights.{load}: no run has this load set-up")
    before = len(choices)
    for pattern in config.content.parameters:
        if not fnmatch.filter(paths, pattern):
            if fnmatch.filter(paths, _any_label(pattern)):
                skipped.append(
                    f"skipped: parameters '{pattern}': no run has such a floor, load or session"
                )
                continue
            raise unknown_parameter(config, pattern, pattern, paths)
        choices.append(checked_choice(config, pattern, pattern, robot))
    return choices, skipped, len(choices) - before


def unknown_parameter(config: Config, pattern: str, name: str, paths: list[str]) -> DataError:
    """Return the error about a pattern of `[parameters]` whose `name` matches no path."""
    return DataError(
        f"{config.path}: parameters.'{pattern}': no such parameter{did_you_mean(name, paths)}; "
        f"expected one of {', '.join(paths)}"
    )


def checked_choice(config: Config, pattern: str, name: str, root: Robot | BenchRoot) -> Choice:
    """Return the choice under a pattern of `[parameters]`.

    Args:
        config: the config.
        pattern: pattern in the config.
        name: pattern without the label of a motor; the choice applies to the parameters that match.
        root: object with the parameters.

    Raises:
        DataError: the choice is impossible, for example a value outside the bounds.
    """
    setting = config.content.parameters[pattern]
    gauss = (setting.prior.mean, setting.prior.std) if setting.prior else (None, None)
    choice = Choice(name, setting.start, setting.fixed, setting.free, *gauss)
    try:
        Space(root, [choice])
    except ValueError as error:
        raise DataError(f"{config.path}: parameters.'{pattern}': {error}") from error
    return choice


def _any_label(pattern: str) -> str:
    """Return a pattern with the name of its floor, load set-up or session replaced by `*`."""
    head, at, _ = pattern.partition("@")
    parts = head.split(".")
    if parts[0] == "surface" and len(parts) == 3:
        parts[1] = "*"
    return ".".join(parts) + (f"{at}*" if at else "")
