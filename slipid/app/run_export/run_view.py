"""A run beside its predictions: what is shown of one run of a result folder.

The run is read from its log, and predicted by the models in the folder. The estimator of the
folder's robot.json is run over the log as if it had run on the robot.
"""

import glob
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from slipid.app.calibrate import read_calibration
from slipid.app.config import Config, LogsSection, shape_of
from slipid.app.floor_maps import map_path
from slipid.app.logs import config_of_fit, matching_files, read_dataset, read_run_file
from slipid.data.floor_map import FloorMap, read_map
from slipid.data.log import Log
from slipid.data.runs import Runs
from slipid.data.windows import incomplete_poses
from slipid.deploy.deploy import robot_of_folder
from slipid.deploy.floors import floor_of
from slipid.deploy.replay import EstimatedRun, Start, estimated
from slipid.infer.body_path import (
    BodyPath,
    contact_path,
    kinematic_path,
    measured_path,
    moved_to_start,
    times,
)
from slipid.infer.fit_file import load
from slipid.infer.motion_models import MotionModels
from slipid.infer.replayed_paths import replayed_over_floors
from slipid.infer.result_folder import FIT, ROBOT
from slipid.predict import open_loop as replay
from slipid.predict.selection import aligned_path
from slipid.robot.estimator import Estimator
from slipid.support.errors import DataError, first_names
from slipid.support.progress import Reporter

_EXPECTED = "a result of `slipid identify`"


@dataclass(frozen=True, eq=False)
class RunView:
    """One run and its predictions.

    Attributes:
        log: the run.
        fitted: `yes` if the models were fitted to this log, `no` if they were not, `changed` if the
            log has changed since.
        selected: name of the slip model selected on the run's floor; None if there is none.
        paths: paths of the body, keyed `measured`, `nominal`, `calibrated`, `selected` and
            `estimator`, as far as they exist.
        estimate: estimates of the deployed estimator; None without a robot.json.
        floor: map of the floor; None if there is none.
        wheels: centres of the robot's wheels, ahead and to the left of its middle [m].
        notes: sentences about what is missing, and why.
    """

    log: Log
    fitted: str
    selected: str | None
    paths: Mapping[str, BodyPath]
    estimate: EstimatedRun | None
    floor: FloorMap | None
    wheels: Float[np.ndarray, "wheel 2"]
    notes: tuple[str, ...]


def run_view(
    out: Path, wanted: str, data: Path | None, map_file: Path | None, report: Reporter
) -> RunView:
    """Return a run of a result folder with its predictions.

    Args:
        out: folder that `slipid identify` wrote.
        wanted: name of a fitted run or an unambiguous part of it; or the path of another log in the
            data folder.
        data: folder of the logs; None for that of the fit.
        map_file: map of the floor; None for the map that the config names for the run, if any.
        report: reporter of the progress.

    Raises:
        DataError: there is no result, no such run, or the log cannot be read or predicted.
    """
    about = read_run_file(out).data
    fitted = about.logs
    config, root = config_of_fit(out), Path(about.folder) if data is None else data
    if not root.is_dir():
        raise DataError(f"{root}: no such folder; expected the folder of the logs (--data)")
    name = _name_of(wanted, list(fitted), root, out)
    report.stage("reading the log")
    run, section = _read(config, name, root, report)
    log, state, notes = run.logs[0], "no", []
    if log.name in fitted:
        state = "yes" if fitted[log.name] == log.sha256 else "changed"
    if state == "changed":
        notes.append(
            f"{log.path}: its SHA-256 hash is not that of the fitted log: the log has changed "
            "since, or --data names other logs"
        )
    report.stage("predicting")
    models = _models(out, config, run)
    floor, no_map = _floor(config, section, map_file)
    paths, selected, why = _paths(run, models, floor)
    report.stage("estimating floors")
    estimate, unknown = _estimate(out, log, models, paths, floor if log.surface is None else None)
    if estimate is not None:
        pose, cov = (np.asarray(x) for x in (estimate.estimate.pose, estimate.estimate.covariance))
        paths["estimator"] = BodyPath(estimate.time, pose, cov[:, :2, :2], np.inf)
    shape = models.seen.geometry
    wheels = np.asarray(shape.place) * float(shape.base_radius)
    notes += [*why, *no_map, *unknown]
    return RunView(log, state, selected, paths, estimate, floor, wheels, tuple(notes))


