"""Record of a robot: its numbers, and quantities computed once from the model.

The effect table of robot.json follows from the effects that fitted runs share. As in forecasts
(`slipid.fitting.shared_effects`), the motion along, across and in yaw, per metre that the wheels
would roll without slip, is predicted to be

    contact(z) - shared(z),   shared(z) = mean + slope (z - z_fit)

with z the search vector, z_fit its value at the fit, contact(z) the motion by the contact model and
shared(z) the effect estimated from the fitted runs. The table's mean is -shared at the robot's
numbers. Its remaining variance is that of effects of single runs, plus two parts that are increased
for extrapolation as in forecasts: the variance of the shared effects given the numbers, and the
scatter of the predicted motion over posterior draws of z. Near fitted runs that scatter is small,
since the estimated effect changes with the numbers and compensates them.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import reduce
from types import MappingProxyType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.fitting.noise import SHARED
from slipid.fitting.shared_effects import AXES, SpeedAndLoad, TravelConditions
from slipid.model import contact
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import WheelFrame, at_drives, at_wheels
from slipid.model.motor import Motor
from slipid.model.robot import GRAVITY, Robot, Validity
from slipid.parameter import entries
from slipid.predict.predictive import ForceBalance
from slipid.robot import record
from slipid.robot.record import EffectRecord, axes_of, plain


def robot_record(
    robot: Robot,
    numbers: Mapping[str, record.RecordedNumber],
    std: Mapping[str, float],
    draws: Robot,
    highest_speed: float,
    current_trend: record.Pair,
    seen: Mapping[str, Validity],
    effects: Mapping[str, EffectRecord] = MappingProxyType({}),
) -> record.RobotRecord:
    """Return the record of a robot; its fields about the source of the numbers have defaults.

    Args:
        robot: robot with every number at its value in `numbers`.
        numbers: numbers by path; those of the camera are left out.
        std: std of every variance component by name (such as `process.gray.along`), as used in
            forecasts of new runs.
        draws: posterior draws of the robot, stacked, from which the uncertainty of the motion is
            computed.
        highest_speed: highest wheel speed of the fitted runs [rad/s].
        current_trend: a and b of a + b v, by which measured currents exceed the model's at speed v
            [A, A s/m].
        seen: ranges that the fitted runs cover, by floor; floors may be absent.
        effects: effect tables by load set-up; load set-ups may be absent.
    """
    return record.RobotRecord(
        wheels=record.Wheels(
            **{f.name: getattr(robot.geometry, f.name) for f in fields(record.Wheels)}
        ),
        parameters={p: n for p, n in numbers.items() if not p.startswith("camera.")},
        floors=tuple(_floor(name, std, seen.get(name)) for name in robot.surfaces.labels),
        loads=tuple(
            _load(robot, name, highest_speed, draws, effects.get(name)) for name in robot.body.loads
        ),
        current_trend=current_trend,
        highest_speed=highest_speed,
        draws=dict(_varied(robot, draws)),
    )


def _varied(robot: Robot, draws: Robot) -> Iterator[tuple[str, tuple[record.Numbers, ...]]]:
    """Yield path and draws of every number that varies over draws, except those of the camera."""
    for e in entries(robot):
        leaf = np.asarray(reduce(getattr, e.leaf, draws))
        rows = leaf if e.index is None else leaf[:, e.index]
        if not e.path.startswith("camera.") and (rows != rows[0]).any():
            yield e.path, tuple(plain(np.asarray(row)) for row in rows)


def _floor(name: str, std: Mapping[str, float], seen: Validity | None) -> record.FloorRecord:
    """Return the record of a floor's errors, from the stds of variance components by name."""

    def of(kind: str, default: record.Axes) -> np.ndarray:
        return np.array(
            [std.get(f"{kind}.{name}.{a}", d) for a, d in zip(AXES, default, strict=True)]
        )

    shared = [of(kind, (0.0, 0.0, 0.0)) ** 2 for kind in SHARED]
    effect = np.sqrt(of("run", (0.01, 0.01, 0.03)) ** 2 + sum(shared))
    kinds = [std.get(f"current.{name}.{kind}", 0.05) for kind in ("window", "run")]
    return record.FloorRecord(
        name=name,
        process=axes_of(of("process", (0.005, 0.002, 0.01))),
        effect=axes_of(effect),
        current_std=float((kinds[0] ** 2 + kinds[1] ** 2) ** 0.5),
        seen=seen,
    )


def _load(
    robot: Robot, name: str, top: float, draws: Robot, effects: EffectRecord | None
) -> record.LoadRecord:
    """Return the record of a load set-up."""
    shape, k = robot.geometry, jnp.asarray(robot.load_index(name))
    frame, twists = shape.frame(), directions(36)
    if not shape.determines_twist:
        twists = jnp.concatenate([twists, _turns(frame)])
    wheels, rest = _WheelArrays.of(robot), robot.body.load_share[k]
    floors, motor, mass = robot.surfaces, robot.motor, robot.body.mass
    speed, amps, slip = _circle(wheels, floors, rest, motor, mass, jnp.asarray(top), twists)
    curve = np.asarray(_wheel_curve(speed, amps, slip))
    return record.LoadRecord(
        name=name,
        spread=tuple(axes_of(row) for row in _spread(robot, frame, draws, k)),
        told=effects,
        highest_current=float(jnp.max(jnp.abs(amps))),
        wheel_curve=tuple((float(a), float(b)) for a, b in curve),
    )


