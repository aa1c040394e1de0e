"""The record of a robot: its numbers as they are, and what the model makes of them once for all.

What the fitted runs tell of the effects of floors, as the table that robot.json has.

The motion per metre along, across and in yaw, of wheels that would not slip, is predicted to be

    contact(z) - told(z),   told(z) = mean + slope (z - z_fit)

as forecasts have it (`slipid.fit.shared_effects`). The mean of the table is what that is beyond
the contact model with the robot's numbers; what is left is the covariance of the effects given the
numbers, grown as forecasts are, and the scatter of this very sum over draws of the numbers: where
runs were near, another number is made up for by another effect.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.fit.noise import SHARED
from slipid.fit.shared_effects import AXES, SpeedAndLoad, TravelConditions
from slipid.model import contact
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import WheelFrame, at_drives, at_wheels
from slipid.model.motor import Motor
from slipid.model.robot import GRAVITY, Robot, Validity
from slipid.parameter import entries
from slipid.predict.predictive import ForceBalance
from slipid.robot import record
from slipid.robot.record import Axes, EffectRecord


def robot_record(
    robot: Robot,
    numbers: Mapping[str, record.RecordedNumber],
    std: Mapping[str, float],
    draws: Robot,
    highest_speed: float,
    current_trend: record.Pair,
    seen: Mapping[str, Validity],
    told: Mapping[str, record.EffectRecord] | None = None,
) -> record.RobotRecord:
    """The record of a robot, but for what is known of where its numbers come from.

    Args:
        robot: with every number at its value in `numbers`.
        numbers: by path; those that the deployed robot does not need, the camera's, are left out.
        std: of every variance component by name (`process.gray.along`), as runs that were not seen
            are forecast with.
        draws: the robot's posterior, stacked, for what the uncertainty of the numbers adds to the
            effects.
        highest_speed: of the wheels in the fitted runs [rad/s].
        current_trend: of currents over the model's in the fitted runs, all floors [A], [A s/m].
        seen: what the floors were seen with, as far as that is known.
        told: what the fitted runs tell of effects, by load set-up, as far as that is known.
    """
    return record.RobotRecord(
        wheels=record.Wheels(
            **{f.name: getattr(robot.geometry, f.name) for f in fields(record.Wheels)}
        ),
        parameters={p: n for p, n in numbers.items() if not p.startswith("camera.")},
        floors=tuple(_floor(name, std, seen.get(name)) for name in robot.surfaces.labels),
        loads=tuple(
            _load(robot, name, highest_speed, draws, (told or {}).get(name))
            for name in robot.body.loads
        ),
        current_trend=current_trend,
        highest_speed=highest_speed,
        draws=dict(_varied(robot, draws)),
    )


def plain(value: np.ndarray) -> record.Numbers:
    """A float, or a tuple of floats."""
    return float(value.reshape(())) if value.size == 1 else tuple(float(v) for v in value)


def _varied(robot: Robot, draws: Robot) -> Iterator[tuple[str, tuple[record.Numbers, ...]]]:
    """Paths and draws of all numbers that differ between draws, the camera's left out."""
    for e in entries(robot):
        leaf = np.asarray(reduce(getattr, e.leaf, draws))
        rows = leaf if e.index is None else leaf[:, e.index]
        if not e.path.startswith("camera.") and (rows != rows[0]).any():
            yield e.path, tuple(plain(np.asarray(row)) for row in rows)


def _floor(name: str, std: Mapping[str, float], seen: Validity | None) -> record.FloorRecord:
    """What the model misses on a floor."""

    def of(kind: str, default: record.Axes) -> np.ndarray:
        return np.array(
            [std.get(f"{kind}.{name}.{a}", d) for a, d in zip(AXES, default, strict=True)]
        )

    shared = [of(kind, (0.0, 0.0, 0.0)) ** 2 for kind in SHARED]
    effect = np.sqrt(of("run", (0.01, 0.01, 0.03)) ** 2 + sum(shared))
    kinds = [std.get(f"current.{name}.{kind}", 0.05) for kind in ("window", "run")]
    return record.FloorRecord(
        name=name,
        process=_axes(of("process", (0.005, 0.002, 0.01))),
        effect=_axes(effect),
        current_std=float((kinds[0] ** 2 + kinds[1] ** 2) ** 0.5),
        seen=seen,
    )


def _axes(row: Sequence[float] | np.ndarray) -> record.Axes:
    along, across, yaw = (float(x) for x in row)
    return along, across, yaw


