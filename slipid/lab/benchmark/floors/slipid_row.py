"""A robot of which only the contact and the motors are known, as the floor filter drives it.

slipid's own row: numbers of floors by currents and turning, and the estimator's floor filter.

The filter is the one that is deployed (`slipid.robot.estimator.Estimator`); it hears wheels,
currents and the gyro. What it is told here beside the floors' numbers:

- what the ammeters show of a motor that brakes (`slipid.lab.benchmark.floors.fitting`);
- how much currents scatter on each floor, apart for going straight, in bends and on the spot: the
  robot knows which of them its wheels do;
- that all wheels are on one floor, which stays.

At its first row it takes the wheels to turn as measured, and not to have stood before.

The numbers of floors, motors and scatters are of the runs that are fitted. `SETTINGS`, `BENDS`,
what meters show and the weights in `slipid.lab.benchmark.floors.fitting` are not picked by an inner
cross-validation, as settings of other rows are: they were set by hand after about a hundred
variants were compared by their cross-validated accuracy on `borealtc`. Its accuracy there is
flattered by as much as that choice fits these very runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.deploy.deploy import given_numbers
from slipid.lab.benchmark.floors.fitting import (
    MeteredMotor,
    currents_off,
    fitted_floors,
    scatter_of,
    stiffness_of,
)
from slipid.lab.systems.floors.interface import Beliefs, FloorClassifier, FloorSignals, floors_of
from slipid.model.contact_law import ContactSurface
from slipid.model.robot import Robot
from slipid.predict.slip_model import RobotSpec
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator, EstimatorState
from slipid.robot.interface import Readings, Settings
from slipid.robot.record import FloorRecord, LoadRecord, RobotRecord, Wheels

HIGHEST_A, HIGHEST_SPEED = 100.0, 20.0
"""Of what is measured; what is far above it is no reading [A], [rad/s]."""


def deployed(robot: Robot) -> DeployedRobot:
    """The robot as it drives, its numbers as they are.

    What the floor filter does not use, a robot's uncertainty and what a fit has seen, is left at
    values that limit nothing.
    """
    shape = robot.geometry
    none = (0.0, 0.0, 0.0)
    load = LoadRecord(
        name=robot.body.loads[0],
        spread=(none,) * len(robot.surfaces.labels),
        told=None,
        highest_current=HIGHEST_A,
        wheel_curve=((0.0, 0.0),) * shape.drives,
    )
    record = RobotRecord(
        wheels=Wheels(**{f.name: getattr(shape, f.name) for f in fields(Wheels)}),
        parameters={
            path: n for path, n in given_numbers(robot).items() if not path.startswith("camera.")
        },
        floors=tuple(
            FloorRecord(name=name, process=none, effect=none, current_std=1.0, seen=None)
            for name in robot.surfaces.labels
        ),
        loads=(load,),
        current_trend=(0.0, 0.0),
        highest_speed=HIGHEST_SPEED,
        draws={},
    )
    return DeployedRobot.of(record)


BENDS = (0.17, 0.45)
"""L |W| / (|v| + L |W|) from which a robot goes in a bend, and on the spot."""
TOGETHER = 64
"""Runs that the filter hears in one call."""
SHARED_ROWS = 20.0
"""Rows that the scatter on a floor as a whole counts as, for that in each kind of motion."""
MOST_ROWS = 150
"""Of a run at most, for the scatter."""
SETTINGS = Settings(
    current_is_signed=False,
    forget_s=4.0,
    filter_s=0.02,
    patch_m=50.0,
    further_floor_penalty=27.0,
    unknown_std=4.0,
    ammeter_std_a=0.1,
    gyro_std=0.08,
)
"""Currents of neighbouring rows are alike for seconds (`forget_s`), and one row alone is no mean of
others (`filter_s`); `gyro_std` is about what the fits leave of the yaw rate."""


@dataclass(frozen=True, eq=False)
class FittedFloors:
    """What is known of floors.

    Attributes:
        surfaces: their numbers; motor: with its ammeter.
        std: of currents in each kind of motion on each floor [A].
    """

    surfaces: ContactSurface
    motor: MeteredMotor
    std: Float[np.ndarray, "kind floor"]


@dataclass(frozen=True)
class SlipidFloorClassifier(FloorClassifier):
    """slipid's floor filter.

    Attributes:
        robot: as its maker has it, on no floor.
        zero_a: what its ammeters show of wheels that stand [A].
        settings: of the estimator.
        fitted: None before.
    """

    name: str = "slipid"
    robot: Robot | None = None
    zero_a: float = 0.0
    settings: Settings = SETTINGS
    fitted: FittedFloors | None = field(default=None, repr=False)

    def fit(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> "SlipidFloorClassifier":
        labels = floors_of(felts)
        seen = [self._heard(felt) for felt in felts]
        robot = self._on(labels)
        motor = MeteredMotor.of(
            robot.motor, jnp.asarray(stiffness_of(seen)), jnp.asarray(scatter_of(seen))
        )
        robot = fitted_floors(replace(robot, motor=motor), seen)
        std = _scatter(robot, seen, spec)
        return replace(self, labels=labels, fitted=FittedFloors(robot.surfaces, motor, std))

    def probability(self, felts: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if self.fitted is None:
            raise ValueError(f"{self.name} was not fitted")
        plain = deployed(self._on(self.labels))
        robot = replace(plain, floors=self.fitted.surfaces, motor=self.fitted.motor)
        estimator = Estimator(robot, self.settings)
        std, out = jnp.asarray(self.fitted.std), []
        rows = -(-max(len(felt) for felt in felts) // 8) * 8
        for first in range(0, len(felts), TOGETHER):
            some = [self._heard(felt) for felt in felts[first : first + TOGETHER]]
            beliefs = np.asarray(_driven(estimator, std, _FilterRows.of(some, rows, spec)))
            out += [beliefs[k, : len(felt)] for k, felt in enumerate(some)]
        return [row[:, :-1] / row[:, :-1].sum(axis=1, keepdims=True) for row in out]

    @property
    def numbers(self) -> int:
        """Three of each floor and its scatters, and those of the motors."""
        if self.fitted is None:
            return 0
        return 3 * len(self.labels) + self.fitted.std.size + len(self.fitted.motor.stiffness)

    def _on(self, labels: tuple[str, ...]) -> Robot:
        """The robot on floors that have not been fitted."""
        if self.robot is None:
            raise ValueError(f"{self.name}: which robot? none was given")
        robot = self.robot.on(labels)
        none = jnp.zeros(len(labels))
        # patches that lead and drag by the load are for soft floors under omni wheels
        surfaces = replace(robot.surfaces, lead=none, drag_exponent=none + 1.0)
        return replace(robot, surfaces=surfaces)

    def _heard(self, felt: FloorSignals) -> FloorSignals:
        """The run with currents over the zero of the ammeters, and nothing below it."""
        return replace(felt, current=np.maximum(np.abs(felt.current) - self.zero_a, 0.0))


def kinds(felt: FloorSignals, spec: RobotSpec) -> Int[np.ndarray, " row"]:
    """How a robot goes in each row: 0 straight, 1 in a bend, 2 on the spot."""
    x, y, yaw = felt.rolling(spec).T
    turn = spec.base_radius * np.abs(yaw)
    return np.digitize(turn / np.maximum(np.hypot(x, y) + turn, 1e-9), BENDS)


def _scatter(
    robot: Robot, felts: Sequence[FloorSignals], spec: RobotSpec
) -> Float[np.ndarray, "kind floor"]:
    """Std of currents about the model's on every floor, straight, in bends and on the spot [A]."""
    count = len(BENDS) + 1
    std = np.ones((count, len(robot.surfaces.labels)))
    for k, floor in enumerate(robot.surfaces.labels):
        speed, current, kind = [], [], []
        for felt in (felt for felt in felts if felt.floor == floor):
            take = np.flatnonzero(felt.moves)
            take = take[:: max(1, len(take) // MOST_ROWS)]
            speed.append(felt.speed[take])
            current.append(felt.current[take])
            kind.append(kinds(felt, spec)[take])
        off = currents_off(robot, k, np.concatenate(speed), np.concatenate(current))
        squares, of_kind = (off**2).mean(axis=1), np.concatenate(kind)
        for n in range(count):
            mine = squares[of_kind == n]
            shared = SHARED_ROWS * squares.mean()
            std[n, k] = np.sqrt((mine.sum() + shared) / (len(mine) + SHARED_ROWS))
    return std


class _FilterRows(eqx.Module):
    """What the filter hears, run by run and row by row.

    Attributes:
        speed, current, gyro: as of `FloorSignals`.
        dt: how long each row stands for [s]; 0 of rows that a run is filled up with.
        kind: how the robot goes, see `kinds`.
    """

    speed: Float[Array, "*run row drive"]
    current: Float[Array, "*run row drive"]
    gyro: Float[Array, "*run row"]
    dt: Float[Array, "*run row"]
    kind: Int[Array, "*run row"]

    @classmethod
    def of(cls, felts: Sequence[FloorSignals], rows: int, spec: RobotSpec) -> "_FilterRows":
        """Runs side by side, filled up to so many rows and to `TOGETHER` runs."""
        drives = felts[0].speed.shape[1]
        speed, current = np.zeros((2, TOGETHER, rows, drives))
        gyro, dt = np.full((TOGETHER, rows), np.nan), np.zeros((TOGETHER, rows))
        kind = np.zeros((TOGETHER, rows), dtype=int)
        for k, felt in enumerate(felts):
            n = len(felt)
            speed[k, :n], current[k, :n] = felt.speed, felt.current
            # a robot that stands feels nothing
            dt[k, :n] = np.where(felt.moves, felt.dt, 0.0)
            gyro[k, :n] = np.nan if felt.gyro is None else felt.gyro
            kind[k, :n] = kinds(felt, spec)
        return cls(*(jnp.asarray(x) for x in (speed, current, gyro, dt, kind)))


@eqx.filter_jit
def _driven(
    estimator: Estimator, std: Float[Array, "kind floor"], runs: _FilterRows
) -> Float[Array, "run row floor_or_none"]:
    """Probability of every floor, and of none, under the robot after every row."""
    nothing = Readings.nothing(estimator.robot.drives)

    def step(state: EstimatorState, row: _FilterRows) -> tuple[EstimatorState, Array]:
        now = Estimator(replace(estimator.robot, current_std=std[row.kind]), estimator.settings)
        z = replace(nothing, wheel_speed=row.speed, current=row.current, gyro=row.gyro)
        state, seen = now.advance(state, z, row.dt)
        return state, seen.surface_probability.mean(axis=0)

    def one(run: _FilterRows) -> Array:
        state = estimator.init()
        state = replace(
            state,
            wheels=replace(state.wheels, speed=run.speed[0]),
            current=run.current[0],
        )
        return jax.lax.scan(step, state, run)[1]

    return jax.vmap(one)(runs)
