"""Description of the test site that is the same for all runs: robot, sensors, camera, surfaces."""

from collections.abc import Mapping
from dataclasses import asdict, field
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from slipid.lab.testsite.motors import MotorBuild, SpeedLoop
from slipid.lab.testsite.omni_build import OmniBuild
from slipid.lab.testsite.ordinary_build import OrdinaryBuild
from slipid.lab.testsite.surfaces import SURFACES, SurfacePhysics
from slipid.support.content import Content
from slipid.support.quantities import Bounds, Coordinate, Seconds
from slipid.support.toml_file import CLOSED

Interval = Annotated[float, Bounds(1e-3, 1, "s")]
"""Time between successive readings or frames [s]."""
Tilt = Annotated[float, Bounds(-10, 10, "deg")]
"""Tilt of the camera about one axis [deg]."""
Pixels = Annotated[int, Bounds(16, 10_000)]
"""Width or height of an image [pixel]."""
Part = Annotated[float, Field(ge=0, lt=1, strict=True)]
"""Fraction of a whole, at least 0 and below 1 [1]."""
Distortion = Annotated[float, Bounds(-10, 10)]
"""Coefficient of OpenCV's lens model [1]."""


@dataclass(frozen=True, config=CLOSED)
class SiteSensors:
    """Errors of the logged sensors.

    Attributes:
        row_s, row_jitter: mean time between rows [s], and largest relative deviation from it [1].
        current_step_a, current_noise_a: quantisation step of currents, and std of their noise [A].
        current_is_signed: True if currents have a sign; most robots log magnitudes.
        speed_step, speed_gain: quantum of the reported motor speed [rad/s], and reported over true
            speed [1].
        voltage, duty, bus_voltage, gyro: True if this channel is logged.
        voltage_step_v, voltage_noise_v: quantisation step of voltages, and std of their noise [V].
        gyro_noise, gyro_bias: std of the noise in each row, and of the bias of each run [rad/s].
        average_s: time over which currents and voltages are averaged before they are sampled [s].
        frame_s, lag_s: time between camera frames, and mean age of a new pose when logged [s].
        camera_scale: true length over logged length; 1.117 for the camera of the 2022 logs.
        camera_noise_m, camera_noise_rad: std of the noise of position [m] and heading [rad] in each
            frame.
        dropout: fraction of the frames that are lost.
        outlier, outlier_m: fraction of frames with a wrong position, and std of their error [m].
    """

    row_s: Interval = 0.031
    row_jitter: Part = 0.1
    current_step_a: Annotated[float, Bounds(1e-9, 1e3, "A")] = 1 / 39
    current_noise_a: Annotated[float, Bounds(0, 1e3, "A")] = 0.05
    current_is_signed: bool = False
    speed_step: Annotated[float, Bounds(1e-9, 1e3, "rad/s")] = 2.83
    speed_gain: Annotated[float, Bounds(1e-3, 1e3)] = 1.013
    voltage: bool = True
    duty: bool = False
    bus_voltage: bool = False
    gyro: bool = False
    voltage_step_v: Annotated[float, Bounds(0.01, 1e3, "V")] = 0.1
    voltage_noise_v: Annotated[float, Bounds(0, 1e3, "V")] = 0.05
    gyro_noise: Annotated[float, Bounds(0, 100, "rad/s")] = 0.004
    gyro_bias: Annotated[float, Bounds(0, 100, "rad/s")] = 0.005
    average_s: Annotated[float, Bounds(0, 1, "s")] = 0.008
    frame_s: Interval = 1 / 29
    lag_s: Seconds = 0.056
    camera_scale: Annotated[float, Bounds(1e-3, 100)] = 1.117
    camera_noise_m: Annotated[float, Bounds(0, 100, "m")] = 0.0005
    camera_noise_rad: Annotated[float, Bounds(0, 10, "rad")] = 0.004
    dropout: Part = 0.01
    outlier: Part = 0.0005
    outlier_m: Annotated[float, Bounds(0, 1e3, "m")] = 0.03

    def __post_init__(self) -> None:
        if not 0.5 * self.frame_s <= self.lag_s <= 0.4:
            raise ValueError(
                f"lag_s = {self.lag_s}; expected at least half of frame_s, and at most 0.4"
            )

    def amperes(
        self, true: Float[np.ndarray, "*batch"], rng: np.random.Generator
    ) -> Float[np.ndarray, "*batch"]:
        """Return the readings of ammeters at true currents [A]."""
        read = true + self.current_noise_a * rng.normal(size=true.shape)
        read = read if self.current_is_signed else np.abs(read)
        return np.round(read / self.current_step_a) * self.current_step_a

    def volts(
        self, true: Float[np.ndarray, "*batch"], rng: np.random.Generator
    ) -> Float[np.ndarray, "*batch"]:
        """Return the readings of voltmeters at true voltages [V]."""
        read = true + self.voltage_noise_v * rng.normal(size=true.shape)
        return np.round(read / self.voltage_step_v) * self.voltage_step_v


