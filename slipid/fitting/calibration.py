"""Calibration of the kinematics of a robot and of its pose sensor from runs with poses.

Every fit begins with these numbers (see `slipid.model.kinematics` for the equations):

    radius of drive j on floor k     r_kj = r exp(c + d_j + rho_k + e_kj),   rho = 0 on the firmest
                                     floor; e = 0 if there is only one floor
    track or base on floor k         b_k = b exp(f_k)
    centre of rotation on floor k    x_k, for more than two wheels that point ahead; 0 on the
                                     firmest floor, since only its distance from the sensor shows
    wheelbase on floor k             l_k = l exp(f + f_k) of a robot that steers, f_k = 0 on the
                                     firmest floor; its drives have one radius
    steering                         zero, gain and understeer, equal on all floors
    pose sensor                      place p, yaw psi (with a deviation for every session), lag, and
                                     scale of the positions

They minimise the squared whitened innovations of all poses (`slipid.fitting.innovations`), each run
weighted by a Student t, plus a Gaussian prior. The variances of poses and motion are estimated by
maximum likelihood in turn. Intervals are from a jackknife over runs, since the kinematics are wrong
somewhere and errors of a run are alike; they are at least as wide as those of the likelihood.

Straight driving tells the steering's zero, and turns tell gain over wheelbase. Gain and wheelbase
apart follow from large angles alone, by the tangent, so that both have priors: the config's
wheelbase within 5 %, and a gain of 1 within .1.

Source: least squares for the same numbers on square paths, Borenstein and Feng 1996, "Measurement
and correction of systematic odometry errors in mobile robots" (UMBmark), IEEE Transactions on
Robotics and Automation 12(6).
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Literal

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize
from scipy.stats import t as student

from slipid.data.align.lag import pose_lag
from slipid.data.runs import Runs
from slipid.fitting.gyro import LEAST_PARTS, gyro_errors
from slipid.fitting.innovations import (
    Motion,
    PoseTracks,
    innovations,
    linear_innovations,
    loss_of_noise,
    pose_tracks,
    sensor_yaw,
    start_headings,
)
from slipid.model.kinematics import Kinematics, Steering, is_axle, nominal_base, nominal_steering
from slipid.model.robot import Robot
from slipid.parameter import as_numbers
from slipid.search_space import Choice, Space
from slipid.support.content import Content

Verdict = Literal["identified", "weak", "not_identified", "fixed"]
IDENTIFIED, WEAK = 0.3, 0.8
"""Largest std(posterior) / std(prior) for the verdicts `identified` and `weak`."""
ABSURD = 3.0
"""Ratio of a calibrated length on the firmest floor to the config's, or its inverse, from which on
the length counts as not identified, on other floors as well: the logs and the config must then
contradict each other [1]. On a floor on which the wheels slip, such a ratio is natural."""
RADIUS_STD, DRIVE_STD, FLOOR_STD, DRIVE_ON_FLOOR_STD, BASE_STD = 0.3, 0.02, 0.3, 0.03, 0.5
"""Prior stds of the logarithms of the radius, of the drives' deviations from it, of a floor's
radius over that of the firmest floor, of the drives' further deviations on a floor, and of the
track or base over the config's [1]."""
WHEELBASE_STD, WHEELBASE_ON_FLOOR_STD, ZERO_STD, GAIN_STD, UNDERSTEER_STD = (
    0.05,
    0.15,
    0.1,
    0.1,
    0.03,
)
"""Prior stds of the logarithm of a steered robot's wheelbase over the config's on the firmest floor
and of that on other floors over it [1], of the steering's zero [rad], of its gain [1], and of the
understeer [s^2/m], of which soft tyres have .03."""
LAG_STD, YAW_STD, SESSION_STD = 0.3, 0.5, 0.02
"""Prior stds of the lag [s], of the sensor's yaw and of its deviation in a session [rad]."""
GYRO_PRIORS = {"gyro_scale": (1.0, 0.05, "1"), "gyro_bias_rad_s": (0.0, 0.02, "rad/s")}
"""Prior mean, prior std and unit of the true over the measured yaw rate, and of the gyro's bias."""
LOOSE_SCALE_STD = 0.01
"""Relative prior std of the scale of positions above which the radius stays at the config's, since
motion determines only their ratio."""
WHOLE_TURN, MEAN_TURN = 1.0, 0.3
"""Changes of heading by the encoders that show a track or base: in any run, or on average over the
runs on a floor [rad]."""
SMALL_TURN, EXPLAINED, LEAST_TURNS = 0.1, 0.8, 6
"""Smaller changes of heading by the encoders may be errors of the speed controllers or slip. They
show a track if they exceed this one on average [rad] and explain this fraction of the squares of
the measured changes [1], in at least this number of runs. They never show the base of wheels that
determine the twist, whose slip depends on the direction of travel, and so does the turning."""
DEGREES = 4.0
"""Degrees of freedom of the Student t of runs."""
LEAST_CLUSTERS = 12
"""Number of parts into which runs are divided for the jackknife if there are fewer runs."""
MOST_ROUNDS, MOST_STEPS, SETTLED = 6, 5, 0.1
"""Largest numbers of rounds and of solver steps per round, and the change of every number at which
rounds end [std]."""
RECUT_S = 0.02
"""Change of the lag after which wheel turns are computed anew [s]."""
MOST_START = 64
"""Number of runs above which a calibration starts from that of so many of them."""
NOISE_TRACKS = 12
"""Largest number of runs on each floor from which variances are estimated."""
_TYPICAL = np.log(np.array([0.003, 0.005, 0.005, 0.005, 0.01, 0.005, 0.005, 0.01]) ** 2)
"""Logarithms of the typical variances of positions, of headings, of the motion along, across and in
yaw per metre, and of a run's effects on them."""
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


