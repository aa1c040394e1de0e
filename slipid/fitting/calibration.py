"""Calibration of the kinematics of a robot and of its pose sensor from runs with poses.

Every fit begins with these numbers (see `slipid.model.kinematics` for the equations):

    radius of drive j on floor k     r_kj = r exp(c + d_j + rho_k),   rho = 0 on the firmest floor
    track or base on floor k         b_k = b exp(f_k)
    centre of rotation on floor k    x_k, for more than two wheels that point ahead; 0 on the
                                     firmest floor, since only its distance from the sensor shows
    pose sensor                      place p, yaw psi (with a deviation for every session), lag, and
                                     scale of the positions

They minimise the squared whitened innovations of all poses (`slipid.fitting.innovations`), each run
weighted by a Student t, plus a Gaussian prior. The variances of poses and motion are estimated by
maximum likelihood in turn. Intervals are from a jackknife over runs, since the kinematics are wrong
somewhere and errors of a run are alike; they are at least as wide as those of the likelihood.

Source: least squares for the same numbers on square paths, Borenstein and Feng 1996, "Measurement
and correction of systematic odometry errors in mobile robots" (UMBmark), IEEE Transactions on
Robotics and Automation 12(6).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize
from scipy.stats import t as student

from slipid.data.align.lag import pose_lag
from slipid.data.runs import Runs
from slipid.fitting.innovations import (
    Innovations,
    Noise,
    PoseTracks,
    Sensor,
    aligned_headings,
    innovations,
    moved,
)
from slipid.model.kinematics import Kinematics, is_axle, matrices, nominal_base
from slipid.search_space import Choice, Space
from slipid.support.content import Content

Verdict = Literal["identified", "weak", "not_identified", "fixed"]
IDENTIFIED, WEAK = 0.3, 0.8
"""Largest std(posterior) / std(prior) for the verdicts `identified` and `weak`."""
RADIUS_STD, DRIVE_STD, FLOOR_STD, BASE_STD = 0.3, 0.05, 0.3, 0.5
"""Prior stds of the logarithms of the radius, of the drives' deviations from it, of a floor's
radius over that of the firmest floor, and of the track or base over the config's [1]."""
LAG_STD, YAW_STD, SESSION_STD = 0.3, 0.5, 0.02
"""Prior stds of the lag [s], of the sensor's yaw and of its deviation in a session [rad]."""
LOOSE_SCALE_STD = 0.01
"""Relative prior std of the scale of positions above which the radius stays at the config's, since
motion determines only their ratio."""
DEGREES = 4.0
"""Degrees of freedom of the Student t of runs."""
LEAST_CLUSTERS = 12
"""Number of parts into which runs are divided for the jackknife if there are fewer runs."""
MOST_ROUNDS, MOST_STEPS, SETTLED = 8, 12, 0.02
"""Largest numbers of rounds and of solver steps per round, and the change of every number at which
rounds end [std]."""
NOISE_TRACKS = 12
"""Largest number of runs on each floor from which variances are estimated."""
_TYPICAL = np.log(np.array([0.003, 0.005, 0.01, 0.01, 0.02]) ** 2)
"""Logarithms of the typical variances of positions, headings, and of the motion along, across and
in yaw per metre."""
_TYPICAL_STD = 3.0
"""Prior std of the logarithms of variances [1]."""


@dataclass(frozen=True)
class Value:
    """A calibrated number with its interval.

    Attributes:
        value: estimate [unit].
        interval90: equal-tailed 90 % interval [unit].
        std: standard deviation [unit], 0 if the number was given.
        verdict: how well the runs determine it.
        unit: unit of all of them.
    """

    value: float
    interval90: tuple[float, float]
    std: float
    verdict: Verdict
    unit: str

    def to_json(self) -> Content:
        return {
            "value": self.value,
            "interval90": list(self.interval90),
            "std": self.std,
            "verdict": self.verdict,
            "unit": self.unit,
        }


