"""An identified robot as plain values: every parameter with its uncertainty and its origin.

Field names are the keys of robot.json. Units of fields are listed in `UNITS`; each parameter in
`RobotRecord.parameters` has its own field `unit`.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from slipid.model.robot import Validity
from slipid.support.files import checksum

Numbers = float | tuple[float, ...]
"""A single number, or one number per wheel or drive."""
Pair = tuple[float, float]
Axes = tuple[float, float, float]
"""Values along, across and in yaw."""
Rows = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Rows (ahead, to the left, yaw) of a matrix from the drives' wheel speeds to the body twist."""
Source = Literal["laplace", "short_chain", "posterior", "given"]
Verdict = Literal["identified", "weak", "disputed", "not_identified", "at_bound", "fixed"]
Provenance = Literal["measured", "borrowed", "override"]
Basis = Literal["config", "logs", "assumed"]
"""Origin of a setting: the user's config, the logs, or nothing that belongs to the robot."""
UNITS = {
    "wheels.place": "base radius",
    "wheels.drive_angle": "rad",
    "wheels.roller_angle": "rad",
    "wheels.gear_ratio": "1",
    "floors.process": "m/sqrt(m), m/sqrt(m), rad/sqrt(m)",
    "floors.effect": "m/m, m/m, rad/m",
    "floors.kinematics": "m/rad, m/rad, rad/rad",
    "floors.calibration": "m/rad, m/rad, rad/rad",
    "floors.wheelbase": "m",
    "floors.current_std": "A",
    "floors.seen.wheel_speed": "rad/s",
    "floors.seen.torque_nm": "N*m",
    "floors.seen.slip": "1",
    "floors.seen.yaw_rate": "rad/s",
    "floors.seen.headings_deg": "deg",
    "floors.seen.speeds": "m/s",
    "floors.seen.turn_rates": "rad/s",
    "floors.seen.distance": "m",
    "loads.spread": "m/m, m/m, rad/m",
    "loads.told.speeds": "m/s",
    "loads.told.mean": "m/m, m/m, rad/m",
    "loads.told.left": "m/m, m/m, rad/m",
    "loads.highest_current": "A",
    "loads.wheel_curve": "1, 1/A",
    "loads.inverse_kinematics": "rad/m, rad/m, 1",
    "current_trend": "A, A*s/m",
    "highest_speed": "rad/s",
    "nominal": "m/rad, m/rad, rad/rad",
    "steering.zero": "rad",
    "steering.gain": "1",
    "steering.understeer": "s^2/m",
    "limits.speed": "m/s",
    "limits.yaw_rate": "rad/s",
    "limits.acceleration": "m/s^2",
    "limits.wheel_speed": "rad/s",
    "limits.voltage": "V",
    "sensors.ammeter_std_a": "A",
    "sensors.voltmeter_std_v": "V",
    "sensors.gyro_std": "rad/s",
    "sensors.gyro_bias_std": "rad/s",
    "sensors.stale_s": "s",
    "actuators.delay_s": "s",
    "actuators.lag_s": "s",
}
"""Units of the fields of robot.json, keyed by the field's path without indices."""


@dataclass(frozen=True)
class RecordedNumber:
    """A parameter of the robot with its uncertainty and origin, as in identified.json.

    The defaults describe a parameter that was given, not fitted.

    Attributes:
        value: value [unit].
        unit: unit of the value.
        std: posterior std [unit]; None for a fixed parameter.
        interval90: equal-tailed 90 % interval [unit]; None for a fixed parameter.
        verdict: verdict on how well the logs determine the value.
        provenance: source of the value: "measured" (the logs), "borrowed" (a prior) or "override"
            (an explicit choice).
        source: method by which std and interval were computed.
    """

    value: Numbers
    unit: str
    std: Numbers | None = None
    interval90: Pair | tuple[Pair, ...] | None = None
    verdict: Verdict = "fixed"
    provenance: Provenance = "override"
    source: Source = "given"


def plain(value: np.ndarray) -> Numbers:
    """Convert an array to a float if it has one element, else to a tuple of floats."""
    return float(value.reshape(())) if value.size == 1 else tuple(float(v) for v in value)


def rows_of(matrix: np.ndarray) -> Rows:
    """Convert a matrix with three rows to tuples of floats."""
    ahead, left, yaw = (tuple(float(x) for x in row) for row in matrix)
    return ahead, left, yaw


def axes_of(row: Iterable[float] | np.ndarray) -> Axes:
    """Convert three numbers (along, across, yaw) to a tuple of floats."""
    along, across, yaw = (float(x) for x in row)
    return along, across, yaw


