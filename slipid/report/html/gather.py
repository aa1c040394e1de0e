"""Gathering of the evidence of a fit, or of a calibration, from its runs."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.special import fdtri

from slipid.data.floor_map import FloorMap
from slipid.data.runs import Runs
from slipid.data.windows import incomplete_poses
from slipid.fitting.variances import DEGREES
from slipid.infer.body_path import LEVEL, BodyPath, measured_path
from slipid.infer.measured_windows import MeasuredWindows, driving_torque, measured_windows
from slipid.infer.motion_models import MotionModels
from slipid.infer.replayed_paths import ReplayedPaths, replayed, replayed_over_floors
from slipid.infer.result import Fit
from slipid.model.geometry import Geometry
from slipid.predict.selection import aligned_path
from slipid.predict.slip_model import turned
from slipid.report.html import evidence as ev
from slipid.support.errors import DataError
from slipid.support.progress import Tell, silent

MOST_POSES, MOST_REGIONS = 65, 12
"""Largest numbers of poses, and of regions, that are kept of a run."""
MOST_CELLS = 200
"""Largest number of rows, and of columns, that are kept of a floor map."""
MOST_DOTS = 6000
"""Largest number of segments whose wheels become dots; of more, evenly spaced ones are kept."""
QUARTERS = 4
"""Number of parts of a run whose errors are shown."""
TURNS_ON_SPOT = 0.3
"""Displacement over path length of a quarter below which it has no direction of travel [1]."""
RESTING_M_S = 0.005
"""Speed of the fastest rim below which a robot rests [m/s]."""
LEAST_SHARE = 0.3
"""Smallest speed of a drawn wheel, as a share of that of the fastest wheel: the slip of slower
wheels is too uncertain."""


def evidence_of_fit(
    fit: Fit, data: Runs, mixed: Sequence[tuple[Runs, FloorMap]] = (), tell: Tell = silent
) -> ev.FitEvidence:
    """Return the evidence of a fit.

    Args:
        fit: the fit, which may have been loaded from its files.
        data: its runs on one floor each.
        mixed: sets of runs over several floors, each with the map of the floors.
        tell: function that reports the progress.
    """
    notes: list[str] = []
    dots: Mapping[str, object] = {}
    try:
        dots = _dots(fit, data)
    except DataError as error:  # a run that is too short to be cut into segments
        notes.append(f"no slip of single wheels: {error}")
    models = MotionModels.of_fit(fit)
    over, maps, lost = _over_floors(models, mixed)
    found = evidence_of_runs(data, models, fit.data_hash, [*notes, *lost], tell)
    more = {"over_floors": over, "maps": maps, "correlations": _correlations(fit), **dots}
    return found.model_copy(update=more)


def evidence_of_runs(
    data: Runs,
    models: MotionModels,
    data_hash: str,
    notes: Sequence[str] = (),
    tell: Tell = silent,
) -> ev.FitEvidence:
    """Return the evidence of runs on one floor each, without single wheels and correlations.

    `tell` reports the progress.
    """
    notes = list(notes)
    reasons = [incomplete_poses(data, k) for k in range(len(data))]
    runs: dict[int, ev.RunEvidence] = {}
    try:
        if numbers := [k for k, why in enumerate(reasons) if why is None]:
            some = data.subset(numbers)
            found = _paths(some, models, replayed(models, some), tell)
            runs = dict(zip(numbers, found, strict=True))
    except DataError as error:  # a run has too few poses to be predicted
        notes.append(f"no paths from measured starts: {error}")
    whole = set(runs)
    for k, reason in enumerate(reasons):
        if reason is not None and (run := _aligned(data, models, k)) is not None:
            runs[k] = run
    order = sorted(runs)
    if not order:
        notes.append("no paths: the logs have no positions")
    elif reason := next(filter(None, reasons), None):
        notes.append(f"paths are moved to the measured positions: {reason}")
    return ev.FitEvidence(
        data_hash=data_hash,
        wheels=_wheels(models.shape),
        runs=[runs[k] for k in order],
        quarters=_quarters([runs[k] if k in whole else None for k in order]),
        notes=notes,
    )


def _wheels(shape: Geometry) -> ev.WheelLayout:
    place = np.asarray(shape.place) * float(shape.base_radius)
    return ev.WheelLayout(
        place_m=[(float(x), float(y)) for x, y in place],
        angle_deg=np.degrees(shape.drive_angle).tolist(),
        drive=list(shape.drive_of or range(shape.wheels)),
        radius_m=float(shape.wheel_radius),
        sideways=bool(shape.determines_twist),
    )


def _paths(
    data: Runs, models: MotionModels, replays: Iterable[ReplayedPaths], tell: Tell = silent
) -> list[ev.RunEvidence]:
    """Return the evidence of runs whose poses are whole, from their replays."""
    out: dict[int, ev.RunEvidence] = {}
    for done in replays:
        for n, k in enumerate(done.w.run.tolist()):
            if k not in out:  # runs are repeated to fill a group
                out[k] = _run(data, models, done, n, k)
        tell(len(out), len(data))
    return [out[k] for k in sorted(out)]


def _spread(last: int, most: int) -> np.ndarray:
    """Return at most `most` + 1 evenly spaced indices from 0 to `last`."""
    return np.unique(np.linspace(0, last, min(last, most) + 1).round().astype(int))


def _over_floors(
    models: MotionModels, mixed: Sequence[tuple[Runs, FloorMap]]
) -> tuple[list[ev.RunEvidence], list[ev.MapEvidence], list[str]]:
    """Return the evidence of runs over several floors, their maps, and sentences on what it lacks.

    The fit has used their poses, which are whole.
    """
    out: list[ev.RunEvidence] = []
    maps: list[ev.MapEvidence] = []
    notes: list[str] = []
    for data, floor in mixed:
        try:
            runs = _paths(data, models, replayed_over_floors(models, data, floor))
        except DataError as error:  # a run has too few poses to be predicted
            notes.append(f"no paths over several floors: {error}")
            continue
        out += [run.model_copy(update={"map": len(maps)}) for run in runs]
        maps.append(_map(floor, runs))
    return out, maps, notes


def _map(floor: FloorMap, runs: Sequence[ev.RunEvidence]) -> ev.MapEvidence:
    """Return the part of a map around some runs, with at most `MOST_CELLS` rows and columns."""
    x, y = (
        np.concatenate([getattr(track, axis) for run in runs for track in _tracks(run)]) / 1000.0
        for axis in ("x_mm", "y_mm")
    )
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    margin = 0.2 + float((high - low).max())  # the page shows what is beside the paths too
    low, high = low - margin, high + margin
    low, high = np.maximum(low, floor.extent[:2]), np.minimum(high, floor.extent[2:])
    if (high <= low).any():  # the runs are beside their map
        low, high = np.array(floor.extent[:2]), np.array(floor.extent[2:])
    count = np.clip(np.ceil((high - low) / floor.cell), 1, MOST_CELLS).astype(int)
    cell = (high - low) / count
    middles = (low[k] + cell[k] * (np.arange(count[k]) + 0.5) for k in range(2))
    cells = floor.at(np.stack(np.meshgrid(*middles), axis=-1))
    return ev.MapEvidence(
        surfaces=list(floor.surfaces),
        corner_m=(round(float(low[0]), 4), round(float(low[1]), 4)),
        cell_m=(float(cell[0]), float(cell[1])),
        cells=cells.tolist(),
    )


def _tracks(run: ev.RunEvidence) -> tuple[ev.Track, ...]:
    return run.measured, *run.models.values()


def _run(data: Runs, models: MotionModels, done: ReplayedPaths, n: int, k: int) -> ev.RunEvidence:
    """Return the evidence of the run k, the n-th one of a replay."""
    time = np.concatenate([[0.0], np.cumsum(done.w.dt[n])])[:: done.w.parts]
    kept = _spread(len(time) - 1, MOST_POSES - 1)
    paths = {name: path[n, kept] for name, path in done.paths.items()}
    region = None if done.scale is None else _region(done.scale[n], kept)
    measured = BodyPath(time[kept], done.measured[n, kept])
    return _evidence(data, models, k, measured, paths, region, done.floor[n])


def _aligned(data: Runs, models: MotionModels, k: int) -> ev.RunEvidence | None:
    """Return the evidence of a run whose poses lack coordinates; None for one without positions.

    Its start is not known: predicted paths are moved to the measured positions.
    """
    seen = models.seen
    measured = measured_path(data, k, seen)
    if measured is None or len(measured.time) < 2:
        return None
    kept = _spread(len(measured.time) - 1, MOST_POSES - 1)
    time, paths = measured.time[kept], {}
    offset = np.broadcast_to(np.asarray(seen.camera.marker_place), (len(kept), 2))
    for name, model in models.kinematic.items():
        found = aligned_path(data, k, model.fitted.get(data.surface[k], model.model), seen)
        if found is None:
            return None
        x, y, yaw = (np.interp(time, found.time, column) for column in found.pose.T)
        place = np.stack([x, y], axis=-1) + turned(yaw, offset)  # of the pose sensor
        paths[name] = np.column_stack([place, yaw])
    shown = BodyPath(time - time[0], measured.pose[kept])
    return _evidence(data, models, k, shown, paths, None, data.surface[k])


def _evidence(
    data: Runs,
    models: MotionModels,
    k: int,
    measured: BodyPath,
    paths: Mapping[str, Float[np.ndarray, "edge 3"]],
    region: ev.PointRegions | None,
    floor: str,
) -> ev.RunEvidence:
    """Return the evidence of the run k with its paths; `floor` is the one most driven on."""
    heading, speed = np.degrees(data.heading[k]), data.speed[k]
    return ev.RunEvidence(
        name=data.logs[k].name,
        floor=floor,
        load=data.logs[k].load,
        heading_deg=round(float(heading), 1) if np.isfinite(heading) else None,
        speed=round(float(speed), 3) if np.isfinite(speed) else None,
        seconds=round(float(measured.time[-1]), 2),
        rest_s=round(_rest(data, k, float(models.shape.wheel_radius)), 2),
        path_m=round(float(np.linalg.norm(np.diff(measured.pose[:, :2], axis=0), axis=1).sum()), 4),
        time_s=np.round(measured.time, 2).tolist(),
        measured=_track(measured.pose),
        models={name: _track(path) for name, path in paths.items()},
        region=region,
        selected=models.selected[floor],
    )


def _rest(data: Runs, k: int, radius: float) -> float:
    """Return the time in a run in which no wheel turns [s]."""
    rows = data.rows(k)
    dt = np.diff(data.time[rows])
    speed = radius * np.abs(np.diff(data.wheel_angle[rows], axis=0)).max(axis=1)
    return float(dt[speed < RESTING_M_S * dt].sum())


def _track(pose: Float[np.ndarray, "edge 3"]) -> ev.Track:
    x, y, yaw = np.round(1000 * pose).astype(int).T.tolist()
    return ev.Track(x_mm=x, y_mm=y, yaw_mrad=yaw)


def _region(scale: Float[np.ndarray, "edge 2 2"], kept: np.ndarray) -> ev.PointRegions:
    """Return the 90 % regions of a run at some of the kept poses."""
    factor = np.sqrt(2 * fdtri(2, DEGREES, LEVEL))
    at = _spread(len(kept) - 1, MOST_REGIONS)[1:]
    square, direction = np.linalg.eigh(scale[kept[at]])
    minor, major = np.round(1000 * factor * np.sqrt(np.maximum(square, 0.0)), 1).T.tolist()
    angle = np.arctan2(direction[:, 1, 1], direction[:, 0, 1])
    return ev.PointRegions(
        edge=at.tolist(),
        major_mm=major,
        minor_mm=minor,
        angle_mrad=np.round(1000 * angle).astype(int).tolist(),
    )


def _quarters(runs: Sequence[ev.RunEvidence | None]) -> ev.Quarters:
    """Return the quarters of runs, with the errors of the selected model; None is skipped."""
    columns: dict[str, list] = {name: [] for name in ev.Quarters.model_fields}
    for k, run in enumerate(runs):
        if run is None:
            continue
        measured, predicted = (_poses(t) for t in (run.measured, run.models[run.selected]))
        edges = np.linspace(0, len(run.time_s) - 1, QUARTERS + 1).round().astype(int)
        for i, j in pairwise(edges.tolist()):
            seconds = run.time_s[j] - run.time_s[i]
            if seconds <= 0:
                continue
            moved = _moved(measured, i, j)
            off = (_moved(predicted, i, j) - moved) / seconds
            path = np.linalg.norm(np.diff(measured[i : j + 1, :2], axis=0), axis=1).sum()
            chord = float(np.hypot(*moved[:2]))
            ahead = moved[:2] / chord if chord > TURNS_ON_SPOT * path else np.array([1.0, 0.0])
            travel = _travel(measured[i : j + 1])
            row = {
                "run": k,
                "time_s": round(0.5 * (run.time_s[i] + run.time_s[j]), 2),
                "seconds": round(seconds, 2),
                "speed": round(float(path) / seconds, 3),
                "turn_deg_s": round(float(np.degrees(moved[2])) / seconds, 2),
                "heading_deg": round(float(np.degrees(np.arctan2(*travel[::-1]))), 1) % 360
                if np.hypot(*travel) > TURNS_ON_SPOT * path
                else None,
                "along_mm_s": round(1000 * float(off[:2] @ ahead), 2),
                "across_mm_s": round(1000 * float(ahead[0] * off[1] - ahead[1] * off[0]), 2),
                "yaw_deg_s": round(float(np.degrees(off[2])), 3),
            }
            for name, value in row.items():
                columns[name].append(value)
    return ev.Quarters(**columns)


def _travel(pose: Float[np.ndarray, "edge 3"]) -> Float[np.ndarray, "2"]:
    """Return the way ahead and to the left in the body frame, summed over steps [m]."""
    middle = 0.5 * (pose[:-1, 2] + pose[1:, 2])
    return np.asarray(turned(-middle, np.diff(pose[:, :2], axis=0)).sum(axis=0))


def _poses(track: ev.Track) -> Float[np.ndarray, "edge 3"]:
    return np.array([track.x_mm, track.y_mm, track.yaw_mrad]).T / 1000.0


def _moved(pose: Float[np.ndarray, "edge 3"], i: int, j: int) -> Float[np.ndarray, "3"]:
    """Return the increment from pose i to pose j in the frame of pose i [m, m, rad]."""
    place = turned(-pose[i, 2], pose[j, :2] - pose[i, :2])
    return np.append(place, pose[j, 2] - pose[i, 2])


def _dots(fit: Fit, data: Runs) -> dict[str, object]:
    """Return the evidence about single wheels: slip and, if they are logged, currents."""
    measured = measured_windows(fit.robot, data, fit.channels.windows)
    some = _spread(len(measured.run) - 1, MOST_DOTS - 1)
    out: dict[str, object] = {"slip": _slip(fit, measured, some)}
    if measured.amps is not None:
        start = fit.space.tree(fit.space.start)
        before = measured_windows(start, data, fit.channels.windows)
        if len(before.run) == len(measured.run):  # windows cut for another lag may differ
            out["currents"] = _currents(measured, before, some)
    return out


def _slip(fit: Fit, m: MeasuredWindows, some: np.ndarray) -> ev.WheelDots:
    fastest = np.abs(m.wheel_speed).max(axis=1, keepdims=True)
    drawn = (np.abs(m.wheel_speed) > LEAST_SHARE * fastest) & np.isfinite(m.wheel_slip)
    torque = driving_torque(fit.robot, m) / (m.share * m.share.shape[1])
    row, drive = np.nonzero(drawn[some])
    row = some[row]
    return ev.WheelDots(
        run=m.run[row].tolist(),
        drive=drive.tolist(),
        torque_nm=np.round(torque[row, drive], 4).tolist(),
        slip=np.round(m.wheel_slip[row, drive], 4).tolist(),
    )


def _currents(m: MeasuredWindows, before: MeasuredWindows, some: np.ndarray) -> ev.CurrentDots:
    assert m.amps is not None
    row, drive = np.nonzero(np.isfinite(m.amps[some]))
    row = some[row]
    return ev.CurrentDots(
        run=m.run[row].tolist(),
        drive=drive.tolist(),
        measured=np.round(m.amps[row, drive], 4).tolist(),
        start=np.round(before.amps_model[row, drive], 4).tolist(),
        fitted=np.round(m.amps_model[row, drive], 4).tolist(),
    )


def _correlations(fit: Fit) -> ev.Correlations:
    std = np.sqrt(np.diag(fit.covariance))
    percent = np.round(100 * fit.covariance / np.outer(std, std)).astype(int)
    return ev.Correlations(names=list(fit.space.names), percent=percent.tolist())
