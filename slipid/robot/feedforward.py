"""Feed-forward gains of a robot's motors, for motion along each axis of the body.

If nothing slips, motors with the torques tau accelerate the body with the twist xi by

    J^T tau / r = M xi',    r w' = J xi'

with J the matrix from the twist to rim speeds, r the wheel radius and M = diag(m, m, I_z). If the
axes of the body do not influence each other (J^T J is diagonal), the torques of least squares that
accelerate one axis are proportional to the accelerations w' of the wheels. Every motor then has the
load of the inertia r^2 M_k / (J^T J)_kk along axis k: m r^2 / 2 for each side of a robot with two
motors, and 2 I_z r^2 / b^2 with the track b when it turns. Speeds are those of a wheel. What a
floor resists, as when wheels scrub sideways in a turn, is not included.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from slipid.model.feedforward import Feedforward, Known, feedforward, useful
from slipid.parameter import Entry
from slipid.robot.deployed import DeployedRobot
from slipid.robot.record import RecordedNumber, RobotRecord
from slipid.robot.robot_file import declared_numbers

LARGEST_COUPLING = 0.05
"""Largest cosine of the angle between two columns of J at which axes count as independent [1]."""
MOTOR = (
    *("resistance", "back_emf", "coulomb_friction", "viscous_friction", "rotor_inertia"),
    *("brush_drop", "brush_current", "brush_shape", "brush_tail", "efficiency"),
)
"""Names of the parameters of a motor that gains follow from."""
MASS, YAW_INERTIA = "robot.mass", "robot.yaw_inertia"


@dataclass(frozen=True)
class Load:
    """Inertia that each motor moves along an axis, behind the gear.

    Attributes:
        path: path of the body's inertia along the axis.
        factor: inertia at the wheel per inertia of the body, r^2 / (J^T J)_kk [m^2 or 1].
    """

    path: str
    factor: float


def robot_feedforwards(robot: DeployedRobot) -> tuple[Feedforward, ...]:
    """Return the gains along each axis: `linear`, `linear_y` if it drives sideways, and `angular`.

    If the axes influence each other, the only gains are `wheel`, those of a wheel that moves
    nothing. There are no gains if nothing was fitted, or if resistance or back-EMF are hardly
    known.
    """
    record = robot.record
    entries = {e.path: e for e in declared_numbers(record)}
    ratio = f"robot.mass_ratio@{robot.load_setup}"
    needed = [*(f"motor.{name}" for name in MOTOR), MASS, YAW_INERTIA, ratio]
    known = {path: _known(entries[path], record.parameters[path]) for path in needed}
    known[MASS] = known[MASS].times(known[ratio])
    if record.source == "given" or not useful(known["motor.resistance"], known["motor.back_emf"]):
        return ()
    gear, found = Known(float(record.wheels.gear_ratio)), []
    for name, load in _loads(robot).items():
        paths = {n: f"motor.{n}" for n in MOTOR}
        numbers = {n: known[path] for n, path in paths.items()}
        if load is not None:
            paths["load_inertia"] = load.path
            numbers["load_inertia"] = known[load.path].times(load.factor)
        correlation = _correlation(record, [*paths.values(), "wheels.gear_ratio"])
        numbers["gear_ratio"] = gear
        found.append(feedforward(name, numbers, correlation, float(robot.frame.radius)))
    return tuple(found)


def _loads(robot: DeployedRobot) -> dict[str, Load | None]:
    """Return the load along each axis; None for the load of a wheel that moves nothing."""
    forward, squared_radius = np.asarray(robot.forward, float), float(robot.frame.radius) ** 2
    axes = {"linear": (0, MASS), "linear_y": (1, MASS), "angular": (2, YAW_INERTIA)}
    if not robot.holonomic:
        del axes["linear_y"]
    columns = forward[:, [k for k, _ in axes.values()]]
    with np.errstate(invalid="ignore"):
        unit = columns / np.linalg.norm(columns, axis=0)
    coupling = np.abs(unit.T @ unit - np.eye(len(axes))).max()
    if not coupling <= LARGEST_COUPLING:  # NaN if no wheel drives along an axis
        return {"wheel": None}
    return {
        name: Load(path, squared_radius / float(forward[:, k] @ forward[:, k]))
        for name, (k, path) in axes.items()
    }


def _known(e: Entry, number: RecordedNumber) -> Known:
    """Return a parameter; one that was neither fitted nor chosen has the std of its prior.

    Such a parameter is not identified, except for the mass, which the config states. A parameter
    at 0, such as a brush drop that is not modelled, counts as exact, and so do the efficiency, at
    which friction was fitted, and the mass ratio of the first load set-up.
    """
    value = float(np.asarray(number.value))
    if number.verdict != "fixed":
        return Known(value, float(np.asarray(number.std or 0.0)), number.verdict)
    exact = e.path == "motor.efficiency" or (e.declaration.relative and e.index == 0)
    if number.provenance != "borrowed" or value == 0 or exact:
        return Known(value)
    std = float(np.asarray(e.declaration.slope(value))) * e.declaration.spread
    return Known(value, std, "fixed" if e.path == MASS else "not_identified")


def _correlation(record: RobotRecord, paths: Sequence[str]) -> Float[np.ndarray, "path path"]:
    """Return the correlations of parameters over the posterior draws of a robot.

    Those of parameters that are positive are the correlations of their logarithms.
    """
    out, draws = np.eye(len(paths)), record.draws
    drawn = [k for k, path in enumerate(paths) if path in draws]
    if len(drawn) > 1 and record.drawn > len(drawn) + 1:
        rows = [np.asarray(draws[paths[k]], float) for k in drawn]
        logs = [np.log(x) if (x > 0).all() else x for x in rows]
        out[np.ix_(drawn, drawn)] = np.corrcoef(logs)
    return out
