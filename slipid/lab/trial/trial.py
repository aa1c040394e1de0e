"""Closed-loop trial of controllers on the rectangle of the 2021 paper, or on another path.

The plant, which simulates the robot, is the virtual test site, or a twin with parameters drawn from
the posterior.
"""

import json
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.floor_map import FloorMap, read_map
from slipid.deploy.controllers import centre_of, control_loop_of
from slipid.deploy.deploy import actuator_model_of, read_robot
from slipid.deploy.floors import floor_of
from slipid.deploy.twin_run import (
    REST_S,
    path_of,
    require_known_surfaces,
    starts,
    twin_floor,
    twin_plant,
)
from slipid.infer.result_folder import fit_of
from slipid.lab.testsite.config import plan
from slipid.lab.testsite.driving import PERIOD, RimSpeeds
from slipid.lab.testsite.plant import SimulatedRobot
from slipid.lab.testsite.site import Site
from slipid.lab.trial.controllers import (
    ROWS,
    TruePosePlant,
    applicable,
)
from slipid.lab.trial.summary import TrialRun, best_controllers, summaries, verdict
from slipid.robot import closed_loop, trajectory
from slipid.robot.deployed import DeployedRobot, posterior_robots
from slipid.robot.gains import Gains
from slipid.robot.interface import Measurement, Settings
from slipid.robot.robot_file import typed
from slipid.robot.twin import ActuatorModel
from slipid.support.checkpoint import Checkpoint, key_of, source_hash
from slipid.support.errors import DataError
from slipid.support.executor import results
from slipid.support.files import write_json
from slipid.support.jax_setup import setup_jax
from slipid.support.progress import Reporter
from slipid.support.toml_file import text_of

SCHEMA = "slipid.trial/1"
FOLDER = "trial"
"""Name of the folder of finished runs, in the result folder."""
SAME_PLACE = 0.2
"""Largest distance of a wheel of the test site's robot from that of the fit, in base radii [1]."""
MOST_REST_S = 60.0
"""Longest rest before a robot drives [s]."""
PLANTS = ("testsite", "twin")


@dataclass(frozen=True, eq=False)
class TrialTask:
    """Task of driving one run: one controller from one start.

    Attributes:
        name: name of the run, `CONTROLLER/startNN`.
        row: name of the controller.
        path: reference path that begins at the origin; a robot that does not drive sideways turns
            along it about the point that the row's model says.
        start: pose to which the path is moved and at which the robot starts [m, m, rad].
        rest: rest before the robot drives [s].
        seed: seed of all random numbers.
        plant: `testsite` or `twin`.
        floor: map of the floor on which the robot drives.
        known_map: map of the floor that is given to controllers.
        robot: identified robot.
        site: the test site; unused for the twin.
        settings: settings of the estimator.
        actuators: delay, lag and limits of the twin's wheel speeds.
        kept: checkpoint that stores finished runs.
    """

    name: str
    row: str
    path: trajectory.Path
    start: tuple[float, float, float]
    rest: float
    seed: int
    plant: str
    floor: FloorMap
    known_map: FloorMap
    robot: DeployedRobot
    site: Site
    settings: Settings
    actuators: ActuatorModel
    kept: Checkpoint


@dataclass(frozen=True)
class TrialOptions:
    """Options of a trial.

    Attributes:
        plant: `testsite` (MuJoCo) or `twin` (the identified model itself, with parameters drawn
            anew from the posterior for every start).
        site: config of `slipid simulate` with the robot and the surfaces of the test site; None for
            the built-in robot with three omni wheels.
        map: file of the map of the floor on which the robot drives; None for patches of the
            identified floors.
        told_map: file of the map that is given to controllers with a map; None for the true one.
        controllers: names of controllers, keys of `ROWS`.
        path: name of the path, see `path_of`.
        speed: speed along the path [m/s].
        starts: number of starts.
        rest: rest before the robot drives, during which the estimator finds the gyro's bias [s].
        load: name of the load set-up; None for the first.
    """

    plant: str = "testsite"
    site: Path | None = None
    map: Path | None = None
    told_map: Path | None = None
    controllers: tuple[str, ...] = tuple(ROWS)
    path: str = "rectangle"
    speed: float = 0.2
    starts: int = 20
    rest: float = REST_S
    load: str | None = None


