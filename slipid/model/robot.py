"""The whole robot as one tree of declared numbers: wheels, motors, floors, loads, camera."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from slipid.model import contact
from slipid.model.contact import ContactSurface
from slipid.model.geometry import Frame, Geometry
from slipid.model.motor import Motor
from slipid.parameter import entries, parameter

GRAVITY = 9.81
"""[m/s^2]"""


class Body(eqx.Module):
    """Mass and how it rests on the wheels; the leading axis of `load_share` is the load set-up."""

    mass: Array = parameter(
        unit="kg", symbol="m", start=10.0, lower=0.0, spread=0.1, free=False, doc="mass"
    )
    yaw_inertia: Array = parameter(
        unit="kg*m^2", symbol="I_z", start=0.2, lower=0.0, spread=0.5, free=False, doc="inertia"
    )
    load_share: Array = parameter(
        unit="1",
        symbol="N0",
        start=1 / 3,
        spread=0.5,
        shares=True,
        per="loads",
        doc="share of the weight on each wheel at rest",
    )
    loads: tuple[str, ...] = eqx.field(static=True, default=("as_built",))


class Camera(eqx.Module):
    """From the body on the floor to the logged pose.

    Logged places are corrected by `corrected`: true = scale * Q(q), q from the image centre, with
    Q(q) = (q (1 + k q.q) + p q.q + 2 q (p.q)) / (1 + tilt.q): perspective of a tilted camera,
    radial and tangential distortion (Brown 1966, Conrady 1919; first order of each). The marker's
    heading is the body's plus `marker_yaw`, with an own deviation per session in which it was put
    on.
    """

    scale: Array = parameter(
        unit="1",
        symbol="s",
        start=1.0,
        lower=0.0,
        spread=0.02,
        free=False,
        doc="true over logged length",
    )
    lag: Array = parameter(
        unit="s", symbol="t_c", start=0.0, spread=0.03, free=False, doc="camera behind the encoders"
    )
    marker_yaw: Array = parameter(
        unit="rad",
        symbol="psi",
        start=0.0,
        spread=0.03,
        free=False,
        doc="marker heading less body's",
    )
    session_yaw: Array = parameter(
        unit="rad",
        symbol="dpsi",
        start=0.0,
        spread=0.01,
        free=False,
        per="sessions",
        doc="its change",
    )
    marker_place: Array = parameter(
        unit="m",
        symbol="p_m",
        start=0.0,
        spread=0.02,
        free=False,
        doc="marker from the body's centre",
    )
    tilt: Array = parameter(
        unit="1/m",
        symbol="h",
        start=0.0,
        spread=0.03,
        free=False,
        doc="perspective of a tilted camera",
    )
    radial: Array = parameter(
        unit="1/m^2", symbol="k", start=0.0, spread=0.02, free=False, doc="radial distortion"
    )
    tangential: Array = parameter(
        unit="1/m", symbol="p", start=0.0, spread=0.02, free=False, doc="decentred lens"
    )
    centre: tuple[float, float] = eqx.field(static=True, default=(0.0, 0.0))
    sessions: tuple[str, ...] = eqx.field(static=True, default=())

    def corrected(self, pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """Pose in true metres, heading turned as the map turns it; the marker yaw stays in."""
        u = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
        place, turned = jax.jvp(self._ground, (pose[:2],), (u,))
        turn = jnp.arctan2(u[0] * turned[1] - u[1] * turned[0], u @ turned)
        return jnp.concatenate([place, (pose[2] + turn)[None]])

    def logged(self, pose: Float[Array, "3"]) -> Float[Array, "3"]:
        """What is logged of a true pose: the inverse of `corrected`, by iteration.

        Every step shrinks the error by the bend of the map, some percent across a picture.
        """
        step = jnp.stack([self.scale, self.scale, jnp.ones(())])
        q = (pose / step).at[:2].add(jnp.asarray(self.centre))
        for _ in range(12):
            q = q + (pose - self.corrected(q)) / step
        return q

    def log_jacobian(self, pose: Float[Array, "3"]) -> Float[Array, ""]:
        """Log |d corrected / d pose|, which a density of logged poses has beside its residuals.

        With m the derivative of the map of places and u the heading's direction the place gives
        log |m|, the heading log(|m| / |m u|^2).
        """
        m = jax.jacfwd(self._ground)(pose[:2])
        turned = m @ jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
        area = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        return 2 * jnp.log(area) - jnp.log(turned @ turned)

    def _ground(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """True place on the floor of a logged one."""
        q = place - jnp.asarray(self.centre)
        p, r2 = self.tangential, q @ q
        bent = q * (1 + self.radial * r2) + p * r2 + 2 * q * (p @ q)
        return self.scale * bent / (1 + self.tilt @ q)

    def yaw(self, session: Int[Array, ""] | int) -> Float[Array, ""]:
        """Marker heading less body heading in a session; an unknown one (-1) has the common yaw."""
        if not self.sessions:
            return self.marker_yaw
        own = jnp.where(session >= 0, self.session_yaw[session], 0.0)
        return self.marker_yaw + own

    def seen(
        self, increment: Float[Array, "3"], session: Int[Array, ""] | int
    ) -> Float[Array, "3"]:
        """Body-frame increment of the marker from the body's (x, y [m], yaw [rad])."""
        c, s = jnp.cos(increment[2]), jnp.sin(increment[2])
        px, py = self.marker_place[0], self.marker_place[1]
        x = increment[0] + (c - 1) * px - s * py
        y = increment[1] + s * px + (c - 1) * py
        psi = self.yaw(session)
        c, s = jnp.cos(psi), jnp.sin(psi)
        return jnp.stack([c * x + s * y, c * y - s * x, increment[2]])


