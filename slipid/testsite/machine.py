"""The robot as a MuJoCo model: chassis, omni wheels with passive rollers, floor."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat
from pydantic.dataclasses import dataclass

from slipid.support.toml_file import CLOSED, NotNegative, Positive


@dataclass(frozen=True, config=CLOSED)
class Machine:
    """What the robot is made of; by default like a Robotino 2.

    Attributes:
        mass_kg: mass of the whole robot.
        centres_m: x, y of the centre of mass of every load set-up.
        centre_height_m: height of the centre of mass above the wheel axes.
        wheel_azimuths_deg: azimuths of the wheel centres; each drives 90 deg further.
        base_radius_m, wheel_radius_m: [m].
        gear_ratio: turns of the motor per turn of the wheel.
        rollers: number of rollers of one wheel, in two staggered rows; even.
        roller_radius_m, roller_mass_kg: radius and mass of one roller.
        row_offset_m: distance of each row from the middle of the wheel.
        mount_n_m: stiffness of a roller's mount along the wheel's rim [N/m].
        roller_friction_nm: friction of a roller's bearing.
        wheel_mass_kg: without rollers.
        body_radius_m: radius of the chassis, for pictures.
        marker_height_m, marker_size_m: height of the camera's marker above the floor, its edge.
        marker_yaw_deg: heading of the marker less the body's.
    """

    mass_kg: Positive = 12.0
    centres_m: Annotated[Mapping[str, tuple[float, float]], Field(min_length=1)] = field(
        default_factory=lambda: {"as_built": (-0.021, 0.002), "moved": (-0.004, -0.012)}
    )
    centre_height_m: Annotated[float, Field(ge=0, le=0.5)] = 0.06
    wheel_azimuths_deg: Annotated[tuple[FiniteFloat, ...], Field(min_length=3)] = (
        60.0,
        180.0,
        300.0,
    )
    base_radius_m: Positive = 0.125
    wheel_radius_m: Positive = 0.04
    gear_ratio: Positive = 16.0
    rollers: Annotated[int, Field(ge=6, multiple_of=2)] = 12
    roller_radius_m: Positive = 0.009
    roller_mass_kg: Annotated[FiniteFloat, Field(ge=1e-4)] = 0.012
    row_offset_m: NotNegative = 0.006
    mount_n_m: Positive = 2e4
    roller_friction_nm: NotNegative = 0.012
    wheel_mass_kg: Positive = 0.3
    body_radius_m: Positive = 0.18
    marker_height_m: float = 0.25
    marker_size_m: Positive = 0.131
    marker_yaw_deg: FiniteFloat = -0.9

    def __post_init__(self) -> None:
        if self.roller_radius_m >= self.wheel_radius_m:
            raise ValueError("rollers as large as the wheel; expected smaller ones")
        if self.own_mass_kg <= 0:
            raise ValueError(f"{self.mass_kg} kg is less than the wheels weigh; expected more")
        if np.linalg.cond(self.wheel_from_twist * self.wheel_radius_m) > 100:
            raise ValueError(
                f"wheel_azimuths_deg = {self.wheel_azimuths_deg}; expected them spread"
            )
        if not self.marker_height_m >= self.wheel_radius_m + 0.08:
            raise ValueError(
                f"marker_height_m = {self.marker_height_m}; expected it 0.08 above the axes"
            )
        for name in self.centres_m:
            if not self.load_share(name).min() > 0.02:
                raise ValueError(f"load {name}: the centre of mass is not within the wheels")

    @property
    def own_mass_kg(self) -> float:
        """Mass of the chassis without wheels."""
        wheel = self.wheel_mass_kg + self.rollers * self.roller_mass_kg
        return self.mass_kg - len(self.wheel_azimuths_deg) * wheel

    @property
    def places(self) -> Float[np.ndarray, "wheel 2"]:
        """Wheel centres in the body frame [m]."""
        azimuth = np.radians(self.wheel_azimuths_deg)
        return self.base_radius_m * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)

    @property
    def wheel_from_twist(self) -> Float[np.ndarray, "wheel 3"]:
        """Wheel speed [rad/s] of a body that rolls without slip, per twist."""
        azimuth = np.radians(self.wheel_azimuths_deg)
        ahead = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=1)
        turn = np.full((len(azimuth), 1), self.base_radius_m)
        return np.concatenate([ahead, turn], axis=1) / self.wheel_radius_m

    def load_share(self, load: str) -> Float[np.ndarray, " wheel"]:
        """Share of the weight on each wheel at rest, from statics (least squares beyond three)."""
        count = len(self.wheel_azimuths_deg)
        level = np.concatenate([np.ones((1, count)), self.places.T])
        return np.linalg.lstsq(level, np.array([1.0, *self.centres_m[load]]), rcond=None)[0]


def mjcf(
    machine: Machine,
    load: str,
    timestep: float,
    ribs: Sequence[tuple[float, float, float, float]] = (),
    looks: str = "",
    floor_looks: str = "",
) -> str:
    """MuJoCo's XML of the robot at the origin of a flat floor.

    Rollers carry the contact parameters (they have priority over the floor), so that `plant` can
    give each those of the surface beneath it.

    Args:
        load: whose centre of mass it has.
        ribs: x, lowest y, highest y, height [m] of every rib.
        looks: XML of assets, for pictures.
        floor_looks: XML attributes of the floor's plane.
    """
    m = machine
    # the chassis makes up for wheels that are not spread evenly
    wheels = (m.mass_kg - m.own_mass_kg) * m.places.mean(axis=0)
    x, y = (m.mass_kg * np.array(m.centres_m[load]) - wheels) / m.own_mass_kg
    inertia = m.own_mass_kg * np.array([0.012, 0.012, 0.016])
    parts = [
        f'<mujoco><option timestep="{timestep}" cone="elliptic" impratio="10" '
        'integrator="implicitfast" iterations="30" tolerance="1e-8"/>'
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
        f'<inertial pos="{x} {y} {m.centre_height_m}" mass="{m.own_mass_kg}" '
        f'diaginertia="{inertia[0]} {inertia[1]} {inertia[2]}"/>{_dress(m)}'
    )
    parts += [_wheel(m, k) for k in range(len(m.wheel_azimuths_deg))]
    return "".join(parts) + "</body></worldbody></mujoco>"


def _dress(m: Machine) -> str:
    """Body and marker, for pictures: nothing touches them."""
    from_axis = m.marker_height_m - m.wheel_radius_m
    half, edge = 0.5 * m.marker_size_m, 0.62 * m.marker_size_m
    nothing = 'contype="0" conaffinity="0" mass="0"'
    yaw = np.radians(m.marker_yaw_deg)
    return (
        f'<geom type="cylinder" size="{m.body_radius_m} .02" pos="0 0 .05" rgba=".75 .76 .78 1" '
        f'{nothing}/><geom type="cylinder" size=".06 {0.5 * (from_axis - 0.07)}" '
        f'pos="0 0 {0.5 * (from_axis + 0.07) - 0.003}" rgba=".3 .3 .32 1" {nothing}/>'
        f'<geom type="box" size="{edge + 0.03} {edge} .001" pos="0 0 {from_axis - 0.0025}" '
        f'rgba="1 1 1 1" {nothing}/>'
        f'<geom name="marker" type="box" size="{half} {half} .001" pos="0 0 {from_axis - 0.001}" '
        f'euler="0 0 {yaw}" rgba="1 1 1 1" {nothing}/>'
    )


def _wheel(m: Machine, k: int) -> str:
    azimuth = np.radians(m.wheel_azimuths_deg[k])
    x, y = m.places[k]
    ring = m.wheel_radius_m - m.roller_radius_m
    # straight rollers bridge the gap to the next row where both are as low as one in the middle
    step = np.pi / m.rollers
    half = ring * (1 - np.cos(step)) / np.sin(step)
    parts = [
        f'<body name="wheel{k}" pos="{x} {y} 0" euler="0 0 {azimuth}">'
        f'<joint name="wheel{k}" type="hinge" axis="-1 0 0"/>'
        f'<inertial pos="0 0 0" mass="{m.wheel_mass_kg}" diaginertia="2.5e-4 1.5e-4 1.5e-4"/>'
    ]
    for j in range(m.rollers):
        angle = 2 * np.pi * j / m.rollers
        row = m.row_offset_m * (1 if j % 2 else -1)
        parts.append(
            f'<body pos="{row} {ring * np.sin(angle)} {-ring * np.cos(angle)}" euler="{angle} 0 0">'
            f'<joint name="mount{k}_{j}" type="slide" axis="0 1 0" stiffness="{m.mount_n_m}"/>'
            f'<joint name="roller{k}_{j}" type="hinge" axis="0 1 0" armature="1e-6" '
            f'damping="1e-4" frictionloss="{m.roller_friction_nm}"/>'
            f'<geom name="roller{k}_{j}" type="capsule" size="{m.roller_radius_m} {half}" '
            f'euler="{np.pi / 2} 0 0" mass="{m.roller_mass_kg}" contype="2" conaffinity="1" '
            'condim="6" priority="1" rgba=".15 .15 .15 1"/></body>'
        )
    return "".join(parts) + "</body>"
