"""Rivals that a user has without slipid: nominal numbers, or robust least squares with scipy.

The equations are written again here, not taken from `drive`, and logs are read from their files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from tests.benchmarks.every_robot.drive import columns_of_wheels, twist
from tests.benchmarks.every_robot.robots import MadeRobot

WINDOW = {"pose": 0.8, "xy": 5.0, "heading": 1.5}
"""Length of a window in which motion is compared [s], by the kind of the poses."""


@dataclass(frozen=True)
class Track:
    """A run as logged: rows, and the poses (times, 3), NaN where the sensor gives no number."""

    name: str
    floor: str
    t: np.ndarray
    angle: np.ndarray
    steering: np.ndarray
    pose_t: np.ndarray
    pose: np.ndarray


def read(robot: MadeRobot, folder: Path) -> list[Track]:
    """Read all runs FLOOR/NN.csv of a folder."""
    tracks = []
    for path in sorted(folder.glob("*/*.csv")):
        rows = np.genfromtxt(path, delimiter=",", names=True)
        angle = np.stack([rows[name] for name in columns_of_wheels(robot)], 1)
        if robot.ticks:
            angle = angle * 2 * np.pi / robot.ticks
        nothing = np.full(len(rows), np.nan)
        names = rows.dtype.names
        pose = [rows[name] if name in names else nothing for name in ("x", "y", "heading")]
        pose = np.stack(pose, 1)
        posed = ~np.isnan(pose).all(1)
        pose = pose[posed]
        pose[:, 2] = np.unwrap(pose[:, 2])
        steering = rows["steering"] if "steering" in names else np.zeros(len(rows))
        name = path.relative_to(folder).as_posix()
        tracks.append(
            Track(name, path.parent.name, rows["t"], angle, steering, rows["t"][posed], pose)
        )
    return tracks


@dataclass(frozen=True)
class Kinematics:
    """Numbers of a calibration, those of a floor keyed by its name.

    Attributes:
        radius: rolling radius of each drive [m].
        base: effective track, base or wheelbase [m].
        centre: centre of rotation ahead of the middle [m].
        place: pose sensor ahead and left of the middle [m].
        yaw: heading of the pose sensor in the robot [rad].
        lag: age of the poses [s].
        steering: true angle at zero, and gain.
        understeer: as in `Floor` [s^2/m].
    """

    radius: dict[str, np.ndarray]
    base: dict[str, float]
    centre: dict[str, float]
    place: tuple[float, float] = (0.0, 0.0)
    yaw: float = 0.0
    lag: float = 0.0
    steering: tuple[float, float] = (0.0, 1.0)
    understeer: dict[str, float] = field(default_factory=dict)


def nominal(robot: MadeRobot) -> Kinematics:
    """The numbers of the config."""
    names = [floor.name for floor in robot.floors]
    return Kinematics(
        {name: np.full(robot.drives, robot.nominal_radius) for name in names},
        dict.fromkeys(names, robot.nominal_base),
        dict.fromkeys(names, 0.0),
    )


def true(robot: MadeRobot) -> Kinematics:
    """The true numbers."""
    return Kinematics(
        {floor.name: np.array(floor.radius) for floor in robot.floors},
        {floor.name: floor.base for floor in robot.floors},
        {floor.name: floor.centre for floor in robot.floors},
        robot.place,
        robot.yaw,
        robot.lag,
        (robot.steering_zero, robot.steering_gain),
        {floor.name: floor.understeer for floor in robot.floors},
    )


Motion = Callable[[Track, np.ndarray, np.ndarray], np.ndarray]
"""Body twists (time, 3) from a run, wheel speeds (time, drives) and steering angles."""


def kinematic(robot: MadeRobot, k: Kinematics) -> Motion:
    """Motion without load-dependent slip."""

    def motion(track: Track, speed: np.ndarray, steering: np.ndarray) -> np.ndarray:
        rim, base = speed * k.radius[track.floor], k.base[track.floor]
        if robot.drive == "omni":
            a = np.radians(robot.azimuths_deg)
            rows = np.stack([-np.sin(a), np.cos(a), base * np.ones(len(a))], 1)
            return np.linalg.lstsq(rows, rim.T, rcond=None)[0].T
        if robot.drive == "mecanum":
            fl, fr, rl, rr = rim.T
            return (
                np.stack([fl + fr + rl + rr, fr - fl + rl - rr, (fr - fl - rl + rr) / base], 1) / 4
            )
        if robot.drive == "steered":
            v, angle = rim.mean(1), k.steering[1] * (steering - k.steering[0])
            v = v * np.cos(angle) if robot.driven == "front" else v
            rate = v * np.tan(angle) / (base + k.understeer.get(track.floor, 0.0) * v * v)
        else:
            left, right = rim.T
            v, rate = (left + right) / 2, (right - left) / base
        return np.stack([v, -k.centre[track.floor] * rate, rate], 1)

    return motion


def truth(robot: MadeRobot) -> Motion:
    """True motion but for what the wheels slip at random."""
    if robot.has_kinematics:
        return kinematic(robot, true(robot))
    return lambda track, speed, steering: twist(robot, robot.floor(track.floor), speed, steering)


def sensor_path(motion: Motion, k: Kinematics, track: Track) -> np.ndarray:
    """Predicted poses of the sensor at its times, from an arbitrary start, (poses, 3)."""
    parts = max(1, int(np.ceil(np.median(np.diff(track.pose_t)) / 0.05)))
    at = np.arange((len(track.pose_t) - 1) * parts + 1) / parts
    t = np.interp(at, np.arange(len(track.pose_t)), track.pose_t)
    angle = np.stack([np.interp(t - k.lag, track.t, a) for a in track.angle.T], 1)
    steering = np.interp((t[1:] + t[:-1]) / 2 - k.lag, track.t, track.steering)
    dt = np.diff(t)[:, None]
    turned = motion(track, np.diff(angle, axis=0) / dt, steering) * dt
    heading = np.concatenate([[0], np.cumsum(turned[:, 2])])
    middle = np.exp(1j * (heading[1:] + heading[:-1]) / 2)
    steps = (turned[:, 0] + 1j * turned[:, 1]) * middle * np.sinc(turned[:, 2] / 2 / np.pi)
    place = np.concatenate([[0], np.cumsum(steps)]) + np.exp(1j * heading) * complex(*k.place)
    return np.stack([place.real, place.imag, heading + k.yaw], 1)[::parts]


def relative(pose: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Poses j seen from poses i, (windows, 3)."""
    d = pose[j] - pose[i]
    c, s = np.cos(pose[i, 2]), np.sin(pose[i, 2])
    return np.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]], 1)


