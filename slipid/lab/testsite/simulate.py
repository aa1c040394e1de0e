"""Simulation of logs on the virtual test site, in parallel and with realistic sensor errors.

The truth is written to a folder separate from the logs.
"""

import hashlib
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from slipid.data.floor_map import write_map
from slipid.data.log import Log
from slipid.data.wheel_signals import interpolate
from slipid.data.write import own_csv, robotino2022_csv
from slipid.lab.testsite.config import SimulationPlan, all_filmed, can_identify, identify_config
from slipid.lab.testsite.driving import SiteRun, Trace, drive
from slipid.lab.testsite.kinematics import Motion, effective_kinematics
from slipid.lab.testsite.plant import engine
from slipid.lab.testsite.site import Site, SiteCamera
from slipid.lab.testsite.studio import Studio, film
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.executor import InProcess, Processes, results
from slipid.support.files import read_arrays, read_json, write_arrays, write_bytes, write_json
from slipid.support.progress import Reporter


def log_of(trace: Trace, site: Site, run: SiteRun, name: str, seed: int) -> Log:
    """Return the log of a run, with the errors of the site's sensors.

    Args:
        trace: true motion of the run.
        site: the site, whose sensors have the errors.
        run: the run.
        name: name of the run, and of the log file without its ending.
        seed: seed of the sensor noise.
    """
    s, rng = site.sensors, np.random.default_rng([seed, 1])
    count = int(trace.time[-1] / s.row_s) + 1
    uneven = s.row_s * (1 + s.row_jitter * rng.uniform(-1, 1, count))
    time = np.concatenate([[0.0], np.cumsum(uneven)])
    time = time[time <= trace.time[-1]]
    at = np.searchsorted(trace.time, time + 1e-9) - 1
    whole = np.floor(trace.wheel_angle[at] / site.tick) * site.tick
    quantum = s.speed_step / site.robot.gear_ratio
    speed = np.round(s.speed_gain * _averaged(trace.wheel_speed, at, 5) / quantum) * quantum
    width = max(1, round(s.average_s / (trace.time[1] - trace.time[0])))
    amps = s.amperes(_averaged(trace.current, at, width), rng)
    volts = s.volts(_averaged(trace.voltage, at, width), rng)
    bus = s.volts(_averaged(trace.bus[:, None], at, width)[:, 0], rng)
    turn = trace.yaw_rate[at] + s.gyro_bias * rng.normal()
    turn = turn + s.gyro_noise * rng.normal(size=turn.shape)
    duty = _averaged(trace.voltage / trace.bus[:, None], at, width)
    pose, fresh = _camera(trace, site, rng, time)
    logged = b"".join(np.ascontiguousarray(x).tobytes() for x in (whole, amps, volts, pose, time))
    return Log(
        name=f"{name}.csv",
        path=Path(f"{name}.csv"),
        sha256=hashlib.sha256(logged).hexdigest(),
        time=time,
        wheel_angle=whole - whole[0],
        wheel_speed=speed,
        wheel_speed_command=trace.wheel_command[at],
        twist_command=trace.twist_command[at],
        current=amps,
        current_is_signed=s.current_is_signed,
        voltage=volts if s.voltage else None,
        duty=np.round(duty, 3) if s.duty else None,
        bus_voltage=bus if s.bus_voltage else None,
        gyro=turn if s.gyro else None,
        pose=pose,
        pose_fresh=fresh,
        surface=run.surface,
        load=run.load,
    )


