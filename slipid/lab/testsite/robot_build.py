"""Properties of the test site's robot: DC motors, wheel speed loop, body, and its MuJoCo model."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from math import exp, floor, pi
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat
from pydantic.dataclasses import dataclass

from slipid.support.toml_file import CLOSED, NotNegative, Positive


@dataclass(frozen=True, config=CLOSED)
class MotorBuild:
    """A brushed DC motor with its gear.

    Attributes:
        resistance_ohm, inductance_h: resistance and inductance of the winding.
        back_emf_vs: back-EMF constant, equal to the torque constant [V s/rad].
        rotor_inertia_kg_m2: inertia at the motor shaft.
        coulomb_nm, viscous_nms: Coulomb and viscous friction at the wheel [N m], [N m s].
        efficiency: efficiency of the gear while the motor drives the wheel.
        supply_v, supply_ohm: open-circuit voltage [V] and internal resistance [ohm] of the battery
            that all motors share; under load its voltage never falls below 5 % of `supply_v`.
        ticks_per_revolution: encoder ticks per turn of the motor shaft.
    """

    resistance_ohm: Positive = 5.5
    inductance_h: Positive = 8.9e-3
    back_emf_vs: Positive = 0.0514
    rotor_inertia_kg_m2: Positive = 7.1e-6
    coulomb_nm: NotNegative = 0.07
    viscous_nms: NotNegative = 0.006
    efficiency: Annotated[float, Field(gt=0, le=1)] = 0.9
    supply_v: Positive = 24.0
    supply_ohm: NotNegative = 0.15
    ticks_per_revolution: Annotated[int, Field(ge=10)] = 2000


@dataclass(frozen=True, config=CLOSED)
class SpeedLoop:
    """The robot's built-in controller of wheel speed, which runs at the engine's time step.

    Attributes:
        kind: `pi`; `feed_forward` (proportional, plus the back-EMF of the commanded speed);
            `cascade` (a PI controller commands a current, which an inner loop controls).
        gain: gain of the error in motor speed [V s/rad]; in a cascade [A s/rad].
        integral: gain of the error's integral [V/rad]; in a cascade [A/rad].
        current_gain: gain of the cascade's inner loop [V/A].
        current_limit_a: limit of the cascade's commanded current [A].
        filter_s: time constant of the low pass of the measured speed [s].
    """

    kind: Literal["pi", "feed_forward", "cascade"] = "pi"
    gain: NotNegative = 0.08
    integral: NotNegative = 0.8
    current_gain: NotNegative = 4.0
    current_limit_a: Positive = 3.0
    filter_s: NotNegative = 0.004


class WheelDrives:
    """Simulation of all motors with their speed loops and battery, in steps of `dt` [s].

    `current` [A] and `voltage` [V] have a value for each motor; `bus` is the battery's voltage [V].
    """

    def __init__(
        self, motor: MotorBuild, loop: SpeedLoop, gear_ratio: float, wheels: int, dt: float
    ):
        self.motor, self.loop, self.gear, self.dt = motor, loop, gear_ratio, dt
        self._per_tick = 2 * pi / (motor.ticks_per_revolution * gear_ratio)
        self._decay = exp(-dt * motor.resistance_ohm / motor.inductance_h)
        self._blend = 1 - exp(-dt / loop.filter_s) if loop.filter_s > 0 else 1.0
        self.current = [0.0] * wheels
        self.voltage = [0.0] * wheels
        self.bus = motor.supply_v
        self._integral = [0.0] * wheels
        self._speed = [0.0] * wheels
        self._ticks: list[int] | None = None

    def step(self, wanted: list[float], angle: list[float], speed: list[float]) -> list[float]:
        """Return the torques at the wheels over one step [N m].

        Args:
            wanted: commanded wheel speeds [rad/s].
            angle: angles of the wheels [rad], which the loop measures in whole encoder ticks.
            speed: speeds of the wheels [rad/s], for the back-EMF.
        """
        m = self.motor
        ticks = [floor(a / self._per_tick) for a in angle]
        before = self._ticks or ticks
        self._ticks = ticks
        out = []
        drawn = 0.0
        for k, target in enumerate(wanted):
            measured = (ticks[k] - before[k]) * self._per_tick / self.dt
            self._speed[k] += self._blend * (measured - self._speed[k])
            volts = self._voltage(k, target * self.gear, self._speed[k] * self.gear)
            turning = speed[k] * self.gear
            settled = (volts - m.back_emf_vs * turning) / m.resistance_ohm
            amps = settled + (self.current[k] - settled) * self._decay
            torque = self.gear * m.back_emf_vs * 0.5 * (amps + self.current[k])
            self.voltage[k], self.current[k] = volts, amps
            drawn += amps * volts / self.bus
            out.append(torque * m.efficiency if torque * turning > 0 else torque)
        self.bus = max(m.supply_v - m.supply_ohm * max(drawn, 0.0), 0.05 * m.supply_v)
        return out

    def _voltage(self, k: int, wanted: float, measured: float) -> float:
        """Return the loop's voltage for motor `k`, limited to the bus voltage [V].

        While a limit is active, the integral keeps its value (anti-windup).
        """
        loop, m = self.loop, self.motor
        error = wanted - measured
        stored = self._integral[k] + loop.integral * error * self.dt
        if loop.kind == "pi":
            volts = loop.gain * error + stored
        elif loop.kind == "feed_forward":
            volts = loop.gain * error + m.back_emf_vs * wanted
        else:
            amps = loop.gain * error + stored
            held = min(max(amps, -loop.current_limit_a), loop.current_limit_a)
            stored = stored if held == amps else self._integral[k]
            volts = (
                m.resistance_ohm * held
                + m.back_emf_vs * measured
                + loop.current_gain * (held - self.current[k])
            )
        limited = min(max(volts, -self.bus), self.bus)
        if limited == volts:
            self._integral[k] = stored
        return limited


@dataclass(frozen=True, config=CLOSED)
class RobotBuild:
    """Dimensions and masses of the robot; by default like a Robotino 2.

    Attributes:
        mass_kg: mass of the whole robot [kg].
        centres_m: x, y of the centre of mass, keyed by load set-up [m].
        centre_height_m: height of the centre of mass above the wheel axes [m].
        wheel_azimuths_deg: azimuths of the wheel centres [deg]; the drive direction of each wheel
            is its azimuth plus 90 deg.
        base_radius_m: distance from the middle of the robot to the wheel centres [m].
        wheel_radius_m: radius of the wheels [m].
        gear_ratio: turns of the motor per turn of the wheel.
        rollers: number of rollers of one wheel, which are in two staggered rows; even.
        roller_radius_m, roller_mass_kg: radius [m] and mass [kg] of one roller.
        row_offset_m: distance of each row of rollers from the middle plane of the wheel [m].
        mount_n_m: stiffness of a roller's mount along the wheel's rim [N/m].
        roller_friction_nm: friction torque of a roller's bearing [N m].
        wheel_mass_kg: mass of a wheel without rollers [kg].
        body_radius_m: radius of the chassis, used in videos only [m].
        marker_height_m, marker_size_m: height of the camera's marker above the floor, and its edge
            length [m].
        marker_yaw_deg: heading of the marker less that of the body [deg].
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
            raise ValueError(
                f"roller_radius_m = {self.roller_radius_m} is not less than wheel_radius_m = "
                f"{self.wheel_radius_m}; expected smaller rollers"
            )
        if self.own_mass_kg <= 0:
            raise ValueError(
                f"mass_kg = {self.mass_kg} is less than the mass of the wheels; expected a larger "
                "mass"
            )
        if np.linalg.cond(self.wheel_from_twist * self.wheel_radius_m) > 100:
            raise ValueError(
                f"wheel_azimuths_deg = {self.wheel_azimuths_deg}: the wheels are too close "
                "together to move the body in all directions; expected angles all around"
            )
        if not self.marker_height_m >= self.wheel_radius_m + 0.08:
            raise ValueError(
                f"marker_height_m = {self.marker_height_m}; expected at least wheel_radius_m + 0.08"
            )
        for name in self.centres_m:
            if not self.load_share(name).min() > 0.02:
                raise ValueError(
                    f"centres_m.{name}: the centre of mass is not well within the wheels; expected "
                    "a position at which every wheel carries over 2 % of the weight"
                )

    @property
    def own_mass_kg(self) -> float:
        """Mass of the chassis without wheels [kg]."""
        wheel = self.wheel_mass_kg + self.rollers * self.roller_mass_kg
        return self.mass_kg - len(self.wheel_azimuths_deg) * wheel

    @property
    def places(self) -> Float[np.ndarray, "wheel 2"]:
        """Wheel centres in the body frame [m]."""
        azimuth = np.radians(self.wheel_azimuths_deg)
        return self.base_radius_m * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)

    @property
    def wheel_from_twist(self) -> Float[np.ndarray, "wheel 3"]:
        """Matrix that maps the body twist to wheel speeds without slip [rad/s]."""
        azimuth = np.radians(self.wheel_azimuths_deg)
        ahead = np.stack([-np.sin(azimuth), np.cos(azimuth)], axis=1)
        turn = np.full((len(azimuth), 1), self.base_radius_m)
        return np.concatenate([ahead, turn], axis=1) / self.wheel_radius_m

    def load_share(self, load: str) -> Float[np.ndarray, " wheel"]:
        """Return the fraction of the weight on each wheel, from static equilibrium.

        With more than three wheels, the minimum-norm solution is used.
        """
        count = len(self.wheel_azimuths_deg)
        level = np.concatenate([np.ones((1, count)), self.places.T])
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

    Contact parameters of the rollers override those of the floor, so that `SimulatedRobot` can give
    each roller the parameters of the surface beneath it.

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
        f'diaginertia="{inertia[0]} {inertia[1]} {inertia[2]}"/>{_body_geoms(m)}'
    )
    parts += [_wheel(m, k) for k in range(len(m.wheel_azimuths_deg))]
    return "".join(parts) + "</body></worldbody></mujoco>"


def _body_geoms(m: RobotBuild) -> str:
    """Return the XML of body and marker, which are only drawn and never collide."""
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


def _wheel(m: RobotBuild, k: int) -> str:
    """Return the part of the MuJoCo model (XML) with wheel `k`, from 0, and its rollers."""
    azimuth = np.radians(m.wheel_azimuths_deg[k])
    x, y = m.places[k]
    ring = m.wheel_radius_m - m.roller_radius_m
    # `half` is half the roller length at which neighbouring rollers of the two rows just meet
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