def _load(
    robot: Robot, name: str, top: float, draws: Robot, told: record.EffectRecord | None
) -> record.LoadRecord:
    """What depends on how the robot is loaded."""
    shape, k = robot.geometry, jnp.asarray(robot.load_index(name))
    frame, ways = shape.frame(), directions(36)
    if not shape.determines_twist:
        ways = jnp.concatenate([ways, _turns(frame)])
    wheels, rest = _WheelArrays.of(robot), robot.body.load_share[k]
    floors, motor, mass = robot.surfaces, robot.motor, robot.body.mass
    speed, amps, slip = _circle(wheels, floors, rest, motor, mass, jnp.asarray(top), ways)
    curve = np.asarray(_wheel_curve(speed, amps, slip))
    return record.LoadRecord(
        name=name,
        spread=tuple(_axes(row) for row in _spread(robot, frame, draws, k)),
        told=told,
        highest_current=float(jnp.max(jnp.abs(amps))),
        wheel_curve=tuple((float(a), float(b)) for a, b in curve),
    )


def directions(count: int) -> Float[Array, "way 3"]:
    """Twists of 1 m/s in so many directions, without turning."""
    angle = jnp.linspace(0.0, 2 * jnp.pi, count, endpoint=False)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=-1)


def _turns(frame: WheelFrame) -> Float[Array, "way 3"]:
    """Twists on the spot, to the left and to the right, with a rim speed of 1 m/s or so."""
    return jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]) / frame.base


class _WheelArrays(eqx.Module):
    """The wheels as arrays, wherever they are: what is compiled for some serves all as many."""

    frame: WheelFrame
    forward: Float[Array, "*draw drive 3"]
    drive_of: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, robot: Robot) -> "_WheelArrays":
        shape = robot.geometry
        return cls(shape.frame(), shape.forward(), shape.drive_of)

    def rim(self, of_drives: Float[Array, "*batch drive"]) -> Float[Array, "*batch wheel"]:
        """Rim speeds of the wheels by those of their drives [m/s]."""
        return at_wheels(self.drive_of, of_drives)


@eqx.filter_jit
def _circle(
    wheels: _WheelArrays,
    surfaces: ContactSurface,
    rest: Float[Array, " wheel"],
    motor: Motor,
    mass: Array,
    top: Array,
    ways: Float[Array, "way 3"],
) -> tuple[Array, Array, Array]:
    """Wheel speeds, currents, slip ratios on every floor for all ways to move (.., drive)."""
    frame = wheels.frame
    speed = ways @ wheels.forward.T / frame.radius
    speed = jnp.stack([0.4 * top, 0.8 * top])[:, None, None] * speed / jnp.max(jnp.abs(speed))

    def one(w: Array, floor: ContactSurface) -> tuple[Array, Array]:
        turned = frame.radius * w
        rim = wheels.rim(turned)
        xi = contact.equilibrium(rim, frame, floor, rest)
        force = floor.friction * mass * GRAVITY * frame.radius
        where = xi, rim, frame, floor, rest
        motor_force = jnp.stack([contact.traction(*where), contact.rolling_drag(*where)], axis=-1)
        amps = motor.current(
            at_drives(wheels.drive_of, force * motor.opposing_force(motor_force)), w
        )
        lost = turned - wheels.forward @ xi
        return amps, lost / jnp.where(jnp.abs(turned) < 1e-9, 1e-9, turned)

    flat = speed.reshape(-1, speed.shape[-1])
    amps, slip = jax.vmap(lambda s: jax.vmap(lambda w: one(w, s))(flat))(surfaces)
    return jnp.broadcast_to(flat, amps.shape), amps, slip


@eqx.filter_jit
def _wheel_curve(speed: Array, amps: Array, slip: Array) -> Array:
    """Least squares of the slip speed on a + b |I|, drive by drive, over all floors.

    The 2021 paper's deployed form, its coefficients refitted; weighted by wheel speed, so that
    wheels that hardly turn do not decide.
    """
    flat = [x.reshape(-1, x.shape[-1]) for x in (speed, jnp.abs(amps), slip)]

    def wheel(w: Array, i: Array, s: Array) -> Array:
        a = jnp.stack([w, w * i], axis=-1)
        return jnp.linalg.solve(a.T @ a, a.T @ (w * s))

    return jax.vmap(wheel, 1)(*flat)


def _spread(
    robot: Robot, frame: WheelFrame, draws: Robot, load: Array
) -> Float[np.ndarray, "floor 3"]:
    """Std over posterior draws of the motion per metre, a row per floor (along, across, yaw).

    On average over all directions; of wheels that do not drive sideways the largest, turns on the
    spot included.
    """
    free, speed = robot.geometry.determines_twist, jnp.asarray(0.2)
    ways = directions(12) if free else jnp.concatenate([directions(2), _turns(frame)])
    std = spread_of(np.asarray(moved_per_metre(draws, load, speed, ways)))
    return np.sqrt(np.mean(std**2, axis=1)) if free else std.max(axis=1)


def spread_of(draws: Float[np.ndarray, "draw *rest"]) -> Float[np.ndarray, "*rest"]:
    """Std over draws by the middle two thirds of them: a few that get stuck do not decide."""
    low, high = np.quantile(draws, (0.1587, 0.8413), axis=0)
    return np.asarray(high - low) / 2