@dataclass(frozen=True, eq=False)
class TrialResult:
    """Result of a trial.

    Attributes:
        content: content of trial.json.
        runs: runs that the content summarises.
        paths: true poses (step, 3) of every run, keyed by the run's name.
        wanted: positions (row, 2) on the reference path that begins at the origin, keyed by
            controller [m].
        floor: map of the floor on which the robot drove.
    """

    content: dict[str, Any]
    runs: tuple[TrialRun, ...]
    paths: Mapping[str, np.ndarray]
    wanted: Mapping[str, np.ndarray]
    floor: FloorMap


def trial(out: Path, options: TrialOptions, executor: Executor, report: Reporter) -> TrialResult:
    """Drive every controller from every start, and write trial.json.

    Finished runs are saved, and are not driven again unless something on which they depend changes.

    Raises:
        DataError: there is no fit in the folder; the plant, a controller, the path, the load set-up
            or a map does not exist; MuJoCo is missing; the test site has another robot; a floor is
            unknown to the plant or the fit; the speed is higher than that of any fitted run; or the
            rest is not 0 to 60 s.
    """
    setup_jax(quiet=True)
    tasks = _tasks(out, options)
    rows = tuple(dict.fromkeys(task.row for task in tasks))
    omitted: dict[str, list[str]] = {}
    for name in options.controllers:
        if obstacle := ROWS[name].obstacle(tasks[0].robot):
            omitted.setdefault(obstacle, []).append(name)
    for obstacle, names in omitted.items():
        report.line(f"omitted: {', '.join(names)} ({obstacle})")
    todo = {task.name: task for task in tasks if _finished_run(task) is None}
    report.stage(f"driving {len(todo)} of {len(tasks)} runs")
    results(executor, drive, todo, report)
    driven = {task.name: found for task in tasks if (found := _finished_run(task)) is not None}
    runs = [run for run, _ in driven.values()]
    # the true pose is a limit, not a competitor, unless it is the only row
    compared = [run for run in runs if not ROWS[run.controller].true_pose] or runs
    best = list(best_controllers(compared))
    needs = {name: ROWS[name].needs for name in rows}
    content = {
        "schema": SCHEMA,
        "plant": options.plant,
        "site": None if options.site is None else str(options.site),
        "map": "patches" if options.map is None else str(options.map),
        "told_map": None if options.told_map is None else str(options.told_map),
        "path": options.path,
        "speed_m_s": options.speed,
        "rest_s": options.rest,
        "gains": _gains(tasks[0].robot),
        "closes_best": None if len(best) > 1 else best[0],
        "not_told_apart": best,
        "verdict": verdict(compared, needs, tasks[0].robot.record.sensors.gyro),
        "summary": summaries(runs),
        "controllers": {name: ROWS[name].about for name in rows},
        "runs": [run.to_json() for run in runs],
        "fit": fit_of(out),
    }
    write_json(out / "trial.json", content)
    paths = {name: path for name, (_, path) in driven.items()}
    wanted = {task.row: np.asarray(task.path.rows)[:, :2] for task in tasks}
    return TrialResult(content, tuple(runs), paths, wanted, tasks[0].floor)


