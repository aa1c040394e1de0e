"""The config of a robot and its logs: a TOML file checked once, every mistake with its key.

Units are part of the key names, and every key with a default is optional. The docstring of a
section explains its keys: `slipid reference` and `slipid new` print it.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from slipid.model import geometry as g
from slipid.model.geometry import Geometry
from slipid.support.toml_file import Section, checked, mapping_of, text_of

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Numbers = Number | list[Number]


class WheeledDrive(Section):
    """Keys of every robot.

    Attributes:
        wheel_radius_m: rolling radius of the wheels under the robot's weight.
        gear_ratio: motor turns per wheel turn.
        mass_kg: mass of the robot as it drives; friction scales with it.
        drives: wheels, counted from 1, that share a motor with its encoder and ammeter, in the
            order of the columns of the logs: [[1, 3], [2, 4]] turns the wheels of a side together.
            Without
                it
            each wheel has its own.
        motor: file that `slipid identify` or `slipid motor` wrote about its motor on a bench,
            relative to the config.
    """

    wheel_radius_m: Positive
    gear_ratio: Positive = 1.0
    mass_kg: Positive | None = None
    drives: list[Annotated[list[int], Field(min_length=1)]] | None = None
    motor: str | None = None

    def drive_of(self, wheels: int) -> tuple[int, ...]:
        """Return the number of each wheel's drive, from 0; empty where each has its own."""
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
    """Wheels on a circle, each driving 90 deg ahead of its azimuth.

    Attributes:
        base_radius_m: distance from the middle to the wheel centres.
        wheel_azimuths_deg: directions of the wheels from the middle, counter-clockwise from ahead,
            in the order of the columns of the logs.
        roller_angle_deg: angle from the rollers' free direction to the drive direction.
    """

    drive: Literal["omni"]
    base_radius_m: Positive
    wheel_azimuths_deg: list[Number] = Field(min_length=3)
    roller_angle_deg: Number = 90.0


class FourWheelDrive(WheeledDrive):
    """Four wheels, front left, front right, rear left, rear right: mecanum in X, or ordinary.

    Attributes:
        half_length_m: half the wheelbase, from the front axle to the rear one.
        half_width_m: half the track, between the middles of left and right wheels.
    """

    drive: Literal["mecanum", "skid"]
    half_length_m: Positive
    half_width_m: Positive


class DifferentialDrive(WheeledDrive):
    """Two ordinary wheels on an axle, left and right, and casters.

    Attributes:
        track_m: distance between the middles of the wheels.
    """

    drive: Literal["differential"]
    track_m: Positive


class GeneralDrive(WheeledDrive):
    """Any wheels: centres, drive directions, roller angles.

    Attributes:
        wheel_places_m: x (ahead) and y (left) of every wheel's centre, in the order of the columns.
        drive_directions_deg: direction in which each wheel rolls at a positive speed,
            counter-clockwise from ahead.
        roller_angles_deg: angle from each wheel's rollers to its drive direction; "none" is an
            ordinary wheel.
    """

    drive: Literal["general"]
    wheel_places_m: list[Annotated[list[Number], Field(min_length=2, max_length=2)]] = Field(
        min_length=2
    )
    drive_directions_deg: list[Number]
    roller_angles_deg: list[Number | Literal["none"]]

    @model_validator(mode="after")
    def _one_per_wheel(self) -> "GeneralDrive":
        wheels = len(self.wheel_places_m)
        for key in ("drive_directions_deg", "roller_angles_deg"):
            if (count := len(getattr(self, key))) != wheels:
                raise ValueError(f"{count} {key}; expected {wheels}, one per wheel_places_m")
        return self


class BenchMotors(Section):
    """No wheels: motors on a bench, logged at their shafts.

    Attributes:
        names: names of the motors in the order of the columns, where there are several.
    """

    drive: Literal["motor"]
    names: list[Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]] = Field(default_factory=list)


Wheels = OmniDrive | FourWheelDrive | DifferentialDrive | GeneralDrive