@dataclass(frozen=True)
class MotionNoise:
    """Stds of what calibrated kinematics leave unexplained.

    Attributes:
        place: std of a logged position [m].
        heading: std of a logged heading [rad].
        process: std of the motion along, across and in yaw on each floor [m/sqrt(m), m/sqrt(m),
            rad/sqrt(m)].
    """

    place: float
    heading: float
    process: Mapping[str, tuple[float, float, float]]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated kinematics and pose sensor of a robot.

    Attributes:
        kinematics: kinematics on each floor, at the estimates.
        sideways: True if the wheels determine the twist, so that `base` is an effective base.
        radius: effective rolling radius of every drive, keyed by floor [m].
        base: effective track or base, keyed by floor [m].
        centre: centre of rotation ahead of the axle's middle, keyed by floor [m]; empty for wheels
            that have none.
        offset: place of the pose sensor ahead of and to the left of the robot's middle [m].
        yaw: heading of the pose sensor less that of the robot [rad].
        session_yaw: deviations of the sensor's heading in each session [rad].
        lag: lag of the poses behind the wheels [s].
        scale: true over logged length [1].
        firmest: floor with the largest radius, to which the centre and other radii refer.
        nominal_radius, nominal_base: lengths of the config [m].
        noise: stds of poses and motion.
        runs: number of calibrated runs.
    """

    kinematics: Kinematics
    sideways: bool
    radius: Mapping[str, tuple[Value, ...]]
    base: Mapping[str, Value]
    centre: Mapping[str, Value]
    offset: tuple[Value, Value]
    yaw: Value
    session_yaw: Mapping[str, float]
    lag: Value
    scale: Value
    firmest: str
    nominal_radius: float
    nominal_base: float
    noise: MotionNoise
    runs: int

    @property
    def multipliers(self) -> dict[str, tuple[tuple[float, ...], float]]:
        """Radius of every drive, and track or base, over the config's, keyed by floor [1].

        ROS controllers take them as `left_wheel_radius_multiplier`, `right_wheel_radius_multiplier`
        and `wheel_separation_multiplier`.
        """
        return {
            floor: (
                tuple(v.value / self.nominal_radius for v in self.radius[floor]),
                self.base[floor].value / self.nominal_base,
            )
            for floor in self.radius
        }

    def to_json(self) -> Content:
        """Return the section `calibration` of identified.json."""
        length = "effective_base_m" if self.sideways else "effective_track_m"
        return {
            "surfaces": {
                floor: {
                    "rolling_radius_m": [v.to_json() for v in self.radius[floor]],
                    length: self.base[floor].to_json(),
                }
                for floor in self.radius
            },
            "centre_of_rotation_m": {floor: v.to_json() for floor, v in self.centre.items()},
            "pose_offset_m": [v.to_json() for v in self.offset],
            "pose_yaw_rad": self.yaw.to_json(),
            "pose_lag_s": self.lag.to_json(),
            "pose_scale": self.scale.to_json(),
            "multipliers": {
                floor: {"wheel_radius": list(radius), "track": base}
                for floor, (radius, base) in self.multipliers.items()
            },
        }


@dataclass(frozen=True)
class _Number:
    """One coordinate of the search vector: its Gaussian prior, and the step of derivatives."""

    mean: float
    std: float
    step: float = 1e-5


@dataclass(frozen=True, eq=False)
class _Model:
    """Map from the search vector to kinematics, pose sensor and lag of every run.

    Attributes:
        space: robot and choices of the config.
        floors, sessions: names of floors and sessions.
        firmest: index of the floor to which radii refer.
        numbers: coordinates of the search vector, keyed by name.
    """

    space: Space
    floors: tuple[str, ...]
    sessions: tuple[str, ...]
    firmest: int
    numbers: Mapping[str, _Number]

    @classmethod
    def of(cls, space: Space, choices: Sequence[Choice], data: Runs, firmest: int) -> "_Model":
        shape = space.template.geometry
        floors = tuple(sorted({log.surface or "unknown" for log in data.logs}))
        sessions = tuple(sorted(set(data.session)))
        scale = _given(space, choices, "camera.scale", 0.0)
        loose = scale.std > LOOSE_SCALE_STD * scale.mean
        size = max(nominal_base(shape), 0.1)
        numbers = {"radius": _Number(0.0, 0.0 if loose else RADIUS_STD)}
        numbers |= {f"drive.{j}": _Number(0.0, DRIVE_STD) for j in range(shape.drives)}
        others = [f for k, f in enumerate(floors) if k != firmest]
        numbers |= {f"floor.{f}": _Number(0.0, FLOOR_STD) for f in others}
        numbers |= {f"base.{f}": _Number(0.0, BASE_STD) for f in floors}
        if not shape.determines_twist and not is_axle(shape):
            numbers |= {f"centre.{f}": _Number(0.0, size) for f in others}
        place = np.asarray(space.template.camera.marker_place)
        fixed = _is_fixed(choices, "camera.marker_place")
        for axis, name in enumerate("xy"):
            numbers[f"offset.{name}"] = _Number(float(place[axis]), 0.0 if fixed else size)
        numbers["yaw"] = _given(space, choices, "camera.marker_yaw", YAW_STD)
        if len(sessions) > 1:
            numbers |= {f"yaw@{s}": _Number(0.0, SESSION_STD) for s in sessions}
        numbers["lag"] = replace(_given(space, choices, "camera.lag", LAG_STD), step=1e-3)
        numbers["scale"] = scale
        return cls(space, floors, sessions, firmest, numbers)

    @property
    def free(self) -> list[str]:
        """Names of the coordinates that are fitted."""
        return [name for name, number in self.numbers.items() if number.std > 0]

    def column(self, name: str, z: Float[np.ndarray, "*batch free"]) -> Float[np.ndarray, "*batch"]:
        """Return one coordinate of search vectors, or its given value if it is not fitted."""
        if name not in self.numbers:
            return np.zeros(z.shape[:-1])
        if (number := self.numbers[name]).std > 0:
            return np.asarray(z[..., self.free.index(name)])
        return np.full(z.shape[:-1], number.mean)

    def log_radius(self, floor: int, drive: int, z: np.ndarray) -> Float[np.ndarray, "*batch"]:
        """Return the logarithm of an effective radius over that of the config."""
        own = self.column(f"drive.{drive}", z) + self.column(f"floor.{self.floors[floor]}", z)
        return np.asarray(self.column("radius", z) + own)

    def kinematics(self, z: Float[np.ndarray, " free"]) -> Kinematics:
        """Return the kinematics at a search vector."""
        shape = self.space.template.geometry
        base, drives = nominal_base(shape), range(shape.drives)
        radius = [[self.log_radius(k, j, z) for j in drives] for k in range(len(self.floors))]
        return Kinematics(
            self.floors,
            np.asarray(shape.pseudo_inverse()),
            base,
            float(shape.wheel_radius) * np.exp(np.array(radius)),
            base * np.exp([float(self.column(f"base.{f}", z)) for f in self.floors]),
            np.array([float(self.column(f"centre.{f}", z)) for f in self.floors]),
        )


def _is_fixed(choices: Sequence[Choice], path: str) -> bool:
    """Return whether the last choice about a parameter fixes it."""
    mine = [c for c in choices if fnmatchcase(path, c.pattern)]
    return bool(mine) and (mine[-1].fixed is not None or mine[-1].free is False)


def _given(space: Space, choices: Sequence[Choice], path: str, usual: float) -> _Number:
    """Return the prior of a scalar of the camera: the config's if it has one, else std `usual`."""
    entry = next(e for e in space.all if e.path == path)
    value = float(entry.get(space.template))
    if entry in space.free:
        at, d = space.slices[path], entry.declaration
        mean = float(d.to_si(space.prior_mean[at])[0])
        return _Number(mean, float(space.prior_std[at][0] * d.slope(mean)))
    return _Number(value, 0.0 if _is_fixed(choices, path) else usual)