def _tasks(out: Path, options: TrialOptions) -> list[TrialTask]:
    if options.plant not in PLANTS:
        raise DataError(f"no plant '{options.plant}'; expected {' or '.join(PLANTS)}")
    unknown = [f" '{name}'" for name in options.controllers if name not in ROWS]
    if unknown or not options.controllers:
        raise DataError(f"no controller{''.join(unknown[:1])}; expected one of {', '.join(ROWS)}")
    if not 0 <= options.rest <= MOST_REST_S:
        raise DataError(f"rest {options.rest:g} s; expected 0 to {MOST_REST_S:g} s")
    robot = jax.tree.map(np.asarray, read_robot(out, options.load))
    path = path_of(options.path, options.speed, robot)
    floor = twin_floor(robot) if options.map is None else read_map(options.map)
    known_map = floor if options.told_map is None else read_map(options.told_map)
    settings, actuators = Settings.of(robot), actuator_model_of(robot, gyro=False)
    site = Site() if options.site is None else plan(options.site, text_of(options.site)).site
    # the test site has its own sensors and actuators, whatever the logged robot had
    if options.plant == "testsite":
        refuse_unknown_to_site(site, floor, robot)
        settings = replace(settings, current_is_signed=site.sensors.current_is_signed)
        actuators = ActuatorModel()
    else:
        require_known_surfaces(floor, robot, str(options.map))
    if options.told_map is not None:
        require_known_surfaces(known_map, robot, str(options.told_map))
    gains = _gains(robot)
    about = options.plant, options.path, options.speed, options.rest, robot.load_setup, gains
    key = key_of(
        *(*about, json.dumps(site.to_json()), settings, actuators, *jax.tree.leaves(robot)),
        *(part for m in (floor, known_map) for part in (m.surfaces, m.corner, m.cell, m.cells)),
        # a hash of the code, so that runs of another version of it are not reused
        source_hash("robot", "model", "lab/testsite", "data", "deploy", "lab/trial"),
    )
    # trials with other gains or floors have separate folders, so that their runs stay reusable
    kept = Checkpoint(out / FOLDER / key[:12] / f"of{options.starts}", key)
    paths = {
        row: path_of(options.path, options.speed, robot, centre_of(ROWS[row], robot))
        for row in applicable(options.controllers, robot)
    }
    shared = options.plant, floor, known_map, robot, site, settings, actuators
    return [
        TrialTask(f"{row}/start{k:02d}", row, own, start, options.rest, 1000 + k, *shared, kept)
        for row, own in paths.items()
        for k, start in enumerate(starts(options.starts, floor, path))
    ]


def _gains(robot: DeployedRobot) -> dict[str, float]:
    gains = Gains.of(robot)
    return {f.name: float(getattr(gains, f.name)) for f in fields(gains)}


def _finished_run(task: TrialTask) -> tuple[TrialRun, np.ndarray] | None:
    """Return a run with its errors, and its true poses; None if it has not been driven yet."""
    run, path = task.kept.load_json(task.name), task.kept.load(task.name)
    return None if run is None or path is None else (typed(TrialRun, run), path["pose"])


def drive(task: TrialTask) -> None:
    """Drive one run and save its errors and its path in the checkpoint."""
    setup_jax(quiet=True)
    row = ROWS[task.row]
    robot = jax.tree.map(jnp.asarray, task.robot)
    path = task.path.moved(task.start).after_rest(task.rest)
    plant: closed_loop.Plant
    if task.plant == "twin":
        truth = drawn_robot(robot, task.seed)
        plant = twin_plant(
            truth, task.floor, task.start, task.seed, replace(task.actuators, gyro=row.gyro)
        )
    else:
        sensors = replace(task.site.sensors, gyro=row.gyro)
        site = replace(task.site, sensors=sensors)
        plant = SitePlant(site, task.floor, robot.load_setup, task.start, task.seed)
    if row.true_pose:
        plant = TruePosePlant(plant)
    there = floor_of(task.known_map, robot.labels)
    sees = row.gyro or row.true_pose
    loop = control_loop_of(robot, row, task.settings, there, recovery=sees)
    driven = closed_loop.run_closed_loop(loop, path, plant, task.start)
    off = driven.pose[-1] - driven.estimated_pose[-1]
    run = TrialRun(
        controller=task.row,
        start=task.start,
        seed=task.seed,
        metrics=closed_loop.path_metrics(driven),
        believed_error_mm=1000 * float(np.hypot(off[0], off[1])),
    )
    # save the path before the errors, because a run with saved errors counts as finished
    poses = {"time": driven.time, "pose": driven.pose, "believed": driven.estimated_pose}
    task.kept.save(task.name, poses)
    task.kept.save_json(task.name, asdict(run))


def controller_names(text: str | None) -> tuple[str, ...]:
    """Return the controllers in a comma-separated list; all controllers for None."""
    if text is None:
        return tuple(ROWS)
    return tuple(dict.fromkeys(t.strip() for t in text.split(",") if t.strip()))