@dataclass(frozen=True)
class Wheels:
    """Arrangement of the wheels, with attributes of `slipid.model.geometry.Geometry`."""

    place: tuple[Pair, ...]
    drive_angle: tuple[float, ...]
    roller_angle: tuple[float, ...]
    grips: tuple[bool, ...]
    drive_of: tuple[int, ...]
    gear_ratio: float
    driven: str | None = None


@dataclass(frozen=True)
class SteeringRecord:
    """Steering of a robot that steers, see `slipid.model.kinematics.Steering`."""

    zero: float
    gain: float
    understeer: float


@dataclass(frozen=True)
class FloorRecord:
    """Errors of the model on a floor, as stds.

    Attributes:
        name: name of the floor.
        process: std of motion errors that grow with the root of the path length.
        effect: std of effects, motion errors that stay the same over the path.
        current_std: std of measured less modelled currents, without the ammeters' noise.
        seen: ranges of speed, torque and so on that the fitted runs cover; None if the parameters
            were given, not fitted.
        unseen: True for a floor that no run drove on, see `slipid.robot.deployed.with_unseen`.
        kinematics: rows of the matrix from the drives' wheel speeds to the body twist, where
            calibrated kinematics were selected for all wheels on this floor; None where the force
            balance is used.
        calibration: rows of the same matrix by the calibration of the wheels, whether it was
            selected or not; None without a calibration.
        wheelbase: effective wheelbase of a robot that steers; None for others.
    """

    name: str
    process: Axes
    effect: Axes
    current_std: float
    seen: Validity | None
    unseen: bool = False
    kinematics: Rows | None = None
    calibration: Rows | None = None
    wheelbase: float | None = None


@dataclass(frozen=True)
class EffectRecord:
    """Effect table of a load set-up: effects estimated from the fitted runs.

    Its arrays are indexed by floor, speed and direction of travel. The direction is relative to the
    body; directions are evenly spaced counter-clockwise from straight ahead.

    Attributes:
        speeds: speeds of the rows, rising.
        mean: estimated effect, to be added to the motion that the model predicts.
        left: std of the effect that remains after `mean` is added; it includes the uncertainty of
            the robot's parameters.
    """

    speeds: tuple[float, ...]
    mean: tuple[tuple[tuple[Axes, ...], ...], ...]
    left: tuple[tuple[tuple[Axes, ...], ...], ...]


@dataclass(frozen=True)
class LoadRecord:
    """Quantities that depend on the load set-up.

    Attributes:
        name: name of the load set-up.
        spread: for each floor, std of the motion per metre that is due to uncertain parameters.
        told: effect table of this load set-up; None if the robot was not fitted to runs.
        highest_current: largest current that the model predicts at up to 0.8 of the highest wheel
            speed.
        wheel_curve: a and b of the slip ratio a + b |I| of each drive at a current I, fitted over
            all floors.
        inverse_kinematics: for each floor, rows of the matrix from a body twist to the drives'
            wheel speeds that the force balance needs for it, linearised; None for a robot without a
            force balance, and in files of older versions.
    """

    name: str
    spread: tuple[Axes, ...]
    told: EffectRecord | None
    highest_current: float
    wheel_curve: tuple[Pair, ...]
    inverse_kinematics: tuple[tuple[Axes, ...], ...] | None = None

    def on(self, rows: tuple[int, ...]) -> "LoadRecord":
        """Return the record with only the floors whose indices are `rows`."""
        spread, inverse = tuple(self.spread[k] for k in rows), self.inverse_kinematics
        inverse = None if inverse is None else tuple(inverse[k] for k in rows)
        kept = replace(self, spread=spread, inverse_kinematics=inverse)
        if self.told is None:
            return kept
        mean, left = (tuple(x[k] for k in rows) for x in (self.told.mean, self.told.left))
        return replace(kept, told=replace(self.told, mean=mean, left=left))


@dataclass(frozen=True)
class Setting:
    """A limit, or a property of a sensor or an actuator, with its origin."""

    value: float
    provenance: Basis = "assumed"


@dataclass(frozen=True)
class LimitsRecord:
    """Limits of commands, see `slipid.robot.limits.Limits`."""

    speed: Setting
    yaw_rate: Setting
    acceleration: Setting
    wheel_speed: Setting
    voltage: Setting