@dataclass(frozen=True, config=CLOSED)
class Site:
    """Description of the test site that is the same for all runs.

    Attributes:
        robot: dimensions and masses of the robot.
        motor: the robot's motors.
        loop: the robot's controller of wheel speed.
        sensors: errors of the logged sensors.
        surfaces: physics of every surface, keyed by name.
        command_delay_s: time from a command to the change of the wheels' target speed [s].
        acceleration: acceleration of the wheels' rims towards a new command [m/s^2].
    """

    robot: OmniBuild | OrdinaryBuild = field(default_factory=OmniBuild)
    motor: MotorBuild = field(default_factory=MotorBuild)
    loop: SpeedLoop = field(default_factory=SpeedLoop)
    sensors: SiteSensors = field(default_factory=SiteSensors)
    surfaces: Mapping[str, SurfacePhysics] = field(default_factory=lambda: dict(SURFACES))
    command_delay_s: float = 0.12
    acceleration: float = 1.0

    def to_json(self) -> Content:
        """Return the site as in the truth file, which has older names for robot and surfaces."""
        content = asdict(self)
        return {"machine": content.pop("robot"), "grounds": content.pop("surfaces"), **content}

    @property
    def tick(self) -> float:
        """Angle by which a wheel turns from one encoder tick to the next [rad]."""
        return 2 * np.pi / (self.motor.ticks_per_revolution * self.robot.gear_ratio)


@dataclass(frozen=True, config=CLOSED)
class SiteCamera:
    """A camera that looks down on the floor; its image is rotated by 180 deg to the world's axes.

    Attributes:
        height_m: height of the lens above the floor [m].
        focal_px: focal length [pixel].
        width_px, height_px: size of the image [pixel].
        centre_m: x and y of the lens [m].
        tilt_deg: tilt about the image's x and y axes [deg].
        distortion: k1, k2, p1, p2 of OpenCV's lens model.
        blur_px: std of the Gaussian blur [pixel].
        noise: std of the noise of a pixel, on a scale from 0 to 255.
        flicker: relative amplitude of changes of the light over some seconds.
        exposure_s: exposure time of a frame; moving objects appear twice, at its start and end [s].
        frame_s: time between frames [s].
        early_s: time by which the video starts before the robot's log [s]; times in the video file
            count from the video's start, so they are larger than log times by `early_s`.
    """

    height_m: Annotated[float, Bounds(0.1, 100, "m")] = 2.2
    focal_px: Annotated[float, Bounds(10, 1e5, "pixels")] = 1200.0
    width_px: Pixels = 1920
    height_px: Pixels = 1080
    centre_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    tilt_deg: tuple[Tilt, Tilt] = (0.6, -0.4)
    distortion: tuple[Distortion, Distortion, Distortion, Distortion] = (
        -0.06,
        0.02,
        0.0006,
        -0.0004,
    )
    blur_px: Annotated[float, Bounds(0, 100, "pixels")] = 0.8
    noise: Annotated[float, Bounds(0, 255)] = 2.0
    flicker: Annotated[float, Bounds(0, 1)] = 0.06
    exposure_s: Annotated[float, Bounds(0, 1, "s")] = 0.012
    frame_s: Interval = 1 / 29
    early_s: Annotated[float, Bounds(0, 1e3, "s")] = 0.0

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """OpenCV's camera matrix; the principal point is the middle of the image."""
        x, y = 0.5 * (self.width_px - 1), 0.5 * (self.height_px - 1)
        return np.array([[self.focal_px, 0.0, x], [0.0, self.focal_px, y], [0.0, 0.0, 1.0]])

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from world axes to OpenCV's camera axes: x right, y down, z along the view."""
        tilted = Rotation.from_euler("xy", self.tilt_deg, degrees=True)
        return np.asarray(tilted.as_matrix() @ np.diag([-1.0, 1.0, -1.0]))

    @property
    def place(self) -> Float[np.ndarray, "3"]:
        """Position of the lens in the world [m]."""
        return np.array([*self.centre_m, self.height_m])

    def to_json(self) -> Content:
        """Return the content of the camera file that `slipid track` reads."""
        return {
            "schema": "slipid.camera/1",
            "image_px": [self.width_px, self.height_px],
            "matrix": self.matrix.tolist(),
            "distortion": list(self.distortion),
            "rotation_from_world": self.rotation.tolist(),
            "place_m": self.place.tolist(),
            "frame_s": self.frame_s,
        }
