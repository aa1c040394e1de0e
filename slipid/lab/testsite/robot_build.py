"""Dimensions and masses that every robot of the test site has, and the MuJoCo model of a robot."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from pydantic.dataclasses import dataclass

from slipid.support.content import Content
from slipid.support.quantities import Bounds, Coordinate, Degrees, GearRatio, Length, Mass
from slipid.support.toml_file import CLOSED

MIN_LOAD_SHARE = 0.02
"""Fraction of the weight that every wheel and castor must carry at least [1]."""


@dataclass(frozen=True, config=CLOSED)
class RobotBuild(ABC):
    """Dimensions and masses that every robot has; by default like a Robotino 2.

    Attributes:
        mass_kg: mass of the whole robot [kg].
        centres_m: x, y of the centre of mass, keyed by load set-up [m].
        centre_height_m: height of the centre of mass above the wheel axes [m].
        wheel_radius_m: radius of the wheels [m].
        gear_ratio: turns of the motor per turn of the wheel.
        wheel_mass_kg: mass of a wheel, without rollers [kg].
        body_radius_m: radius of the chassis, used in videos only [m].
        marker_place_m: x, y of the camera's marker in the body frame [m].
        marker_height_m, marker_size_m: height of the marker above the floor, and its edge length
            [m].
        marker_yaw_deg: heading of the marker less that of the body [deg].
    """

    mass_kg: Mass = 12.0
    centres_m: Annotated[Mapping[str, tuple[Coordinate, Coordinate]], Field(min_length=1)] = field(
        default_factory=lambda: {"as_built": (-0.021, 0.002), "moved": (-0.004, -0.012)}
    )
    centre_height_m: Annotated[float, Bounds(0, 0.5, "m")] = 0.06
    wheel_radius_m: Length = 0.04
    gear_ratio: GearRatio = 16.0
    wheel_mass_kg: Mass = 0.3
    body_radius_m: Length = 0.18
    marker_place_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    marker_height_m: Length = 0.25
    marker_size_m: Length = 0.131
    marker_yaw_deg: Degrees = -0.9

    def __post_init__(self) -> None:
        if self.chassis_mass_kg <= 0:
            raise ValueError(
                f"mass_kg = {self.mass_kg} is less than the mass of the wheels; expected a larger "
                "mass"
            )
        if not self.marker_height_m >= self.wheel_radius_m + 0.08:
            raise ValueError(
                f"marker_height_m = {self.marker_height_m}; expected at least wheel_radius_m + 0.08"
            )
        for name in self.centres_m:
            if not self.support_share(name).min() > MIN_LOAD_SHARE:
                raise ValueError(
                    f"centres_m.{name}: the centre of mass is not well within the wheels; expected "
                    "a position at which every wheel carries over 2 % of the weight"
                )

    @property
    @abstractmethod
    def places(self) -> Float[np.ndarray, "wheel 2"]:
        """Wheel centres in the body frame [m]."""

    @property
    @abstractmethod
    def radii(self) -> Float[np.ndarray, " wheel"]:
        """True radius of each wheel [m]; commands are computed with `wheel_radius_m`."""

    @property
    @abstractmethod
    def drive_of(self) -> tuple[int, ...]:
        """Index of the motor that turns each wheel, from 0."""

    @property
    @abstractmethod
    def wheel_from_twist(self) -> Float[np.ndarray, "drive 3"]:
        """Matrix that maps the body twist to the speeds of the drives without slip [rad/s]."""

    @property
    @abstractmethod
    def supports(self) -> Float[np.ndarray, "support 2"]:
        """Points that carry the weight in the body frame: the wheels, then a castor if any [m]."""

    @property
    @abstractmethod
    def support_mass_kg(self) -> Float[np.ndarray, " support"]:
        """Mass of the wheel or castor at each support [kg]."""

    @property
    @abstractmethod
    def gyration_m2(self) -> tuple[float, float, float]:
        """Moments of inertia of the chassis about x, y and z over its mass [m^2]."""

    @property
    @abstractmethod
    def friction_impedance(self) -> int:
        """Impedance of the engine's friction over that of its normal contact forces [1]."""

    @property
    @abstractmethod
    def drive_section(self) -> Content:
        """Keys of `[robot]` in the config of `slipid identify` that describe the wheels."""

    @abstractmethod
    def wheels_xml(self) -> str:
        """Return the bodies of wheels, with whatever carries weight, in the chassis (XML)."""

    @abstractmethod
    def constraints_xml(self) -> str:
        """Return the contact pairs and equality constraints of the model (XML)."""

    @property
    def drives(self) -> int:
        """Number of motors, which is also the number of logged angles, currents and voltages."""
        return max(self.drive_of) + 1

    @property
    def chassis_mass_kg(self) -> float:
        """Mass of the chassis without wheels [kg]."""
        return self.mass_kg - float(self.support_mass_kg.sum())

    def load_share(self, load: str) -> Float[np.ndarray, " wheel"]:
        """Return the fraction on each wheel of the weight that the wheels carry."""
        wheels = self.support_share(load)[: len(self.places)]
        return wheels / wheels.sum()

    def wheels_part(self, load: str) -> float:
        """Return the fraction of the weight that the wheels carry together."""
        return float(self.support_share(load)[: len(self.places)].sum())

    def support_share(self, load: str) -> Float[np.ndarray, " support"]:
        """Return the fraction of the weight on each support, from static equilibrium.

        With more than three supports, the minimum-norm solution is used.
        """
        level = np.concatenate([np.ones((1, len(self.supports))), self.supports.T])
        return np.linalg.lstsq(level, np.array([1.0, *self.centres_m[load]]), rcond=None)[0]


