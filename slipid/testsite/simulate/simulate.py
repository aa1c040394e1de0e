"""`slipid simulate`: logs from the virtual test site, in parallel, with the truth apart."""

import time
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from slipid.data.floor_map import write_map
from slipid.data.write import own_csv, robotino2022_csv
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.executor import Here, Processes, results
from slipid.support.files import read_json, write_arrays, write_bytes, write_json
from slipid.support.progress import Reporter
from slipid.testsite.driving import Run, Trace, drive
from slipid.testsite.plant import engine
from slipid.testsite.simulate.config import Plan, all_filmed, can_identify, identify_config
from slipid.testsite.simulate.observe import observe
from slipid.testsite.site import Camera, Site
from slipid.testsite.studio import Studio, film

MANIFEST = "simulate.json"
SCHEMA = "slipid.simulation/1"
FOLDERS = {"slipid": "logs", "robotino2022": "robotino2022"}
"""Folder below OUT of every format."""
TRUTH_STEP = 10
"""Time steps between rows of a stored truth."""


@dataclass(frozen=True, eq=False)
class Job:
    """One run to be driven by a process of its own."""

    name: str
    run: Run
    site: Site
    seed: int
    formats: tuple[str, ...]
    out: Path


def simulate(plan: Plan, out: Path, executor: Executor, report: Reporter) -> Content:
    """Drive every run of a plan that is not there yet; what simulate.json holds.

    A run's truth is written last: a run that has one is done. Called again after an interrupt it
    goes on from there.

    Raises:
        DataError: MuJoCo is missing, or the folder holds runs of another config.
    """
    version = engine().__version__
    manifest = out / MANIFEST
    about = {"schema": SCHEMA, "config_hash": plan.hash, "mujoco": version}
    if manifest.is_file():
        before = read_json(manifest, "what slipid simulate wrote")
        before = before if isinstance(before, dict) else {}
        for key, what in (("config_hash", "config"), ("mujoco", "version of MuJoCo")):
            if before.get(key) != about[key]:
                raise DataError(
                    f"{out}: holds runs of another {what}; expected an empty folder or the same"
                )
    write_json(manifest, about)
    _describe(plan, out)
    formats = tuple(plan.content.formats)
    every = [
        Job(name, run, plan.site, _seed(plan.content.seed, k), formats, out)
        for k, (name, run) in enumerate(plan.runs)
    ]
    todo = {job.name: job for job in every if not _truth(job).is_file()}
    report.stage(f"driving {len(todo)} of {len(every)} runs")
    began = time.monotonic()
    seconds = sum(results(executor, drive_and_write, todo, report), 0.0)
    pace = seconds / max(time.monotonic() - began, 1e-9)
    filmed = [job for job in every if job.name in plan.filmed]
    _film(filmed, plan.content.camera, executor, report)
    content = {**about, "runs": [name for name, _ in plan.runs]}
    write_json(manifest, content)
    return {**content, "driven": len(todo), "seconds": seconds, "pace": pace if todo else None}


def _film(jobs: Sequence[Job], camera: Camera, executor: Executor, report: Reporter) -> None:
    """Videos of the runs that have none yet, with the camera's numbers beside them."""
    todo = {job.name: (job, camera) for job in jobs if not _video(job).is_file()}
    if not todo:
        return
    write_json(jobs[0].out / "video" / "camera.json", camera.as_dict())
    report.stage(f"filming {len(todo)} of {len(jobs)} runs")
    # not in this process, even alone: what draws has to be chosen before MuJoCo is there
    with Processes(1) if isinstance(executor, Here) else nullcontext(executor) as apart:
        results(apart, film_and_write, todo, report)


def film_and_write(what: tuple[Job, Camera]) -> None:
    """Film one run that was driven. The video is written last."""
    job, camera = what
    with np.load(_truth(job)) as true:
        studio = Studio(job.site, job.run.load, job.run.map, camera, job.seed)
        path = _video(job)
        frames = np.arange(true["time"][0] - camera.early_s, true["time"][-1], camera.frame_s)
        rows = "".join(f"{k},{t:.4f}\n" for k, t in enumerate(frames))
        write_bytes(path.with_suffix(".csv"), f"frame,time\n{rows}".encode())
        with closing(studio):
            film(studio, dict(true), frames, path)


