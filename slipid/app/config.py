"""The config of a robot and its logs: a TOML file, checked when it is read.

Every error message names the key that is wrong. Units are part of the names of keys, and every key
with a default is optional. The docstring of a section explains its keys, and `slipid reference` and
`slipid new` print these explanations.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from slipid.infer.bench.rows import Between
from slipid.model import geometry as g
from slipid.model.geometry import Geometry
from slipid.support.errors import DataError, shown
from slipid.support.quantities import (
    Bounds,
    Coordinate,
    Degrees,
    GearRatio,
    InsidePath,
    Label,
    Length,
    Mass,
    Number,
    PathText,
    Positive,
    Seconds,
    Seed,
    Speed,
)
from slipid.support.toml_file import Section, checked, mapping_of, text_of

Numbers = Number | list[Number]
Place = Annotated[float, Bounds(-1e3, 1e3, "m")]
"""Coordinate of a place on a robot, from the middle of the robot [m]."""
MOST_WHEELS = 100
"""Largest number of wheels of one robot."""


class LimitsSection(Section):
    """Limits of the commands of a controller, in a table `[robot.limits]`.

    A limit that is not given is the highest value in the logs; `slipid check` prints it.

    Attributes:
        speed_m_s: largest translational speed that is demanded of the body.
        yaw_rate_rad_s: largest yaw rate that is demanded of the body.
        acceleration_m_s2: largest acceleration of the rim of a wheel.
        wheel_speed_rad_s: largest speed of a wheel.
        voltage_v: voltage of the supply.
    """

    speed_m_s: Annotated[float, Bounds(1e-4, 50, "m/s")] | None = None
    yaw_rate_rad_s: Annotated[float, Bounds(1e-4, 50, "rad/s")] | None = None
    acceleration_m_s2: Annotated[float, Bounds(1e-4, 100, "m/s^2")] | None = None
    wheel_speed_rad_s: Annotated[float, Bounds(1e-3, 1e3, "rad/s")] | None = None
    voltage_v: Annotated[float, Bounds(0.1, 1e3, "V")] | None = None


class SensorsSection(Section):
    """Noise of the robot's sensors, in a table `[robot.sensors]`.

    What is not given is taken from the logs while the wheels rest; `slipid check` prints it.

    Attributes:
        ammeter_std_a: standard deviation of the noise of a motor's current.
        voltmeter_std_v: standard deviation of the noise of a motor's voltage.
        gyro_std_rad_s: standard deviation of the noise of the gyro.
        gyro_bias_std_rad_s: standard deviation of the gyro's bias when the robot starts.
        stale_s: time without readings after which the estimator calls a wheel stale.
    """

    ammeter_std_a: Annotated[float, Bounds(1e-6, 100, "A")] | None = None
    voltmeter_std_v: Annotated[float, Bounds(1e-6, 100, "V")] | None = None
    gyro_std_rad_s: Annotated[float, Bounds(1e-8, 10, "rad/s")] | None = None
    gyro_bias_std_rad_s: Annotated[float, Bounds(1e-8, 10, "rad/s")] | None = None
    stale_s: Annotated[float, Bounds(1e-3, 60, "s")] | None = None


class ActuatorsSection(Section):
    """Response of the wheels to commands, in a table `[robot.actuators]`.

    Attributes:
        delay_s: time until a command reaches the wheels.
        lag_s: time constant with which the wheels then follow the command.
    """

    delay_s: Annotated[float, Bounds(0, 5, "s")] | None = None
    lag_s: Annotated[float, Bounds(0, 5, "s")] | None = None


class WheeledDrive(Section):
    """Keys that every robot on wheels has.

    Attributes:
        wheel_radius_m: rolling radius of the wheels under the robot's weight.
        gear_ratio: motor turns per wheel turn.
        mass_kg: mass of the robot as it drives; friction scales with it. With several load
            set-ups it is that of the first one in alphabetical order.
        drives: lists of wheels (counted from 1) that are driven by one motor with one encoder and
            one ammeter, in the order of the columns of the logs. With [[1, 3], [2, 4]], one motor
            drives both left wheels and one both right wheels. By default, each wheel has a motor.
        motor: result of `slipid identify` or `slipid motor` for the robot's motor on a test bench;
            its path is relative to the config. Intervals of resistance, back-EMF, brush drop and
            friction that are identified or weak there become priors.
        limits: limits of the commands of a controller.
        sensors: noise of the robot's sensors.
        actuators: response of the wheels to commands.
    """

    wheel_radius_m: Length
    gear_ratio: GearRatio = 1.0
    mass_kg: Mass | None = None
    drives: list[Annotated[list[int], Field(min_length=1)]] | None = None
    motor: PathText | None = None
    limits: LimitsSection = LimitsSection()
    sensors: SensorsSection = SensorsSection()
    actuators: ActuatorsSection = ActuatorsSection()

    def drive_of(self, wheels: int) -> tuple[int, ...]:
        """Return the index of each wheel's drive, or an empty tuple if no wheels share a drive."""
        if self.drives is None:
            return ()
        turned = [wheel for drive in self.drives for wheel in drive]
        if sorted(turned) != list(range(1, wheels + 1)):
            raise ValueError(
                f"drives {self.drives}; expected each of the wheels 1 to {wheels} once"
            )
        return tuple(
            k for wheel in range(1, wheels + 1) for k, d in enumerate(self.drives) if wheel in d
        )