def aligned(found: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Predicted positions turned and moved onto the measured ones, both complex (points,)."""
    a, b = found - found.mean(), measured - measured.mean()
    return a * np.exp(1j * np.angle(np.vdot(a, b))) + measured.mean()


def residuals(robot: MadeRobot, k: Kinematics, track: Track) -> np.ndarray:
    """Predicted less measured motion of every window, (windows, numbers)."""
    found = sensor_path(kinematic(robot, k), k, track)
    stride = max(1, round(WINDOW[robot.pose_kind] / np.median(np.diff(track.pose_t))))
    cut = np.arange(0, len(found), stride)
    if robot.pose_kind == "xy":
        p, m = (pose[:, 0] + 1j * pose[:, 1] for pose in (found, track.pose))
        parts = [slice(i, i + stride + 1) for i in cut[:-1]]
        gaps = np.stack([(aligned(p[part], m[part]) - m[part])[:stride] for part in parts])
        return np.concatenate([gaps.real, gaps.imag], 1)
    i, j = cut[:-1], cut[1:]
    if robot.pose_kind == "heading":
        return (np.diff(found[cut, 2]) - np.diff(track.pose[cut, 2]))[:, None]
    return relative(found, i, j) - relative(track.pose, i, j)


@dataclass(frozen=True)
class Fitted:
    """Least squares: numbers, and the search vector's mean, covariance and degrees of freedom."""

    numbers: Kinematics
    unpack: Callable[[np.ndarray], Kinematics]
    mean: np.ndarray
    covariance: np.ndarray
    freedom: int

    def interval(self, number: Callable[[Kinematics], float]) -> tuple[float, float]:
        """90 % interval of a number, by linear propagation."""
        step = 1e-5
        rise = [
            (number(self.unpack(self.mean + d)) - number(self.unpack(self.mean - d))) / 2 / step
            for d in step * np.eye(len(self.mean))
        ]
        half = float(np.sqrt(np.array(rise) @ self.covariance @ rise))
        half *= student.ppf(0.95, self.freedom)
        value = number(self.numbers)
        return value - half, value + half


def least_squares_fit(robot: MadeRobot, tracks: list[Track]) -> Fitted:
    """Calibration by robust least squares over windows, with a covariance clustered by run."""
    start, names = nominal(robot), [floor.name for floor in robot.floors]
    d, f = robot.drives, len(names)
    skid = f - 1 if robot.drive == "skid" else 0  # the centre is known from floor to floor alone
    widths = np.array([*[0.3] * (f * d + f), *[0.3] * skid, 0.5, 0.5, 0.5, 0.5, 0.2, 0.3, 0.3])
    if robot.pose_kind == "heading":  # tells radii over track alone: the radii were measured
        widths[: f * d] = 0.02
    still = np.zeros(len(widths), bool)  # numbers that nothing tells
    still[-7:-4] = robot.pose_kind == "heading"
    still[-3:] = robot.drive != "steered"
    still[-5] = robot.pose_kind == "xy"
    if max(np.ptp(track.pose[:, 2]) for track in tracks) < 0.5:
        still[f * d : f * d + f] = still[-7:-5] = True  # no turn tells tracks or the sensor's place
    free = np.flatnonzero(~still)

    def unpack(z: np.ndarray) -> Kinematics:
        full = np.zeros(len(widths))
        full[free] = z
        full *= widths
        radius = robot.nominal_radius * np.exp(full[: f * d].reshape(f, d))
        base = robot.nominal_base * np.exp(full[f * d : f * d + f])
        centre = np.concatenate([[0], full[f * d + f : f * d + f + skid], np.zeros(f)])
        px, py, yaw, lag, zero, gain, under = full[-7:]
        return replace(
            start,
            radius=dict(zip(names, radius, strict=True)),
            base=dict(zip(names, base, strict=True)),
            centre=dict(zip(names, centre, strict=False)),
            place=(px, py),
            yaw=yaw,
            lag=lag,
            steering=(zero, float(np.exp(gain))),
            understeer=dict.fromkeys(names, under),
        )

    def parts(z: np.ndarray) -> list[np.ndarray]:
        return [residuals(robot, unpack(z), track) for track in tracks]

    scale = np.ones(parts(np.zeros(len(free)))[0].shape[1])
    scale = scale * 0.005
    z = np.zeros(len(free))
    for _ in range(3):  # residuals that were far outside count little in the next scale

        def whitened(z: np.ndarray, scale: np.ndarray = scale) -> np.ndarray:
            return np.concatenate([(np.concatenate(parts(z)) / scale).ravel(), 0.1 * z])

        found = least_squares(whitened, z, loss="soft_l1", f_scale=1.5, x_scale="jac")
        z = found.x
        scale = 1.4826 * np.median(np.abs(np.concatenate(parts(z))), axis=0) + 1e-6
    count = [len(part) * len(scale) for part in parts(z)]
    weight = 1 / np.sqrt(1 + (whitened(z)[: sum(count)] / 1.5) ** 2)
    each = np.split(found.jac[: sum(count)], np.cumsum(count)[:-1])
    # scipy returns the Jacobian of the loss: J = sqrt(weight) dr/dz
    inner = np.linalg.inv(found.jac.T @ found.jac)
    off = np.split(whitened(z)[: sum(count)] * np.sqrt(weight), np.cumsum(count)[:-1])
    pulls = np.stack([j.T @ r for j, r in zip(each, off, strict=True)])
    runs = len(tracks)
    covariance = inner @ (pulls.T @ pulls) @ inner * runs / (runs - 1)
    return Fitted(unpack(z), unpack, z, covariance, max(runs - 1 - len(free) // 2, 2))