@dataclass(frozen=True)
class LogSensors:
    """Sensors of the logs, on which the estimator relies by default.

    Attributes:
        current_is_signed: True if logged currents have signs.
        voltage: True if voltages are logged.
        gyro: True if yaw rates of a gyro are logged.
        ammeter_std_a: std of an ammeter's noise.
        voltmeter_std_v: std of a voltmeter's noise.
        gyro_std: std of the gyro's noise.
        gyro_bias_std: std of the gyro's bias at the start.
        stale_s: time without readings after which a wheel counts as stale.
    """

    current_is_signed: bool = False
    voltage: bool = False
    gyro: bool = False
    ammeter_std_a: Setting = Setting(0.07)
    voltmeter_std_v: Setting = Setting(0.06)
    gyro_std: Setting = Setting(0.004)
    gyro_bias_std: Setting = Setting(0.01)
    stale_s: Setting = Setting(0.3)


@dataclass(frozen=True)
class ActuatorRecord:
    """Response of the wheels to commands.

    Attributes:
        delay_s: time until a command reaches the wheels; None if unknown.
        lag_s: time constant with which the wheels then follow it; None if unknown.
    """

    delay_s: Setting | None = None
    lag_s: Setting | None = None

    @property
    def response_s(self) -> float | None:
        """Delay and lag together [s]; None if one of them is unknown."""
        if self.delay_s is None or self.lag_s is None:
            return None
        return self.delay_s.value + self.lag_s.value


@dataclass(frozen=True, eq=False, kw_only=True)
class RobotRecord:
    """Content of robot.json. Two records with the same content are equal.

    Attributes:
        source: method that the parameters come from.
        wheels: arrangement of the wheels.
        parameters: parameters of the robot, keyed by path such as `robot.mass`.
        floors: floors, in the order of all arrays with an element per floor.
        loads: load set-ups, the default one first.
        current_trend: a and b of the excess a + b v of measured over modelled currents at a body
            speed v.
        highest_speed: highest wheel speed of the fitted runs.
        nominal: rows of the matrix from the drives' wheel speeds to the body twist with the lengths
            of the config and without slip; None if they are those of the parameters.
        limits: limits of commands.
        sensors: sensors of the logs.
        actuators: response of the wheels to commands.
        alike: decrease of the log probability of a hypothesis for each further floor under the
            robot; it is smaller if the fit used runs over several floors.
        messages: messages for users of the parameters.
        data: hash of the runs; None if the parameters were given, not fitted.
        versions: versions of the software that computed the parameters.
        draws: posterior draws of the fitted parameters, keyed by path.
        steering: steering of a robot that steers; None for others.
    """

    source: Source = "given"
    wheels: Wheels
    parameters: Mapping[str, RecordedNumber]
    floors: tuple[FloorRecord, ...]
    loads: tuple[LoadRecord, ...]
    current_trend: Pair
    highest_speed: float
    limits: LimitsRecord
    nominal: Rows | None = None
    sensors: LogSensors = LogSensors()
    actuators: ActuatorRecord = ActuatorRecord()
    alike: float = 3.0
    messages: tuple[str, ...] = ()
    data: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    draws: Mapping[str, tuple[Numbers, ...]]
    steering: SteeringRecord | None = None

    @cached_property
    def numbers(self) -> str:
        """Hash of the robot's parameters; it does not depend on versions and messages."""
        return checksum(asdict(replace(self, versions={}, messages=())))

    @cached_property
    def _mark(self) -> str:
        return checksum(asdict(self))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, RobotRecord) and self._mark == other._mark)

    def __hash__(self) -> int:
        return hash(self._mark)

    @property
    def drawn(self) -> int:
        """Number of posterior draws."""
        return len(next(iter(self.draws.values()), ()))

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the floors."""
        return tuple(floor.name for floor in self.floors)

    def load_index(self, name: str | None) -> int:
        """Return the index of a load set-up in `loads`, 0 by default.

        Raises:
            ValueError: there is no load set-up of this name; the message lists the existing ones.
        """
        names = [load.name for load in self.loads]
        if name not in (None, *names):
            raise ValueError(f"no load set-up '{name}'; identified: {', '.join(names)}")
        return 0 if name is None else names.index(name)

    def on(self, rows: tuple[int, ...]) -> "RobotRecord":
        """Return the record with only the floors whose indices are `rows`."""
        floors = tuple(self.floors[k] for k in rows)
        kept = tuple(f"surface.{floor.name}." for floor in floors)

        def stays(path: str) -> bool:
            return not path.startswith("surface.") or path.startswith(kept)

        return replace(
            self,
            floors=floors,
            loads=tuple(load.on(rows) for load in self.loads),
            parameters={path: n for path, n in self.parameters.items() if stays(path)},
            draws={path: n for path, n in self.draws.items() if stays(path)},
        )