@dataclass(frozen=True, eq=False)
class _Fit:
    """State of a calibration.

    Attributes:
        model: map from the search vector.
        tracks: poses and wheel turns.
        z: search vector.
        log_variance: logarithms of the variances: positions, headings, then motion by floor.
        weight: weight of each run [1].
    """

    model: _Model
    tracks: PoseTracks
    z: Float[np.ndarray, " free"]
    log_variance: Float[np.ndarray, " variance"]
    weight: Float[np.ndarray, " run"]
    turn_cache: dict[float, np.ndarray] = field(default_factory=dict)

    @cached_property
    def floor(self) -> Int[np.ndarray, " run"]:
        """Index of the floor of each track."""
        logs = self.tracks.data.logs
        names = [logs[k].surface or "unknown" for k in self.tracks.run]
        return np.array([self.model.floors.index(name) for name in names])

    @cached_property
    def session(self) -> Int[np.ndarray, " run"]:
        """Index of the session of each track."""
        names = [self.tracks.data.session[k] for k in self.tracks.run]
        return np.array([self.model.sessions.index(name) for name in names])

    def turned(self, lag: float) -> np.ndarray:
        if lag not in self.turn_cache:
            self.turn_cache.clear()
            self.turn_cache[lag] = self.tracks.turned(lag)
        return self.turn_cache[lag]

    def motion(self, z: Float[np.ndarray, " free"]) -> Float[np.ndarray, "run gap 3"]:
        """Return the predicted motion between poses."""
        matrix = self.model.kinematics(z).matrices()[self.floor]
        lag = float(self.model.column("lag", z))
        own = float(self.model.column("lag", self.z))
        turn = self.turned(own) if lag == own else self.tracks.turned(lag)
        return moved(matrix, turn)

    def sensor(self, z: Float[np.ndarray, "variant free"]) -> Sensor:
        model = self.model
        place = np.stack([model.column(f"offset.{axis}", z) for axis in "xy"], axis=-1)
        each = np.stack([model.column(f"yaw@{s}", z) for s in model.sessions], axis=-1)
        yaw = model.column("yaw", z)[:, None] + each[:, self.session]
        return Sensor(place[:, None], yaw, model.column("scale", z)[:, None])

    def noise(self, log_variance: Float[np.ndarray, "variant variance"]) -> Noise:
        v = np.exp(log_variance)
        process = v[:, 2:].reshape(len(v), -1, 3)[:, self.floor]
        return Noise(v[:, :1], v[:, 1:2], process)

    def innovations(
        self, z: Float[np.ndarray, "variant free"], log_variance: np.ndarray
    ) -> Innovations:
        """Return the innovations at several search vectors, or at several sets of variances."""
        first = self.motion(z[0])
        # Coordinates of the sensor do not change the predicted motion.
        same = [name.startswith(("offset", "yaw", "scale")) for name in self.model.free]
        motion = np.stack(
            [
                first if k == 0 or not (row != z[0])[~np.array(same, bool)].any()
                else self.motion(row)
                for k, row in enumerate(z)
            ]
        )  # fmt: skip
        arm = 0.5 * nominal_base(self.model.space.template.geometry)
        start = aligned_headings(self.tracks.pose, first) + self.sensor(z[:1]).yaw[0]
        return innovations(
            self.tracks.pose,
            motion,
            self.sensor(z),
            self.noise(np.atleast_2d(log_variance)),
            arm,
            start,
        )

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and std of the prior."""
        each = [self.model.numbers[name] for name in self.model.free]
        return np.array([n.mean for n in each]), np.array([n.std for n in each])

    def linear(self) -> tuple[Float[np.ndarray, "run m"], Float[np.ndarray, "run m free"]]:
        """Return weighted whitened residuals of every run, and their derivative."""
        step = np.array([self.model.numbers[name].step for name in self.model.free])
        z = self.z + np.concatenate([np.zeros((1, len(step))), np.diag(step)])
        white = self.innovations(z, self.log_variance).white
        white = white.reshape(*white.shape[:2], -1) * np.sqrt(self.weight)[:, None]
        return white[0], np.moveaxis((white[1:] - white[0]) / step[:, None, None], 0, -1)

    def loss(self, z: Float[np.ndarray, " free"]) -> float:
        """Return minus twice the log posterior of the search vector at the present variances."""
        at = self.innovations(z[None], self.log_variance)
        mean, std = self.prior
        each = (at.white[0] ** 2).sum(axis=(1, 2)) + at.log_variance[0]
        return float((self.weight * each).sum() + (((z - mean) / std) ** 2).sum())

    def solved(self) -> "_Fit":
        """Return the fit with the search vector solved by Levenberg and Marquardt."""
        now, damping, loss = self, 1e-3, self.loss(self.z)
        mean, std = self.prior
        for _ in range(MOST_STEPS):
            r, slope = now.linear()
            a = np.einsum("nmi,nmj->ij", slope, slope) + np.diag(std**-2.0)
            g = np.einsum("nmi,nm->i", slope, r) + (now.z - mean) / std**2
            for _ in range(8):
                step = np.linalg.solve(a + damping * np.diag(np.diag(a)), -g)
                new = now.loss(now.z + step)
                if new < loss + 1e-9 * abs(loss):
                    break
                damping *= 10.0
            else:
                return now
            size = np.abs(step) / np.sqrt(np.diag(np.linalg.inv(a)))
            now, loss, damping = replace(now, z=now.z + step, turn_cache={}), new, damping * 0.1
            if size.max() < 0.5 * SETTLED:
                break
        return now

    def with_noise(self) -> "_Fit":
        """Return the fit with variances of largest posterior, from some of the runs."""
        some = np.concatenate([
            mine[np.unique(np.linspace(0, len(mine) - 1, NOISE_TRACKS).round().astype(int))]
            for k in range(len(self.model.floors))
            if len(mine := np.flatnonzero(self.floor == k))
        ])  # fmt: skip
        part = replace(
            self, tracks=self.tracks.subset(some), weight=self.weight[some], turn_cache={}
        )
        typical = np.concatenate([_TYPICAL[:2], np.tile(_TYPICAL[2:], len(self.model.floors))])
        step = 1e-3

        def loss(v: np.ndarray) -> tuple[float, np.ndarray]:
            each = v + np.concatenate([np.zeros((1, len(v))), step * np.eye(len(v))])
            at = part.innovations(np.tile(self.z, (len(each), 1)), each)
            whole = (part.weight * ((at.white**2).sum(axis=(2, 3)) + at.log_variance)).sum(axis=1)
            whole = whole + (((each - typical) / _TYPICAL_STD) ** 2).sum(axis=1)
            return float(whole[0]), (whole[1:] - whole[0]) / step

        found = minimize(
            loss, self.log_variance, jac=True, method="L-BFGS-B",
            bounds=[(t - 12.0, t + 12.0) for t in typical], options={"maxiter": 25, "ftol": 1e-6},
        )  # fmt: skip
        return replace(self, log_variance=found.x, turn_cache={})

    def with_weights(self) -> "_Fit":
        """Return the fit with the Student-t weight of every run."""
        at = self.innovations(self.z[None], self.log_variance)
        square = (at.white[0] ** 2).sum(axis=(1, 2))
        # A run counts as one observation of variance: long runs are not more robust.
        each = square / np.maximum(at.count, 1)
        return replace(self, weight=(DEGREES + 1) / (DEGREES + each), turn_cache={})


def calibrate(data: Runs, space: Space, choices: Sequence[Choice] = ()) -> Calibration:
    """Return the calibration of a robot from runs with poses.

    Args:
        data: the runs, each on one floor.
        space: robot with the lengths of the config; priors of the camera's scale, lag and marker
            yaw are used, too.
        choices: choices from which the space was made; numbers that they fix stay fixed.

    Raises:
        DataError: no run has two poses.
    """
    model = _Model.of(space, choices, data, 0)
    mean = np.array([model.numbers[name].mean for name in model.free])
    lag = pose_lag(data)
    if "lag" in model.free and lag is not None and lag.decisive:
        mean[model.free.index("lag")] = lag.seconds
    floors = len(model.floors)
    log_variance = np.concatenate([_TYPICAL[:2], np.tile(_TYPICAL[2:] + 2.0, floors)])
    fit = _started(model, data, mean, log_variance)
    for _ in range(MOST_ROUNDS):
        before = fit
        fit = fit.solved().with_noise().with_weights()
        radius = [float(np.mean(row)) for row in fit.model.kinematics(fit.z).radius]
        fit = _referred(fit, data, choices, int(np.argmax(radius)))
        at = float(fit.model.column("lag", fit.z))
        if abs(at - float(before.model.column("lag", before.z))) > 0.02:
            fit = replace(fit, tracks=PoseTracks.of(data, at), turn_cache={})
            fit = replace(fit, weight=np.ones(len(fit.tracks.run)), turn_cache={})
            continue
        if fit.model.firmest == before.model.firmest:
            _, covariance, _ = _uncertainty(fit)
            change = np.abs(fit.z - before.z) / np.sqrt(np.diag(covariance))
            if change.max() < SETTLED:
                break
    return _result(fit, len(data))


def _started(model: _Model, data: Runs, z: np.ndarray, log_variance: np.ndarray) -> _Fit:
    """Return the fit before its first round, with the sensor's yaw estimated from directions."""
    tracks = PoseTracks.of(data, float(model.column("lag", z)))
    fit = _Fit(model, tracks, z, log_variance, np.ones(len(tracks.run)))
    if "yaw" in model.free and not np.isnan(tracks.pose[..., 2]).all():
        motion, pose = fit.motion(z), tracks.pose
        seen = np.diff(pose[..., 0] + 1j * pose[..., 1], axis=1) * np.exp(-1j * pose[:, :-1, 2])
        product = seen * (motion[..., 0] - 1j * motion[..., 1])
        z = z.copy()
        z[model.free.index("yaw")] = -np.angle(np.nansum(product))
        fit = replace(fit, z=z, turn_cache={})
    return fit


