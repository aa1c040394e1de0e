"""One instant's physics over time: replay of measured wheels, simulation of commanded ones.

Both integrate the body by implicit Euler on the twist and exactly on SE(2):

    0 = contact forces(xi, r w) - M (xi - xi_before) / dt,     pose <- pose * exp(xi dt)

with M = 0 (quasi-static) unless the body's inertia is asked for. `jax.vmap` lifts both over runs.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from slipid.model import contact
from slipid.model.geometry import Frame
from slipid.model.motor import Motor
from slipid.model.robot import GRAVITY, Robot, twist, wheel_torque
from slipid.model.se2 import path

_NEWTON = 6
_DAMPING = (1.0, 0.5, 0.2, 0.05)


_Five = tuple[Array, Array, Array, Array, Array]
_number = partial(eqx.field, converter=jnp.asarray)


class SpeedLoop(eqx.Module):
    """PI control of each wheel's speed with feed-forward of the back-EMF, in volts.

    U = clip(kf C_e n w_ref + kp (w_ref - w) + ki integral(w_ref - w) dt, -limit, limit)

    Attributes:
        proportional: kp [V s/rad] per wheel speed.
        integral: ki [V/rad].
        feed_forward: kf [1], share of the back-EMF at the set speed.
        limit: largest voltage [V]; the integral rests while it is reached.
    """

    proportional: Float[Array, ""] = _number(default=0.8)
    integral: Float[Array, ""] = _number(default=8.0)
    feed_forward: Float[Array, ""] = _number(default=1.0)
    limit: Float[Array, ""] = _number(default=24.0)

    def control(
        self, motor: Motor, want: Array, w: Array, total: Array, dt: Array | float
    ) -> tuple[Array, Array]:
        """Voltage of this step and the integral after it."""
        gap = want - w
        ahead = self.feed_forward * motor.back_emf * motor.gear_ratio * want
        asked = ahead + self.proportional * gap + self.integral * (total + gap * dt)
        volt = jnp.clip(asked, -self.limit, self.limit)
        return volt, jnp.where(volt == asked, total + gap * dt, total)


class Simulated(eqx.Module):
    """A simulated run, everything at the instants of `time`; voltages hold until the next one.

    Attributes:
        time: [s]; wheel_angle: [rad]; wheel_speed: [rad/s]; current: [A], signed; voltage: [V];
            twist: of the body [m/s, m/s, rad/s]; pose: of the body [m, m, rad].
    """

    time: Float[Array, " time"]
    wheel_angle: Float[Array, "time wheel"]
    wheel_speed: Float[Array, "time wheel"]
    current: Float[Array, "time wheel"]
    voltage: Float[Array, "time wheel"]
    twist: Float[Array, "time 3"]
    pose: Float[Array, "time 3"]


def inertia(robot: Robot, surface: Int[Array, ""] | int) -> Float[Array, "3"]:
    """Mass, mass and yaw inertia in units of mean(mu) m g [s^2/m, s^2/m, s^2 m]."""
    weight = jnp.mean(robot.surfaces.at(surface).friction) * robot.body.mass * GRAVITY
    return jnp.stack([robot.body.mass, robot.body.mass, robot.body.yaw_inertia]) / weight


def replay_twist(
    robot: Robot,
    dt: Float[Array, " step"],
    wheel_speed: Float[Array, "step wheel"],
    surface: Int[Array, ""] | Int[Array, " step"] | int,
    load: Int[Array, ""] | int,
    *,
    body_inertia: bool = False,
) -> Float[Array, "step 3"]:
    """Body twists of a robot whose wheels turn at given speeds.

    Args:
        dt: length of every step [s].
        wheel_speed: mean over every step [rad/s].
        surface: index of the floor, one or one per step.
        body_inertia: the body starts at rest and has mass; otherwise forces balance at once.

    Source: `slipid.model.contact`.
    """
    frame, load = robot.geometry.frame(), jnp.asarray(load)
    floors = jnp.broadcast_to(jnp.asarray(surface), dt.shape)
    if not body_inertia:
        return jax.vmap(lambda w, floor: twist(robot, frame, w, floor, load))(wheel_speed, floors)
    rest = robot.body.load_share[load]

    def step(before: Array, now: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        w, floor, h = now
        rim, mass = frame.radius * w, inertia(robot, floor)
        xi = contact.step_with_inertia(rim, frame, robot.surfaces.at(floor), rest, before, mass, h)
        return xi, xi

    return jax.lax.scan(step, jnp.zeros(3), (wheel_speed, floors, dt))[1]


def replay(
    robot: Robot,
    time: Float[Array, " time"],
    wheel_angle: Float[Array, "time wheel"],
    surface: Int[Array, ""] | Int[Array, " step"] | int,
    load: Int[Array, ""] | int,
    start: Float[Array, "3"] | None = None,
    *,
    body_inertia: bool = False,
) -> Float[Array, "time 3"]:
    """Body poses [m, m, rad] of a robot whose wheels turned as measured.

    Args:
        wheel_angle: [rad] at every time [s].
        surface, load, body_inertia: as of `replay_twist`.
        start: first pose, at the origin by default.
    """
    dt = jnp.diff(time)
    speed = jnp.diff(wheel_angle, axis=0) / dt[:, None]
    xi = replay_twist(robot, dt, speed, surface, load, body_inertia=body_inertia)
    return path(xi, dt, jnp.zeros(3) if start is None else start)


def simulate(
    robot: Robot,
    loop: SpeedLoop,
    command: Float[Array, "step wheel"],
    dt: Float[Array, ""] | float,
    surface: Int[Array, ""] | Int[Array, " step"] | int,
    load: Int[Array, ""] | int,
    start: Float[Array, "3"] | None = None,
    *,
    inductance: bool = False,
    body_inertia: bool = True,
) -> Simulated:
    """Run from rest under speed commands, through speed loop, motor, wheel and contact.

        L_a dI/dt = U - R I - C_e n w - brush drop          (L_a = 0 without `inductance`)
        n^2 J_m dw/dt = n eta C_e I - friction(w) - traction torque(xi, w)

    Args:
        command: set speed of each wheel in each step [rad/s].
        dt: step [s]; implicit Euler, so stiff floors are no bar, a millisecond or two is precise.
        surface: index of the floor, one or one per step.
        start: first pose, at the origin by default.
        inductance: the current takes L_a / R to rise.
        body_inertia: the body has mass; otherwise its forces balance at once.
    """
    frame, load = robot.geometry.frame(), jnp.asarray(load)
    floors = jnp.broadcast_to(jnp.asarray(surface), command.shape[:1])
    still = jnp.zeros(command.shape[1])

    def step(state: _Five, now: tuple[Array, Array]) -> tuple[_Five, _Five]:
        xi, w, amps, angle, total = state
        want, floor = now
        volt, total = loop.control(robot.motor, want, w, total, dt)
        mass = inertia(robot, floor) / dt if body_inertia else jnp.zeros(3)
        henry = robot.motor.inductance if inductance else jnp.zeros(())
        w, amps = _Step(robot, frame, floor, load, mass, henry, dt, volt, xi, w, amps).wheels()
        # the twist anew, by the robust root finder: exactly what `replay` makes of these wheels
        rest, rim = robot.body.load_share[load], frame.radius * w
        near = (rim, frame, robot.surfaces.at(floor), rest)
        if body_inertia:
            xi = contact.step_with_inertia(*near, xi, mass * dt, dt)
        else:
            xi = contact.equilibrium(*near)
        angle = angle + w * dt
        return (xi, w, amps, angle, total), (xi, w, amps, angle, volt)

    first = (jnp.zeros(3), still, still, still, still)
    _, (xi, w, amps, angle, volt) = jax.lax.scan(step, first, (command, floors))
    steps = jnp.full(command.shape[:1], dt)

    def led(x: Array) -> Array:
        return jnp.concatenate([jnp.zeros((1, x.shape[1])), x])

    return Simulated(
        time=jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)]),
        wheel_angle=led(angle),
        wheel_speed=led(w),
        current=led(amps),
        voltage=jnp.concatenate([volt, volt[-1:]]),
        twist=led(xi),
        pose=path(xi, steps, jnp.zeros(3) if start is None else start),
    )


class _Step(eqx.Module):
    """What wheels, motors and body go through in one implicit Euler step.

    Attributes:
        mass: of the body over the time step [mu m g s/m]; henry: inductance of the motors [H].
        volt: of the motors; xi, w, amps: twist, wheel speeds and currents before the step.
    """

    robot: Robot
    frame: Frame
    floor: Int[Array, ""]
    load: Int[Array, ""]
    mass: Float[Array, "3"]
    henry: Float[Array, ""]
    dt: Float[Array, ""] | float
    volt: Float[Array, " wheel"]
    xi: Float[Array, "3"]
    w: Float[Array, " wheel"]
    amps: Float[Array, " wheel"]

    def balance(self, y: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """Residuals of contact [mu m g], wheels and motors [N m] at twist, speeds and currents."""
        robot, motor, count = self.robot, self.robot.motor, len(self.w)
        xi, w, amps = y[:3], y[3 : 3 + count], y[3 + count :]
        surface, rest = robot.surfaces.at(self.floor), robot.body.load_share[self.load]
        felt = contact.forces(xi, self.frame.radius * w, self.frame, surface, rest)
        body = felt.residual - (self.mass * (xi - self.xi)).at[2].divide(self.frame.base)
        rotor = motor.gear_ratio**2 * motor.rotor_inertia
        load_torque = wheel_torque(robot, self.frame, xi, w, self.floor, self.load)
        wheel = motor.torque(amps, w) - load_torque - rotor * (w - self.w) / self.dt
        stall = motor.gear_ratio * motor.efficiency * motor.back_emf / motor.resistance  # [N m/V]
        rise = self.henry * (amps - self.amps) / self.dt
        electric = stall * (self.volt - motor.voltage(amps, w) - rise)
        return jnp.concatenate([body, wheel, electric])

    def wheels(self) -> tuple[Float[Array, " wheel"], Float[Array, " wheel"]]:
        """Wheel speeds and currents after the step, solved together with the twist."""

        def newton(y: Array, _: None) -> tuple[Array, None]:
            dy = _eliminate(jax.jacfwd(self.balance)(y), self.balance(y))

            def merit(alpha: Array) -> Array:
                g = self.balance(y - alpha * dy)
                return jnp.where(jnp.all(jnp.isfinite(g)), g @ g, jnp.inf)

            damping = jnp.asarray(_DAMPING)
            best = damping[jnp.argmin(jax.vmap(merit)(damping))]
            return y - best * dy, None

        y = jnp.concatenate([self.xi, self.w, self.amps])
        y, count = jax.lax.scan(newton, y, None, length=_NEWTON)[0], len(self.w)
        return y[3 : 3 + count], y[3 + count :]


def _eliminate(m: Array, b: Array) -> Array:
    """m^-1 b by Gauss-Jordan; without pivots, implicit steps have heavy diagonals."""
    a = jnp.concatenate([m, b[:, None]], axis=1)
    for k in range(m.shape[0]):
        row = a[k] / a[k, k]
        a = (a - a[:, k : k + 1] * row).at[k].set(row)
    return a[:, -1]