@dataclass(frozen=True)
class MotionNoise:
    """Stds of what calibrated kinematics leave unexplained.

    Attributes:
        place: std of a logged position [m].
        heading: std of a logged heading [rad].
        process: std of the motion along, across and in yaw on each floor [m/sqrt(m), m/sqrt(m),
            rad/sqrt(m)].
        effect: std of a run's constant errors along, across and in yaw per distance, keyed by floor
            [m/m, m/m, rad/m].
    """

    place: float
    heading: float
    process: Mapping[str, tuple[float, float, float]]
    effect: Mapping[str, tuple[float, float, float]]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated kinematics and pose sensor of a robot.

    Attributes:
        sideways: True if the wheels determine the twist, so that `base` is an effective base.
        radius: effective rolling radius of every drive, keyed by floor [m].
        base: effective track or base, keyed by floor [m].
        centre: centre of rotation ahead of the axle's middle, keyed by floor [m]; empty for wheels
            that have none.
        offset: place of the pose sensor ahead of and to the left of the robot's middle [m].
        yaw: heading of the pose sensor less that of the robot [rad].
        session_yaw: deviation of the sensor's heading in each session [rad].
        lag: lag of the poses behind the wheels [s].
        scale: true over logged length [1].
        firmest: floor with the largest radius, to which the centre and other radii refer.
        steering: numbers of a robot that steers, keyed as in identified.json; empty for others.
        gyro: scale and bias of the gyro, keyed as in identified.json; empty if no run has both a
            gyro and headings.
        nominal_radius, nominal_base: lengths of the config [m].
        noise: stds of poses and motion.
        runs: number of calibrated runs.
    """

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
    steering: Mapping[str, Value]
    gyro: Mapping[str, Value]
    nominal_radius: float
    nominal_base: float
    noise: MotionNoise
    runs: int

    def __str__(self) -> str:
        return "\n".join(self.sentences)

    @property
    def sentences(self) -> tuple[str, ...]:
        """One line for each floor, and one for the pose sensor, for people."""
        lines = []
        for floor, radii in self.radius.items():
            names = (
                ["left", "right"] if len(radii) == 2 else [str(j + 1) for j in range(len(radii))]
            )
            names, radii = (["mean"], radii[:1]) if self.steering else (names, radii)
            each = ", ".join(f"{n} {_mm(v)}" for n, v in zip(names, radii, strict=True))
            ratio = self.multipliers[floor][1]
            line = f"{floor}: wheel radius {each}; effective {self.length} {_mm(self.base[floor])}"
            line += f", {ratio:.3f} of nominal"
            if floor in self.centre and self.centre[floor].verdict != "fixed":
                line += f"; turns about a point {_mm(self.centre[floor])} ahead of the middle"
            lines.append(line)
        if self.steering:
            lines.append(self._of_steering())
        x, y = self.offset
        lines.append(
            f"pose sensor {_mm(x)} ahead and {_mm(y)} left of the middle, turned by "
            f"{np.degrees(self.yaw.value):.2f} deg; poses are {1e3 * self.lag.value:.0f} ms late"
        )
        return tuple(lines)

    @property
    def length(self) -> str:
        """Name of the length that `base` is the effective one of."""
        return "wheelbase" if self.steering else "base" if self.sideways else "track"

    def _of_steering(self) -> str:
        """Return a line about the steering, which says what only priors tell."""
        zero, gain, understeer = (self.steering[n] for n in ("zero_rad", "gain", "understeer"))
        line = (
            f"steering: straight ahead at {np.degrees(zero.value):.2f} deg, gain {gain.value:.3f}, "
            f"understeer {understeer.value:.4f} s^2/m"
        )
        if gain.verdict != "identified" or self.base[self.firmest].verdict != "identified":
            ratio = gain.value / self.base[self.firmest].value
            line += (
                f"; of gain and wheelbase the runs tell little but their ratio, {ratio:.3f} per m"
                ": drive curves at large steering angles"
            )
        if understeer.verdict == "not_identified":
            line += "; understeer is not identified: drive the same curves slowly and fast"
        return line

    def numbers(self, floor: str) -> Float[np.ndarray, " number"]:
        """Return log radius ratios of the drives, log base ratio, and centre [m] on a floor.

        Ratios are to the config's lengths. Zero [rad], gain and understeer [s^2/m] of the steering
        follow if a wheel is steered.

        Raises:
            ValueError: the floor was not calibrated.
        """
        if floor not in self.radius:
            raise ValueError(f"no surface '{floor}'; calibrated: {', '.join(self.radius)}")
        radius = [np.log(v.value / self.nominal_radius) for v in self.radius[floor]]
        centre = self.centre[floor].value if floor in self.centre else 0.0
        steering = [v.value for name, v in self.steering.items() if name != "wheelbase_m"]
        base = np.log(self.base[floor].value / self.nominal_base)
        return np.array([*radius, base, centre, *steering])

    def seen(self, robot: Robot) -> Robot:
        """Return a robot whose poses are measured by the calibrated pose sensor."""
        deviations = [self.session_yaw.get(s, 0.0) for s in robot.camera.sessions]
        camera = replace(
            robot.camera,
            scale=as_numbers(self.scale.value),
            lag=as_numbers(self.lag.value),
            marker_yaw=as_numbers(self.yaw.value),
            session_yaw=as_numbers(np.array(deviations)),
            marker_place=as_numbers([v.value for v in self.offset]),
        )
        return replace(robot, camera=camera)

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
        """Return the section `calibration` of identified.json, which `of_json` reads."""
        has_track = not self.sideways and not self.steering
        length = "effective_track_m" if has_track else "effective_base_m"
        steering = {name: asdict(value) for name, value in self.steering.items()}
        return {
            "surfaces": {
                floor: {
                    "rolling_radius_m": [asdict(v) for v in self.radius[floor]],
                    length: asdict(self.base[floor]),
                }
                for floor in self.radius
            },
            "centre_of_rotation_m": {floor: asdict(v) for floor, v in self.centre.items()},
            "pose_offset_m": [asdict(v) for v in self.offset],
            "pose_yaw_rad": asdict(self.yaw),
            "pose_session_yaw_rad": dict(self.session_yaw),
            "pose_lag_s": asdict(self.lag),
            "pose_scale": asdict(self.scale),
            **{name: asdict(number) for name, number in self.gyro.items()},
            **({"steering": steering} if steering else {}),
            "multipliers": {
                floor: {"wheel_radius": list(radius), "track": base}
                for floor, (radius, base) in self.multipliers.items()
            },
            "nominal": {"wheel_radius_m": self.nominal_radius, length[10:]: self.nominal_base},
            "firmest": self.firmest,
            "noise": asdict(self.noise),
            "runs": self.runs,
        }

    @classmethod
    def of_json(cls, content: Content) -> "Calibration":
        """Return the calibration of a section `calibration`."""

        def value(x: Content) -> Value:
            return Value(**{**x, "interval90": tuple(x["interval90"])})

        def stds(x: Content) -> dict[str, tuple[float, float, float]]:
            return {floor: (a, b, c) for floor, (a, b, c) in x.items()}

        floors, noise = content["surfaces"], content["noise"]
        steering = content.get("steering", {})
        length = "base_m" if "base_m" in content["nominal"] else "track_m"
        x, y = content["pose_offset_m"]
        return cls(
            sideways=length == "base_m" and not steering,
            radius={f: tuple(value(v) for v in of["rolling_radius_m"]) for f, of in floors.items()},
            base={f: value(of[f"effective_{length}"]) for f, of in floors.items()},
            centre={f: value(v) for f, v in content["centre_of_rotation_m"].items()},
            offset=(value(x), value(y)),
            yaw=value(content["pose_yaw_rad"]),
            session_yaw=content["pose_session_yaw_rad"],
            lag=value(content["pose_lag_s"]),
            scale=value(content["pose_scale"]),
            firmest=content["firmest"],
            steering={name: value(v) for name, v in steering.items()},
            gyro={name: value(content[name]) for name in GYRO_PRIORS if name in content},
            nominal_radius=content["nominal"]["wheel_radius_m"],
            nominal_base=content["nominal"][length],
            noise=MotionNoise(
                noise["place"], noise["heading"], stds(noise["process"]), stds(noise["effect"])
            ),
            runs=content["runs"],
        )


def _mm(length: Value) -> str:
    """Return a length in mm with half the width of its interval, or the reason why it has none."""
    half = 0.5 * (length.interval90[1] - length.interval90[0])
    text = f"{1e3 * length.value:.4g} mm"
    if length.verdict == "not_identified":
        return f"{text} (not identified)"
    return text if length.verdict == "fixed" else f"{text} +- {1e3 * half:.2g}"


def _base_names(floor: str) -> tuple[str, ...]:
    """Return the names of the coordinates whose sum is log b_k / b."""
    return "base", f"base.{floor}"


def _radius_names(floor: str, drive: int) -> tuple[str, ...]:
    """Return the names of the coordinates whose sum is log r_kj / r."""
    return "radius", f"drive.{drive}", f"floor.{floor}", f"drive.{drive}@{floor}"


@dataclass(frozen=True)
class _Number:
    """Gaussian prior of one coordinate of the search vector; a std of 0 fixes it."""

    mean: float
    std: float


@dataclass(frozen=True, eq=False)
class _Model:
    """Map from the search vector to kinematics, pose sensor and lag of every run.

    Attributes:
        space: robot and choices of the config.
        floors, sessions: names of floors and sessions.
        firmest: index of the floor to which radii refer.
        numbers: coordinates of the search vector, keyed by name.
        unseen: names of coordinates that no run shows, such as the track without turns, or the
            radius without positions; they stay at their prior means.
    """

    space: Space
    floors: tuple[str, ...]
    sessions: tuple[str, ...]
    firmest: int
    numbers: Mapping[str, _Number]
    unseen: frozenset[str]

    @classmethod
    def of(cls, space: Space, choices: Sequence[Choice], data: Runs, firmest: int) -> "_Model":
        shape = space.template.geometry
        floors = tuple(sorted({log.surface or "unknown" for log in data.logs}))
        sessions = tuple(sorted(set(data.session)))
        scale = _given(space, choices, "camera.scale", 0.0)
        loose = scale.std > LOOSE_SCALE_STD * scale.mean
        size = max(nominal_base(shape), 0.1)
        numbers = {"radius": _Number(0.0, 0.0 if loose else RADIUS_STD)}
        drives = range(shape.drives if shape.driven is None else 0)
        numbers |= {f"drive.{j}": _Number(0.0, DRIVE_STD) for j in drives}
        others = [f for k, f in enumerate(floors) if k != firmest]
        numbers |= {f"floor.{f}": _Number(0.0, FLOOR_STD) for f in others}
        if others:
            own = {f"drive.{j}@{f}" for f in floors for j in drives}
            numbers |= {name: _Number(0.0, DRIVE_ON_FLOOR_STD) for name in sorted(own)}
        if shape.driven is None:
            numbers |= {f"base.{f}": _Number(0.0, BASE_STD) for f in floors}
        else:
            numbers["base"] = _Number(0.0, WHEELBASE_STD)
            numbers |= {f"base.{f}": _Number(0.0, WHEELBASE_ON_FLOOR_STD) for f in others}
            numbers["zero"] = _Number(0.0, ZERO_STD)
            numbers["gain"] = _Number(1.0, GAIN_STD)
            numbers["understeer"] = _Number(0.0, UNDERSTEER_STD)
        if not shape.determines_twist and not is_axle(shape):
            numbers |= {f"centre.{f}": _Number(0.0, size) for f in others}
        for axis, name in enumerate("xy"):
            numbers[f"offset.{name}"] = _given(space, choices, "camera.marker_place", size, axis)
        numbers["yaw"] = _given(space, choices, "camera.marker_yaw", YAW_STD)
        if len(sessions) > 1:
            numbers |= {f"yaw@{s}": _Number(0.0, SESSION_STD) for s in sessions}
        numbers["lag"] = _given(space, choices, "camera.lag", LAG_STD)
        numbers["scale"] = scale
        # Steering that is off its zero turns a robot that seems to drive straight ahead.
        straight = set(floors) - _floors_with_turns(space, data) if shape.driven is None else set()
        unseen = {f"{what}.{f}" for f in straight for what in ("base", "centre")}
        if straight == set(floors):
            unseen |= {"offset.x", "offset.y"}
        seen = np.isfinite(data.pose[data.fresh]).any(axis=0)
        if not seen[0]:
            # Headings alone show ratios of lengths, so the config's radius counts as known.
            unseen |= {"radius", "offset.x", "offset.y", "scale", *(f"floor.{f}" for f in others)}
        if not seen[2]:
            unseen |= {"yaw", *(f"yaw@{s}" for s in sessions)}
        if max(int(data.fresh[data.rows(k)].sum()) for k in range(len(data))) < 3:
            unseen.add("lag")
        unseen &= set(numbers)
        return cls(space, floors, sessions, firmest, numbers, frozenset(unseen))

    @cached_property
    def free(self) -> list[str]:
        """Names of the coordinates that are fitted."""
        return [n for n, number in self.numbers.items() if number.std > 0 and n not in self.unseen]

    def column(self, name: str, z: Float[np.ndarray, "*batch free"]) -> Float[np.ndarray, "*batch"]:
        """Return one coordinate of search vectors, or its given value if it is not fitted."""
        if name not in self.numbers:
            return np.zeros(z.shape[:-1])
        if name in self.free:
            return np.asarray(z[..., self.free.index(name)])
        return np.full(z.shape[:-1], self.numbers[name].mean)

    @cached_property
    def has_centre(self) -> bool:
        """True if floors differ in the point about which the robot turns."""
        shape = self.space.template.geometry
        return not shape.determines_twist and not is_axle(shape)

    def kinematics(self, z: Float[np.ndarray, "*batch free"]) -> Kinematics:
        """Return the kinematics at a search vector; for several, arrays have leading axes."""
        shape, floors = self.space.template.geometry, self.floors
        drives = range(shape.drives)
        radius = np.array(
            [[sum(self.column(n, z) for n in _radius_names(f, j)) for j in drives] for f in floors]
        )
        if "radius" not in self.free:
            # The mean radius is given, so that drives deviate from it in opposite directions.
            radius = radius - np.mean([self.column(f"drive.{j}", z) for j in drives], axis=0)
        base = [sum(self.column(n, z) for n in _base_names(f)) for f in floors]
        base = self.nominal_base * np.exp(np.stack(base, axis=-1))
        return Kinematics(
            floors,
            self.rolling,
            self.nominal_base,
            float(shape.wheel_radius) * np.exp(np.moveaxis(radius, (0, 1), (-2, -1))),
            base,
            np.stack([self.column(f"centre.{f}", z) for f in floors], axis=-1),
            self.steering(z, base),
        )

    def steering(
        self, z: Float[np.ndarray, "*batch free"], base: Float[np.ndarray, "*batch floor"]
    ) -> Steering | None:
        """Return the steering on every floor at a search vector; None if no wheel is steered."""
        driven = self.space.template.geometry.driven
        if driven is None:
            return None
        zero, gain, understeer = (
            np.broadcast_to(self.column(name, z)[..., None], base.shape)
            for name in ("zero", "gain", "understeer")
        )
        front = np.full(base.shape, float(driven == "front"))
        return Steering(base, zero, gain, understeer, front)

    def matrices(
        self, z: Float[np.ndarray, "*batch free"]
    ) -> Float[np.ndarray, "*batch floor 3 drive"]:
        """Return the matrices from wheel turns to body increments on every floor."""
        return self.kinematics(z).matrices()

    @cached_property
    def rolling(self) -> Float[np.ndarray, "3 drive"]:
        """Pseudo-inverse of the config's geometry."""
        return np.asarray(self.space.template.geometry.pseudo_inverse())

    @cached_property
    def nominal_base(self) -> float:
        """Track or base of the config's geometry [m]."""
        return nominal_base(self.space.template.geometry)


