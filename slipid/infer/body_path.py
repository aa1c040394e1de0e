"""Measured and predicted paths of the robot's body in a run, with regions of its position.

Slip models predict poses of the marker; its place and yaw on the robot are removed here. Each
predicted position has a Student t, as the end points in `slipid.predict.predictive`. The regions of
kinematic models follow from the calibration: its stds of process, run effects and poses, and the
stds of its lengths, taken as further effects of the run.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtri

from slipid.data.runs import Runs
from slipid.data.windows import Windows
from slipid.fitting.calibration.result import Calibration
from slipid.fitting.likelihood import corrected
from slipid.fitting.noise import travelled
from slipid.fitting.shared_effects import AXES
from slipid.fitting.variances import DEGREES
from slipid.model.robot import Robot
from slipid.predict import open_loop as replay
from slipid.predict.predictive import ForceBalance
from slipid.predict.slip_model import body_increments, body_poses, turned
from slipid.predict.slip_models import FloorModels

LEVEL = 0.9
"""Probability of the regions [1]."""


@dataclass(frozen=True, eq=False)
class BodyPath:
    """Path of the body in one run.

    Attributes:
        time: time in the run of each pose, on the clock of the wheels [s].
        pose: x, y [m] and heading [rad], in metres as corrected by the camera.
        covariance: scale matrix of the Student t of each position less the measured one [m^2];
            None for a path without uncertainty.
        freedom: degrees of freedom of that Student t, infinite for a Gaussian.
    """

    time: Float[np.ndarray, " edge"]
    pose: Float[np.ndarray, "edge 3"]
    covariance: Float[np.ndarray, "edge 2 2"] | None = None
    freedom: float = DEGREES

    def rows(self, picked: Int[np.ndarray, " some"]) -> "BodyPath":
        """Return some of the poses."""
        cov = None if self.covariance is None else self.covariance[picked]
        return BodyPath(self.time[picked], self.pose[picked], cov, self.freedom)

    def at(self, time: Float[np.ndarray, " some"]) -> "BodyPath":
        """Return the path at those of some times that lie between its ends.

        The body moves with a constant twist from one pose to the next, and the scale matrices are
        interpolated linearly.
        """
        within = (time > self.time[0] - 1e-9) & (time < self.time[-1] + 1e-9)
        time = np.clip(time[within], self.time[0], self.time[-1])
        k = np.clip(np.searchsorted(self.time, time, "right") - 1, 0, len(self.time) - 2)
        part = (time - self.time[k]) / np.diff(self.time)[k]
        start, (x, y, yaw) = self.pose[k], (part[:, None] * body_increments(self.pose)[k]).T
        # the chord of an arc is shorter than it by sinc(yaw / 2), and at half the yaw to its start
        chord = np.sinc(yaw / (2 * np.pi))[:, None] * np.stack([x, y], axis=-1)
        place = start[:, :2] + turned(start[:, 2] + 0.5 * yaw, chord)
        cov = self.covariance
        if cov is not None:
            cov = cov[k] + part[:, None, None] * (cov[k + 1] - cov[k])
        pose = np.column_stack([place, start[:, 2] + yaw])
        return BodyPath(time, pose, cov, self.freedom)

    def outlines(self, points: int) -> Float[np.ndarray, "edge point 2"] | None:
        """Return points on the boundaries of the 90 % regions [m]; None without uncertainty."""
        if self.covariance is None:
            return None
        finite = np.isfinite(self.freedom)
        square = 2 * (fdtri(2, self.freedom, LEVEL) if finite else -np.log1p(-LEVEL))
        angle = np.linspace(0.0, 2 * np.pi, points, endpoint=False)
        circle = np.sqrt(square) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        root = np.linalg.cholesky(self.covariance)
        return np.asarray(self.pose[:, None, :2] + np.einsum("eij,pj->epi", root, circle))


def measured_path(data: Runs, run: int, robot: Robot) -> BodyPath | None:
    """Return the measured path of a run, corrected by a robot's camera and its lag.

    Poses without a heading give the path of the pose sensor instead of the body, with heading 0.

    Returns:
        None for a run without positions.
    """
    rows, lag = data.rows(run), float(robot.camera.lag)
    time, pose = data.time[rows], data.pose[rows]
    picked = data.fresh[rows] & np.isfinite(pose[:, :2]).all(axis=1)
    picked &= (time - lag >= time[0] - 1e-9) & (time - lag <= time[-1] + 1e-9)
    if not picked.any():
        return None
    whole = bool(np.isfinite(pose[picked, 2]).all())
    logged = pose[picked] if whole else np.pad(pose[picked, :2], ((0, 0), (0, 1)))
    shown = np.array(corrected(robot, jnp.asarray(logged[None])))
    if whole:
        shown = body_poses(robot, data.session[run : run + 1], shown)
    else:
        shown[..., 2] = 0.0
    return BodyPath(time[picked] - lag, shown[0])


def moved_to_start(
    path: Float[np.ndarray, "run edge 3"], start: Float[np.ndarray, "run 3"]
) -> Float[np.ndarray, "run edge 3"]:
    """Return paths that are moved, as rigid bodies, to begin at other poses.

    Models correct the poses by their own camera, and their starts differ by millimetres.
    """
    yaw = start[:, 2] - path[:, 0, 2]
    place = turned(yaw[:, None], path[..., :2] - path[:, :1, :2]) + start[:, None, :2]
    return np.concatenate([place, path[..., 2:] + yaw[:, None, None]], axis=-1)


def times(w: Windows) -> Float[np.ndarray, " edge"]:
    """Return the times of the measured poses of the first run, less the assumed lag [s]."""
    passed = np.concatenate([[0.0], np.cumsum(w.dt[0])])[:: w.parts]
    return np.asarray(w.start[0] - w.lag + passed)


def contact_path(model: ForceBalance, w: Windows) -> BodyPath:
    """Return the path that the force balance predicts in the first run of some windows."""
    one = w.segments(np.zeros(1, int))
    pose, cov = model.body_paths(one)
    return BodyPath(times(one), pose[0], cov[0])


def kinematic_path(
    model: FloorModels, seen: Robot, w: Windows, noise: Calibration | None = None
) -> BodyPath:
    """Return the path that a kinematic model predicts in the first run of some windows.

    Arguments are those of `kinematic_bodies`.
    """
    one = w.segments(np.zeros(1, int))
    pose, cov = kinematic_bodies(model, seen, one, noise)
    return BodyPath(times(one), pose[0], None if cov is None else cov[0])


def kinematic_bodies(
    model: FloorModels, seen: Robot, w: Windows, noise: Calibration | None = None
) -> tuple[Float[np.ndarray, "run edge 3"], Float[np.ndarray, "run edge 2 2"] | None]:
    """Return the poses of the body that a kinematic model predicts, and their scale matrices.

    Args:
        model: the fitted model.
        seen: robot with the calibrated pose sensor.
        w: whole runs, one segment each.
        noise: calibration with the noise of the predicted paths; None for no scale matrices.
    """
    late = w.at_lag(float(seen.camera.lag))
    marker = replay.tracks_from_increments(seen, late, model.increments(late, seen)).predicted
    picked = np.arange(0, marker.shape[1], w.parts)
    body = body_poses(seen, w.session, marker)[:, picked]
    if noise is None:
        return body, None
    shared = np.stack([np.diag(noise.spread(floor)) ** 2 for floor in w.surface])
    motion = None
    if seen.geometry.driven is not None:  # the wheels of a robot that steers tell no direction
        step = np.diff(marker, axis=1)
        step[..., :2] = turned(-marker[:, :-1, 2], step[..., :2])
        motion = travelled(step, noise.nominal_base)
    of_noise = marker, _variances(noise), shared, picked, body[..., :2], motion
    return body, replay.path_covariance(seen, late, *of_noise)


def _variances(found: Calibration) -> dict[str, float]:
    """Return the variances of a calibration's noise with the names that a fit gives them."""
    noise = found.noise
    out = {"camera.place": noise.place**2, "camera.heading": noise.heading**2}
    for kind, stds in (("process", noise.process), ("run", noise.effect)):
        for floor, each in stds.items():
            out |= {f"{kind}.{floor}.{axis}": s**2 for axis, s in zip(AXES, each, strict=True)}
    return out
