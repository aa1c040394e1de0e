"""`slipid simulate`: logs from the virtual test site, in parallel, with the truth apart."""

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.data.map_file import write_map
from slipid.data.write import OPTIONAL, own_csv, own_layout, robotino2022_csv
from slipid.support.content import Content
from slipid.support.errors import DataError
from slipid.support.files import read_json, write_arrays, write_bytes, write_json
from slipid.support.progress import Reporter
from slipid.support.workers import spread
from slipid.testsite.camera import Camera, Studio, film
from slipid.testsite.driving import Site, drive
from slipid.testsite.experiments import Run
from slipid.testsite.plant import Trace, engine
from slipid.testsite.sensors import observe
from slipid.testsite.simulate.config import Plan

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


def simulate(plan: Plan, out: Path, jobs: int, report: Reporter) -> Content:
    """Drive every run of a plan that is not there yet; what simulate.json holds.

    A run's truth is written last: a run that has one is done. Called again after an interrupt it
    goes on from there.

    Args:
        plan: what to drive.
        out: folder to write to.
        jobs: processes at once.
        report: progress.

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
    todo = [job for job in every if not _truth(out, job.name).is_file()]
    report.stage(f"driving {len(todo)} of {len(every)} runs")
    began = time.monotonic()
    seconds = 0.0
    with closing(spread(drive_and_write, todo, min(jobs, len(todo)), alone=True)) as finished:
        for done, (job, driven) in enumerate(finished, 1):
            seconds += driven
            report.advance(done, len(todo), f"{done} of {len(todo)}, {job.name}")
    pace = seconds / max(time.monotonic() - began, 1e-9)
    _film([job for job in every if job.name in plan.filmed], plan.content.camera, jobs, report)
    content = {**about, "runs": [name for name, _ in plan.runs]}
    write_json(manifest, content)
    return {**content, "driven": len(todo), "seconds": seconds, "pace": pace if todo else None}


def _film(jobs: Sequence[Job], camera: Camera, processes: int, report: Reporter) -> None:
    """Videos of the runs that have none yet, with the camera's numbers beside them."""
    if not jobs:
        return
    write_json(jobs[0].out / "video" / "camera.json", camera.as_dict())
    todo = [(job, camera) for job in jobs if not _video(job.out, job.name).is_file()]
    report.stage(f"filming {len(todo)} of {len(jobs)} runs")
    if not todo:
        return
    # in processes of their own, also one by one: what draws has to be chosen before MuJoCo is there
    with closing(spread(film_and_write, todo, min(processes, len(todo)))) as finished:
        for done, ((job, _), _) in enumerate(finished, 1):
            report.advance(done, len(todo), f"{done} of {len(todo)}, {job.name}")


def film_and_write(what: tuple[Job, Camera]) -> int:
    """Film one run that was driven; how many frames. The video is written last."""
    job, camera = what
    site, run = job.site, job.run
    with np.load(_truth(job.out, job.name)) as true:
        studio = Studio(site.machine, run.load, run.map, site.grounds, camera, job.seed)
        path = _video(job.out, job.name)
        frames = np.arange(true["time"][0], true["time"][-1], camera.frame_s)
        rows = "".join(f"{k},{t:.4f}\n" for k, t in enumerate(frames))
        write_bytes(path.with_suffix(".csv"), f"frame,time\n{rows}".encode())
        with closing(studio):
            film(studio, true["time"], true["pose"], true["wheel_angle"], frames, path)
    return len(frames)


def _video(out: Path, name: str) -> Path:
    return out / "video" / f"{name}.avi"


def drive_and_write(job: Job) -> float:
    """Drive one run and write its log and its truth; the seconds it drove."""
    try:
        trace = drive(job.run, job.site, job.seed)
    except ValueError as error:  # also the engine's, of a robot that it cannot build
        raise DataError(f"{job.name}: {error}") from error
    site = job.site
    gear, ticks = site.machine.gear_ratio, site.motor.ticks_per_revolution
    log = logged(trace, site, job.name, job.run, job.seed)
    for form in job.formats:
        write = own_csv if form == "slipid" else robotino2022_csv
        path = job.out / FOLDERS[form] / _place(form, job)
        write_bytes(path, write(log, gear, ticks).encode())
    write_arrays(_truth(job.out, job.name), _true(trace, job.run, site))
    return float(trace.time[-1])