class OmniDrive(WheeledDrive):
    """Omnidirectional wheels on a circle around the middle, each driving along the circle.

    Attributes:
        base_radius_m: distance from the middle of the robot to the wheel centres.
        wheel_azimuths_deg: directions from the middle to the wheels, counter-clockwise from
            straight ahead, in the order of the columns of the logs. A wheel drives 90 deg
            counter-clockwise of this direction.
        roller_angle_deg: angle from the direction in which the rollers roll freely to the drive
            direction.
    """

    drive: Literal["omni"]
    base_radius_m: Length
    wheel_azimuths_deg: list[Degrees] = Field(min_length=3, max_length=MOST_WHEELS)
    roller_angle_deg: Degrees = 90.0


class FourWheelDrive(WheeledDrive):
    """Four wheels in the order front left, front right, rear left, rear right.

    They are mecanum wheels, whose rollers form an X seen from above, or ordinary wheels (skid
    steering).

    Attributes:
        half_length_m: half the distance between the front axle and the rear axle.
        half_width_m: half the distance between the middles of the left and right wheels.
    """

    drive: Literal["mecanum", "skid"]
    half_length_m: Length
    half_width_m: Length


class DifferentialDrive(WheeledDrive):
    """Two ordinary wheels on one axle, left and right; casters carry the rest of the weight.

    Attributes:
        track_m: distance between the middles of the two wheels.
    """

    drive: Literal["differential"]
    track_m: Length


class SteeredDrive(WheeledDrive):
    """Wheels that are steered: bicycle, tricycle or car (Ackermann); x counts from the rear axle.

    The logs need the channel `steering_angle`. Such a robot is calibrated, but has no force
    balance.

    Attributes:
        wheelbase_m: distance between the rear axle and the steered front axle.
        driven: axle whose wheels have the encoders, "rear" or "front".
        encoders: number of encoders on this axle, of which the mean counts.
    """

    drive: Literal["steered"]
    wheelbase_m: Length
    driven: Literal["rear", "front"] = "rear"
    encoders: Literal[1, 2] = 1

    @model_validator(mode="after")
    def _one_axle(self) -> "SteeredDrive":
        if self.drives is not None:
            raise ValueError("drives is given; expected encoders = 1 or 2 on the driven axle")
        return self


class GeneralDrive(WheeledDrive):
    """Any arrangement of wheels, described by their centres, drive directions and roller angles.

    Attributes:
        wheel_places_m: x (ahead) and y (left) of every wheel's centre, in the order of the columns
            of the logs.
        drive_directions_deg: direction in which each wheel rolls at a positive speed,
            counter-clockwise from straight ahead.
        roller_angles_deg: angle from the direction in which each wheel's rollers roll freely to its
            drive direction; "none" for an ordinary wheel.
    """

    drive: Literal["general"]
    wheel_places_m: list[Annotated[list[Place], Field(min_length=2, max_length=2)]] = Field(
        min_length=2, max_length=MOST_WHEELS
    )
    drive_directions_deg: list[Degrees]
    roller_angles_deg: list[Degrees | Literal["none"]]

    @model_validator(mode="after")
    def _one_per_wheel(self) -> "GeneralDrive":
        wheels = len(self.wheel_places_m)
        for key in ("drive_directions_deg", "roller_angles_deg"):
            if (count := len(getattr(self, key))) != wheels:
                raise ValueError(f"{count} {key}; expected {wheels}, one per wheel_places_m")
        return self


