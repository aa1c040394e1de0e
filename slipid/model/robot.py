"""The whole robot as one tree of declared parameters: wheels, motors, floors, loads, camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model import contact, geometry
from slipid.model.camera import Camera
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import Geometry, WheelFrame
from slipid.model.motor import Motor
from slipid.parameter import as_numbers, entries, parameter

Number = int | float
GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""


class Body(eqx.Module):
    """Mass, inertia and load shares; the leading axis of `load_share` is the load set-up."""

    mass: Array = parameter("kg", "m", "mass", start=10.0, lower=0.0, spread=0.1, free=False)
    yaw_inertia: Array = parameter(
        "kg*m^2", "I_z", "inertia about the vertical", start=0.2, lower=0.0, spread=0.5, free=False
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
    loads: tuple[str, ...] = eqx.field(static=True, default=("as_built",))


class Robot(eqx.Module):
    """All known or fitted numbers of a robot; `entries(robot)` names each of them.

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
        """Return a robot with omni wheels on a circle, each driving 90 deg ahead of its azimuth.

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
        return _with_mass(build(shape, ()), as_numbers(mass))

    def on(
        self,
        surfaces: Sequence[str],
        loads: Sequence[str] = ("as_built",),
        sessions: Sequence[str] = (),
        image_centre: tuple[float, float] = (0.0, 0.0),
    ) -> "Robot":
        """Return the same robot for these floors, load set-ups and sessions, at start values.

        `image_centre` is the point at which the camera's tilt and distortion are zero [m].
        """
        made = build(self.geometry, surfaces, loads, sessions, image_centre)
        return _with_mass(replace(made, motor=self.motor), self.body.mass)

    def surface_index(self, name: str) -> int:
        """Return the position of a floor in the stack; ValueError with the choices if unknown."""
        if name not in self.surfaces.labels:
            known = ", ".join(self.surfaces.labels)
            raise ValueError(f"no surface '{name}'; identified: {known}")
        return self.surfaces.labels.index(name)

    def load_index(self, name: str) -> int:
        """Return the position of a load set-up; ValueError with the choices if unknown."""
        if name not in self.body.loads:
            raise ValueError(f"no load set-up '{name}'; identified: {', '.join(self.body.loads)}")
        return self.body.loads.index(name)

    def session_index(self, name: str) -> int:
        """Return the position of a session, -1 for one that was not fitted."""
        return self.camera.sessions.index(name) if name in self.camera.sessions else -1


@dataclass(frozen=True)
class Validity:
    """Range of conditions of the runs on a floor; outside it the fitted numbers are extrapolated.

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


def _with_mass(robot: Robot, mass: Array) -> Robot:
    return replace(robot, body=replace(robot.body, mass=mass))


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
            load_share=as_numbers(np.full((len(loads), wheels), 1 / wheels)), loads=tuple(loads)
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


def twist(
    robot: Robot,
    frame: WheelFrame,
    wheel_speed: Float[Array, " wheel"],
    surface: Array,
    load: Array,
    near: Float[Array, "3"] | None = None,
) -> Float[Array, "3"]:
    """Return the body twist at given wheel speeds [rad/s] (vx, vy [m/s], yaw rate [rad/s]).

    `surface` and `load` are indices of the floor and the load set-up. `surface` may have one index
    per wheel, here and in the functions below; `near` is as in `contact.equilibrium`.
    """
    floor, rest = robot.surfaces.at(surface), robot.body.load_share[load]
    return contact.equilibrium(frame.radius * wheel_speed, frame, floor, rest, near)


def motor_forces(
    robot: Robot,
    frame: WheelFrame,
    xi: Float[Array, "3"],
    wheel_speed: Float[Array, " wheel"],
    surface: Array,
    load: Array,
) -> Float[Array, "wheel 2"]:
    """Return the forces against which each motor works at a twist, in units of mean(mu) m g.

    They are the traction, and the drag along the drive for `Motor.rolling_drag` 1
    (`contact.rolling_drag`).
    """
    rim, floor = frame.radius * wheel_speed, robot.surfaces.at(surface)
    where = xi, rim, frame, floor, robot.body.load_share[load]
    return jnp.stack([contact.traction(*where), contact.rolling_drag(*where)], axis=-1)


def wheel_torque(
    robot: Robot,
    frame: WheelFrame,
    xi: Float[Array, "3"],
    wheel_speed: Float[Array, " wheel"],
    surface: Array,
    load: Array,
) -> Float[Array, " wheel"]:
    """Return the torque of the traction of each wheel: r mu m g T [N m]."""
    force = jnp.mean(robot.surfaces.friction[surface]) * robot.body.mass * GRAVITY
    return frame.radius * force * motor_forces(robot, frame, xi, wheel_speed, surface, load)[..., 0]


def motor_current(
    robot: Robot,
    frame: WheelFrame,
    xi: Float[Array, "3"],
    speed: Float[Array, " drive"],
    surface: Array,
    load: Array,
) -> Float[Array, " drive"]:
    """Return the signed current of each motor [A], for the forces of its wheels and its friction.

    `speed` is the wheel speed of each drive [rad/s].
    """
    shape = robot.geometry
    force = jnp.mean(robot.surfaces.friction[surface]) * robot.body.mass * GRAVITY
    opposing = robot.motor.opposing_force(
        motor_forces(robot, frame, xi, shape.at_wheels(speed), surface, load)
    )
    return robot.motor.current(frame.radius * force * shape.at_drives(opposing), speed)
