"""Record of a robot: its parameters, and quantities computed once from the model.

The effect table of robot.json is computed from the effects that fitted runs share. As in forecasts
(`slipid.fitting.shared_effects`), the motion along, across and in yaw, per metre that the wheels
would roll without slip, is predicted to be

    contact(z) - shared(z),   shared(z) = mean + slope (z - z_fit)

where z is the search vector (the robot's free parameters), z_fit its value at the fit, contact(z)
the motion by the contact model and shared(z) the effect estimated from the fitted runs. The table's
mean is -shared(z) at the robot's parameters. The table's remaining variance is the variance of
effects of single runs, plus two terms that are increased for extrapolation as in forecasts: the
variance of the shared effects at given parameters, and the scatter of the predicted motion over
posterior draws of z. Near fitted runs that scatter is small, since the estimated effect changes
with the parameters and compensates for them.
"""

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.fitting.noise import SHARED
from slipid.fitting.session_effects import on_floor
from slipid.fitting.shared_effects import AXES, SpeedAndLoad, TravelConditions
from slipid.model import contact
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import Geometry, WheelFrame
from slipid.model.robot import Robot, Validity, steady_states
from slipid.parameter import Numbers, entries
from slipid.predict.predictive import ForceBalance
from slipid.robot import record
from slipid.robot.record import EffectRecord, axes_of, plain
from slipid.support.blocks import in_blocks

HEADROOM = 1.2
"""Highest wheel speed that is allowed, over the highest one of the runs [1]."""
MOST_YAW_RATE, ACCELERATION = 2.0, 1.0
"""Limits of a robot about which nothing is known: yaw rate [rad/s], acceleration of the rim of a
wheel [m/s^2]."""
NO_LIMIT = 1e6
"""Highest current of a robot whose currents are not modelled [A]."""


def robot_record(
    robot: Robot,
    numbers: Mapping[str, record.RecordedNumber],
    std: Mapping[str, float],
    draws: Robot,
    highest_speed: float,
    current_trend: record.Pair,
    seen: Mapping[str, Validity],
    effects: Mapping[str, EffectRecord] = MappingProxyType({}),
    settings: Mapping[str, record.Setting] = MappingProxyType({}),
) -> record.RobotRecord:
    """Return the record of a robot, with default values of the fields about the record's origin.

    Args:
        robot: robot with every parameter at its value in `numbers`.
        numbers: parameters keyed by path; the camera's parameters are not recorded.
        std: std of every variance component, keyed by its name such as `process.gray.along`, as
            used in forecasts of new runs.
        draws: posterior draws of the robot, stacked along a leading axis, from which the
            uncertainty of the motion is computed.
        highest_speed: highest wheel speed of the fitted runs [rad/s].
        current_trend: a [A] and b [A s/m] of the excess a + b v of measured over modelled currents
            at a body speed v.
        seen: ranges that the fitted runs cover, keyed by floor; floors may be absent.
        effects: effect tables keyed by load set-up; load set-ups may be absent.
        settings: known limits, noise of sensors and delays, keyed by path such as `limits.speed`.
    """
    loads = tuple(
        _load(robot, name, highest_speed, draws, effects.get(name))
        if robot.geometry.driven is None
        else _without_forces(robot, name)
        for name in robot.body.loads
    )
    return record.RobotRecord(
        wheels=record.Wheels(
            **{f.name: getattr(robot.geometry, f.name) for f in fields(record.Wheels)}
        ),
        parameters={p: n for p, n in numbers.items() if not p.startswith("camera.")},
        floors=tuple(_floor(name, std, seen.get(name)) for name in robot.surfaces.labels),
        loads=loads,
        current_trend=current_trend,
        highest_speed=highest_speed,
        limits=replace(
            assumed_limits(
                robot,
                settings.get(
                    "limits.wheel_speed", record.Setting(HEADROOM * highest_speed, "logs")
                ),
                max(load.highest_current for load in loads),
            ),
            **_known(settings, "limits"),
        ),
        sensors=record.LogSensors(**_known(settings, "sensors")),
        actuators=record.ActuatorRecord(**_known(settings, "actuators")),
        draws=dict(_varied(robot, draws)),
    )


def _known(settings: Mapping[str, record.Setting], group: str) -> dict[str, Any]:
    """Return the settings of a group, keyed by name."""
    start = f"{group}."
    return {path.removeprefix(start): s for path, s in settings.items() if path.startswith(start)}


