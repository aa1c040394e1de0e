"""Robots of the test site on ordinary wheels: two with a castor ball, or four (skid steering)."""

from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic.dataclasses import dataclass

from slipid.lab.testsite.robot_build import RobotBuild
from slipid.support.content import Content
from slipid.support.quantities import Bounds, Coordinate, Length, Mass
from slipid.support.toml_file import CLOSED

IMPEDANCE = 0.1
"""Largest impedance of the engine's contacts beneath wheels and castor [1]."""
RadiusError = Annotated[float, Bounds(-0.2, 0.2)]
"""True radius of a wheel over its nominal radius, less 1 [1]."""


@dataclass(frozen=True, config=CLOSED)
class OrdinaryBuild(RobotBuild):
    """Dimensions and masses of a robot on ordinary wheels, which grip sideways as ahead.

    A differential robot has two wheels, left and right, and a castor ball; the middle of the axle
    is the origin. A skid-steer robot has four: front left, front right, rear left, rear right.

    Attributes:
        drive: `differential` or `skid`.
        track_m: distance between the middles of the left and right wheels [m].
        wheelbase_m: distance between the front and rear axles of a skid-steer robot [m].
        motors: whether each side or each wheel of a skid-steer robot has a motor.
        castor_m: x, y of a differential robot's castor ball [m].
        castor_radius_m, castor_mass_kg: radius [m] and mass [kg] of the castor ball.
        castor_friction_nm: friction torque of the castor ball in its socket [N m].
        wheel_width_m: width of the wheels; they touch the floor at their two edges [m].
        radius_error: relative errors of `wheel_radius_m` of the left and the right wheels [1].
    """

    drive: Literal["differential", "skid"] = "skid"
    track_m: Length = 0.4
    wheelbase_m: Length | None = None
    motors: Literal["side", "wheel"] = "side"
    castor_m: tuple[Coordinate, Coordinate] | None = None
    castor_radius_m: Length = 0.02
    castor_mass_kg: Mass = 0.1
    castor_friction_nm: Annotated[float, Bounds(0, 1e3, "N m")] = 0.005
    wheel_width_m: Length = 0.03
    radius_error: tuple[RadiusError, RadiusError] = (0.0, 0.0)

    def __post_init__(self) -> None:
        keys = {"differential": "castor_m", "skid": "wheelbase_m"}
        for drive, key in keys.items():
            if (getattr(self, key) is None) is (self.drive == drive):
                what = (
                    "expected this key" if self.drive == drive else f"only {drive} robots have it"
                )
                raise ValueError(f"{key} with drive = '{self.drive}'; {what}")
        super().__post_init__()

    @property
    def places(self) -> Float[np.ndarray, "wheel 2"]:
        y = 0.5 * self.track_m
        if self.wheelbase_m is None:
            return np.array([[0.0, y], [0.0, -y]])
        x = 0.5 * self.wheelbase_m
        return np.array([[x, y], [x, -y], [-x, y], [-x, -y]])

    @property
    def radii(self) -> Float[np.ndarray, " wheel"]:
        sides = self.wheel_radius_m * (1 + np.array(self.radius_error))
        return np.tile(sides, len(self.places) // 2)

    @property
    def drive_of(self) -> tuple[int, ...]:
        if self.drive == "skid" and self.motors == "side":
            return 0, 1, 0, 1
        return tuple(range(len(self.places)))

    @property
    def wheel_from_twist(self) -> Float[np.ndarray, "drive 3"]:
        left = self.places[: self.drives, 1]
        rows = np.stack([np.ones_like(left), np.zeros_like(left), -left], axis=1)
        return rows / self.wheel_radius_m

    @property
    def supports(self) -> Float[np.ndarray, "support 2"]:
        return self.places if self.castor_m is None else np.vstack([self.places, self.castor_m])

    @property
    def support_mass_kg(self) -> Float[np.ndarray, " support"]:
        castor = [] if self.castor_m is None else [self.castor_mass_kg]
        return np.array([self.wheel_mass_kg] * len(self.places) + castor)

    @property
    def gyration_m2(self) -> tuple[float, float, float]:
        length, width = np.ptp(self.supports, axis=0) + 2 * np.array([self.wheel_radius_m, 0.0])
        height = 2 * self.wheel_radius_m
        x, y, z = float(length) ** 2 / 12, float(width) ** 2 / 12, height**2 / 12
        return y + z, x + z, x + y

    @property
    def friction_impedance(self) -> int:
        # the engine lifts a contact that slides, less so the stiffer its friction is
        return 100

    @property
    def drive_section(self) -> Content:
        if self.wheelbase_m is None:
            return {"drive": self.drive, "track_m": self.track_m}
        half = {"half_length_m": 0.5 * self.wheelbase_m, "half_width_m": 0.5 * self.track_m}
        shared = {"drives": [[1, 3], [2, 4]]} if self.motors == "side" else {}
        return {"drive": self.drive, **shared, **half}

    def wheels_xml(self) -> str:
        contact = f'contype="2" conaffinity="1" priority="1" solimp="{IMPEDANCE} {IMPEDANCE} .001"'
        parts = [
            f'<body name="wheel{k}" pos="{x} {y} 0"><joint name="wheel{k}" type="hinge" '
            f'axis="0 1 0"/><geom name="tread{k}" type="cylinder" euler="{np.pi / 2} 0 0" '
            f'size="{radius} {0.5 * self.wheel_width_m}" mass="{self.wheel_mass_kg}" {contact} '
            'rgba=".15 .15 .15 1"/></body>'
            for k, ((x, y), radius) in enumerate(zip(self.places, self.radii, strict=True))
        ]
        if self.castor_m is not None:
            x, y = self.castor_m
            parts.append(
                f'<body name="castor" pos="{x} {y} {self.castor_radius_m - self.wheel_radius_m}">'
                '<joint name="castor" type="ball"/><geom name="castor" type="sphere" '
                f'size="{self.castor_radius_m}" mass="{self.castor_mass_kg}" {contact}/></body>'
            )
        return "".join(parts)

    def constraints_xml(self) -> str:
        geoms = [f"tread{k}" for k in range(len(self.places))]
        geoms += ["castor"] if self.castor_m is not None else []
        solimp = f"{IMPEDANCE} {IMPEDANCE} .001"
        pairs = "".join(
            f'<pair name="{g}" geom1="floor" geom2="{g}" condim="3" solimp="{solimp}"/>'
            for g in geoms
        )
        # wheels that share a motor turn together
        joined = "".join(
            f'<joint joint1="wheel{k}" joint2="wheel{motor}" polycoef="0 1 0 0 0" '
            'solref=".002 1" solimp=".99 .99 .001"/>'
            for k, motor in enumerate(self.drive_of)
            if k != motor
        )
        return f"<contact>{pairs}</contact><equality>{joined}</equality>"