class BenchMotors(Section):
    """Motors on a test bench, without wheels, logged at their shafts.

    Attributes:
        names: names of the motors in the order of the columns of the logs, if there are several.
        voltage_between_rows: form of the voltage between the rows of a log: "held" until the next
            row, "straight" from row to row, or "jumps" for a straight one that jumps between rows.
            By default the likeliest.
    """

    drive: Literal["motor"]
    names: list[Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]] = Field(default_factory=list)
    voltage_between_rows: Between | None = None


Wheels = OmniDrive | FourWheelDrive | DifferentialDrive | SteeredDrive | GeneralDrive


class LogsSection(Section):
    """A set of log files that have the same layout.

    Attributes:
        glob: pattern of the paths of the files, relative to the data folder, such as `runs/*.csv`.
        format: name of the layout of the files: one defined in this config, or a preset.
        surface: name of the floor; "folder" stands for the name of the folder that contains the
            file.
        map: file of a floor map, relative to the config; it replaces `surface` if runs drive over
            several floors. The poses of the logs must be in the frame of the map.
        load: name of the load set-up; the wheel loads are fitted separately for each set-up.
        session: the property that runs of the same session have in common. Within a session the
            marker or pose sensor stays in the same place on the robot.
        session_name: name of the session of all runs of this section, instead of `session`;
            sections with the same name share a session. Example: all runs of one day.
        min_rows: runs with fewer rows are left out.
        end_poses: table of poses at the ends of runs, measured by hand, for logs without poses; its
            path is relative to the data folder. Its columns are run (path of the log relative to
            the data folder), x_m, y_m and heading_deg (counting full turns) at the end, and
            start_x_m, start_y_m and start_heading_deg, 0 if absent; cells may be empty. Such runs
            calibrate the kinematics alone.
    """

    glob: InsidePath
    format: Label
    surface: Label = "folder"
    map: PathText | None = None
    load: Label = "as_built"
    session: Literal["surface/load/speed", "folder", "file"] = "surface/load/speed"
    session_name: Label | None = None
    min_rows: Annotated[int, Bounds(2, 10**9)] = 2
    end_poses: InsidePath | None = None

    @model_validator(mode="after")
    def _one_floor_or_many(self) -> "LogsSection":
        if self.map is not None and self.surface != "folder":
            raise ValueError("both surface and map are given; expected only one of them")
        if self.session_name is not None and "session" in self.model_fields_set:
            raise ValueError("both session and session_name are given; expected only one of them")
        return self


class CameraSection(Section):
    """The camera, or another sensor, that measured the poses.

    Attributes:
        image_centre_m: position of the middle of the picture in the frame of the poses; there the
            errors due to tilt and distortion are zero.
    """

    image_centre_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)


class PriorSection(Section):
    """Gaussian prior of a parameter, in SI units.

    Attributes:
        mean: mean of the prior: one number for all entries of a vector, or one number per entry.
        std: standard deviation of the prior: one number, or one number per entry.
    """

    mean: Numbers
    std: Positive | list[Positive]


class ParameterSection(Section):
    """Settings for all parameters whose names match a pattern.

    Attributes:
        start: start value of the fit [SI]; a parameter that is not fitted keeps this value.
        fixed: value at which the parameter is held during the fit [SI].
        free: true to fit the parameter, false to keep it at its start value.
        prior: prior from other measurements or from a data sheet; it makes the parameter free.
    """

    start: Numbers | None = None
    fixed: Numbers | None = None
    free: bool | None = None
    prior: PriorSection | None = None

    @model_validator(mode="after")
    def _not_both(self) -> "ParameterSection":
        if self.fixed is not None and (self.prior is not None or self.free):
            raise ValueError(
                "fixed is given together with free or prior; expected only one of them"
            )
        return self


class WeightsSection(Section):
    """Known weights on the wheels in a load set-up.

    Give either the readings of scales under each wheel (`kg`), or the difference from another
    set-up: `like`, `mass_kg` and `place_m`.

    Attributes:
        std_kg: standard deviation of each scale reading, or of the weight that the added mass puts
            on each wheel.
        kg: reading of the scale under each wheel, in the order of the wheels.
        like: name of the load set-up from which this one differs.
        mass_kg: mass that was added to the other set-up; negative if it was removed.
        place_m: x (ahead) and y (left) of that mass, measured from the middle of the robot.
    """

    std_kg: Mass
    kg: list[Mass] | None = None
    like: Label | None = None
    mass_kg: Annotated[float, Bounds(-1e7, 1e7, "kg")] | None = None
    place_m: tuple[Place, Place] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "WeightsSection":
        added = (self.like, self.mass_kg, self.place_m)
        if self.kg is None and None in added:
            raise ValueError("expected kg, or like, mass_kg and place_m")
        if self.kg is not None and added != (None, None, None):
            raise ValueError(
                "kg is given together with like, mass_kg or place_m; expected either kg or the "
                "other three"
            )
        return self