def _name_of(wanted: str, fitted: Sequence[str], root: Path, out: Path) -> str:
    """Return the name of a fitted run from a part of it, or that of another log in the folder."""
    similar = [name for name in fitted if wanted in name]
    if wanted in fitted or _is_log(root / _file_of(wanted, root)):
        return wanted
    if len(similar) == 1:
        return similar[0]
    if similar:
        raise DataError(
            f"run '{wanted}': {len(similar)} runs in {out / 'run.json'} have this in their names; "
            f"expected one of {first_names(similar)}"
        )
    raise DataError(
        f"run '{wanted}': neither a run in {out / 'run.json'} nor a log in {root} (--data); "
        f"expected one of {first_names(fitted)}, or a part of such a name"
    )


def _is_log(path: Path) -> bool:
    return path.is_file() or (path / "metadata.yaml").is_file()


def _file_of(name: str, root: Path) -> str:
    """Return the path of the log of a run, whose name may end in `#` and the run's own name."""
    return name if _is_log(root / name) else name.rpartition("#")[0] or name


def _read(config: Config, name: str, root: Path, report: Reporter) -> tuple[Runs, LogsSection]:
    """Return a run, and the section of the config by which it was read."""
    file = _file_of(name, root)
    if not _is_log(root / file):
        raise DataError(f"{root / file}: no such log; expected the folder of the logs (--data)")
    pattern = glob.escape(file)
    sections = [*config.content.logs, *config.content.validate_.logs]
    found = matching_files(config, sections, root, pattern)
    if not found:
        raise DataError(f"{root / name}: an additional file of a run; expected its main file")
    section = found[0][0]
    runs, aside = read_dataset(config, [section], root, report, pattern)
    numbers = [k for k, log in enumerate(runs.logs) if log.name == name or len(runs) == 1]
    if not numbers:
        there = first_names(log.name for log in runs.logs)
        raise DataError(f"{root}: no run '{name}'; expected one of {there}", *aside)
    return runs.subset(numbers), section


def _models(out: Path, config: Config, run: Runs) -> MotionModels:
    """Return the models of motion in a result folder.

    Raises:
        DataError: the load set-up of the run was not fitted.
    """
    if not (out / FIT).exists():
        found, shape = read_calibration(out), shape_of(config)
        seen = found.seen(shape, run)
        return MotionModels.of_calibration(found.calibration, found.models, shape, seen)
    fit, log = load(out), run.logs[0]
    if log.load not in fit.robot.body.loads:
        known = ", ".join(fit.robot.body.loads)
        raise DataError(
            f"{log.name}: load set-up '{log.load}' was not identified; identified: {known}"
        )
    return MotionModels.of_fit(fit)