class LogsSection(Section):
    """Log files of one kind, found by a glob below the data folder.

    Attributes:
        glob: selects the files, below the data folder.
        format: one of the config's own layouts, or a preset.
        surface: name of the floor; "folder" takes the name of the folder that each file lies in.
        map: file of a floor map, relative to the config, instead of a surface: runs cross the
            floors it shows, and their poses are in its frame.
        load: name of the load set-up; each has its own wheel loads.
        session: runs with this in common share a session, in which the marker stays in place.
        session_name: instead of session: runs that belong together, of this section and of others
            with the same name, such as those of a day, or between two set-ups of the robot.
        min_rows: shorter runs are left out.
    """

    glob: str
    format: str
    surface: str = "folder"
    map: str | None = None
    load: str = "as_built"
    session: Literal["surface/load/speed", "folder", "file"] = "surface/load/speed"
    session_name: str | None = Field(default=None, min_length=1)
    min_rows: int = Field(default=2, ge=2)

    @model_validator(mode="after")
    def _one_floor_or_many(self) -> "LogsSection":
        if self.map is not None and self.surface != "folder":
            raise ValueError("surface and map at once; expected one of them")
        if self.session_name is not None and "session" in self.model_fields_set:
            raise ValueError("session and session_name at once; expected one of them")
        return self


class CameraSection(Section):
    """The camera that measured the pose.

    Attributes:
        image_centre_m: middle of the picture in the frame of the poses, where tilt and distortion
            are zero.
    """

    image_centre_m: tuple[Number, Number] = (0.0, 0.0)


class PriorSection(Section):
    """Gaussian prior, in SI around its mean.

    Attributes:
        mean: its centre, one number for all entries of a vector or one for each.
        std: its standard deviation, likewise.
    """

    mean: Numbers
    std: Positive | list[Positive]


class ParameterSection(Section):
    """Choice for the parameters that match a pattern.

    Attributes:
        start: start value [SI]; a number that is not fitted keeps it.
        fixed: value that the number keeps [SI].
        free: whether it is fitted.
        prior: knowledge about it from elsewhere.
    """

    start: Numbers | None = None
    fixed: Numbers | None = None
    free: bool | None = None
    prior: PriorSection | None = None

    @model_validator(mode="after")
    def _not_both(self) -> "ParameterSection":
        if self.fixed is not None and (self.prior is not None or self.free):
            raise ValueError("fixed and free or prior at once; expected one of them")
        return self


class WeightsSection(Section):
    """Known weight on the wheels in a load set-up.

    Either scales under each wheel give `kg`; or the set-up is `like` another one, with `mass_kg`
    more (or less) at `place_m`.

    Attributes:
        std_kg: standard deviation of each scale, or of the weight that the mass adds to each wheel.
        kg: reading of the scales under each wheel, in the order of the wheels.
        like: name of another load set-up.
        mass_kg: mass added to that one; negative where it was taken away.
        place_m: x (ahead) and y (left) of that mass, from the middle.
    """

    std_kg: Positive
    kg: list[Positive] | None = None
    like: str | None = None
    mass_kg: Number | None = None
    place_m: tuple[Number, Number] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "WeightsSection":
        added = (self.like, self.mass_kg, self.place_m)
        if self.kg is None and None in added:
            raise ValueError("expected kg, or like, mass_kg and place_m")
        if self.kg is not None and added != (None, None, None):
            raise ValueError("kg and like, mass_kg or place_m at once; expected one of both ways")
        return self


class FitSection(Section):
    """How finely runs are cut, how long to fit, and which lengths are trusted.

    Motion determines the ratio of wheel radius to pose scale, and neither of them alone.

    Attributes:
        lengths_from: the known lengths: "poses" in true metres, as those of motion capture, lidar
            and RTK are, make the wheel radius free; "wheels" that were measured make the scale of
            the camera free. Without it both are as `[parameters]` says.
        windows_per_piece: number of windows in a segment of a run.
        longest_window_s: longer windows become more segments.
        rounds: largest number of rounds.
        tolerance: the fit ends when no number changes by more than this part of its standard
            deviation.
        seed: seed of the draws behind the bands of the curves.
    """

    lengths_from: Literal["poses", "wheels"] | None = None
    windows_per_piece: int = Field(default=4, ge=1, le=32)
    longest_window_s: Positive = 6.0
    rounds: int = Field(default=30, ge=1)
    tolerance: Positive = 0.02
    seed: int = Field(default=0, ge=0)