class FitSection(Section):
    """Division of the runs into windows, end of the fit, and known lengths.

    The motion of a robot determines only the ratio of wheel radius to pose scale, so one of the two
    must be known.

    Attributes:
        lengths_from: the lengths that are known: "poses" if the poses are in true metres, as from
            motion capture, lidar or RTK (the wheel radius is then fitted); "wheels" if the wheel
            radius was measured (the scale of the camera is then fitted). By default `[parameters]`
            decides which of the two is fitted.
        windows_per_piece: number of neighbouring windows in a segment, which the fit treats as one
            observation.
        longest_window_s: longest duration of a window; if windows would be longer, a run gets more
            segments. By default as long as the wheels keep nearly constant speeds, .75 to 6 s.
        rounds: largest number of rounds of the fit; each optimises the parameters and then the
            noise variances.
        tolerance: the fit ends when no parameter changes by more than this fraction of its standard
            deviation in a round.
        intervals: "sampled" if a short chain of the posterior replaces intervals of the Laplace
            approximation that it contradicts; "laplace" for the approximation alone, which takes
            less time.
        seed: seed of the short chain and of the draws from which the uncertainty bands of curves
            are computed.
    """

    lengths_from: Literal["poses", "wheels"] | None = None
    windows_per_piece: Annotated[int, Bounds(1, 32)] = 4
    longest_window_s: Seconds | None = None
    rounds: Annotated[int, Bounds(1, 10_000)] = 30
    tolerance: Annotated[float, Bounds(1e-15, 10)] = 0.02
    intervals: Literal["sampled", "laplace"] = "sampled"
    seed: Seed = 0


class ValidateSection(Section):
    """Runs that `slipid validate` predicts, if they are not the fitted ones.

    Attributes:
        logs: sections with the keys of `[[logs]]`.
    """

    logs: list[LogsSection] = Field(default_factory=list)


class SelftestSection(Section):
    """Simulated runs of `slipid selftest`, and the parameters that it must recover.

    Attributes:
        surfaces: names of the simulated floors.
        headings: number of evenly spread directions in which straight runs are driven.
        speeds_m_s: speeds of the runs.
        turns: number of curved runs on each floor with each load set-up.
        distance_m: length of a run.
        truth: true values of parameters in the simulation, keyed by the name of the parameter.
        wanted: patterns of the names of the parameters that must be recovered; by default all free
            parameters.
    """

    surfaces: list[Label] = Field(default=["firm", "soft"], min_length=1)
    headings: Annotated[int, Bounds(1, 360)] = 12
    speeds_m_s: list[Speed] = Field(default=[0.1, 0.2], min_length=1)
    turns: Annotated[int, Bounds(0, 1000)] = 2
    distance_m: Annotated[float, Bounds(1e-3, 1e4, "m")] = 0.7
    truth: dict[str, Numbers] = Field(default_factory=dict)
    wanted: list[Label] | None = None


class ConfigContent(Section):
    """Tables of the config.

    Attributes:
        robot: wheels, gear and mass of the robot.
        layouts: layouts of your log files, by names that you choose: the meaning and unit of each
            column.
        logs: one section for each set of log files with the same layout, floor and load.
        camera: the camera, or another sensor, that measured the poses.
        parameters: start values, fixed values and priors of parameters, by patterns of their names.
        weights: known weights on the wheels, keyed by the name of the load set-up.
        fit: division of the runs into windows, end of the fit, and known lengths.
        selftest: runs that `slipid selftest` simulates if it is given no logs.
        validate: runs that `slipid validate` predicts instead of the fitted ones.
    """

    robot: Annotated[Wheels | BenchMotors, Field(discriminator="drive")]
    layouts: dict[str, dict[str, object]] = Field(default_factory=dict)
    logs: list[LogsSection] = Field(min_length=1)
    camera: CameraSection = CameraSection()
    parameters: dict[str, ParameterSection] = Field(default_factory=dict)
    weights: dict[str, WeightsSection] = Field(default_factory=dict)
    fit: FitSection = FitSection()
    selftest: SelftestSection = SelftestSection()
    validate_: ValidateSection = Field(default_factory=ValidateSection, alias="validate")

    @property
    def wheels(self) -> Wheels:
        """The robot section, if it describes wheels.

        Raises:
            ValueError: the config describes a motor on a bench.
        """
        if isinstance(self.robot, BenchMotors):
            raise ValueError("drive = 'motor' describes motors on a bench, not wheels on a floor")
        return self.robot

    @model_validator(mode="after")
    def _floors_one_by_one(self) -> "ConfigContent":
        for name, sections in (("logs", self.logs), ("validate.logs", self.validate_.logs)):
            if sections and not single_floor_sections(sections):
                raise ValueError(
                    f"{name}: every section has a map; expected at least one section without a "
                    "map, whose runs stay on one floor"
                )
        return self