def _paths(
    run: Runs, models: MotionModels, floor_map: FloorMap | None
) -> tuple[dict[str, BodyPath], str | None, list[str]]:
    """Return the paths of a run, the name of the selected model, and sentences about missing paths.

    Predicted paths have the times of the measured poses, from the first motion on.
    """
    floor, log = run.surface[0], run.logs[0]
    whole, several = incomplete_poses(run, 0) is None, log.surface is None
    if several and whole and floor_map and set(floor_map.surfaces) <= set(models.selected):
        return *_over_floors(run, models, floor_map), []
    known, notes = floor in models.selected, []
    if not known:
        identified = ", ".join(models.selected)
        what = f"on '{floor}', and not on one of the identified floors ({identified})"
        if several and floor_map is None:
            what = "over several floors without a map of them"
        elif several and not whole:
            what = "over several floors whose poses lack a coordinate"
        elif several and floor_map is not None:
            on_map = ", ".join(floor_map.surfaces)
            what = f"over several floors ({on_map}), not all of them identified ({identified})"
        notes.append(f"{log.name}: a run {what}: without the paths calibrated and selected")
    kinematic = {name: m for name, m in models.kinematic.items() if known or name == "nominal"}
    sensor = models.sensor(floor)
    measured = measured_path(run, 0, sensor)
    paths = {} if measured is None else {"measured": measured}
    selected = models.selected.get(floor)
    if measured is None or (sentence := incomplete_poses(run, 0)):
        notes.append(f"{sentence}; predicted paths are aligned with the measured poses")
        for name, model in kinematic.items():
            aligned = aligned_path(run, 0, model.fitted.get(floor, model.model), models.seen)
            if aligned is not None:
                paths[name] = BodyPath(aligned.time, aligned.pose)
        if selected in paths:
            paths["selected"] = paths[selected]
        return paths, selected, notes
    w = replay.replay_windows(run, sensor)[0]
    begin = measured.at(w.start[:1] - w.lag).pose[0]
    for name, model in kinematic.items():
        found = kinematic_path(model, models.seen, w)
        pose = moved_to_start(found.pose[None], begin[None])[0]
        paths[name] = BodyPath(found.time, pose)
    if selected in kinematic:
        model = kinematic[selected]
        paths["selected"] = kinematic_path(model, models.seen, w, models.calibration)
    elif selected is not None and models.contact is not None:
        paths["selected"] = contact_path(models.contact, w)
    return _at_measured(paths), selected, notes


def _over_floors(
    run: Runs, models: MotionModels, floor: FloorMap
) -> tuple[dict[str, BodyPath], str]:
    """Return the paths of a run over several floors, and the name of the selected model."""
    done = next(replayed_over_floors(models, run, floor))
    paths = {name: BodyPath(times(done.w), path[0]) for name, path in done.paths.items()}
    measured = measured_path(run, 0, models.sensor(done.floor[0]))
    assert measured is not None  # its poses are whole
    selected = models.selected[done.floor[0]]
    paths |= {"measured": measured, "selected": paths[selected]}
    paths.pop("contact", None)
    return _at_measured(paths), selected


def _at_measured(paths: Mapping[str, BodyPath]) -> dict[str, BodyPath]:
    """Return the paths at the times of the measured poses."""
    time = paths["measured"].time
    return {name: path if name == "measured" else path.at(time) for name, path in paths.items()}


def _floor(
    config: Config, section: LogsSection, given: Path | None
) -> tuple[FloorMap | None, list[str]]:
    """Return the map of the floor, and a sentence if the config's map is missing."""
    if given is not None:
        return read_map(given), []
    path = map_path(config, section)
    if path is None:
        return None, []
    if path.is_file():
        return read_map(path), []
    return None, [f"{path}: no such floor map; name it by --map"]


def _estimate(
    out: Path,
    log: Log,
    models: MotionModels,
    paths: Mapping[str, BodyPath],
    floor: FloorMap | None,
) -> tuple[EstimatedRun | None, list[str]]:
    """Return the estimates of the deployed estimator, and a sentence if there are none.

    The estimator starts at the first measured pose; if measured poses lack coordinates, it starts
    at the first pose of the selected or of the nominal path.
    """
    if not (out / ROBOT).is_file():
        return None, [f"{out / ROBOT}: missing, so that neither slip nor floors are estimated"]
    robot = robot_of_folder(out, log.load)
    known = None if floor is None else floor_of(floor, robot.labels)
    path, std = paths.get("selected", paths["nominal"]), (0.0, 0.0)
    if log.pose is not None and np.isfinite(log.pose).all():
        path = paths["measured"]
        if models.contact is not None:
            variance, scale = models.contact.variance, float(models.contact.robot.camera.scale)
            place, heading = (np.sqrt(variance[f"camera.{name}"]) for name in ("place", "heading"))
            std = float(place) * scale, float(heading)
    x, y, heading = path.pose[0].tolist()
    if not models.currents:
        log = replace(log, current=None, voltage=None)
    estimator = Estimator(robot, floor=known)
    return estimated(estimator, log, Start(float(path.time[0]), (x, y, heading), std)), []