def _averaged(
    x: Float[np.ndarray, "step wheel"], at: np.ndarray, width: int
) -> Float[np.ndarray, "row wheel"]:
    """Return the mean over the last `width` time steps before each row; `at` has their indices."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    first = np.maximum(at + 1 - width, 0)
    return (total[at + 1] - total[first]) / (at + 1 - first)[:, None]


def _camera(
    trace: Trace, site: Site, rng: np.random.Generator, time: Float[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, "row 3"], Bool[np.ndarray, " row"]]:
    """Return the logged marker pose in each row, and True for rows that have a new frame."""
    s = site.sensors
    delay = s.lag_s - 0.5 * s.frame_s
    first = -(s.lag_s + 3 * s.frame_s)  # early enough for a frame in the first row
    taken = np.arange(first, trace.time[-1] + s.frame_s, s.frame_s) + rng.uniform(0, s.frame_s)
    taken = taken[(rng.uniform(size=len(taken)) >= s.dropout) | (taken + delay <= 0.0)]
    poses = interpolate(trace.time, trace.pose, taken)
    (x, y), c, sn = site.robot.marker_place_m, np.cos(poses[:, 2]), np.sin(poses[:, 2])
    poses[:, :2] += np.stack([c * x - sn * y, sn * x + c * y], axis=1)
    poses[:, 2] += float(np.radians(site.robot.marker_yaw_deg))
    poses[:, :2] += s.camera_noise_m * rng.normal(size=(len(taken), 2))
    poses[:, 2] += s.camera_noise_rad * rng.normal(size=len(taken))
    wrong = rng.uniform(size=len(taken)) < s.outlier
    poses[:, :2] += np.where(wrong[:, None], s.outlier_m * rng.normal(size=(len(taken), 2)), 0.0)
    poses[:, :2] /= s.camera_scale
    newest = np.searchsorted(taken + delay, time, side="right") - 1
    fresh = np.concatenate([[True], np.diff(newest) > 0])
    return poses[newest], fresh


MANIFEST = "simulate.json"
SCHEMA = "slipid.simulation/1"
FOLDERS = {"slipid": "logs", "robotino2022": "robotino2022"}
"""Name of the folder of each log format, in the output folder."""
WRITTEN = (*FOLDERS.values(), "truth", "maps", "video", "robot.toml", "robot_video.toml")
"""Names of what a simulation writes besides its manifest."""
TRUTH_STEP = 10
"""Number of time steps from one row of the stored truth to the next."""


@dataclass(frozen=True, eq=False)
class SiteTask:
    """Task of driving and writing one run, which may be executed in a separate process."""

    name: str
    run: SiteRun
    site: Site
    seed: int
    formats: tuple[str, ...]
    out: Path


def simulate(plan: SimulationPlan, out: Path, executor: Executor, report: Reporter) -> Content:
    """Drive all runs of a plan that are not finished yet; return the content of simulate.json.

    The truth of a run is written last and marks it as finished, so that a later call continues an
    interrupted simulation.

    Raises:
        DataError: MuJoCo is missing, or the folder contains runs of another config.
    """
    version = engine().__version__
    manifest = out / MANIFEST
    about = {"schema": SCHEMA, "config_hash": plan.hash, "mujoco": version}
    if manifest.is_file():
        before = read_json(manifest, "a result of `slipid simulate`")
        before = before if isinstance(before, dict) else {}
        for key, what in (("config_hash", "config"), ("mujoco", "version of MuJoCo")):
            if before.get(key) != about[key]:
                raise DataError(
                    f"{out}: contains runs with another {what}; expected an empty folder or the "
                    f"same {what}"
                )
    elif there := [name for name in WRITTEN if (out / name).exists()]:
        raise DataError(
            f"{out / there[0]}: not of a simulation, since {MANIFEST} is missing beside it; "
            "expected an empty or new folder (--out)"
        )
    write_json(manifest, about)
    _write_truth(plan, out)
    formats = tuple(plan.content.formats)
    every = [
        SiteTask(name, run, plan.site, _seed(plan.content.seed, k), formats, out)
        for k, (name, run) in enumerate(plan.runs)
    ]
    todo = {task.name: task for task in every if not _truth_path(task).is_file()}
    report.stage(f"driving {len(todo)} of {len(every)} runs")
    began = time.monotonic()
    seconds = sum(results(executor, drive_and_write, todo, report), 0.0)
    pace = seconds / max(time.monotonic() - began, 1e-9)
    filmed = [task for task in every if task.name in plan.filmed]
    _film(filmed, plan.content.camera, executor, report)
    if plan.site.robot.drive != "omni":
        found = effective_kinematics(plan.site.robot, map(_motion, every))
        path, schema = out / "truth" / "kinematics.json", "slipid.kinematics/1"
        write_json(path, {"schema": schema, "load_setups": found})
    content = {**about, "runs": [name for name, _ in plan.runs]}
    write_json(manifest, content)
    return {**content, "driven": len(todo), "seconds": seconds, "pace": pace if todo else None}


def _film(
    tasks: Sequence[SiteTask], camera: SiteCamera, executor: Executor, report: Reporter
) -> None:
    """Make the videos that are missing, and write the camera file to their folder."""
    todo = {task.name: (task, camera) for task in tasks if not _video_path(task).is_file()}
    if not todo:
        return
    write_json(tasks[0].out / "video" / "camera.json", camera.to_json())
    report.stage(f"filming {len(todo)} of {len(tasks)} runs")
    # use other processes: MuJoCo's drawing backend can be chosen only before MuJoCo is imported
    with Processes(1) if isinstance(executor, InProcess) else nullcontext(executor) as apart:
        results(apart, film_and_write, todo, report)


def film_and_write(what: tuple[SiteTask, SiteCamera]) -> None:
    """Make the video of one run that was driven.

    The times of its frames are written first, so that a video marks the task as finished.
    """
    task, camera = what
    true = read_arrays(_truth_path(task), _TRUTH)
    studio = Studio(task.site, task.run.load, task.run.map, camera, task.seed)
    path = _video_path(task)
    frames = np.arange(true["time"][0] - camera.early_s, true["time"][-1], camera.frame_s)
    rows = "".join(f"{k},{t:.4f}\n" for k, t in enumerate(frames))
    write_bytes(path.with_suffix(".csv"), f"frame,time\n{rows}".encode())
    with closing(studio):
        film(studio, true, frames, path)


def _video_path(task: SiteTask) -> Path:
    return task.out / "video" / f"{task.name}.avi"


_TRUTH = "the truth of a run that `slipid simulate` drove"


def _truth_path(task: SiteTask) -> Path:
    return task.out / "truth" / f"{task.name}.npz"


def _motion(task: SiteTask) -> Motion:
    """Return the true motion of a run that was driven."""
    true = read_arrays(_truth_path(task), _TRUTH)
    return task.run, true["pose"], true["wheel_angle"]


def drive_and_write(task: SiteTask) -> float:
    """Drive one run, write its logs and its truth, and return the simulated duration [s]."""
    try:
        trace = drive(task.run, task.site, task.seed)
    except ValueError as error:  # MuJoCo also raises ValueError for a model it cannot compile.
        raise DataError(f"{task.name}: {error}") from error
    site = task.site
    gear, ticks = site.robot.gear_ratio, site.motor.ticks_per_revolution
    log = log_of(trace, site, task.run, task.name, task.seed)
    for form in task.formats:
        write = own_csv if form == "slipid" else robotino2022_csv
        path = task.out / FOLDERS[form] / _log_path(form, task)
        write_bytes(path, write(log, gear, ticks).encode())
    write_arrays(_truth_path(task), _truth_arrays(trace, task.run, site))
    return float(trace.time[-1])


def _seed(seed: int, k: int) -> int:
    """Return the seed of run `k`; it does not depend on the number of runs."""
    return int(np.random.SeedSequence(seed, spawn_key=(k,)).generate_state(1)[0])


def _log_path(form: str, task: SiteTask) -> str:
    """Return the path of a run's log relative to the folder of a format."""
    if form == "slipid":
        return f"{task.name}.csv"
    load, folder, number = task.name.split("/")
    kind = {"as_built": "one_surface", "moved": "wheel_load"}.get(load, load)
    if task.run.surface is None:
        kind = "two_surfaces" if load == "as_built" else f"two_surfaces/{load}"
    return f"{kind}/{folder}/exp{number.removeprefix('run')}.csv"


