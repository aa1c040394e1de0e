"""The whole robot as one tree of declared parameters: wheels, motors, floors, loads, camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.model import contact, geometry
from slipid.model.camera import Camera
from slipid.model.contact_balance import Balance, stand
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import Geometry, WheelFrame
from slipid.model.motor import Motor
from slipid.model.se2 import Planar
from slipid.parameter import as_numbers, entries, known, parameter
from slipid.support.blocks import in_blocks

Number = int | float
GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""


class Body(eqx.Module):
    """Mass, inertia and load shares.

    The leading axis of `load_share` and of `mass_ratio` is the load set-up; `mass` is that of the
    first one, in alphabetical order.
    """

    mass: Array = known("kg", "m", "mass", start=10.0, lower=0.0, spread=0.1)
    yaw_inertia: Array = known(
        "kg*m^2", "I_z", "inertia about the vertical", start=0.2, lower=0.0, spread=0.5
    )
    load_share: Array = parameter(
        "1",
        "N0",
        "share of the weight on each wheel at rest",
        start=1 / 3,
        spread=0.5,
        shares=True,
        per="loads",
    )
    mass_ratio: Array = parameter(
        "1",
        "m/m_1",
        "mass over that in the first load set-up, from currents",
        start=1.0,
        lower=0.0,
        spread=0.15,
        electric=True,
        relative=True,
        per="loads",
    )
    loads: tuple[str, ...] = eqx.field(static=True, default=("as_built",))

    def mass_in(self, load: Int[Array, "*some"] | int) -> Float[Array, "*some"]:
        """Return the mass in load set-ups of given indices [kg]."""
        return self.mass * self.mass_ratio[load]


class Robot(eqx.Module):
    """All known or fitted parameters of a robot; `entries(robot)` names each of them.

    Attributes:
        surfaces: floors, stacked in the order of `surfaces.labels`.
    """

    geometry: Geometry = eqx.field(metadata={"path": "robot"})
    body: Body = eqx.field(metadata={"path": "robot"})
    motor: Motor
    surfaces: ContactSurface = eqx.field(metadata={"path": "surface"})
    camera: Camera

    @classmethod
    def omni(
        cls,
        azimuth_deg: Sequence[Number],
        base_radius: Number,
        wheel_radius: Number,
        gear_ratio: Number = 1.0,
        mass: Number = 10.0,
    ) -> "Robot":
        """Return a robot with omni wheels on a circle, each of which drives tangentially.

        Args:
            azimuth_deg: azimuths of the wheels, counter-clockwise from ahead [deg].
            base_radius: distance of the wheel centres from the middle [m].
            wheel_radius: radius of the wheels [m].
            gear_ratio: motor turns per wheel turn.
            mass: mass of the robot, to which torques are proportional [kg].
        """
        azimuths = [float(a) for a in azimuth_deg]
        sizes = float(base_radius), float(wheel_radius), float(gear_ratio)
        return cls.of(geometry.omni(azimuths, *sizes), mass)

    @classmethod
    def of(cls, shape: Geometry, mass: Number = 10.0) -> "Robot":
        """Return a robot with any wheels (see `slipid.model.geometry`) and no floors yet."""
        robot = build(shape, ())
        return replace(robot, body=replace(robot.body, mass=as_numbers(mass)))

    def on(
        self,
        surfaces: Sequence[str],
        loads: Sequence[str] = ("as_built",),
        sessions: Sequence[str] = (),
        image_centre: tuple[float, float] = (0.0, 0.0),
    ) -> "Robot":
        """Return the robot with new floors, load set-ups and sessions, all at start values.

        `image_centre` is the point at which the camera's tilt and distortion are zero [m].
        """
        made = build(self.geometry, surfaces, loads, sessions, image_centre)
        return replace(made, motor=self.motor, body=replace(made.body, mass=self.body.mass))

    def standing(self, frame: WheelFrame, surface: Array, load: Array) -> "Standing":
        """Return the robot on a floor, or on one floor per wheel, with a load set-up.

        `frame` holds the robot's wheels; `surface` and `load` are indices of the floors and of the
        load set-up.
        """
        rest = self.body.load_share[load]
        mass = self.body.mass_in(load)
        return Standing(frame, self.surfaces.at(surface), rest, self.motor, mass)

    def surface_index(self, name: str) -> int:
        """Return the index of a floor in `surfaces`; raise `ValueError` if it is unknown."""
        if name not in self.surfaces.labels:
            known = ", ".join(self.surfaces.labels)
            raise ValueError(f"no surface '{name}'; identified: {known}")
        return self.surfaces.labels.index(name)

    def load_index(self, name: str) -> int:
        """Return the index of a load set-up; raise `ValueError` if it is unknown."""
        if name not in self.body.loads:
            raise ValueError(f"no load set-up '{name}'; identified: {', '.join(self.body.loads)}")
        return self.body.loads.index(name)

    def session_index(self, name: str) -> int:
        """Return the index of a session; -1 for a session that was not fitted."""
        return self.camera.sessions.index(name) if name in self.camera.sessions else -1


class Standing(eqx.Module):
    """A robot standing on a floor, or on one floor under each wheel.

    Attributes:
        frame: directions and radii of the wheels.
        floor: the floor, or the floor under each wheel.
        rest: fraction of the weight on each wheel at rest [1].
        motor: motor, which all drives share.
        mass: mass of the robot [kg].
    """

    frame: WheelFrame
    floor: ContactSurface
    rest: Float[Array, " wheel"]
    motor: Motor
    mass: Float[Array, ""]

    def contact(self, wheel_speed: Float[Array, " wheel"]) -> contact.ContactProblem:
        """Return the contact problem at given wheel speeds [rad/s]."""
        rim = self.frame.radius * wheel_speed
        return contact.ContactProblem(rim, self.frame, self.floor, self.rest)

    def twist(self, wheel_speed: Float[Array, " wheel"]) -> Float[Array, "3"]:
        """Return the body twist at given wheel speeds [rad/s] (vx, vy [m/s], yaw rate [rad/s])."""
        rim = self.frame.radius * wheel_speed
        return contact.equilibrium(rim, self.frame, self.floor, self.rest)

    def motor_forces(
        self, xi: Float[Array, "3"], wheel_speed: Float[Array, " wheel"]
    ) -> Float[Array, "wheel 2"]:
        """Return the two forces at each wheel that its motor works against [mean(mu) m g].

        They are the traction, and the rolling drag that would result from `Motor.rolling_drag` = 1.
        At that value a wheel that rolls in its drive direction has as much drag as its rollers
        have. The rolling drag exerts no force on the body.
        """
        on = stand(self.frame, self.floor, self.rest)
        at = Balance(self.frame.radius * wheel_speed, on).at(Planar(*xi))
        return jnp.stack([at.motor_force, at.rolling_drag], axis=-1)

    @property
    def lever(self) -> Float[Array, ""]:
        """Torque at a wheel per unit of the forces: r mean(mu) m g [N m]."""
        return self.frame.radius * (jnp.mean(self.floor.friction) * self.mass * GRAVITY)

    def wheel_torque(
        self, xi: Float[Array, "3"], wheel_speed: Float[Array, " wheel"]
    ) -> Float[Array, " wheel"]:
        """Return the torque of the traction of each wheel [N m]."""
        return self.lever * self.motor_forces(xi, wheel_speed)[..., 0]

    def current(
        self, xi: Float[Array, "3"], speed: Float[Array, " drive"]
    ) -> Float[Array, " drive"]:
        """Return the signed current of each motor [A], for its wheels' forces and its friction.

        `speed` is the wheel speed of each drive [rad/s].
        """
        forces = self.motor_forces(xi, self.frame.at_wheels(speed))
        opposing = self.frame.at_drives(self.motor.opposing_force(forces))
        return self.motor.current(self.lever * opposing, speed)


@dataclass(frozen=True)
class Validity:
    """Range of conditions in which a floor was driven; outside it, predictions extrapolate.

    Attributes:
        runs: number of runs.
        loads: load set-ups.
        wheel_speed: smallest and largest wheel speed [rad/s].
        torque_nm: smallest and largest torque [N m].
        slip: smallest and largest slip.
        yaw_rate: smallest and largest yaw rate by the encoders [rad/s].
        headings_deg: directions of travel in the body frame that were driven [deg]. Headings,
            speeds and turn rates are commanded values, or approximate values from the encoders if
            no steady command was logged.
        speeds: speeds of the body that were driven [m/s].
        turn_rates: yaw rates of the body that were driven [rad/s].
        distance: mean distance of a run [m].
    """

    runs: int
    loads: tuple[str, ...]
    wheel_speed: tuple[float, float]
    torque_nm: tuple[float, float]
    slip: tuple[float, float]
    yaw_rate: tuple[float, float]
    headings_deg: tuple[float, ...]
    speeds: tuple[float, ...]
    turn_rates: tuple[float, ...]
    distance: float


def build(
    geometry: Geometry,
    surfaces: Sequence[str],
    loads: Sequence[str] = ("as_built",),
    sessions: Sequence[str] = (),
    centre: tuple[float, float] = (0.0, 0.0),
) -> Robot:
    """Return a robot with every parameter at its declared start value; surfaces are sorted."""
    names = sorted(surfaces)
    single = ContactSurface()
    stack = {e.path: np.full(len(names), np.asarray(e.get(single))) for e in entries(single)}
    wheels = geometry.wheels
    stack["load_bias"] = np.zeros((len(names), wheels))
    return Robot(
        geometry=geometry,
        body=Body(
            load_share=as_numbers(np.full((len(loads), wheels), 1 / wheels)),
            mass_ratio=as_numbers(np.ones(len(loads))),
            loads=tuple(loads),
        ),
        motor=Motor(gear_ratio=as_numbers(geometry.gear_ratio)),
        surfaces=ContactSurface(
            **{k: as_numbers(x) for k, x in stack.items()}, labels=tuple(names)
        ),
        camera=Camera(
            session_yaw=as_numbers(np.zeros(len(sessions))),
            marker_place=as_numbers(np.zeros(2)),
            tilt=as_numbers(np.zeros(2)),
            tangential=as_numbers(np.zeros(2)),
            centre=centre,
            sessions=tuple(sessions),
        ),
    )


class SteadyStates(NamedTuple):
    """Steady motions of a robot whose wheels keep given speeds, a row for each.

    Attributes:
        twist: body twists (vx, vy [m/s], yaw rate [rad/s]).
        torque: torques of the traction of the wheels [N m].
        current: signed currents of the motors [A].
    """

    twist: Float[np.ndarray, "row 3"]
    torque: Float[np.ndarray, "row wheel"]
    current: Float[np.ndarray, "row drive"]


def steady_states(
    robot: Robot,
    wheel_speed: Float[np.ndarray, "row drive"],
    surface: int | Int[np.ndarray, " row"],
    load: int | Int[np.ndarray, " row"],
) -> SteadyStates:
    """Return the steady motions at wheel speeds of the drives [rad/s].

    `surface` and `load` are indices of the floors and the load set-ups. A call with another number
    of rows compiles nothing anew.
    """
    places = (np.broadcast_to(np.asarray(x), len(wheel_speed)) for x in (surface, load))
    return SteadyStates(*in_blocks(partial(_steady_states, robot), wheel_speed, *places))


@eqx.filter_jit
def _steady_states(
    robot: Robot, wheel_speed: Array, surface: Array, load: Array
) -> tuple[Array, Array, Array]:
    frame = robot.geometry.frame()

    def one(w: Array, surface: Array, load: Array) -> tuple[Array, Array, Array]:
        standing, of_wheels = robot.standing(frame, surface, load), frame.at_wheels(w)
        xi = standing.twist(of_wheels)
        return xi, standing.wheel_torque(xi, of_wheels), standing.current(xi, w)

    return jax.vmap(one)(wheel_speed, surface, load)
