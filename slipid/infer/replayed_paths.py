"""Paths of whole runs, measured and predicted from their first pose by every model of motion.

The floor under each wheel of a run over several floors follows from a map and the measured poses,
which a prediction uses for nothing else: its path shows the models' errors, and none from floors
that were looked up at a wrong place.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from slipid.data.floor_map import FloorMap
from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.fitting import likelihood as lk
from slipid.fitting.multi_floor import wheel_places
from slipid.infer.body_path import kinematic_bodies, moved_to_start
from slipid.infer.motion_models import MotionModels
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.slip_model import body_poses

Paths = Float[np.ndarray, "run edge 3"]


@dataclass(frozen=True, eq=False)
class ReplayedPaths:
    """Paths of the body in some runs.

    Attributes:
        w: windows of the runs, one segment each.
        paths: predicted poses (x, y [m], heading [rad]) of every model, keyed by its name; they
            begin at the first measured pose.
        measured: measured poses, by the camera of the selected model.
        floor: name of the floor of each run, or of the floor of most of its windows.
        scale: scale matrices of the selected model's positions [m^2]; None if there are none.
    """

    w: Windows
    paths: Mapping[str, Paths]
    measured: Paths
    floor: tuple[str, ...]
    scale: Float[np.ndarray, "run edge 2 2"] | None


def replayed(models: MotionModels, data: Runs) -> Iterator[ReplayedPaths]:
    """Yield the paths of runs on one floor each, whose poses are whole, some runs at a time."""
    contact, seen = models.contact, models.seen
    for w in replay.replay_windows(data, _sensor(models)):
        paths: dict[str, Paths] = {}
        scale = None
        for name, model in models.kinematic.items():
            noise = models.calibration if name == "calibrated" else None
            paths[name], own = kinematic_bodies(model, seen, w, noise)
            scale = own if own is not None else scale
        if contact is not None:
            paths["contact"], of_contact = contact.body_paths(w)
            chosen = np.array([models.selected[floor] == "contact" for floor in w.surface])
            others = of_contact if scale is None else scale
            scale = np.where(chosen[:, None, None, None], of_contact, others)
        yield _begun(models, w, paths, w.surface, scale)


def replayed_over_floors(
    models: MotionModels, data: Runs, floor: FloorMap
) -> Iterator[ReplayedPaths]:
    """Yield the paths of runs over several floors, some runs at a time.

    In the force balance each wheel has its own floor; calibrated kinematics have the floor of most
    wheels. The paths have no scale matrices.

    Args:
        models: models, which know every surface of the map.
        data: the runs, whose poses are whole and in the frame of the map.
        floor: the map.
    """
    robot, seen = _sensor(models), models.seen
    for w in replay.replay_windows(data, robot):
        under = _floors_under(robot, w, floor)
        main = (under[..., None] == np.arange(len(floor.surfaces))).sum(axis=2).argmax(axis=2)
        paths, late = {}, w.at_lag(float(seen.camera.lag))
        for name, model in models.kinematic.items():
            alone = (replace(late, surface=(f,) * len(w)) for f in floor.surfaces)
            each = np.stack([np.asarray(model.increments(one, seen)) for one in alone])
            step = np.take_along_axis(each, main[None, ..., None], axis=0)[0]
            paths[name] = _bodies(seen, late, step)
        if models.contact is not None:
            numbers = np.array([robot.surface_index(f) for f in floor.surfaces])
            step = np.asarray(replay.contact_increments(robot, lk.batch(w, robot, numbers[under])))
            paths["contact"] = _bodies(robot, w, step)
        most = tuple(floor.surfaces[np.bincount(row).argmax()] for row in main)
        yield _begun(models, w, paths, most, None)


def _begun(
    models: MotionModels,
    w: Windows,
    paths: Mapping[str, Paths],
    floor: tuple[str, ...],
    scale: Float[np.ndarray, "run edge 2 2"] | None,
) -> ReplayedPaths:
    """Return the paths, moved to begin at the first pose by the sensor of the selected model."""
    measured = _measured(models.seen, w)
    if models.contact is not None:
        by_contact = np.array([models.sensor(name) is models.contact.robot for name in floor])
        own = _measured(models.contact.robot, w)
        measured = np.where(by_contact[:, None, None], own, measured)
    begun = {name: moved_to_start(path, measured[:, 0]) for name, path in paths.items()}
    return ReplayedPaths(w, begun, measured, floor, scale)


def _sensor(models: MotionModels) -> Robot:
    """Return the robot with the pose sensor by whose lag runs are cut."""
    return models.seen if models.contact is None else models.contact.robot


def _corrected(robot: Robot, w: Windows) -> Paths:
    return np.asarray(lk.corrected(robot, jnp.asarray(w.pose)))


def _measured(robot: Robot, w: Windows) -> Paths:
    """Return the measured poses of the body, corrected by a robot's camera."""
    return body_poses(robot, w.session, _corrected(robot, w))[:, :: w.parts]


def _floors_under(robot: Robot, w: Windows, floor: FloorMap) -> Int[np.ndarray, "run window wheel"]:
    """Return the index in the map's surfaces of the floor under each wheel amid each window."""
    pose = _corrected(robot, w)
    return floor.at(wheel_places(robot, 0.5 * (pose[:, :-1] + pose[:, 1:]), w.session))


def _bodies(robot: Robot, w: Windows, step: Float[np.ndarray, "run window 3"]) -> Paths:
    """Return the poses of the body between measured poses, from increments of its marker."""
    marker = replay.tracks_from_increments(robot, w, step).predicted
    return body_poses(robot, w.session, marker)[:, :: w.parts]