def moved_per_metre(
    draws: Robot, load: Array, speed: Array, way: Float[Array, "way 3"]
) -> Float[Array, "draw floor way 3"]:
    """Motion along, across and in yaw per metre of wheels that would not slip, at a speed [m/s].

    For ways to move at 1 m/s, of robots that are stacked.
    """
    rest = draws.body.load_share[:, load]
    return _moved(jax.vmap(_WheelArrays.of)(draws), draws.surfaces, rest, speed, way)


@eqx.filter_jit
def _moved(
    wheels: _WheelArrays,
    surfaces: ContactSurface,
    rest: Float[Array, "draw wheel"],
    speed: Array,
    way: Float[Array, "way 3"],
) -> Array:
    """As `moved_per_metre`."""

    def one(wheels: _WheelArrays, surfaces: ContactSurface, rest: Array) -> Array:
        rim, frame = wheels.rim(speed * way @ wheels.forward.T), wheels.frame
        xi = jax.vmap(lambda s: jax.vmap(lambda r: contact.equilibrium(r, frame, s, rest))(rim))(
            surfaces
        )
        along = jnp.einsum("fkc,kc->fk", xi[..., :2], way[:, :2])
        across = xi[..., 1] * way[:, 0] - xi[..., 0] * way[:, 1]
        return jnp.stack([along, across, xi[..., 2]], axis=-1) / speed

    return jax.vmap(one)(wheels, surfaces, rest)


DIRECTIONS = 72
"""Of the table; half of the kernel's length apart."""
_Grid = Float[np.ndarray, "floor speed direction 3"]


def effects_by_load(
    contact: ForceBalance, center: Float[np.ndarray, " free"], draws: Float[np.ndarray, "draw free"]
) -> dict[str, EffectRecord]:
    """What is told of effects by load set-up; nothing where no runs share any.

    Args:
        contact: the fit as a model that forecasts.
        center: search vector of the deployed numbers; draws: of their posterior.
    """
    paces = [pace for found in contact.shared.values() for pace in found.speeds_and_loads]
    if not paces:
        return {}
    speeds = sorted({pace.log_speed for pace in paces})
    return {
        load: _table(contact, center, draws, load, np.array(speeds))
        for load in contact.robot.body.loads
    }


def _table(
    contact: ForceBalance, center: np.ndarray, draws: np.ndarray, load: str, log_speed: np.ndarray
) -> EffectRecord:
    count, labels = len(log_speed), contact.robot.surfaces.labels
    angle = np.linspace(0.0, 2 * np.pi, DIRECTIONS, endpoint=False)
    paces = tuple(SpeedAndLoad(float(s), load) for s in log_speed for _ in angle)
    way = TravelConditions(np.tile(angle, count), paces, contact.robot.geometry.mirror())
    robots = jax.vmap(contact.space.tree)(jnp.asarray(draws))
    k = jnp.asarray(contact.robot.load_index(load))
    moved = [moved_per_metre(robots, k, jnp.exp(s), directions(DIRECTIONS)) for s in log_speed]
    predicted = np.concatenate([np.asarray(x) for x in moved], axis=2)  # speeds in turn
    shape = (len(labels), count, DIRECTIONS, len(AXES))
    mean, left = np.zeros(shape), np.zeros(shape)
    for n, floor in enumerate(labels):
        found = contact.shared[floor]
        told = found.forecast(way)
        grown = contact.extrapolation.get(f"{floor}@{load}", 1.0)
        given = np.diagonal(told.covariance, axis1=1, axis2=2) + _of(contact, "session", floor)
        off = predicted[:, n] - np.einsum("nap,kp->kna", told.slope, draws - center)
        at = told.mean + told.slope @ (center - contact.z)
        mean[n] = -at.reshape(shape[1:])
        left[n] = np.sqrt(
            _of(contact, "run", floor) + grown * (given + spread_of(off) ** 2)
        ).reshape(shape[1:])
    speeds = tuple(_short(np.exp(s)) for s in log_speed)
    return EffectRecord(speeds, _rows(mean), _rows(left))


def _of(contact: ForceBalance, kind: str, floor: str) -> Float[np.ndarray, "3"]:
    """Variances of what a run has of its own, or of what a session shares, by axis."""
    return np.array([contact.variance.get(f"{kind}.{floor}.{axis}", 0.0) for axis in AXES])


def _rows(grid: _Grid) -> tuple[tuple[tuple[Axes, ...], ...], ...]:
    def axes(row: np.ndarray) -> Axes:
        along, across, yaw = (_short(x) for x in row)
        return along, across, yaw

    return tuple(tuple(tuple(axes(a) for a in d) for d in s) for s in grid)


def _short(value: float) -> float:
    """To four digits: the table is long, and known no better."""
    return float(f"{value:.4g}")
