"""What an estimator and a controller know of an identified robot, as arrays."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.model import contact
from slipid.model.contact import ContactSurface
from slipid.model.geometry import Frame
from slipid.model.motor import Motor
from slipid.model.robot import GRAVITY, Robot

AXES = ("along", "across", "yaw")


class Frozen(eqx.Module):
    """An identified robot, ready to be deployed.

    Attributes:
        labels: names of the floors, in the order of every `floor` axis below.
        frame: wheel directions; `places`: wheel centres in the body frame [m].
        forward: J (wheel, 3); `inverse`: its pseudo-inverse.
        motor: of every wheel.
        floors: stacked, a row per floor.
        rest: load shares at rest.
        mass: [kg]; yaw_inertia: [kg m^2].
        process: std of what the model misses, growing with the root of the distance, along and
            across [m/sqrt(m)] and in yaw [rad/sqrt(m)].
        effect: std of what it misses all the way, [m/m], [m/m], [rad/m]; the spread of the fitted
            numbers included.
        current_std: of a measured current from the model's [A].
        current_trend: a + b v, measured currents over the model's at speed v [A, A s/m].
        highest: wheel speed up to which the fit has seen the robot [rad/s], and the model's largest
            current up to 0.8 of it [A].
        wheel_curve: a + b |I|, the slip ratio of each wheel, of all floors together (wheel, 2).
    """

    frame: Frame
    places: Float[Array, "wheel 2"]
    forward: Float[Array, "wheel 3"]
    inverse: Float[Array, "3 wheel"]
    motor: Motor
    floors: ContactSurface
    rest: Float[Array, " wheel"]
    mass: Float[Array, ""]
    yaw_inertia: Float[Array, ""]
    process: Float[Array, "floor 3"]
    effect: Float[Array, "floor 3"]
    current_std: Float[Array, " floor"]
    current_trend: Float[Array, "2"]
    highest: Float[Array, "2"]
    wheel_curve: Float[Array, "wheel 2"]
    labels: tuple[str, ...] = eqx.field(static=True)

    @property
    def wheels(self) -> int:
        """Number of wheels."""
        return len(self.rest)

    def on(self, *floors: str) -> "Frozen":
        """For a place of which it is known that there are only these floors.

        Raises:
            ValueError: none, one twice, or one that is not identified; names those that are.
        """
        for name in floors:
            if name not in self.labels:
                raise ValueError(f"no floor '{name}'; identified: {', '.join(self.labels)}")
        if len(set(floors)) < max(len(floors), 1):
            raise ValueError(
                f"floors {list(floors)}; expected each once of {', '.join(self.labels)}"
            )
        rows = np.array([self.labels.index(name) for name in floors])
        return replace(
            self,
            floors=jax.tree.map(lambda leaf: leaf[rows], self.floors),
            process=self.process[rows],
            effect=self.effect[rows],
            current_std=self.current_std[rows],
            labels=floors,
        )


def freeze(
    robot: Robot,
    load: str,
    std: Mapping[str, float],
    draws: Any = None,
    highest_speed: float | None = None,
    current_trend: tuple[float, float] = (0.0, 0.0),
) -> Frozen:
    """Frozen form of a fitted robot.

    Args:
        robot: with every number at its fitted value.
        load: name of the load set-up it drives with.
        std: of every variance component by name, as fit.json has them (`process.gray.along`).
        draws: the robot's posterior as a batched tree (leading axis), for what the uncertainty of
            the numbers adds to `effect`; None for nothing.
        highest_speed: of the wheels in the fitted runs [rad/s].
        current_trend: of currents over the model's in the fitted runs, all floors [A], [A s/m].

    Raises:
        ValueError: no such load set-up, or wheels whose kinematics have rank below 3.
    """
    frame, k = robot.geometry.frame(), robot.load_index(load)
    labels = robot.surfaces.labels

    def of(kind: str, default: tuple[float, float, float]) -> Array:
        rows = [
            [std.get(f"{kind}.{f}.{a}", d) for a, d in zip(AXES, default, strict=True)]
            for f in labels
        ]
        return jnp.asarray(rows, dtype=float)

    effect = jnp.sqrt(of("run", (0.01, 0.01, 0.03)) ** 2 + of("session", (0.0, 0.0, 0.0)) ** 2)
    if draws is not None:
        effect = jnp.sqrt(effect**2 + _spread(draws, frame, k) ** 2)
    kinds = [
        (std.get(f"current.{f}.window", 0.05), std.get(f"current.{f}.run", 0.05)) for f in labels
    ]
    top = 20.0 if highest_speed is None else highest_speed
    speed, amps, slip = _circle(robot, frame, k, top)
    return Frozen(
        frame=frame,
        places=jnp.asarray(robot.geometry.place) * robot.geometry.base_radius,
        forward=robot.geometry.forward(),
        inverse=robot.geometry.inverse(),
        motor=robot.motor,
        floors=robot.surfaces,
        rest=robot.body.load_share[k],
        mass=robot.body.mass,
        yaw_inertia=robot.body.yaw_inertia,
        process=of("process", (0.005, 0.002, 0.01)),
        effect=effect,
        current_std=jnp.asarray([(a * a + b * b) ** 0.5 for a, b in kinds]),
        current_trend=jnp.asarray(current_trend, dtype=float),
        highest=jnp.stack([jnp.asarray(top, dtype=float), jnp.max(jnp.abs(amps))]),
        wheel_curve=_wheel_curve(speed, amps, slip),
        labels=labels,
    )


@eqx.filter_jit
def _circle(robot: Robot, frame: Frame, load: int, top: float) -> tuple[Array, Array, Array]:
    """Wheel speeds, currents, slip ratios on every floor in all directions (.., wheel)."""
    angle = jnp.linspace(0.0, 2 * jnp.pi, 36, endpoint=False)
    way = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=-1)
    speed = way @ robot.geometry.forward().T / frame.radius
    speed = jnp.stack([0.4 * top, 0.8 * top])[:, None, None] * speed / jnp.max(jnp.abs(speed))
    rest = robot.body.load_share[load]

    def one(w: Array, floor: ContactSurface) -> tuple[Array, Array]:
        rim = frame.radius * w
        xi = contact.equilibrium(rim, frame, floor, rest)
        force = floor.friction * robot.body.mass * GRAVITY * frame.radius
        torque = force * contact.forces(xi, rim, frame, floor, rest).traction
        return robot.motor.current(torque, w), (rim - robot.geometry.forward() @ xi) / (
            jnp.where(jnp.abs(rim) < 1e-9, 1e-9, rim)
        )

    flat = speed.reshape(-1, speed.shape[-1])
    amps, slip = jax.vmap(lambda s: jax.vmap(lambda w: one(w, s))(flat))(robot.surfaces)
    return jnp.broadcast_to(flat, amps.shape), amps, slip


@eqx.filter_jit
def _wheel_curve(speed: Array, amps: Array, slip: Array) -> Array:
    """Least squares of the slip speed on a + b |I|, wheel by wheel, over all floors.

    The 2021 paper's deployed form, its coefficients refitted; weighted by wheel speed, so that
    wheels that hardly turn do not decide.
    """
    flat = [x.reshape(-1, x.shape[-1]) for x in (speed, jnp.abs(amps), slip)]

    def wheel(w: Array, i: Array, s: Array) -> Array:
        a = jnp.stack([w, w * i], axis=-1)
        (p, q), (_, r) = a.T @ a
        u, v = a.T @ (w * s)
        det = p * r - q * q
        return jnp.stack([(r * u - q * v) / det, (p * v - q * u) / det])

    return jax.vmap(wheel, 1)(*flat)


@eqx.filter_jit
def _spread(draws: Any, frame: Frame, load: int) -> Array:
    """Std over posterior draws of the motion per metre, a row per floor (along, across, yaw)."""

    def one(robot: Robot) -> Array:
        frame = robot.geometry.frame()
        angle = jnp.linspace(0.0, 2 * jnp.pi, 12, endpoint=False)
        way = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=-1)
        rim = 0.2 * way @ robot.geometry.forward().T
        rest = robot.body.load_share[load]
        xi = jax.vmap(lambda s: jax.vmap(lambda r: contact.equilibrium(r, frame, s, rest))(rim))(
            robot.surfaces
        )
        along = jnp.einsum("fkc,kc->fk", xi, way)
        across = xi[..., 1] * way[:, 0] - xi[..., 0] * way[:, 1]
        return jnp.stack([along, across, xi[..., 2]], axis=-1) / 0.2

    seen = jax.vmap(one)(draws)
    return jnp.sqrt(jnp.mean(jnp.var(seen, axis=0), axis=1))
