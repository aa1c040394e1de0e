"""Look-up of the floor under each wheel in logged runs, with a map and a fitted camera."""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from slipid.app.config import LogsSection
from slipid.app.logs import config_of_fit, read_dataset
from slipid.data.check.findings import by_reason
from slipid.data.log import Log
from slipid.data.reading.reader import find_logs
from slipid.deploy.floors import FloorLookup
from slipid.infer.fit_file import load
from slipid.model.robot import Robot
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import write_bytes
from slipid.support.folder import refuse_foreign
from slipid.support.progress import Reporter

SCHEMA = "slipid.floors/1"


@dataclass(frozen=True, eq=False)
class RunFloors:
    """The floor under each wheel in one run, in the rows with a new pose.

    Attributes:
        name: name of the run.
        time: time of each row [s].
        pose: pose of the body in the frame of the map: x, y [m], heading [rad].
        surface: index of the surface under each wheel in the surfaces of the look-up table.
        border: distance of each wheel from the nearest point with another surface [m].
        inside: True for a wheel that is on the map; the floor under other wheels is unknown.
    """

    name: str
    time: Float[np.ndarray, " row"]
    pose: Float[np.ndarray, "row 3"]
    surface: Int[np.ndarray, "row wheel"]
    border: Float[np.ndarray, "row wheel"]
    inside: Bool[np.ndarray, "row wheel"]


def floors_under(
    out: Path, map_file: Path, data: Path, glob: str | None, report: Reporter
) -> tuple[FloorLookup, list[RunFloors]]:
    """Return the look-up table of a map, and the floor under each wheel in runs over the map.

    The poses of the runs are corrected by the camera of a fit.

    Args:
        out: folder that `slipid identify` wrote.
        map_file: map of the floor, in the frame of the poses.
        data: folder of the logs.
        glob: glob of logs below the data folder; None to use the `[[logs]]` sections with a map in
            the config of the fit.
        report: reporter of the progress.

    Raises:
        DataError: there is no fit, map or log, or a log has no poses.
    """
    fit = load(out)
    lookup = FloorLookup.read(map_file)
    config = config_of_fit(out)
    named = config.content.logs
    sections = [section for section in named if section.map is not None]
    if glob is not None:
        find_logs(data, glob)
        sections = [
            LogsSection(glob=glob, format=named[0].format, map=str(map_file), load=named[0].load)
        ]
    if not sections:
        raise DataError(
            f"{out / 'config.toml'}: no [[logs]] with a map; expected the option --logs GLOB with "
            "runs over the map"
        )
    report.stage("reading logs")
    runs, skipped = read_dataset(config, sections, data, report)
    for sentence in by_reason(skipped):
        report.line(sentence)
    report.stage("looking up floors")
    sessions = zip(runs.logs, runs.session, strict=True)
    found = [_run_floors(fit.robot, lookup, log, session) for log, session in sessions]
    if not any(run.inside.any() for run in found):
        x, y = np.concatenate([run.pose for run in found])[0, :2]
        raise DataError(
            f"{map_file}: no wheel of any run is on this map (the first run begins at x {x:.2f} m, "
            f"y {y:.2f} m); expected a map in the frame of the poses"
        )
    return lookup, found


def _run_floors(robot: Robot, lookup: FloorLookup, log: Log, session: str) -> RunFloors:
    if log.pose is None or log.pose_fresh is None:
        raise DataError(f"{log.name}: no pose; expected poses in the frame of the map")
    rows = np.flatnonzero(log.pose_fresh)
    pose = jax.vmap(robot.camera.corrected)(jnp.asarray(log.pose[rows]))
    pose = pose.at[:, 2].add(-robot.camera.yaw(robot.session_index(session)))
    wheels = (
        jnp.asarray(robot.geometry.place) * robot.geometry.base_radius - robot.camera.marker_place
    )
    found = lookup.under(pose, wheels)
    arrays = (pose, found.surface, found.border, found.inside)
    return RunFloors(log.name, log.time[rows], *map(np.asarray, arrays))


def write_floors(folder: Path, lookup: FloorLookup, runs: list[RunFloors]) -> list[Path]:
    """Write a CSV file for each run, and return the paths of the files.

    Files of other origin are not overwritten. The columns are time [s], pose [m, rad], and the
    floor and border distance [m] of each wheel.
    """
    paths = [folder / Path(run.name.replace("#", "_")).with_suffix(".csv") for run in runs]
    wheels = range(1, runs[0].surface.shape[1] + 1)
    names = [f"{what}_{wheel}" for what in ("floor", "border") for wheel in wheels]
    head = ",".join(["time", "x", "y", "heading", *names])
    for path in paths:
        refuse_foreign(path, head.encode())
    for path, run in zip(paths, runs, strict=True):
        lines = [head]
        known = run.inside & np.isfinite(run.border)
        for k, time in enumerate(run.time):
            numbers = [f"{v:.5f}" for v in (time, *run.pose[k])]
            floors = np.where(run.inside[k], np.take(lookup.surfaces, run.surface[k]), "")
            borders = [
                f"{v:.4f}" if i else "" for v, i in zip(run.border[k], known[k], strict=True)
            ]
            lines.append(",".join([*numbers, *floors, *borders]))
        write_bytes(path, "\n".join([*lines, ""]).encode())
    return paths


def summary(lookup: FloorLookup, runs: list[RunFloors]) -> Content:
    """Return the fraction of rows in which each wheel was on each floor, for each run."""
    return {
        "schema": SCHEMA,
        "surfaces": list(lookup.surfaces),
        "beyond_the_map": float(np.mean([1.0 - run.inside.mean() for run in runs])),
        "runs": {
            run.name: {
                name: np.round(((run.surface == number) & run.inside).mean(axis=0), 4).tolist()
                for number, name in enumerate(lookup.surfaces)
            }
            for run in runs
        },
    }