class Robot(eqx.Module):
    """Everything that is known or fitted; `entries(robot)` names every number.

    Attributes:
        surfaces: floors, stacked in the order of `surfaces.labels`.
    """

    geometry: Geometry = eqx.field(metadata={"path": "robot"})
    body: Body = eqx.field(metadata={"path": "robot"})
    motor: Motor
    surfaces: ContactSurface = eqx.field(metadata={"path": "surface"})
    camera: Camera

    def surface_index(self, name: str) -> int:
        """Place of a floor in the stack.

        Raises:
            ValueError: no such floor; names those there are.
        """
        if name not in self.surfaces.labels:
            known = ", ".join(self.surfaces.labels)
            raise ValueError(f"no surface '{name}'; identified: {known}")
        return self.surfaces.labels.index(name)

    def load_index(self, name: str) -> int:
        """Place of a load set-up; ValueError with the choices when there is none."""
        if name not in self.body.loads:
            raise ValueError(f"no load set-up '{name}'; identified: {', '.join(self.body.loads)}")
        return self.body.loads.index(name)

    def session_index(self, name: str) -> int:
        """Place of a session, -1 for one that was not fitted."""
        return self.camera.sessions.index(name) if name in self.camera.sessions else -1


def build(
    geometry: Geometry,
    surfaces: Sequence[str],
    loads: Sequence[str] = ("as_built",),
    sessions: Sequence[str] = (),
    centre: tuple[float, float] = (0.0, 0.0),
) -> Robot:
    """Robot with every number at its declared start, for these floors, loads and sessions."""
    names = sorted(surfaces)
    single = ContactSurface()
    stack = {e.path: jnp.full((len(names),), e.get(single)) for e in entries(single)}
    wheels = geometry.wheels
    return Robot(
        geometry=geometry,
        body=Body(load_share=jnp.full((len(loads), wheels), 1 / wheels), loads=tuple(loads)),
        motor=Motor(gear_ratio=geometry.gear_ratio),
        surfaces=ContactSurface(**stack, labels=tuple(names)),
        camera=Camera(
            session_yaw=jnp.zeros(len(sessions)),
            marker_place=jnp.zeros(2),
            tilt=jnp.zeros(2),
            tangential=jnp.zeros(2),
            centre=centre,
            sessions=tuple(sessions),
        ),
    )


def twist(
    robot: Robot,
    frame: Frame,
    wheel_speed: Float[Array, " wheel"],
    surface: Array,
    load: Array,
    near: Float[Array, "3"] | None = None,
) -> Float[Array, "3"]:
    """Quasi-static body twist on floor `surface` (index) with load set-up `load` (index).

    `surface` may have one index per wheel, here and below.

    Args:
        near: a twist so close that plain Newton steps arrive; NaN comes back where they do not.
    """
    floor, rest = robot.surfaces.at(surface), robot.body.load_share[load]
    rim = frame.radius * wheel_speed
    if near is None:
        return contact.equilibrium(rim, frame, floor, rest)
    return contact.equilibrium_near(near, rim, frame, floor, rest)


def felt(
    robot: Robot,
    frame: Frame,
    xi: Float[Array, "3"],
    wheel_speed: Float[Array, " wheel"],
    surface: Array,
    load: Array,
) -> Float[Array, " wheel"]:
    """Traction each motor works against at a twist, in units of mean(mu) m g."""
    rim = frame.radius * wheel_speed
    floor = robot.surfaces.at(surface)
    return contact.forces(xi, rim, frame, floor, robot.body.load_share[load]).traction


def wheel_torque(
    robot: Robot,
    frame: Frame,
    xi: Float[Array, "3"],
    wheel_speed: Float[Array, " wheel"],
    surface: Array,
    load: Array,
) -> Float[Array, " wheel"]:
    """Torque each motor delivers at the wheel, friction excluded: r mu m g T [N m]."""
    force = jnp.mean(robot.surfaces.friction[surface]) * robot.body.mass * GRAVITY
    return frame.radius * force * felt(robot, frame, xi, wheel_speed, surface, load)


def advance(xi: Float[Array, "3"], dt: Float[Array, ""] | float) -> Float[Array, "3"]:
    """Pose increment in the frame of its start after moving at a constant twist (exact SE(2))."""
    w = xi[2] * dt
    small = jnp.abs(w) < 1e-6
    safe = jnp.where(small, 1.0, w)
    a = jnp.where(small, 1.0 - w * w / 6, jnp.sin(safe) / safe)
    b = jnp.where(small, 0.5 * w, (1 - jnp.cos(safe)) / safe)
    return jnp.stack([(a * xi[0] - b * xi[1]) * dt, (b * xi[0] + a * xi[1]) * dt, w])


def compose(pose: Float[Array, "3"], increment: Float[Array, "3"]) -> Float[Array, "3"]:
    """Pose after a body-frame increment."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = increment[0], increment[1]
    return jnp.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y, pose[2] + increment[2]])