def logged(trace: Trace, site: Site, name: str, run: Run, seed: int) -> Log:
    """The log that the sensors make of a trace."""
    return observe(
        trace,
        site.sensors,
        np.random.default_rng([seed, 1]),
        name=f"{name}.csv",
        surface=run.surface,
        load=run.load,
        gear_ratio=site.machine.gear_ratio,
        ticks_per_revolution=site.motor.ticks_per_revolution,
        marker_yaw=float(np.radians(site.machine.marker_yaw_deg)),
    )


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


def _truth(out: Path, name: str) -> Path:
    return out / "truth" / f"{name}.npz"


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
    write_json(
        out / "truth" / "truth.json",
        {
            "schema": "slipid.truth/1",
            "parameters": truth(site),
            "site": asdict(replace(site, grounds=dict(site.grounds))),
        },
    )
    robot = out / "robot.toml"
    if can_identify(plan) and not robot.is_file():  # it may have been edited since
        write_bytes(robot, identify_config(plan).encode())


def can_identify(plan: Plan) -> bool:
    """Whether there are logs in slipid's own columns that a fit can use."""
    return "slipid" in plan.content.formats and any(r.surface is not None for _, r in plan.runs)


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


_IDENTIFY = """\
# Identifies the robot of these logs:
#   slipid identify robot.toml --data logs --out result
# They were made by slipid simulate; the truth lies in truth/, which nothing reads that fits.

[robot]
drive = "omni"
wheel_azimuths_deg = {azimuths}
base_radius_m = {base}
wheel_radius_m = {radius}
gear_ratio = {gear}
mass_kg = {mass}

[layouts.testsite]
ticks_per_revolution = {ticks}
gear_ratio = {gear}
current_is_signed = {signed}

[layouts.testsite.columns]
{columns}
{sets}
[parameters]
"camera.scale" = {{ prior = {{ mean = {scale}, std = 0.002 }} }}      # measured, with an error
"camera.lag" = {{ prior = {{ mean = 0.05, std = 0.02 }} }}
"camera.marker_yaw" = {{ free = true }}
"motor.resistance" = {{ start = 11.0, prior = {{ mean = 8.0, std = 4.0 }} }}
"motor.back_emf" = {{ start = 0.0257, prior = {{ mean = 0.04, std = 0.02 }} }}
"""


def identify_config(plan: Plan) -> str:
    """Text of a config for `slipid identify` that fits the logs in slipid's own columns."""
    machine, sensors = plan.site.machine, plan.site.sensors
    measured = 0.0015 * float(np.random.default_rng([plan.content.seed, 2]).normal())
    layout = own_layout(
        len(machine.wheel_azimuths_deg),
        machine.gear_ratio,
        plan.site.motor.ticks_per_revolution,
        sensors.current_is_signed,
        [channel for channel in OPTIONAL if getattr(sensors, channel)],
    )
    columns = "\n".join(f"{name} = {_inline(c)}" for name, c in layout["columns"].items())
    one = {(run.load, run.surface) for _, run in plan.runs if run.surface is not None}
    sets = "".join(
        f'\n[[logs]]\nglob = "{load}/{surface}/*.csv"\nformat = "testsite"\n'
        f'surface = "folder"\nload = "{load}"\n'
        for load, surface in sorted(one)
    )
    sets += "".join(
        f'\n[[logs]]\nglob = "{load}/{name}/*.csv"\nformat = "testsite"\n'
        f'map = "maps/{name}.toml"\nload = "{load}"\n'
        for load, name in _mapped(plan)
    )
    return _IDENTIFY.format(
        azimuths=list(machine.wheel_azimuths_deg),
        base=machine.base_radius_m,
        radius=machine.wheel_radius_m,
        gear=machine.gear_ratio,
        mass=machine.mass_kg,
        ticks=layout["ticks_per_revolution"],
        signed="true" if layout["current_is_signed"] else "false",
        columns=columns,
        sets=sets,
        scale=round(sensors.camera_scale * (1 + measured), 4),
    )


def _mapped(plan: Plan) -> list[tuple[str, str]]:
    """Load and map of runs over several floors, where runs on one floor tell of each and the load.

    Whatever steered them, the camera logs their poses in the frame of the map.
    """
    one = [run for _, run in plan.runs if run.surface is not None]
    floors, loads = {run.surface for run in one}, {run.load for run in one}
    pairs = {(run.load, name.split("/")[1]) for name, run in plan.runs if run.surface is None}
    return sorted(
        (load, name)
        for load, name in pairs
        if load in loads and set(plan.maps[name].surfaces) <= floors
    )


def _inline(value: object) -> str:
    """A value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_inline(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_inline(v) for v in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)