def refuse_unknown_to_site(site: Site, floor: FloorMap, robot: DeployedRobot) -> None:
    """Raise `DataError` if the test site has another robot, or lacks a surface or load set-up."""
    other = "Use --plant twin, which simulates the identified model itself"
    build, drives = site.robot, robot.drive_of or tuple(range(robot.wheels))
    ours, theirs = np.asarray(robot.places), build.places
    near = SAME_PLACE * float(robot.frame.base)
    if (
        len(ours) != len(theirs)
        or drives != build.drive_of
        or robot.holonomic != (build.drive == "omni")
        or np.abs(ours - theirs).max() > near
    ):
        kinds = "" if robot.holonomic else " that cannot drive sideways"
        raise DataError(
            f"the test site's robot ({build.drive}) has {len(theirs)} wheels and {build.drives} "
            f"motors, but the fit is of a robot{kinds} with {len(ours)} wheels and {robot.drives} "
            "motors, or with wheels in other places. Name the config with which `slipid simulate` "
            f"made the logs by --site, such as --site configs/testsite_skid.toml. {other}"
        )
    for what, name, there in (
        ("load set-up", robot.load_setup, build.centres_m),
        *(("surface", name, site.surfaces) for name in floor.surfaces),
    ):
        if name not in there:
            raise DataError(
                f"the test site has no {what} '{name}'; it has {', '.join(there)}. {other}"
            )


class SitePlant:
    """The virtual test site as a plant of `slipid.robot.closed_loop`.

    Commands take effect after the site's delay, and with limited acceleration.

    Args:
        site: robot, sensors and surfaces of the site.
        floor: map of the surfaces.
        load: name of the load set-up.
        start: start pose: x, y [m], heading [rad].
        seed: seed of the floor's unevenness, the initial wheel angles and sensor noise.
    """

    def __init__(
        self, site: Site, floor: FloorMap, load: str, start: tuple[float, float, float], seed: int
    ):
        self._site = site
        self._new, self._seed = partial(SimulatedRobot, self._site, floor, load, start, seed), seed
        self.reset()

    @property
    def pose(self) -> tuple[float, float, float]:
        """True pose [m, m, rad]."""
        return self.plant.pose

    @property
    def power(self) -> float:
        """Total electric power of the motors [W]."""
        drive = self.plant.drive
        return float(np.dot(drive.voltage, drive.current))

    def reset(self) -> Measurement:
        """Put the robot at its start and return its first measurement, at rest."""
        self.plant = self._new()
        self._rims = RimSpeeds(self._site, self.plant)
        self._rng = np.random.default_rng([self._seed, 1])
        self._bias = self._site.sensors.gyro_bias * float(self._rng.normal())
        return self._read(np.zeros((1, 2 * len(self.plant.wheel_dof))))

    def step(self, wheel_speed: Float[np.ndarray, " drive"]) -> Measurement:
        """Command wheel speeds [rad/s], advance by one period, and return the new measurement."""
        plant, drive, rows = self.plant, self.plant.drive, []
        self._rims.send(np.asarray(wheel_speed, float))
        for _ in range(round(PERIOD / plant.dt)):
            plant.step(self._rims.follow().tolist())
            rows.append([*drive.current, *drive.voltage])
        width = max(1, round(self._site.sensors.average_s / plant.dt))
        return self._read(np.array(rows[-width:]))

    def _read(self, recent: Float[np.ndarray, "step channel"]) -> Measurement:
        """Return a measurement, with currents and voltages averaged over `recent` time steps."""
        s, rng, tick = self._site.sensors, self._rng, self._site.tick
        amps, volts = np.split(recent.mean(axis=0), 2)
        amps, volts = s.amperes(amps, rng), s.volts(volts, rng)
        turn = float(self.plant.data.qvel[5]) + self._bias + s.gyro_noise * float(rng.normal())
        return Measurement(
            wheel_angle=np.floor(self.plant.wheel_angle / tick) * tick,
            current=amps,
            voltage=volts if s.voltage else np.full_like(volts, np.nan),
            gyro=turn if s.gyro else float("nan"),
        )


def drawn_robot(robot: DeployedRobot, seed: int) -> DeployedRobot:
    """Return a robot with parameters drawn from the posterior, or unchanged without draws."""
    count = robot.record.drawn
    if count == 0:
        return robot
    picked = int(np.random.default_rng(seed).integers(count))
    return jax.tree.map(lambda x: x[0], posterior_robots(robot, (picked,)))