def _floors_with_turns(space: Space, data: Runs) -> set[str]:
    """Return the floors on which the wheels turned the robot in some run."""
    shape = space.template.geometry
    yaw = np.asarray(shape.pseudo_inverse())[2] * float(shape.wheel_radius)
    turned: dict[str, list[tuple[float, float, float]]] = {}
    for k, log in enumerate(data.logs):
        rows = data.rows(k)
        seen = np.flatnonzero(data.fresh[rows] & np.isfinite(data.pose[rows, 2]))
        wheels, poses = data.wheel_angle[rows] @ yaw, np.unwrap(data.pose[rows, 2][seen])
        ends = (wheels[seen[-1]] - wheels[seen[0]], poses[-1] - poses[0]) if len(seen) else (0, 0)
        turned.setdefault(log.surface or "unknown", []).append((float(np.ptp(wheels)), *ends))
    gently = not shape.determines_twist
    return {floor for floor, each in turned.items() if _shows_turns(np.array(each), gently)}


def _shows_turns(turns: Float[np.ndarray, "run 3"], gently: bool) -> bool:
    """Return whether changes of heading in some runs are turns by the wheels.

    Args:
        turns: ranges of the heading by the encoders, and its changes from the first to the last
            pose by the encoders and by the poses [rad].
        gently: True if small changes may show turns, too.
    """
    far, by_wheels, by_poses = turns.T
    if far.max() > WHOLE_TURN or far.mean() > MEAN_TURN:
        return True
    if not gently or len(far) < LEAST_TURNS or far.mean() < SMALL_TURN:
        return False
    whole = (by_wheels @ by_wheels) * (by_poses @ by_poses)
    return bool((by_wheels @ by_poses) ** 2 > EXPLAINED * whole)