def assumed_limits(
    robot: Robot, wheel_speed: record.Setting, current: float
) -> record.LimitsRecord:
    """Return limits of a robot of which only the highest wheel speed [rad/s] is known.

    The body may move as fast as the wheels allow in its slowest direction, and yaw at
    `MOST_YAW_RATE` at most. The voltage is what the motor's model needs for that wheel speed at a
    current [A], so that it limits nothing.
    """
    shape, motor = robot.geometry, robot.motor
    frame, top = shape.frame(), wheel_speed.value
    forward, rim = np.abs(frame.forward()), top * float(frame.radius)
    # a wheel rolls fastest where the body moves along its row of `forward`
    ahead = np.hypot(*forward[:, :2].T) if shape.determines_twist else forward[:, 0]
    yaw_rate = min(rim / max(float(forward[:, 2].max()), 1e-9), MOST_YAW_RATE)
    volt = float(motor.back_emf) * float(shape.gear_ratio) * top
    if current < NO_LIMIT:
        volt += float(motor.resistance) * current
    return record.LimitsRecord(
        speed=record.Setting(rim / float(ahead.max())),
        yaw_rate=record.Setting(yaw_rate),
        acceleration=record.Setting(ACCELERATION),
        wheel_speed=wheel_speed,
        voltage=record.Setting(volt),
    )


def _varied(robot: Robot, draws: Robot) -> Iterator[tuple[str, tuple[record.Numbers, ...]]]:
    """Yield path and draws of every parameter that was fitted, except the camera's.

    A fitted parameter is recognised by values that differ between draws.
    """
    for e in entries(robot):
        leaf = np.asarray(e.whole(draws))
        rows = leaf if e.index is None else leaf[:, e.index]
        if not e.path.startswith("camera.") and (rows != rows[0]).any():
            yield e.path, tuple(plain(np.asarray(row)) for row in rows)


def _floor(name: str, std: Mapping[str, float], seen: Validity | None) -> record.FloorRecord:
    """Return the record of a floor's errors; `std` has variance components keyed by name.

    Tuples of numbers, and 0.05, are the stds that are assumed if a component is absent.
    """
    shared = sum(on_floor(std, kind, name) ** 2 for kind in SHARED)
    effect = np.sqrt(on_floor(std, "run", name, (0.01, 0.01, 0.03)) ** 2 + shared)
    kinds = [std.get(f"current.{name}.{kind}", 0.05) for kind in ("window", "run")]
    return record.FloorRecord(
        name=name,
        process=axes_of(on_floor(std, "process", name, (0.005, 0.002, 0.01))),
        effect=axes_of(effect),
        current_std=float((kinds[0] ** 2 + kinds[1] ** 2) ** 0.5),
        seen=seen,
    )


def _load(
    robot: Robot, name: str, top: float, draws: Robot, effects: EffectRecord | None
) -> record.LoadRecord:
    """Return the record of a load set-up."""
    shape, k = robot.geometry, robot.load_index(name)
    frame, twists = shape.frame(), directions(36)
    if not shape.determines_twist:
        twists = np.concatenate([twists, _turns(frame)])
    speed, amps, slip, _ = _operating_points(robot, k, top, twists)
    curve = _wheel_curve(speed, amps, slip)
    return record.LoadRecord(
        name=name,
        spread=tuple(axes_of(row) for row in _spread(robot, frame, draws, k)),
        told=effects,
        highest_current=float(np.abs(amps).max()),
        wheel_curve=tuple((float(a), float(b)) for a, b in curve),
        inverse_kinematics=tuple(
            tuple(axes_of(row) for row in rows) for rows in _inverse_kinematics(robot, k, top)
        ),
    )


def _without_forces(robot: Robot, name: str) -> record.LoadRecord:
    """Return the record of a load set-up of a robot that steers, which has no force balance."""
    return record.LoadRecord(
        name=name,
        spread=((0.0, 0.0, 0.0),) * len(robot.surfaces.labels),
        told=None,
        highest_current=NO_LIMIT,
        wheel_curve=((0.0, 0.0),) * robot.geometry.drives,
    )