def _referred(fit: _Fit, data: Runs, choices: Sequence[Choice], firmest: int) -> _Fit:
    """Return the fit with radii and centres that refer to another floor, if it is the firmest."""
    if firmest == fit.model.firmest:
        return fit
    model = _Model.of(fit.model.space, choices, data, firmest)
    kept = {name: float(fit.model.column(name, fit.z)) for name in model.free}
    own, far = fit.model.floors[firmest], fit.model.floors
    shift = float(fit.model.column(f"floor.{own}", fit.z))
    turned_about = float(fit.model.column(f"centre.{own}", fit.z))
    for name in far:
        if f"floor.{name}" in kept:
            kept[f"floor.{name}"] -= shift
        if f"centre.{name}" in kept:
            kept[f"centre.{name}"] -= turned_about
    kept["offset.x"] = kept.get("offset.x", 0.0) - turned_about
    if "radius" in kept:
        kept["radius"] += shift
    z = np.array([kept[name] for name in model.free])
    return replace(fit, model=model, z=z, turn_cache={})


def _uncertainty(fit: _Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return precision, covariance and the jackknife's change of the vector for every cluster."""
    r, slope = fit.linear()
    mean, std = fit.prior
    per_run = max(1, int(np.ceil(LEAST_CLUSTERS / len(r))))
    gaps = fit.tracks.pose.shape[1]
    part = np.minimum(np.arange(gaps) * per_run // gaps, per_run - 1)
    part = np.repeat(part, 3)
    a = np.einsum("nmi,nmj->ij", slope, slope) + np.diag(std**-2.0)
    changes = []
    for n in range(len(r)):
        for k in range(per_run):
            mine = slope[n][part == k]
            g = mine.T @ r[n][part == k]
            changes.append(np.linalg.solve(a - mine.T @ mine, g))
    return a, np.linalg.inv(a), np.array(changes)


def _result(fit: _Fit, runs: int) -> Calibration:
    """Return the calibration with intervals and verdicts."""
    model, z = fit.model, fit.z
    precision, covariance, changes = _uncertainty(fit)
    _, prior_std = fit.prior
    count = len(changes)
    off = changes - changes.mean(axis=0)

    def value(
        weights: Mapping[str, float], unit: str, centre: float = 0.0, log_of: float | None = None
    ) -> Value:
        """Return a sum of coordinates with its interval; of its exponential times `log_of`."""
        w = np.array([weights.get(name, 0.0) for name in model.free])
        at = centre + sum(x * float(model.column(name, z)) for name, x in weights.items())
        if not w.any():
            best = at if log_of is None else log_of * float(np.exp(at))
            return Value(best, (best, best), 0.0, "fixed", unit)
        model_var = float(w @ covariance @ w)
        influence = (off @ w) ** 2
        jackknife = (count - 1) / count * float(influence.sum())
        std = float(np.sqrt(max(model_var, jackknife)))
        share = influence / max(float(influence.sum()), 1e-300)
        freedom = max(1 / float((share**2).sum()) - 1, 3.0)
        half = std * float(student.ppf(0.95, freedom))
        prior = float(np.sqrt(((w * prior_std) ** 2).sum()))
        ratio = std / prior
        verdict: Verdict = (
            "identified" if ratio < IDENTIFIED else "weak" if ratio < WEAK else "not_identified"
        )
        if log_of is None:
            return Value(at, (at - half, at + half), std, verdict, unit)
        low, best, high = (log_of * float(np.exp(x)) for x in (at - half, at, at + half))
        return Value(best, (low, high), best * std, verdict, unit)

    shape = model.space.template.geometry
    radius, base = float(shape.wheel_radius), nominal_base(shape)
    return Calibration(
        kinematics=model.kinematics(z),
        sideways=shape.determines_twist,
        radius={
            f: tuple(
                value({"radius": 1.0, f"drive.{j}": 1.0, f"floor.{f}": 1.0}, "m", log_of=radius)
                for j in range(shape.drives)
            )
            for f in model.floors
        },
        base={f: value({f"base.{f}": 1.0}, "m", log_of=base) for f in model.floors},
        centre={
            f: value({f"centre.{f}": 1.0}, "m")
            for f in model.floors
            if f"centre.{f}" in model.numbers
        },
        offset=(value({"offset.x": 1.0}, "m"), value({"offset.y": 1.0}, "m")),
        yaw=value({"yaw": 1.0}, "rad"),
        session_yaw={s: float(model.column(f"yaw@{s}", z)) for s in model.sessions},
        lag=value({"lag": 1.0}, "s"),
        scale=value({"scale": 1.0}, "1"),
        firmest=model.floors[model.firmest],
        nominal_radius=radius,
        nominal_base=base,
        noise=_noise(fit),
        runs=runs,
    )


def _noise(fit: _Fit) -> MotionNoise:
    std = np.exp(0.5 * fit.log_variance)
    process = std[2:].reshape(-1, 3).tolist()
    each = {f: (a, b, c) for f, (a, b, c) in zip(fit.model.floors, process, strict=True)}
    return MotionNoise(float(std[0]), float(std[1]), each)