def _is_fixed(choices: Sequence[Choice], path: str) -> bool:
    """Return whether the last choice about a parameter fixes it."""
    mine = [c for c in choices if fnmatchcase(path, c.pattern)]
    return bool(mine) and (mine[-1].fixed is not None or mine[-1].free is False)


def _given(
    space: Space, choices: Sequence[Choice], path: str, usual: float, axis: int | None = None
) -> _Number:
    """Return the prior of a number of the camera: the config's if it has one, else std `usual`.

    `axis` is the index in a vector, whose declared prior is too narrow and does not count.
    """
    entry = next(e for e in space.all if e.path == path)
    at = axis or 0
    value = float(np.ravel(entry.get(space.template))[at])
    stated = any(c.prior_std is not None and fnmatchcase(path, c.pattern) for c in choices)
    if entry in space.free and (stated or axis is None):
        mine, d = space.slices[path], entry.declaration
        mean = float(d.to_si(space.prior_mean[mine])[at])
        return _Number(mean, float(space.prior_std[mine][at] * d.slope(mean)))
    return _Number(value, 0.0 if _is_fixed(choices, path) else usual)


@dataclass(frozen=True, eq=False)
class _Fit:
    """State of a calibration.

    Attributes:
        model: map from the search vector.
        data: the runs.
        tracks: poses and wheel turns.
        z: search vector.
        log_variance: logarithms of the variances: of positions and headings, then for each floor
            six of the motion, as in `innovations`.
        weight: weight of each track [1].
        runs: indices of the runs from which tracks are cut, None for all.
    """

    model: _Model
    data: Runs
    tracks: PoseTracks
    z: Float[np.ndarray, " free"]
    log_variance: Float[np.ndarray, " variance"]
    weight: Float[np.ndarray, " track"]
    runs: Int[np.ndarray, " some"] | None = None

    @cached_property
    def floor(self) -> Int[np.ndarray, " track"]:
        """Index of the floor of each track; 0 for tracks that only fill the arrays."""
        names = [self.data.logs[k].surface or "unknown" for k in self.tracks.run]
        return self._filled([self.model.floors.index(name) for name in names])

    @cached_property
    def session(self) -> Int[np.ndarray, " track"]:
        """Index of the session of each track."""
        names = [self.data.session[k] for k in self.tracks.run]
        return self._filled([self.model.sessions.index(name) for name in names])

    def _filled(self, of_runs: list[int]) -> Int[np.ndarray, " track"]:
        return np.pad(of_runs, (0, len(self.tracks.pose) - len(of_runs)))

    def motion(self, z: Float[np.ndarray, "*batch free"]) -> Motion:
        """Return the numbers by which the poses of every track are predicted."""
        model = self.model
        each = np.stack([model.column(f"yaw@{s}", z) for s in model.sessions], axis=-1)
        each = each[..., self.session]

        def for_all(name: str) -> np.ndarray:
            return np.broadcast_to(model.column(name, z)[..., None], each.shape)

        place = np.stack([for_all("offset.x"), for_all("offset.y")], axis=-1)
        kinematics = model.kinematics(z)
        steering = kinematics.steering
        return Motion(
            matrix=kinematics.matrices()[..., self.floor, :, :],
            place=place,
            yaw=for_all("yaw") + each,
            scale=for_all("scale"),
            lag=for_all("lag") - self.tracks.lag,
            steering=steering and Steering(*(x[..., self.floor] for x in steering)),
        )

    def log_noise(self, log_variance: Float[np.ndarray, " variance"]) -> np.ndarray:
        """Return the logarithms of the variances of every track (track, 8)."""
        motion = log_variance[2:].reshape(-1, 6)[self.floor]
        return np.concatenate([np.tile(log_variance[:2], (len(motion), 1)), motion], axis=1)

    @cached_property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the tracks for the compiled functions."""
        t, now = self.tracks, self.motion(self.z)
        turn = t.turn + now.lag[:, None, None, None] * t.turn_slope
        aligned = start_headings(now.matrix, t.pose, turn, now.steering)
        heading = np.asarray(aligned) + now.yaw
        return t.pose, t.turn, t.turn_slope, t.far, heading

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and std of the prior."""
        each = [self.model.numbers[name] for name in self.model.free]
        return np.array([n.mean for n in each]), np.array([n.std for n in each])

    @cached_property
    def linear(self) -> tuple[Float[np.ndarray, "track m"], Float[np.ndarray, "track m free"]]:
        """Weighted whitened residuals of every track, and their derivative."""
        now, log_noise = self.motion(self.z), self.log_noise(self.log_variance)
        white, slope = linear_innovations(now, log_noise, self.arrays)
        free, step = len(self.z), 1e-6
        moved = self.motion(self.z + step * np.eye(free))
        total = np.zeros((*white.shape, free))
        leaves = (jax.tree.leaves(each) for each in (slope, now, moved))
        for field, before, after in zip(*leaves, strict=True):
            by_z = (after - before) / step
            shape = *white.shape, -1
            by_field = np.asarray(field).reshape(shape)
            total += np.einsum("ngaf,znf->ngaz", by_field, by_z.reshape(free, len(white), -1))
        root = np.sqrt(self.weight)[:, None]
        tracks = len(white)
        return (
            np.asarray(white).reshape(tracks, -1) * root,
            total.reshape(tracks, -1, free) * root[..., None],
        )

    def loss(self, z: Float[np.ndarray, " free"]) -> float:
        """Return the sum of squares at a search vector, with the present path's filter gains."""
        now, log_noise = self.motion(self.z), self.log_noise(self.log_variance)
        white = np.asarray(innovations(self.motion(z), now, log_noise, self.arrays).white)
        mean, std = self.prior
        each = self.weight * (white**2).sum(axis=(1, 2))
        return float(each.sum() + (((z - mean) / std) ** 2).sum())

    @property
    def gradient(self) -> tuple[Float[np.ndarray, " free"], Float[np.ndarray, "free free"]]:
        """Gradient and Gauss-Newton matrix of half the sum of squares, prior included."""
        (r, slope), (mean, std) = self.linear, self.prior
        matrix = np.einsum("nmi,nmj->ij", slope, slope) + np.diag(std**-2.0)
        return np.einsum("nmi,nm->i", slope, r) + (self.z - mean) / std**2, matrix

    def solved(self) -> "_Fit":
        """Return the fit with the search vector solved by Levenberg and Marquardt."""
        now, damping = self, 1e-4
        for _ in range(MOST_STEPS):
            g, a = now.gradient
            loss = now.loss(now.z)
            for _ in range(8):
                step = np.linalg.solve(a + damping * np.diag(np.diag(a)), -g)
                if now.loss(now.z + step) <= loss * (1 + 1e-9):
                    break
                damping *= 10.0
            else:
                return now
            now, damping = replace(now, z=now.z + step), damping * 0.1
            if _in_stds(step, a) < SETTLED:
                break
        return now

    def with_noise(self) -> "_Fit":
        """Return the fit with variances of largest posterior, from some of the tracks."""
        floor = self.floor[: len(self.tracks.run)]
        part = self.of_tracks(evenly(floor, NOISE_TRACKS * len(np.unique(floor))))
        typical = np.concatenate([_TYPICAL[:2], np.tile(_TYPICAL[2:], len(self.model.floors))])
        numbers = part.motion(self.z)

        def loss(v: np.ndarray) -> tuple[float, np.ndarray]:
            each, slope = loss_of_noise(numbers, part.log_noise(v), part.arrays)
            slope = np.asarray(slope) * part.weight[:, None]
            motion = np.zeros((len(self.model.floors), 6))
            np.add.at(motion, part.floor, slope[:, 2:])
            pull = (v - typical) / _TYPICAL_STD
            total = float((part.weight * np.asarray(each)).sum() + (pull**2).sum())
            own = np.concatenate([slope[:, :2].sum(axis=0), motion.ravel()])
            return total, own + 2 * pull / _TYPICAL_STD

        bounds = [(x - 12.0, x + 12.0) for x in typical]
        # Divided by the slope, the first step of the solver is a step of one; else it overshoots.
        size = max(float(np.abs(loss(self.log_variance)[1]).max()), 1.0)

        def scaled(v: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = loss(v)
            return value / size, slope / size

        found = minimize(
            scaled,
            self.log_variance,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={"maxiter": 20, "ftol": 1e-6},
        )
        return replace(self, log_variance=found.x)

    def of_tracks(self, tracks: Int[np.ndarray, " some"]) -> "_Fit":
        """Return the fit of some of the tracks."""
        part = self.tracks.subset(tracks)
        weight = np.pad(self.weight[tracks], (0, len(part.pose) - len(tracks)))
        return replace(self, tracks=part, weight=weight)

    def with_weights(self) -> "_Fit":
        """Return the fit with the Student-t weight of every track."""
        now, log_noise = self.motion(self.z), self.log_noise(self.log_variance)
        white = np.asarray(innovations(now, now, log_noise, self.arrays).white)
        count = np.maximum(np.isfinite(self.tracks.pose[:, 1:]).sum(axis=(1, 2)), 1)
        # The mean square of a run counts as one observation: a long run may be an outlier, too.
        each = (white**2).sum(axis=(1, 2)) / count
        return replace(self, weight=(DEGREES + 1) / (DEGREES + each))


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
    return _result(_fitted(data, space, choices))


def cross_calibrated(
    data: Runs, space: Space, choices: Sequence[Choice], fold: Int[np.ndarray, " run"]
) -> tuple[Calibration, dict[int, Calibration]]:
    """Return the calibration from all runs, and for each fold that from all runs outside it.

    The latter follow from the former by one Gauss-Newton step, which is exact for numbers in which
    the poses are linear. Arguments are those of `calibrate`; runs with fold -1 are never left out.
    """
    fit = _fitted(data, space, choices)
    (r, slope), (_, a) = fit.linear, fit.gradient
    of_track, without = fold[fit.tracks.run], {}
    for k in sorted(set(of_track.tolist()) - {-1}):
        mine = np.flatnonzero(of_track == k)
        inner = np.einsum("nmi,nmj->ij", slope[mine], slope[mine])
        pull = np.einsum("nmi,nm->i", slope[mine], r[mine])
        without[k] = _result(replace(fit, z=fit.z + np.linalg.solve(a - inner, pull)), rough=True)
    return _result(fit), without


def _fitted(data: Runs, space: Space, choices: Sequence[Choice]) -> _Fit:
    """Return the end of a calibration; arguments are those of `calibrate`."""
    model = _Model.of(space, choices, data, 0)
    z = np.array([model.numbers[name].mean for name in model.free])
    lag = pose_lag(data)
    if "lag" in model.free and lag is not None and lag.decisive:
        z[model.free.index("lag")] = lag.seconds
    typical = np.concatenate([_TYPICAL[:2], np.tile(_TYPICAL[2:] + 2.0, len(model.floors))])
    fit = _started(model, data, z, typical)
    if len(data) <= MOST_START:
        return _rounds(fit, choices)
    # Many runs only refine what a part of them has found.
    some = evenly([log.surface or "unknown" for log in data.logs], MOST_START)
    part = _rounds(_cut(replace(fit, runs=some)), choices)
    return _rounds(_cut(replace(part, runs=None)), choices)


def _rounds(fit: _Fit, choices: Sequence[Choice]) -> _Fit:
    """Return the fit after rounds that estimate the numbers, the variances and the weights."""
    for _ in range(MOST_ROUNDS):
        before = fit
        fit = fit.solved().with_noise().with_weights()
        radius = [float(np.mean(row)) for row in fit.model.kinematics(fit.z).radius]
        fit = _referred(fit, choices, int(np.argmax(radius)))
        if abs(float(fit.model.column("lag", fit.z)) - fit.tracks.lag) > RECUT_S:
            fit = _cut(fit)
        elif (
            fit.model.firmest == before.model.firmest
            and _in_stds(fit.z - before.z, fit.gradient[1]) < SETTLED
        ):
            break
    return fit


def evenly(floors: Sequence[str] | np.ndarray, most: int) -> Int[np.ndarray, " some"]:
    """Return indices of at most about `most` elements, evenly from each floor."""
    label = np.asarray(floors)
    some, names = [], np.unique(label)
    for name in names:
        mine = np.flatnonzero(label == name)
        at = np.linspace(0, len(mine) - 1, min(int(np.ceil(most / len(names))), len(mine)))
        some.append(mine[at.round().astype(int)])
    return np.concatenate(some)


def _in_stds(
    change: Float[np.ndarray, " free"], precision: Float[np.ndarray, "free free"]
) -> float:
    """Return the largest change of a coordinate, in its standard deviations."""
    return float((np.abs(change) / np.sqrt(np.diag(np.linalg.inv(precision)))).max())


def _cut(fit: _Fit) -> _Fit:
    """Return the fit with the tracks cut at the present lag."""
    shape = fit.model.space.template.geometry
    nominal = np.asarray(shape.pseudo_inverse()) * float(shape.wheel_radius)
    arm, lag = 0.5 * nominal_base(shape), float(fit.model.column("lag", fit.z))
    tracks = pose_tracks(fit.data, lag, nominal, arm, nominal_steering(shape), fit.runs)
    return replace(fit, tracks=tracks, weight=np.ones(len(tracks.pose)))


def _started(model: _Model, data: Runs, z: np.ndarray, log_variance: np.ndarray) -> _Fit:
    """Return the fit before its first round, with the sensor's yaw estimated from directions."""
    nothing = np.zeros(0)
    empty = PoseTracks(np.zeros(0, int), nothing, nothing, nothing, nothing, 0.0)
    fit = _cut(_Fit(model, data, empty, z, log_variance, np.ones(0)))
    tracks = fit.tracks
    if "yaw" not in model.free or not np.isfinite(tracks.pose).all(axis=-1).any():
        return fit
    z, now = z.copy(), fit.motion(z)
    yaw = sensor_yaw(now.matrix, tracks.pose, tracks.turn, now.steering)
    z[model.free.index("yaw")] = yaw
    return replace(fit, z=z)


def _referred(fit: _Fit, choices: Sequence[Choice], firmest: int) -> _Fit:
    """Return the fit with radii and centres that refer to the floor with index `firmest`."""
    if firmest == fit.model.firmest:
        return fit
    model = _Model.of(fit.model.space, choices, fit.data, firmest)
    own = fit.model.floors[firmest]

    def before(name: str) -> float:
        return float(fit.model.column(name, fit.z))

    longer, ahead = before(f"floor.{own}"), before(f"centre.{own}")
    shift = {"radius": longer, "offset.x": -ahead}
    shift |= {f"floor.{f}": -longer for f in model.floors}
    shift |= {f"centre.{f}": -ahead for f in model.floors}
    if "base" in model.numbers:
        shift |= {"base": before(f"base.{own}")}
        shift |= {f"base.{f}": -before(f"base.{own}") for f in model.floors}
    z = np.array([before(name) + shift.get(name, 0.0) for name in model.free])
    return replace(fit, model=model, z=z)


def _changes(fit: _Fit) -> Float[np.ndarray, "part free"]:
    """Return the change of the search vector if one part of the runs is left out (jackknife).

    Parts are runs, or equal parts of runs if there are few.
    """
    (r, slope), (_, a) = fit.linear, fit.gradient
    runs = len(fit.tracks.run)
    parts = max(1, int(np.ceil(LEAST_CLUSTERS / runs)))
    out = []
    for n in range(runs):
        posed = np.isfinite(fit.tracks.pose[n, 1:]).any(axis=1)
        at = (np.cumsum(posed) - 1).clip(0)
        part = np.repeat(at * parts // max(int(posed.sum()), 1), 3)
        for k in range(parts):
            mine = slope[n][part == k]
            out.append(np.linalg.solve(a - mine.T @ mine, mine.T @ r[n][part == k]))
    return np.array(out)


def _result(fit: _Fit, rough: bool = False) -> Calibration:
    """Return the calibration with intervals and verdicts; `rough` ones have too narrow intervals.

    Rough intervals save the time of the jackknife where only the values are used.
    """
    model, z = fit.model, fit.z
    changes = np.zeros((2, len(z))) if rough else _changes(fit)
    covariance = np.zeros((len(z), len(z))) if rough else np.linalg.inv(fit.gradient[1])
    count = len(changes)
    off = changes - changes.mean(axis=0)

    def total(names: Sequence[str]) -> float:
        return sum(float(model.column(name, z)) for name in names)

    def is_far(names: Sequence[str]) -> bool:
        """Return whether a length is far from the config's; the names are those of its parts."""
        return abs(total(names)) > np.log(ABSURD)

    def value(
        names: Sequence[str], unit: str, log_of: float | None = None, far: bool = False
    ) -> Value:
        """Return the sum of some coordinates, or the exponential of the sum, times `log_of`."""
        w = np.array([float(name in names) for name in model.free])
        stds = {name: model.numbers[name].std for name in names if name in model.numbers}
        prior = float(np.hypot.reduce([*stds.values()], initial=0.0))
        hidden = [std for name, std in stds.items() if name in model.unseen]
        at = total(names)
        influence = (off @ w) ** 2
        jackknife = (count - 1) / count * float(influence.sum())
        std = float(np.sqrt(max(float(w @ covariance @ w), jackknife)))
        std = float(np.hypot.reduce([std, *hidden])) if w.any() else prior
        share = influence / max(float(influence.sum()), 1e-300)
        freedom = max(1 / max(float((share**2).sum()), 1e-9) - 1, 3.0)
        half = std * float(student.ppf(0.95, freedom))
        verdict: Verdict = "fixed" if prior == 0 else "identified"
        if prior > 0 and std > IDENTIFIED * prior:
            verdict = "weak" if w.any() and std < WEAK * prior else "not_identified"
        ends = at - half, at + half
        if log_of is None:
            return Value(at, ends, std, verdict, unit)
        if far:
            verdict = "not_identified"
        best = log_of * float(np.exp(at))
        low, high = (log_of * float(np.exp(end)) for end in ends)
        return Value(best, (low, high), best * std, verdict, unit)

    shape = model.space.template.geometry
    radius, base = float(shape.wheel_radius), nominal_base(shape)
    firm = model.floors[model.firmest]
    far_radius = any(is_far(_radius_names(firm, j)) for j in range(shape.drives))
    far_base = is_far(_base_names(firm))
    steering = {
        "wheelbase_m": value(_base_names(firm), "m", base, far_base),
        "zero_rad": value(["zero"], "rad"),
        "gain": value(["gain"], "1"),
        "understeer": value(["understeer"], "s^2/m"),
    }
    return Calibration(
        sideways=shape.determines_twist,
        radius={
            f: tuple(
                value(_radius_names(f, j), "m", radius, far_radius) for j in range(shape.drives)
            )
            for f in model.floors
        },
        base={f: value(_base_names(f), "m", base, far_base) for f in model.floors},
        centre={f: value([f"centre.{f}"], "m") for f in model.floors if model.has_centre},
        offset=(value(["offset.x"], "m"), value(["offset.y"], "m")),
        yaw=value(["yaw"], "rad"),
        session_yaw={s: float(model.column(f"yaw@{s}", z)) for s in model.sessions},
        lag=value(["lag"], "s"),
        scale=value(["scale"], "1"),
        firmest=firm,
        steering={} if shape.driven is None else steering,
        gyro={} if rough else _gyro(fit.data, float(model.column("lag", z))),
        nominal_radius=radius,
        nominal_base=base,
        noise=_noise(fit),
        runs=len(fit.data),
    )


def _gyro(data: Runs, lag: float) -> dict[str, Value]:
    """Return scale and bias of the gyro; at their priors if headings change too little."""
    found = gyro_errors(data, lag)
    if found is None:
        return {}
    known = all(
        std < WEAK * prior
        for std, (_, prior, _) in zip(found[1], GYRO_PRIORS.values(), strict=True)
    )
    out = {}
    for (name, (mean, prior, unit)), at, std in zip(GYRO_PRIORS.items(), *found, strict=True):
        verdict: Verdict = "identified" if std < IDENTIFIED * prior else "weak"
        best, std, verdict = (at, std, verdict) if known else (mean, prior, "not_identified")
        half = float(std * student.ppf(0.95, LEAST_PARTS - 1))
        ends = float(best) - half, float(best) + half
        out[name] = Value(float(best), ends, float(std), verdict, unit)
    return out


def _noise(fit: _Fit) -> MotionNoise:
    std = np.exp(0.5 * fit.log_variance)
    floors = std[2:].reshape(-1, 2, 3)
    process, effect = (
        {f: (a, b, c) for f, (a, b, c) in zip(fit.model.floors, each.tolist(), strict=True)}
        for each in (floors[:, 0], floors[:, 1])
    )
    return MotionNoise(float(std[0]), float(std[1]), process, effect)