def directions(count: int) -> Float[np.ndarray, "twist 3"]:
    """Return twists [m/s, m/s, rad/s] of 1 m/s in evenly spaced directions, without turning."""
    angle = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=-1)


def _turns(frame: WheelFrame) -> Float[np.ndarray, "twist 3"]:
    """Return twists [m/s, m/s, rad/s] that turn left and right at about 1 m/s rim speed."""
    return np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]) / np.asarray(frame.base)


def _operating_points(
    robot: Robot, load: int, top: float, twists: Float[np.ndarray, "twist 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return wheel speeds [rad/s], currents [A], slip ratios [1] and twists in steady states.

    The wheel speeds are those that without slip give each twist, scaled so that the fastest wheel
    turns at 0.4 and at 0.8 of the highest wheel speed `top` [rad/s]. Each result has a row for
    every floor, speed and twist, and a column for every drive.
    """
    frame = robot.geometry.frame()
    forward, radius = np.asarray(frame.forward()), float(frame.radius)
    speed = twists @ forward.T
    speed *= top / np.abs(speed).max()
    floors = len(robot.surfaces.labels)
    speed = np.tile(np.concatenate([0.4 * speed, 0.8 * speed]), (floors, 1))
    found = steady_states(robot, speed, np.repeat(np.arange(floors), len(speed) // floors), load)
    turned = radius * speed
    lost = turned - found.twist @ forward.T
    slip = lost / np.where(np.abs(turned) < 1e-9, 1e-9, turned)
    return speed, found.current, slip, found.twist


def _inverse_kinematics(robot: Robot, load: int, top: float) -> Float[np.ndarray, "floor drive 3"]:
    """Return the matrices from a body twist to the wheel speeds that it needs on every floor.

    The matrices are fitted by least squares to steady states of the force balance, with equal
    relative weight. The motions are straight ones, turns, and both together.
    """
    shape = robot.geometry
    frame, axes = shape.frame(), [0, 1, 2] if shape.determines_twist else [0, 2]
    straight = directions(12 if shape.determines_twist else 2)
    turns = _turns(frame)
    both = (0.7 * straight[:, None] + 0.5 * turns).reshape(-1, 3)
    twists = np.concatenate([straight, turns, both])
    speed, _, _, twist = _operating_points(robot, load, top, twists)
    out = np.zeros((len(robot.surfaces.labels), shape.drives, 3))
    weight = 1 / np.linalg.norm(speed, axis=-1, keepdims=True)
    pairs = zip(np.split(weight * twist, len(out)), np.split(weight * speed, len(out)), strict=True)
    for k, (moved, turned) in enumerate(pairs):
        out[k][:, axes] = np.linalg.lstsq(moved[:, axes], turned)[0].T
    return out


def _wheel_curve(
    speed: Float[np.ndarray, "row drive"],
    amps: Float[np.ndarray, "row drive"],
    slip: Float[np.ndarray, "row drive"],
) -> Float[np.ndarray, "drive 2"]:
    """Return a and b of the slip ratio a + b |I| of each drive, fitted over all floors [1, 1/A].

    The form a + b |I| was used on the 2021 paper's robot; here it is fitted to the contact model.
    Least squares are applied to the slip speed (wheel speed times slip ratio), so that slow wheels
    have little weight.
    """
    a = np.stack([speed, speed * np.abs(amps)], axis=-1)
    normal = np.einsum("nda,ndb->dab", a, a)
    return np.linalg.solve(normal, np.einsum("nda,nd->da", a, speed * slip)[..., None])[..., 0]


def _spread(
    robot: Robot, frame: WheelFrame, draws: Robot, load: int
) -> Float[np.ndarray, "floor 3"]:
    """Return the posterior std of the motion per metre on each floor, along, across and in yaw.

    Units are [m/m, m/m, rad/m]. The std is the root mean square over all directions of travel. For
    robots that cannot drive sideways it is the largest std of driving ahead, driving back and
    turning on the spot.
    """
    free = robot.geometry.determines_twist
    twists = directions(12) if free else np.concatenate([directions(2), _turns(frame)])
    std = spread_of(moved_per_metre(draws, load, 0.2, twists))
    return np.sqrt(np.mean(std**2, axis=1)) if free else std.max(axis=1)


def spread_of(draws: Float[np.ndarray, "draw *rest"]) -> Float[np.ndarray, "*rest"]:
    """Return the std over draws, estimated as half the width of their central 68 %.

    Unlike the usual estimate, it is not affected by a few outliers among the draws.
    """
    low, high = np.quantile(draws, (0.1587, 0.8413), axis=0)
    return np.asarray(high - low) / 2


def moved_per_metre(
    draws: Robot, load: int | Array, speed: float | Array, twist: Numbers
) -> Float[np.ndarray, "draw floor twist 3"]:
    """Return the motion along, across and in yaw, per metre that wheels would roll without slip.

    Args:
        draws: robots stacked along a leading axis.
        load: index of the load set-up.
        speed: speed of the body without slip [m/s].
        twist: twists of 1 m/s [m/s, m/s, rad/s].
    """
    count, floors = len(draws.body.mass), len(draws.surfaces.labels)
    at, floor, way = (x.ravel() for x in np.indices((count, floors, len(twist))))
    frames = jax.tree.map(lambda x: np.asarray(x)[at], jax.vmap(Geometry.frame)(draws.geometry))
    surfaces = jax.tree.map(lambda x: np.asarray(x)[at, floor], draws.surfaces)
    rest, ahead = np.asarray(draws.body.load_share)[at, int(load)], np.asarray(twist)[way]
    xi = in_blocks(_equilibria, frames, surfaces, rest, float(speed) * ahead) / float(speed)
    along = (xi[:, :2] * ahead[:, :2]).sum(axis=1)
    across = xi[:, 1] * ahead[:, 0] - xi[:, 0] * ahead[:, 1]
    return np.stack([along, across, xi[:, 2]], axis=-1).reshape(count, floors, -1, 3)


@eqx.filter_jit
def _equilibria(
    frames: WheelFrame, surface: ContactSurface, rest: Array, twist: Array
) -> Float[Array, "row 3"]:
    """Return the twists by contact equilibrium, for wheel speeds that without slip give `twist`."""

    def one(frame: WheelFrame, surface: ContactSurface, rest: Array, twist: Array) -> Array:
        rim = frame.at_wheels(frame.forward() @ twist)
        return contact.equilibrium(rim, frame, surface, rest)

    return jax.vmap(one)(frames, surface, rest, twist)


DIRECTIONS = 72
"""Number of directions in the effect table; they are half the width of the effects' Gaussian kernel
apart."""
_Grid = Float[np.ndarray, "floor speed direction 3"]


def effects_by_load(
    contact: ForceBalance, center: Float[np.ndarray, " free"], draws: Float[np.ndarray, "draw free"]
) -> dict[str, EffectRecord]:
    """Return the effect table of every load set-up; empty if no runs share effects.

    Args:
        contact: fitted force balance.
        center: search vector of the robot's parameters.
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
    k = contact.robot.load_index(load)
    moved = [moved_per_metre(robots, k, np.exp(s), directions(DIRECTIONS)) for s in log_speed]
    # join the speeds along the axis of twists, in the order of `rows`: all directions of a speed
    predicted = np.concatenate(moved, axis=2)
    shape = (len(labels), count, DIRECTIONS, len(AXES))
    mean, left = np.zeros(shape), np.zeros(shape)
    for n, floor in enumerate(labels):
        effect = contact.shared[floor].forecast(rows)
        growth = contact.extrapolation.get(f"{floor}@{load}", 1.0)
        given = np.diagonal(effect.covariance, axis1=1, axis2=2)
        given = given + on_floor(contact.variance, "session", floor)
        corrected = predicted[:, n] - np.einsum("nap,kp->kna", effect.slope, draws - center)
        at = effect.mean + effect.slope @ (center - contact.z)
        mean[n] = -at.reshape(shape[1:])
        variance = on_floor(contact.variance, "run", floor) + growth * (
            given + spread_of(corrected) ** 2
        )
        left[n] = np.sqrt(variance).reshape(shape[1:])
    return EffectRecord(tuple(_rounded(np.exp(s)) for s in log_speed), _rows(mean), _rows(left))


def _rows(grid: _Grid) -> tuple[tuple[tuple[record.Axes, ...], ...], ...]:
    return tuple(tuple(tuple(axes_of(map(_rounded, a)) for a in d) for d in s) for s in grid)


def _rounded(value: float) -> float:
    """Round a number to four digits, which exceeds its accuracy, to keep the table short."""
    return float(f"{value:.4g}")
