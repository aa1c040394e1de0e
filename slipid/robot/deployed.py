"""Arrays of an identified robot from robot.json, as used by estimators and controllers.

A robot that may drive on floors without identified parameters can be given hypothetical floors.
Floors differ mainly in softness. Over the floors in the public logs of 2022 and on the virtual test
site, the logarithm of roller drag rises with the logarithm of creep at a slope of 0.8. So a
hypothetical floor is the geometric mean of the known floors, made softer or harder along this
slope, and with more or less friction. Currents and a gyro show which hypothetical floor an
unfamiliar floor resembles; without these sensors the hypothetical floors have little influence,
since their prior probability is low. Their parameters are not identified, and the motion on them is
uncertain by a tenth of the path length and 0.3 rad per metre.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import Drives, Geometry, WheelFrame
from slipid.model.kinematics import Steering
from slipid.model.motor import Motor
from slipid.model.robot import Standing
from slipid.parameter import as_numbers
from slipid.robot.filter.effects import EffectLookup
from slipid.robot.record import (
    Axes,
    FloorRecord,
    LoadRecord,
    Numbers,
    RecordedNumber,
    RobotRecord,
    axes_of,
    plain,
)
from slipid.robot.robot_file import REWRITE_HINT, check_record, read_robot, write_robot
from slipid.support.errors import DataError


class RobotArrays(Drives):
    """Arrays of an identified robot with one load set-up, for estimators and controllers.

    Compiled code depends only on the static fields, which describe the robot's structure, so robots
    of equal structure share the code, whatever their parameters are. A drive is a motor with its
    encoder and ammeter. Every wheel has its own drive unless a motor drives several wheels.

    Attributes:
        frame: directions and radii of the wheels.
        places: wheel centres in the body frame [m].
        forward: matrix J (drive, 3) from body twist [m/s, m/s, rad/s] to rim speeds [m/s].
        inverse: pseudo-inverse of J (3, drive).
        motor: constants of the motor, which all drives share.
        floors: contact parameters, one row per floor in the order of `labels`.
        rest: fraction of the weight on each wheel at rest [1].
        mass: mass of the robot [kg].
        process: std of the model's random errors along and across [m/sqrt(m)] and in yaw
            [rad/sqrt(m)]; these errors grow with the root of the path length.
        effect: std of the effects (model errors that stay the same over the path) along and across
            [m/m] and in yaw [rad/m]; it includes the posterior spread of the fitted parameters.
        effect_table: estimates of the effects from the fitted runs, by direction and speed.
        friction_covariance: posterior covariance of the floors' log friction coefficients.
        current_std: std of measured less modelled currents, without the ammeters' noise [A].
        current_trend: a [A] and b [A s/m] of the excess a + b v of measured over modelled currents
            at a body speed v [m/s].
        highest: highest wheel speed of the fitted runs [rad/s], and the largest current that the
            model predicts at up to 0.8 of that speed [A].
        wheel_curve: a [1] and b [1/A] of the slip ratio a + b |I| of each drive at a current I [A],
            fitted over all floors.
        drive_of: drive of each wheel, see `slipid.model.geometry.Drives`.
        around: order of the wheels around the body, see `slipid.model.geometry.Geometry`.
        holonomic: True if the wheels determine motion ahead, sideways and in yaw; other robots
            cannot drive sideways.
        kinematics: matrix from wheel speeds to the body twist on each floor, zero where the force
            balance is used [m/rad, m/rad, 1].
        inverse_kinematics: matrix from a body twist to wheel speeds on each floor: the inverse of
            `kinematics`, or of the force balance, linearised [rad/m, rad/m, 1].
        unseen: for each floor, True if no run drove on it.
        calibrated: for each floor, True if `kinematics` is used while all wheels are on it.
        steering: steering on each floor of a robot that steers, which has no force balance; None
            for others.
    """

    frame: WheelFrame
    places: Float[Array, "wheel 2"]
    forward: Float[Array, "drive 3"]
    inverse: Float[Array, "3 drive"]
    motor: Motor
    floors: ContactSurface
    rest: Float[Array, " wheel"]
    mass: Float[Array, ""]
    process: Float[Array, "floor 3"]
    effect: Float[Array, "floor 3"]
    effect_table: EffectLookup
    friction_covariance: Float[Array, "floor floor"]
    current_std: Float[Array, " floor"]
    current_trend: Float[Array, "2"]
    highest: Float[Array, "2"]
    wheel_curve: Float[Array, "drive 2"]
    kinematics: Float[Array, "floor 3 drive"]
    inverse_kinematics: Float[Array, "floor drive 3"]
    drive_of: tuple[int, ...] = eqx.field(static=True)
    around: tuple[int, ...] = eqx.field(static=True)
    holonomic: bool = eqx.field(static=True)
    unseen: tuple[bool, ...] = eqx.field(static=True)
    calibrated: tuple[bool, ...] = eqx.field(static=True)
    steering: Steering | None = eqx.field(default=None, kw_only=True)

    @property
    def arrays(self) -> "RobotArrays":
        """The robot's arrays without its record."""
        return RobotArrays(**{f.name: getattr(self, f.name) for f in fields(RobotArrays)})

    @property
    def wheels(self) -> int:
        return len(self.around)

    @property
    def by_wheels(self) -> Float[Array, "3 wheel"]:
        """Matrix from the wheels' rim speeds to body twist; wheels of one drive are averaged."""
        if not self.drive_of:
            return self.inverse
        return self.inverse @ self.on_average(jnp.eye(self.wheels)).T

    def standing(self, under: Int[Array, " wheel"]) -> Standing:
        """Return the robot standing on floors with the indices `under`, one for each wheel."""
        return Standing(self.frame, self.floors.at(under), self.rest, self.motor, self.mass)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the floors, in the order of every `floor` axis."""
        return self.floors.labels


class DeployedRobot(RobotArrays):
    """An identified robot ready for deployment: the content of robot.json for one load set-up.

    Attributes:
        record: content of robot.json, every parameter with its interval, verdict and provenance.
        load_setup: name of the load set-up.
    """

    record: RobotRecord = eqx.field(static=True)
    load_setup: str = eqx.field(static=True)

    @property
    def has_controller(self) -> bool:
        """True unless wheels are steered: a robot that steers has only an estimator."""
        return self.steering is None

    @classmethod
    def of(cls, record: RobotRecord, load: str | None = None) -> "DeployedRobot":
        """Return the robot that a record describes, with the named or else its first load set-up.

        Raises:
            ValueError: there is no such load set-up, or a parameter is missing or out of bounds.
        """
        check_record(record)
        return _arrays(record, load, {path: n.value for path, n in record.parameters.items()})

    @classmethod
    def load(cls, path: Path | str, load: str | None = None) -> "DeployedRobot":
        """Return the robot in a file that `slipid identify`, `slipid sample` or `save` wrote.

        `load` is the name of the load set-up, by default the first one in the file.

        Raises:
            DataError: the file is absent, damaged, changed by hand or of another schema version, or
                has no such load set-up.
        """
        record = read_robot(Path(path))
        try:
            record.load_index(load)
        except ValueError as error:
            raise DataError(f"{path}: {error}") from error
        try:
            return cls.of(record, load)
        except ValueError as error:
            raise DataError(f"{path}: {error}; {REWRITE_HINT}") from error

    def save(self, path: Path | str) -> None:
        """Write robot.json, with all load set-ups.

        Raises:
            ValueError: the arrays were changed and so differ from the record; only the record can
                be stored in a file.
            DataError: the file cannot be written.
        """
        same = DeployedRobot.of(self.record, self.load_setup)
        pairs = zip(jax.tree.leaves(self), jax.tree.leaves(same), strict=True)
        if not all(np.array_equal(a, b) for a, b in pairs):
            raise ValueError(
                "the arrays of this robot were changed and differ from its record, but only the "
                "record can be stored in a file; expected an unchanged robot"
            )
        write_robot(Path(path), self.record)

    def on(self, *floors: str) -> "DeployedRobot":
        """Return the robot for a site on which only these floors occur.

        Raises:
            ValueError: no floor is given, or a floor is given twice or is not identified; the
                message lists the identified floors.
        """
        known = ", ".join(self.labels)
        for name in floors:
            if name not in self.labels:
                raise ValueError(f"no floor '{name}'; identified: {known}")
        if len(set(floors)) < max(len(floors), 1):
            raise ValueError(
                f"floors {list(floors)}; expected one or more of {known}, each at most once"
            )
        rows = tuple(self.labels.index(name) for name in floors)
        return DeployedRobot.of(self.record.on(rows), self.load_setup)

    def with_unseen(self) -> "DeployedRobot":
        """Return the robot with additional floors `unseen_1`, `unseen_2`, ... that no run drove on.

        On an unfamiliar floor the robot's estimator then selects the additional floor that explains
        the currents best, with a large uncertainty of the motion. Without additional floors it
        would select an identified floor.
        """
        if self.steering is not None:
            raise ValueError("no hypothetical floors for a robot that steers: they need forces")
        return DeployedRobot.of(with_unseen(self.record), self.load_setup)


def with_record(robot: RobotArrays) -> DeployedRobot:
    """Return the same robot, typed as `DeployedRobot`, if it includes its record.

    Raises:
        ValueError: the robot consists only of arrays.
    """
    if not isinstance(robot, DeployedRobot):
        raise ValueError(
            "this robot has arrays but no record; expected a DeployedRobot, or explicit settings "
            "for the estimator, and gains and limits for the controller"
        )
    return robot


def posterior_robots(robot: DeployedRobot, picked: tuple[int, ...]) -> DeployedRobot:
    """Return the robots of the posterior draws with indices `picked`, stacked along a leading axis.

    The stacked `effect` is the std of effects without the posterior spread of the parameters, since
    the draws themselves show that spread. `effect_table`, `highest` and `wheel_curve` are the same
    for all draws.
    """
    record, one = robot.record, []
    fitted = {path: n.value for path, n in record.parameters.items()}
    for k in picked:
        values = fitted | {path: rows[k] for path, rows in record.draws.items()}
        one.append(_arrays(record, robot.load_setup, values, spread=False))
    return jax.tree.map(lambda *leaves: jax.device_put(np.stack(leaves)), *one)


def _arrays(
    record: RobotRecord, load: str | None, values: Mapping[str, Numbers], spread: bool = True
) -> DeployedRobot:
    """Return the robot of a record and a load set-up with the parameters `values`, keyed by path.

    With `spread`, the std of effects and the covariance of frictions include the posterior
    uncertainty of the parameters.
    """
    place = record.load_index(load)
    chosen, wheels, floors = record.loads[place], record.wheels, record.floors

    def of(prefix: str, kind: type[eqx.Module]) -> dict[str, Array]:
        names = [f.name for f in fields(kind) if "parameter" in f.metadata]
        return {name: as_numbers(values[f"{prefix}.{name}"]) for name in names}

    shape: dict[str, Any] = of("robot", Geometry) | vars(wheels)
    geometry = Geometry(**shape)
    rows = [of(f"surface.{floor.name}", ContactSurface) for floor in floors]
    effect = np.array([floor.effect for floor in floors], dtype=float)
    with np.errstate(over="ignore"):
        whole = np.sqrt(effect**2 + np.array(chosen.spread, dtype=float) ** 2)
    return DeployedRobot(
        frame=geometry.frame(),
        places=as_numbers(np.asarray(geometry.place) * np.asarray(geometry.base_radius)),
        forward=geometry.forward(),
        inverse=geometry.pseudo_inverse(),
        motor=Motor(**of("motor", Motor), gear_ratio=as_numbers(wheels.gear_ratio)),
        floors=ContactSurface(
            **{name: as_numbers(np.stack([row[name] for row in rows])) for name in rows[0]},
            labels=record.labels,
        ),
        rest=as_numbers(np.atleast_1d(values[f"robot.load_share@{chosen.name}"])),
        mass=as_numbers(
            np.asarray(values["robot.mass"]) * values[f"robot.mass_ratio@{chosen.name}"]
        ),
        process=as_numbers([floor.process for floor in floors]),
        effect=as_numbers(whole if spread else effect),
        effect_table=_effect_table(chosen, whole),
        friction_covariance=as_numbers(_friction_covariance(record) * spread),
        current_std=as_numbers([floor.current_std for floor in floors]),
        current_trend=as_numbers(record.current_trend),
        highest=as_numbers([record.highest_speed, chosen.highest_current]),
        wheel_curve=as_numbers(chosen.wheel_curve),
        kinematics=as_numbers(
            [floor.kinematics or np.zeros((3, geometry.drives)) for floor in floors]
        ),
        inverse_kinematics=as_numbers(_inverse_kinematics(record, chosen, geometry)),
        drive_of=wheels.drive_of,
        around=geometry.around,
        holonomic=geometry.determines_twist,
        unseen=tuple(floor.unseen for floor in floors),
        calibrated=tuple(floor.kinematics is not None for floor in floors),
        steering=_steering(record),
        record=record,
        load_setup=chosen.name,
    )


def _inverse_kinematics(
    record: RobotRecord, load: LoadRecord, geometry: Geometry
) -> Float[np.ndarray, "floor drive 3"]:
    """Return the matrices from a body twist to wheel speeds on every floor [rad/m, rad/m, 1].

    Wheels roll without slip where a record has no such matrix. A robot that cannot drive sideways
    ignores the sideways velocity.
    """
    with np.errstate(over="ignore"):
        rolling = np.asarray(geometry.forward()) / float(geometry.wheel_radius)
    axes = [0, 1, 2] if geometry.determines_twist else [0, 2]
    out = np.tile(rolling, (len(record.floors), 1, 1))
    for k, floor in enumerate(record.floors):
        if floor.kinematics is not None:
            out[k] = 0.0
            out[k][:, axes] = np.linalg.pinv(np.array(floor.kinematics)[axes])
        elif load.inverse_kinematics is not None:
            out[k] = load.inverse_kinematics[k]
    return out


def _steering(record: RobotRecord) -> Steering | None:
    """Return the steering on every floor, or None if no wheel is steered."""
    s = record.steering
    if s is None:
        return None
    front = float(record.wheels.driven == "front")
    rows = [(f.wheelbase, s.zero, s.gain, s.understeer, front) for f in record.floors]
    return Steering(*(as_numbers(column) for column in zip(*rows, strict=True)))


def _effect_table(load: LoadRecord, whole: Float[np.ndarray, "floor 3"]) -> EffectLookup:
    """Return the effect table of a load set-up, with remaining stds as fractions of `whole`.

    `whole` (floor, 3) is the std that each floor's effects have without a table [m/m, m/m, rad/m].
    """
    if load.told is None:
        return EffectLookup.empty(len(whole))
    told = load.told
    mean, left, speeds = (np.array(x, float) for x in (told.mean, told.left, told.speeds))
    part = left / np.maximum(whole[:, None, None], 1e-12)
    return EffectLookup(as_numbers(np.log(speeds)), as_numbers(np.concatenate([mean, part], -1)))


def _friction_covariance(record: RobotRecord) -> Float[np.ndarray, "floor floor"]:
    """Return the posterior covariance of the floors' log frictions; it is 0 for fixed frictions."""
    still = (1.0,) * max(record.drawn, 1)
    paths = [f"surface.{name}.friction" for name in record.labels]
    logs = np.log(np.array([record.draws.get(path, still) for path in paths], dtype=float))
    off = logs - logs.mean(axis=1, keepdims=True)
    return np.asarray(off @ off.T / off.shape[1])