def _video(job: Job) -> Path:
    return job.out / "video" / f"{job.name}.avi"


def _truth(job: Job) -> Path:
    return job.out / "truth" / f"{job.name}.npz"


def drive_and_write(job: Job) -> float:
    """Drive one run and write its log and its truth; the seconds it drove."""
    try:
        trace = drive(job.run, job.site, job.seed)
    except ValueError as error:  # also the engine's, of a robot that it cannot build
        raise DataError(f"{job.name}: {error}") from error
    site = job.site
    gear, ticks = site.machine.gear_ratio, site.motor.ticks_per_revolution
    log = observe(trace, site, job.run, job.name, job.seed)
    for form in job.formats:
        write = own_csv if form == "slipid" else robotino2022_csv
        path = job.out / FOLDERS[form] / _place(form, job)
        write_bytes(path, write(log, gear, ticks).encode())
    write_arrays(_truth(job), _true(trace, job.run, site))
    return float(trace.time[-1])


def _seed(seed: int, k: int) -> int:
    """Seed of a run that stays when runs are added behind it."""
    return int(np.random.SeedSequence(seed, spawn_key=(k,)).generate_state(1)[0])


def _place(form: str, job: Job) -> str:
    """Where the log of a format lies."""
    if form == "slipid":
        return f"{job.name}.csv"
    load, folder, number = job.name.split("/")
    kind = {"as_built": "one_surface", "moved": "wheel_load"}.get(load, load)
    if job.run.surface is None:
        kind = "two_surfaces" if load == "as_built" else f"two_surfaces/{load}"
    return f"{kind}/{folder}/exp{number.removeprefix('run')}.csv"


def _true(trace: Trace, run: Run, site: Site) -> dict[str, np.ndarray]:
    """What truly happened: poses, wheels, currents, and the surface under every wheel."""
    t = replace(trace, **{k: getattr(trace, k)[::TRUTH_STEP] for k in vars(trace)})
    c, s = np.cos(t.pose[:, 2]), np.sin(t.pose[:, 2])
    turned = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    places = t.pose[:, None, :2] + np.einsum("tij,wj->twi", turned, site.machine.places)
    floor = run.map
    names = np.array(floor.surfaces)[floor.at(places)]
    keep = ("time", "pose", "wheel_angle", "wheel_speed", "current", "voltage", "bus", "sinkage")
    return {**{k: getattr(t, k) for k in keep}, "surface": names.astype("S")}


def _describe(plan: Plan, out: Path) -> None:
    """Maps, the truth about the robot, and a config that identifies it."""
    site = plan.site
    for name, floor in plan.maps.items():
        colours = {s: site.grounds[s].colour for s in floor.surfaces}
        write_map(out / "maps" / f"{name}.toml", floor, colours)
    known = {"schema": "slipid.truth/1", "parameters": truth(site), "site": asdict(site)}
    write_json(out / "truth" / "truth.json", known)
    robot = out / "robot.toml"
    if can_identify(plan):
        texts = {robot: identify_config(plan)}
        if all_filmed(plan):
            texts[out / "robot_video.toml"] = identify_config(plan, by_video=True)
        for path, text in texts.items():
            if not path.is_file():  # it may have been edited since
                write_bytes(path, text.encode())


def truth(site: Site) -> dict[str, Content]:
    """Numbers of the site that a fit has as well, by their path names."""
    machine, motor, sensors = site.machine, site.motor, site.sensors
    found: dict[str, tuple[float | list[float], str]] = {
        f"robot.load_share@{load}": (machine.load_share(load).tolist(), "1")
        for load in machine.centres_m
    }
    found |= {
        "motor.resistance": (motor.resistance_ohm, "ohm"),
        "motor.back_emf": (motor.back_emf_vs, "V*s/rad"),
        "camera.scale": (sensors.camera_scale, "1"),
        "camera.lag": (sensors.lag_s, "s"),
        "camera.marker_yaw": (float(np.radians(machine.marker_yaw_deg)), "rad"),
    }
    return {path: {"value": value, "unit": unit} for path, (value, unit) in found.items()}