def single_floor_sections(sections: Sequence[LogsSection]) -> list[LogsSection]:
    """Return the sections in which every run stays on a single floor."""
    return [section for section in sections if section.map is None]


@dataclass(frozen=True)
class Config:
    """Checked content of a config file, with its text, which is copied into result folders.

    Attributes:
        path: path of the file.
        text: text of the file.
        content: checked content of the file.
    """

    path: Path
    text: str
    content: ConfigContent

    @property
    def hash(self) -> str:
        """SHA-256 hash of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def read_config(path: Path) -> Config:
    """Return the config in a TOML file; raise `DataError` if it is unreadable or wrong."""
    return parsed(path, text_of(path))


def parsed(path: Path, text: str) -> Config:
    """Return the config in TOML text; raise `DataError` that lists all mistakes, one per line."""
    return Config(path, text, checked(path, mapping_of(path, text), ConfigContent))


SETTINGS = {
    "limits.speed_m_s": "limits.speed",
    "limits.yaw_rate_rad_s": "limits.yaw_rate",
    "limits.acceleration_m_s2": "limits.acceleration",
    "limits.wheel_speed_rad_s": "limits.wheel_speed",
    "limits.voltage_v": "limits.voltage",
    "sensors.ammeter_std_a": "sensors.ammeter_std_a",
    "sensors.voltmeter_std_v": "sensors.voltmeter_std_v",
    "sensors.gyro_std_rad_s": "sensors.gyro_std",
    "sensors.gyro_bias_std_rad_s": "sensors.gyro_bias_std",
    "sensors.stale_s": "sensors.stale_s",
    "actuators.delay_s": "actuators.delay_s",
    "actuators.lag_s": "actuators.lag_s",
}
"""Path in robot.json of each key in the tables `[robot.limits]`, `[robot.sensors]` and
`[robot.actuators]`."""


def given_settings(robot: Wheels) -> dict[str, float]:
    """Return the limits, noise and delays in a `[robot]` section, keyed by path in robot.json."""
    given = {key: getattr(getattr(robot, key.split(".")[0]), key.split(".")[1]) for key in SETTINGS}
    return {SETTINGS[key]: value for key, value in given.items() if value is not None}


def geometry(robot: Wheels) -> Geometry:
    """Return the geometry of a `[robot]` section; raise `ValueError` if it is impossible."""
    radius, gear = robot.wheel_radius_m, robot.gear_ratio
    if isinstance(robot, OmniDrive):
        azimuths, base = robot.wheel_azimuths_deg, robot.base_radius_m
        if len({round(azimuth % 360, 3) % 360 for azimuth in azimuths}) < 3:
            raise ValueError(
                f"wheel azimuths {shown(azimuths)} deg, with which the wheels do not drive in all "
                "directions; expected at least three different ones"
            )
        shared = robot.drive_of(len(azimuths))
        return g.omni(azimuths, base, radius, gear, robot.roller_angle_deg, shared)
    if isinstance(robot, FourWheelDrive):
        make = g.mecanum if robot.drive == "mecanum" else g.skid_steer
        return make(robot.half_length_m, robot.half_width_m, radius, gear, robot.drive_of(4))
    if isinstance(robot, DifferentialDrive):
        robot.drive_of(2)
        return g.differential(robot.track_m / 2, radius, gear)
    if isinstance(robot, SteeredDrive):
        return g.steered(robot.wheelbase_m, radius, gear, robot.driven, robot.encoders)
    rollers = [None if a == "none" else float(a) for a in robot.roller_angles_deg]
    places, shared = robot.wheel_places_m, robot.drive_of(len(robot.wheel_places_m))
    return g.general(places, robot.drive_directions_deg, rollers, radius, gear, shared)


def shape_of(config: Config) -> Geometry:
    """Return the geometry of a config's robot; raise `DataError` if such a robot cannot drive."""
    try:
        return geometry(config.content.wheels)
    except ValueError as error:
        raise DataError(f"{config.path}: robot: {error}") from error