def mjcf(
    robot: RobotBuild,
    load: str,
    timestep: float,
    ribs: Sequence[tuple[float, float, float, float]] = (),
    looks: str = "",
    floor_looks: str = "",
) -> str:
    """Return a MuJoCo model (XML) of the robot at the origin of a flat floor.

    Contact parameters of the wheels override those of the floor, so that `SimulatedRobot` can give
    each of them the parameters of the surface beneath it.

    Args:
        robot: dimensions and masses of the robot.
        load: name of the load set-up, which determines the centre of mass.
        timestep: time step of the engine [s].
        ribs: x, lowest y, highest y, height of every rib on the floor [m].
        looks: XML of lights, textures and materials for videos.
        floor_looks: XML attributes of the floor's plane for videos.
    """
    m = robot
    # place the chassis' centre of mass so that the centre of mass of the whole robot, wheels
    # included, is that of the load set-up
    wheels = m.support_mass_kg @ m.supports
    x, y = (m.mass_kg * np.array(m.centres_m[load]) - wheels) / m.chassis_mass_kg
    inertia = m.chassis_mass_kg * np.array(m.gyration_m2)
    parts = [
        f'<mujoco><option timestep="{timestep}" cone="elliptic" '
        f'impratio="{m.friction_impedance}" integrator="implicitfast" iterations="30" '
        'tolerance="1e-8"/>'
        f'<compiler angle="radian"/><size memory="32M"/>{looks}<worldbody>'
        f'<geom name="floor" type="plane" size="3 3 .1" contype="1" conaffinity="2" {floor_looks}/>'
    ]
    for place, low, high, height in ribs:
        radius = max(0.004, 2 * height)
        z = height - radius
        parts.append(
            f'<geom type="capsule" size="{radius}" fromto="{place} {low} {z} {place} {high} {z}" '
            'contype="1" conaffinity="2" rgba=".3 .33 .4 1"/>'
        )
    parts.append(
        f'<body name="chassis" pos="0 0 {m.wheel_radius_m}"><freejoint/>'
        f'<inertial pos="{x} {y} {m.centre_height_m}" mass="{m.chassis_mass_kg}" '
        f'diaginertia="{inertia[0]} {inertia[1]} {inertia[2]}"/>{_body_geoms(m)}{m.wheels_xml()}'
    )
    return "".join(parts) + f"</body></worldbody>{m.constraints_xml()}</mujoco>"


def _body_geoms(m: RobotBuild) -> str:
    """Return the XML of body and marker, which are only drawn and never collide."""
    from_axis = m.marker_height_m - m.wheel_radius_m
    half, edge = 0.5 * m.marker_size_m, 0.62 * m.marker_size_m
    nothing = 'contype="0" conaffinity="0" mass="0"'
    yaw = np.radians(m.marker_yaw_deg)
    x, y = m.marker_place_m
    return (
        f'<geom type="cylinder" size="{m.body_radius_m} .02" pos="0 0 .05" rgba=".75 .76 .78 1" '
        f'{nothing}/><geom type="cylinder" size=".06 {0.5 * (from_axis - 0.07)}" '
        f'pos="{x} {y} {0.5 * (from_axis + 0.07) - 0.003}" rgba=".3 .3 .32 1" {nothing}/>'
        f'<geom type="box" size="{edge + 0.03} {edge} .001" pos="{x} {y} {from_axis - 0.0025}" '
        f'rgba="1 1 1 1" {nothing}/>'
        f'<geom name="marker" type="box" size="{half} {half} .001" '
        f'pos="{x} {y} {from_axis - 0.001}" euler="0 0 {yaw}" rgba="1 1 1 1" {nothing}/>'
    )