def _truth_arrays(trace: Trace, run: SiteRun, site: Site) -> dict[str, np.ndarray]:
    """Return the stored truth of a run: poses, wheels, currents, and the surface at each wheel."""
    t = replace(trace, **{k: getattr(trace, k)[::TRUTH_STEP] for k in vars(trace)})
    c, s = np.cos(t.pose[:, 2]), np.sin(t.pose[:, 2])
    turned = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    places = t.pose[:, None, :2] + np.einsum("tij,wj->twi", turned, site.robot.places)
    floor = run.map
    names = np.array(floor.surfaces)[floor.at(places)]
    keep = ("time", "pose", "wheel_angle", "wheel_speed", "current", "voltage", "bus", "sinkage")
    return {**{k: getattr(t, k) for k in keep}, "surface": names.astype("S")}


def _write_truth(plan: SimulationPlan, out: Path) -> None:
    """Write the maps, the true parameters of the robot, and configs that identify it from logs."""
    site = plan.site
    for name, floor in plan.maps.items():
        colours = {s: site.surfaces[s].colour for s in floor.surfaces}
        write_map(out / "maps" / f"{name}.toml", floor, colours)
    content = {"schema": "slipid.truth/1", "parameters": truth(site), "site": site.to_json()}
    write_json(out / "truth" / "truth.json", content)
    robot = out / "robot.toml"
    if can_identify(plan):
        texts = {robot: identify_config(plan)}
        if all_filmed(plan):
            texts[out / "robot_video.toml"] = identify_config(plan, by_video=True)
        for path, text in texts.items():
            if not path.is_file():  # An existing config is kept, since it may have been edited.
                write_bytes(path, text.encode())


def truth(site: Site) -> dict[str, Content]:
    """Return true value and unit of the site's parameters that a fit also has, keyed by path."""
    robot, motor, sensors = site.robot, site.motor, site.sensors
    found: dict[str, tuple[float | list[float], str]] = {
        f"robot.load_share@{load}": (robot.load_share(load).tolist(), "1")
        for load in robot.centres_m
    }
    first, *others = sorted(robot.centres_m)
    for load in others:  # torques are those of the weight that wheels carry, without a castor's
        ratio = robot.wheels_part(load) / robot.wheels_part(first)
        found[f"robot.mass_ratio@{load}"] = (ratio, "1")
    found |= {
        "motor.resistance": (motor.resistance_ohm, "ohm"),
        "motor.back_emf": (motor.back_emf_vs, "V*s/rad"),
        "camera.scale": (sensors.camera_scale, "1"),
        "camera.lag": (sensors.lag_s, "s"),
        "camera.marker_yaw": (float(np.radians(robot.marker_yaw_deg)), "rad"),
        "camera.marker_place": (list(robot.marker_place_m), "m"),
    }
    return {path: {"value": value, "unit": unit} for path, (value, unit) in found.items()}