LOG_CREEPS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Log ratios of creep to that of the middle floor (see `_middle`) [1]. The range exceeds the prior
std over floors, which is 1.5."""
DRAG_EXPONENT = 0.8
"""Exponent d of the assumed proportionality of roller drag to creep^d over floors [1]."""
LOG_FRICTIONS = (-0.4, 0.4)
"""Log ratios of friction to that of the middle floor [1]; the prior std over floors is 0.5."""
EFFECT: Axes = (0.1, 0.1, 0.3)
"""Std of the effects on a hypothetical floor [m/m, m/m, rad/m]."""
CURRENT_FACTOR = 1.5
"""Std of modelled currents on a hypothetical floor, relative to the mean of known floors [1]."""
_SIGNED = ("lead", "load_bias", "rolling_radius")
_UNSEEN_NAME = "unseen_{}"


def with_unseen(record: RobotRecord) -> RobotRecord:
    """Return the robot with hypothetical floors `unseen_1`, `unseen_2`, ..., added at the end.

    A robot that already has hypothetical floors is returned unchanged.

    Raises:
        ValueError: a known floor has the name of a hypothetical floor.
    """
    if any(floor.unseen for floor in record.floors):
        return record
    middle = _middle(record)
    grid = tuple(product(LOG_CREEPS, LOG_FRICTIONS))
    names = [_UNSEEN_NAME.format(k + 1) for k in range(len(grid))]
    if taken := set(names) & set(record.labels):
        raise ValueError(
            f"floor '{min(taken)}': this name is reserved for hypothetical floors without a run; "
            "rename the floor"
        )
    parameters = dict(record.parameters)
    for name, (soft, grip) in zip(names, grid, strict=True):
        factor = {"creep": soft, "roller_drag": DRAG_EXPONENT * soft, "friction": grip}
        for quantity, number in middle.items():
            value = np.asarray(np.exp(factor.get(quantity, 0.0)) * np.asarray(number.value))
            parameters[f"surface.{name}.{quantity}"] = replace(number, value=plain(value))
    process = np.mean([floor.process for floor in record.floors], axis=0)
    current_std = CURRENT_FACTOR * float(np.mean([floor.current_std for floor in record.floors]))
    one = FloorRecord("", axes_of(process), EFFECT, current_std, seen=None, unseen=True)
    floors = tuple(replace(one, name=name) for name in names)
    return replace(
        record,
        parameters=parameters,
        floors=record.floors + floors,
        loads=tuple(_load_with_floors(load, len(names)) for load in record.loads),
    )


def _middle(record: RobotRecord) -> dict[str, RecordedNumber]:
    """Return the parameters of the middle floor, keyed by name.

    Parameters are geometric means over the known floors, or arithmetic means if they have a sign.
    """
    first = f"surface.{record.labels[0]}."
    middle_floor: dict[str, RecordedNumber] = {}
    for path, number in record.parameters.items():
        if not path.startswith(first):
            continue
        quantity = path.removeprefix(first)
        each = np.array([record.parameters[f"surface.{n}.{quantity}"].value for n in record.labels])
        signed = quantity in _SIGNED
        middle = each.mean(axis=0) if signed else np.exp(np.log(each).mean(axis=0))
        value = plain(np.asarray(middle))
        middle_floor[quantity] = RecordedNumber(
            value, number.unit, verdict="not_identified", provenance="borrowed"
        )
    return middle_floor


def _load_with_floors(load: LoadRecord, count: int) -> LoadRecord:
    """Return a load set-up extended by `count` floors whose effects are unknown."""
    spread = axes_of(np.mean(load.spread, axis=0))
    inverse = load.inverse_kinematics
    if inverse is not None:
        middle = np.mean(inverse, axis=0)
        inverse += (tuple(axes_of(row) for row in middle),) * count
    one = replace(load, spread=load.spread + (spread,) * count, inverse_kinematics=inverse)
    if load.told is None:
        return one
    left, shape = axes_of(np.hypot(EFFECT, spread)), np.shape(load.told.mean)
    zeros, lefts = ((((axes,) * shape[2],) * shape[1],) * count for axes in ((0.0, 0.0, 0.0), left))
    effects = replace(load.told, mean=load.told.mean + zeros, left=load.told.left + lefts)
    return replace(one, told=effects)