def directions(count: int) -> Float[Array, "twist 3"]:
    """Return twists [m/s, m/s, rad/s] of 1 m/s in evenly spaced directions, without turning."""
    angle = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    return jax.device_put(np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=-1))


def _turns(frame: WheelFrame) -> Float[Array, "twist 3"]:
    """Return twists [m/s, m/s, rad/s] on the spot, left and right, at about 1 m/s rim speed."""
    return jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]) / frame.base


class _WheelArrays(eqx.Module):
    """Geometry of the wheels as arrays, so that robots of equal structure share compiled code."""

    frame: WheelFrame
    forward: Float[Array, "*draw drive 3"]
    drive_of: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, robot: Robot) -> "_WheelArrays":
        shape = robot.geometry
        return cls(shape.frame(), shape.forward(), shape.drive_of)

    def rim(self, of_drives: Float[Array, "*batch drive"]) -> Float[Array, "*batch wheel"]:
        """Return the rim speeds of the wheels from those of their drives [m/s]."""
        return at_wheels(self.drive_of, of_drives)


@eqx.filter_jit
def _circle(
    wheels: _WheelArrays,
    surfaces: ContactSurface,
    rest: Float[Array, " wheel"],
    motor: Motor,
    mass: Array,
    top: Array,
    twists: Float[Array, "twist 3"],
) -> tuple[Array, Array, Array]:
    """Return wheel speeds [rad/s], currents [A] and slip ratios [1] for some twists.

    Twists are scaled to 0.4 and 0.8 of the highest wheel speed `top` [rad/s]. Each result has the
    shape (floor, speed and twist, drive).
    """
    frame = wheels.frame
    speed = twists @ wheels.forward.T / frame.radius
    speed = jnp.stack([0.4 * top, 0.8 * top])[:, None, None] * speed / jnp.max(jnp.abs(speed))

    def one(w: Array, floor: ContactSurface) -> tuple[Array, Array]:
        turned = frame.radius * w
        rim = wheels.rim(turned)
        xi = contact.equilibrium(rim, frame, floor, rest)
        force = floor.friction * mass * GRAVITY * frame.radius
        where = xi, rim, frame, floor, rest
        forces = jnp.stack([contact.traction(*where), contact.rolling_drag(*where)], axis=-1)
        torque = at_drives(wheels.drive_of, force * motor.opposing_force(forces))
        amps = motor.current(torque, w)
        lost = turned - wheels.forward @ xi
        return amps, lost / jnp.where(jnp.abs(turned) < 1e-9, 1e-9, turned)

    flat = speed.reshape(-1, speed.shape[-1])
    amps, slip = jax.vmap(lambda s: jax.vmap(lambda w: one(w, s))(flat))(surfaces)
    return jnp.broadcast_to(flat, amps.shape), amps, slip


@eqx.filter_jit
def _wheel_curve(speed: Array, amps: Array, slip: Array) -> Array:
    """Return a and b of the slip ratio a + b |I| of each drive, fitted over all floors [1, 1/A].

    It is the form that the 2021 paper's robot used, refitted here to the contact model. The slip
    speed, wheel speed times slip ratio, is fitted by least squares, so that wheels that hardly turn
    have little weight.
    """
    flat = [x.reshape(-1, x.shape[-1]) for x in (speed, jnp.abs(amps), slip)]

    def wheel(w: Array, i: Array, s: Array) -> Array:
        a = jnp.stack([w, w * i], axis=-1)
        return jnp.linalg.solve(a.T @ a, a.T @ (w * s))

    return jax.vmap(wheel, 1)(*flat)


def _spread(
    robot: Robot, frame: WheelFrame, draws: Robot, load: Array
) -> Float[np.ndarray, "floor 3"]:
    """Return the posterior std of the motion per metre on each floor, along, across and in yaw.

    Units are [m/m, m/m, rad/m]. It is the root mean square over all directions of travel. For
    robots that cannot drive sideways it is the largest over driving ahead, back and turning on the
    spot.
    """
    free, speed = robot.geometry.determines_twist, jnp.asarray(0.2)
    twists = directions(12) if free else jnp.concatenate([directions(2), _turns(frame)])
    std = spread_of(np.asarray(moved_per_metre(draws, load, speed, twists)))
    return np.sqrt(np.mean(std**2, axis=1)) if free else std.max(axis=1)


def spread_of(draws: Float[np.ndarray, "draw *rest"]) -> Float[np.ndarray, "*rest"]:
    """Return the std over draws, as half the width of their central 68 %.

    A few outliers among the draws do not affect it.
    """
    low, high = np.quantile(draws, (0.1587, 0.8413), axis=0)
    return np.asarray(high - low) / 2


