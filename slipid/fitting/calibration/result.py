"""Calibrated kinematics and pose sensor of a robot: the numbers with their intervals.

Module `estimate` estimates them from runs with poses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from slipid.model.robot import Robot
from slipid.parameter import as_numbers
from slipid.support.content import Content

Verdict = Literal["identified", "weak", "not_identified", "fixed"]
IDENTIFIED, WEAK = 0.3, 0.8
"""Largest std(posterior) / std(prior) for the verdicts `identified` and `weak`."""
ABSURD = 3.0
"""Ratio of a calibrated length on the firmest floor to the config's, or its inverse, from which on
the length counts as not identified, on other floors as well: the logs and the config must then
contradict each other [1]. On a floor on which the wheels slip, such a ratio is natural."""
GYRO_PRIORS = {"gyro_scale": (1.0, 0.05, "1"), "gyro_bias_rad_s": (0.0, 0.02, "rad/s")}
"""Prior mean, prior std and unit of the true over the measured yaw rate, and of the gyro's bias."""


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
        yaw: heading of the pose sensor less that of the robot, mean over sessions [rad].
        session_yaw: deviation of the sensor's yaw from this mean in each session [rad].
        lag: lag of the poses behind the wheels [s].
        scale: true over logged length [1].
        firmest: floor with the largest radius, to which the centre and other radii refer.
        steering: numbers of a robot that steers, keyed as in identified.json; empty for others.
        gyro: scale and bias of the gyro, keyed as in identified.json; empty if no run has both a
            gyro and headings.
        nominal_radius, nominal_base: lengths of the config [m].
        noise: stds of poses and motion.
        runs: number of calibrated runs.
        settled: False if the numbers still changed in the last round of the calibration.
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
    settled: bool

    def __str__(self) -> str:
        return "\n".join(self.sentences)

    @property
    def sentences(self) -> tuple[str, ...]:
        """One line for each floor, and one for the pose sensor, for people."""
        lines = []
        for floor, radii in self.radius.items():
            each = ", ".join(f"{n} {_mm(v)}" for n, v in self.drives(radii).items())
            ratio = self.multipliers[floor][1]
            line = f"{floor}: wheel radius {each}; effective {self.length} {_mm(self.base[floor])}"
            line += f", {ratio:.3f} of nominal"
            if floor in self.centre and self.centre[floor].verdict != "fixed":
                line += f"; turns about a point {_mm(self.centre[floor])} ahead of the middle"
            lines.append(line)
        if self.steering:
            lines.append(self._of_steering())
        x, y = self.offset
        turned = _shown(self.yaw, f"{np.degrees(self.yaw.value):.2f} deg")
        late = _shown(self.lag, f"{1e3 * self.lag.value:.0f} ms")
        lines.append(
            f"pose sensor {_mm(x)} ahead and {_mm(y)} left of the middle, turned by {turned}; "
            f"poses are late by {late}"
        )
        return tuple(lines)

    def drives(self, of_drives: Sequence[Value]) -> dict[str, Value]:
        """Return numbers of the drives on a floor by their names; one for all of a steered robot.

        Radii of the drives of a robot that steers are equal.
        """
        if self.steering:
            return {"of all drives": of_drives[0]}
        two = len(of_drives) == 2
        names = ("left", "right") if two else [str(j + 1) for j in range(len(of_drives))]
        return dict(zip(names, of_drives, strict=True))

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

    def spread(self, floor: str) -> tuple[float, float, float]:
        """Return the std of motion along, across and in yaw per metre due to uncertain lengths.

        A radius changes the distance, radii and base change the yaw [m/m, m/m, rad/m].
        """
        base = self.base[floor]
        radius = max(v.std / v.value for v in self.radius[floor])
        return radius, 0.0, float(np.hypot(radius, base.std / base.value)) / base.value

    def seen(self, robot: Robot) -> Robot:
        """Return a robot whose poses are measured by the calibrated pose sensor.

        The sensor has a scale, but no tilt and no distortion: both were not calibrated.
        """
        none = as_numbers(np.zeros(2))
        deviations = [self.session_yaw.get(s, 0.0) for s in robot.camera.sessions]
        camera = replace(
            robot.camera,
            scale=as_numbers(self.scale.value),
            tilt=none,
            radial=as_numbers(0.0),
            tangential=none,
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
            "settled": self.settled,
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
        length = "track_m" if content["nominal"].get("base_m") is None else "base_m"
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
            gyro={n: value(content[n]) for n in GYRO_PRIORS if content.get(n) is not None},
            nominal_radius=content["nominal"]["wheel_radius_m"],
            nominal_base=content["nominal"][length],
            noise=MotionNoise(
                noise["place"], noise["heading"], stds(noise["process"]), stds(noise["effect"])
            ),
            runs=content["runs"],
            settled=content["settled"],
        )


def _mm(length: Value) -> str:
    """Return a length in mm with half the width of its interval, or the reason why it has none."""
    half = 500 * (length.interval90[1] - length.interval90[0])
    if length.verdict in ("not_identified", "fixed") or half <= 0:
        return _shown(length, f"{1e3 * length.value:.4g} mm")
    places = max(0, 1 - int(np.floor(np.log10(half))))
    return f"{1e3 * length.value:.{places}f} mm +- {half:.{places}f}"


def _shown(value: Value, text: str) -> str:
    """Return the text of a value, with a remark if the runs do not determine it."""
    return f"{text} (not identified)" if value.verdict == "not_identified" else text