class ValidateSection(Section):
    """Runs to predict where they differ from those that were fitted.

    Attributes:
        logs: sections as `[[logs]]`, for `slipid validate`.
    """

    logs: list[LogsSection] = Field(default_factory=list)


class SelftestSection(Section):
    """Plan and true values of a `selftest`, and the numbers that it must recover.

    Attributes:
        surfaces: names of the simulated floors.
        headings: number of directions in which runs are driven, evenly spread.
        speeds_m_s: speeds of the runs.
        turns: curved runs on each floor with each load set-up.
        distance_m: length of a run.
        truth: parameters by name, and their true value in the simulation.
        wanted: patterns of the parameters that must be recovered; otherwise all free ones.
    """

    surfaces: list[str] = Field(default=["firm", "soft"], min_length=1)
    headings: int = Field(default=12, ge=1, le=360)
    speeds_m_s: list[Positive] = Field(default=[0.1, 0.2], min_length=1)
    turns: int = Field(default=2, ge=0)
    distance_m: Positive = 0.7
    truth: dict[str, Numbers] = Field(default_factory=dict)
    wanted: list[str] | None = None


class ConfigContent(Section):
    """The whole file.

    Attributes:
        robot: its wheels.
        layouts: columns of your files and their channels, by names of your own.
        logs: one section for each set of log files.
        camera: the camera that measured the poses.
        parameters: choices for parameters, by patterns of their names.
        weights: known wheel loads, by load set-up.
        fit: size of the windows and length of the fit.
        selftest: plan that `slipid selftest` simulates where there are no logs.
        validate: runs to predict instead of those that were fitted.
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
        """The robot's wheels.

        Raises:
            ValueError: the config describes a motor on a bench.
        """
        if isinstance(self.robot, BenchMotors):
            raise ValueError("drive = 'motor' has no wheels on a floor")
        return self.robot

    @model_validator(mode="after")
    def _floors_one_by_one(self) -> "ConfigContent":
        for name, sections in (("logs", self.logs), ("validate.logs", self.validate_.logs)):
            if sections and not single_floor_sections(sections):
                raise ValueError(
                    f"{name}: every section has a map; expected one without, of runs on one floor"
                )
        return self


def single_floor_sections(sections: Sequence[LogsSection]) -> list[LogsSection]:
    """Return the sections whose runs stay on one floor each."""
    return [section for section in sections if section.map is None]


@dataclass(frozen=True)
class Config:
    """A checked config file; its text is kept beside the results.

    Attributes:
        path: where it was read.
        text: its text.
        content: its checked content.
    """

    path: Path
    text: str
    content: ConfigContent

    @property
    def hash(self) -> str:
        """Hash of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def read_config(path: Path) -> Config:
    """Return the config in a TOML file; errors as in `parsed`, also where it is unreadable."""
    return parsed(path, text_of(path))


def parsed(path: Path, text: str) -> Config:
    """Return the config in TOML text; raise `DataError` with every mistake on a line of its own."""
    return Config(path, text, checked(path, mapping_of(path, text), ConfigContent))


def geometry(robot: Wheels) -> Geometry:
    """Return the geometry of a `[robot]` section; raise `ValueError` where it cannot drive."""
    radius, gear = robot.wheel_radius_m, robot.gear_ratio
    if isinstance(robot, OmniDrive):
        azimuths, base = robot.wheel_azimuths_deg, robot.base_radius_m
        shared = robot.drive_of(len(azimuths))
        return g.omni(azimuths, base, radius, gear, robot.roller_angle_deg, shared)
    if isinstance(robot, FourWheelDrive):
        make = g.mecanum if robot.drive == "mecanum" else g.skid_steer
        return make(robot.half_length_m, robot.half_width_m, radius, gear, robot.drive_of(4))
    if isinstance(robot, DifferentialDrive):
        robot.drive_of(2)
        return g.differential(robot.track_m / 2, radius, gear)
    rollers = [None if a == "none" else float(a) for a in robot.roller_angles_deg]
    places, shared = robot.wheel_places_m, robot.drive_of(len(robot.wheel_places_m))
    return g.general(places, robot.drive_directions_deg, rollers, radius, gear, shared)
