"""The omnidirectional robot of the test site: wheels on a circle, with passive rollers."""

from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field
from pydantic.dataclasses import dataclass

from slipid.lab.testsite.robot_build import RobotBuild
from slipid.support.content import Content
from slipid.support.quantities import Bounds, Degrees, Length
from slipid.support.toml_file import CLOSED


@dataclass(frozen=True, config=CLOSED)
class OmniBuild(RobotBuild):
    """Dimensions and masses of an omnidirectional robot; by default like a Robotino 2.

    Attributes:
        wheel_azimuths_deg: azimuths of the wheel centres [deg]; the drive direction of each wheel
            is its azimuth plus 90 deg.
        base_radius_m: distance from the middle of the robot to the wheel centres [m].
        rollers: number of rollers of one wheel, which are in two staggered rows; even.
        roller_radius_m, roller_mass_kg: radius [m] and mass [kg] of one roller.
        row_offset_m: distance of each row of rollers from the middle plane of the wheel [m].
        mount_n_m: stiffness of a roller's mount along the wheel's rim [N/m].
        roller_friction_nm: friction torque of a roller's bearing [N m].
    """

    drive: Literal["omni"] = "omni"
    wheel_azimuths_deg: Annotated[tuple[Degrees, ...], Field(min_length=3, max_length=100)] = (
        60.0,
        180.0,
        300.0,
    )
    base_radius_m: Length = 0.125
    rollers: Annotated[int, Bounds(6, 100), Field(multiple_of=2)] = 12
    roller_radius_m: Length = 0.009
    roller_mass_kg: Annotated[float, Bounds(1e-4, 1e3, "kg")] = 0.012
    row_offset_m: Annotated[float, Bounds(0, 1, "m")] = 0.006
    mount_n_m: Annotated[float, Bounds(1, 1e12, "N/m")] = 2e4
    roller_friction_nm: Annotated[float, Bounds(0, 1e3, "N m")] = 0.012

    def __post_init__(self) -> None:
        if self.roller_radius_m >= self.wheel_radius_m:
            raise ValueError(
                f"roller_radius_m = {self.roller_radius_m} is not less than wheel_radius_m = "
                f"{self.wheel_radius_m}; expected smaller rollers"
            )
        if np.linalg.cond(self.wheel_from_twist * self.wheel_radius_m) > 100:
            raise ValueError(
                f"wheel_azimuths_deg = {self.wheel_azimuths_deg}: the wheels are too close "
                "together to move the body in all directions; expected angles all around"
            )
        super().__post_init__()

    @property
    def places(self) -> Float[np.ndarray, "wheel 2"]:
        azimuth = np.radians(self.wheel_azimuths_deg)
        return self.base_radius_m * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)

    @property
    def radii(self) -> Float[np.ndarray, " wheel"]:
        return np.full(len(self.wheel_azimuths_deg), self.wheel_radius_m)

    @property
    def drive_of(self) -> tuple[int, ...]:
        return tuple(range(len(self.wheel_azimuths_deg)))

    @property
    def wheel_from_twist(self) -> Float[np.ndarray, "drive 3"]:
        azimuth = np.radians(self.wheel_azimuths_deg)
        ahead = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=1)
        turn = np.full((len(azimuth), 1), self.base_radius_m)
        return np.concatenate([ahead, turn], axis=1) / self.wheel_radius_m

    @property
    def supports(self) -> Float[np.ndarray, "support 2"]:
        return self.places

    @property
    def support_mass_kg(self) -> Float[np.ndarray, " support"]:
        wheel = self.wheel_mass_kg + self.rollers * self.roller_mass_kg
        return np.full(len(self.wheel_azimuths_deg), wheel)

    @property
    def gyration_m2(self) -> tuple[float, float, float]:
        return 0.012, 0.012, 0.016

    @property
    def friction_impedance(self) -> int:
        return 10

    @property
    def drive_section(self) -> Content:
        return {
            "drive": self.drive,
            "wheel_azimuths_deg": list(self.wheel_azimuths_deg),
            "base_radius_m": self.base_radius_m,
        }

    def wheels_xml(self) -> str:
        return "".join(self._wheel(k) for k in range(len(self.wheel_azimuths_deg)))

    def constraints_xml(self) -> str:
        return ""

    def _wheel(self, k: int) -> str:
        """Return the part of the MuJoCo model (XML) with wheel `k`, from 0, and its rollers."""
        azimuth = np.radians(self.wheel_azimuths_deg[k])
        x, y = self.places[k]
        ring = self.wheel_radius_m - self.roller_radius_m
        # `half` is half the roller length at which neighbouring rollers of the two rows just meet
        step = np.pi / self.rollers
        half = ring * (1 - np.cos(step)) / np.sin(step)
        parts = [
            f'<body name="wheel{k}" pos="{x} {y} 0" euler="0 0 {azimuth}">'
            f'<joint name="wheel{k}" type="hinge" axis="-1 0 0"/>'
            f'<inertial pos="0 0 0" mass="{self.wheel_mass_kg}" '
            'diaginertia="2.5e-4 1.5e-4 1.5e-4"/>'
        ]
        for j in range(self.rollers):
            angle = 2 * np.pi * j / self.rollers
            row = self.row_offset_m * (1 if j % 2 else -1)
            parts.append(
                f'<body pos="{row} {ring * np.sin(angle)} {-ring * np.cos(angle)}" '
                f'euler="{angle} 0 0">'
                f'<joint name="mount{k}_{j}" type="slide" axis="0 1 0" '
                f'stiffness="{self.mount_n_m}"/>'
                f'<joint name="roller{k}_{j}" type="hinge" axis="0 1 0" armature="1e-6" '
                f'damping="1e-4" frictionloss="{self.roller_friction_nm}"/>'
                f'<geom name="roller{k}_{j}" type="capsule" size="{self.roller_radius_m} {half}" '
                f'euler="{np.pi / 2} 0 0" mass="{self.roller_mass_kg}" contype="2" '
                'conaffinity="1" condim="6" priority="1" rgba=".15 .15 .15 1"/></body>'
            )
        return "".join(parts) + "</body>"