def moved_per_metre(
    draws: Robot, load: Array, speed: Array, twist: Float[Array, "twist 3"]
) -> Float[Array, "draw floor twist 3"]:
    """Return the motion along, across and in yaw, per metre that wheels would roll without slip.

    Args:
        draws: robots stacked along a leading axis.
        load: number of the load set-up.
        speed: speed of the body without slip [m/s].
        twist: twists of 1 m/s [m/s, m/s, rad/s].
    """
    rest = draws.body.load_share[:, load]
    return _moved(jax.vmap(_WheelArrays.of)(draws), draws.surfaces, rest, speed, twist)


@eqx.filter_jit
def _moved(
    wheels: _WheelArrays,
    surfaces: ContactSurface,
    rest: Float[Array, "draw wheel"],
    speed: Array,
    twist: Float[Array, "twist 3"],
) -> Array:
    """Return the result of `moved_per_metre`; this part is compiled."""

    def one(wheels: _WheelArrays, surfaces: ContactSurface, rest: Array) -> Array:
        rim, frame = wheels.rim(speed * twist @ wheels.forward.T), wheels.frame
        xi = jax.vmap(lambda s: jax.vmap(lambda r: contact.equilibrium(r, frame, s, rest))(rim))(
            surfaces
        )
        along = jnp.einsum("fkc,kc->fk", xi[..., :2], twist[:, :2])
        across = xi[..., 1] * twist[:, 0] - xi[..., 0] * twist[:, 1]
        return jnp.stack([along, across, xi[..., 2]], axis=-1) / speed

    return jax.vmap(one)(wheels, surfaces, rest)


DIRECTIONS = 72
"""Number of directions in the effect table; they are half a length of the effects' kernel apart."""
_Grid = Float[np.ndarray, "floor speed direction 3"]


def effects_by_load(
    contact: ForceBalance, center: Float[np.ndarray, " free"], draws: Float[np.ndarray, "draw free"]
) -> dict[str, EffectRecord]:
    """Return the effect table of every load set-up; empty if no runs share effects.

    Args:
        contact: fitted force balance.
        center: search vector of the robot's numbers.
        draws: posterior draws of the search vector.
    """
    speeds = {s.log_speed for shared in contact.shared.values() for s in shared.speeds_and_loads}
    if not speeds:
        return {}
    return {
        load: _effect_table(contact, center, draws, load, np.array(sorted(speeds)))
        for load in contact.robot.body.loads
    }


def _effect_table(
    contact: ForceBalance, center: np.ndarray, draws: np.ndarray, load: str, log_speed: np.ndarray
) -> EffectRecord:
    """Return the effect table of a load set-up."""
    count, labels = len(log_speed), contact.robot.surfaces.labels
    angle = np.linspace(0.0, 2 * np.pi, DIRECTIONS, endpoint=False)
    speeds = tuple(SpeedAndLoad(float(s), load) for s in log_speed for _ in angle)
    rows = TravelConditions(np.tile(angle, count), speeds, contact.robot.geometry.mirror())
    robots = jax.vmap(contact.space.tree)(jnp.asarray(draws))
    k = jnp.asarray(contact.robot.load_index(load))
    moved = [moved_per_metre(robots, k, jnp.exp(s), directions(DIRECTIONS)) for s in log_speed]
    predicted = np.concatenate([np.asarray(x) for x in moved], axis=2)  # directions for each speed
    shape = (len(labels), count, DIRECTIONS, len(AXES))
    mean, left = np.zeros(shape), np.zeros(shape)
    for n, floor in enumerate(labels):
        effect = contact.shared[floor].forecast(rows)
        growth = contact.extrapolation.get(f"{floor}@{load}", 1.0)
        given = np.diagonal(effect.covariance, axis1=1, axis2=2)
        given = given + _variances(contact, "session", floor)
        corrected = predicted[:, n] - np.einsum("nap,kp->kna", effect.slope, draws - center)
        at = effect.mean + effect.slope @ (center - contact.z)
        mean[n] = -at.reshape(shape[1:])
        variance = _variances(contact, "run", floor) + growth * (given + spread_of(corrected) ** 2)
        left[n] = np.sqrt(variance).reshape(shape[1:])
    return EffectRecord(tuple(_rounded(np.exp(s)) for s in log_speed), _rows(mean), _rows(left))


def _variances(contact: ForceBalance, kind: str, floor: str) -> Float[np.ndarray, "3"]:
    """Return the variances of one kind of effect on a floor, by axis."""
    return np.array([contact.variance.get(f"{kind}.{floor}.{axis}", 0.0) for axis in AXES])


def _rows(grid: _Grid) -> tuple[tuple[tuple[record.Axes, ...], ...], ...]:
    return tuple(tuple(tuple(axes_of(map(_rounded, a)) for a in d) for d in s) for s in grid)


def _rounded(value: float) -> float:
    """Return a number rounded to four digits, more than its accuracy, to keep the table short."""
    return float(f"{value:.4g}")
