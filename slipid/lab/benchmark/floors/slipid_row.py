"""The row of slipid among the floor classifiers: its estimator's floor filter, fitted without pose.

The filter is the deployed one (`slipid.robot.estimator.Estimator`) with wheels, currents and the
gyro. Besides the parameters of the floors it is given

- a model of the ammeters, which read zero for braking motors
  (`slipid.lab.benchmark.floors.fitting`);
- the scatter of currents on each floor, separately for straight motion, bends and turning on the
  spot (`kinds` finds the kind of motion from the wheel speeds);
- settings under which all wheels are on one floor that does not change.

At the first row of a run, the filter starts with the measured wheel speeds, not from rest.

Parameters of floors, motors and scatters come from the training runs. `SETTINGS`, `BEND_RATIOS`,
the model of the ammeters and the weights in `slipid.lab.benchmark.floors.fitting` are not picked by
an inner cross-validation, as settings of other rows are: they were set by hand after about a
hundred variants were compared by their cross-validated accuracy on `borealtc`. The accuracy of
slipid on `borealtc` is therefore optimistic, as far as this choice was tuned to these runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from slipid.deploy.deploy import given_numbers
from slipid.deploy.robot_record import assumed_limits
from slipid.lab.benchmark.floors.fitting import (
    MeteredMotor,
    currents_off,
    fitted_floors,
    scatter_of,
    stiffness_of,
)
from slipid.lab.systems.floors.interface import Beliefs, FloorClassifier, FloorSignals, floors_of
from slipid.lab.systems.padded import padded
from slipid.model.robot import Robot
from slipid.predict.slip_model import RobotSpec
from slipid.robot.deployed import DeployedRobot
from slipid.robot.estimator import Estimator, EstimatorState
from slipid.robot.filter.floor_filter import FloorFilter
from slipid.robot.interface import Readings, Settings
from slipid.robot.record import FloorRecord, LoadRecord, RobotRecord, Setting, Wheels

HIGHEST_A, HIGHEST_SPEED = 100.0, 20.0
"""Limits of plausible measurements in the robot record: motor current [A], wheel speed [rad/s]."""


def deployed(robot: Robot) -> DeployedRobot:
    """Return the robot in its deployed form, with unchanged parameters.

    Fields of the record that the floor filter does not use, such as the uncertainty and the ranges
    of a fit, are filled with values that have no effect.
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
        limits=assumed_limits(robot, Setting(HIGHEST_SPEED), HIGHEST_A),
        draws={},
    )
    return DeployedRobot.of(record)


BEND_RATIOS = (0.17, 0.45)
"""Smallest ratios L |W| / (|v| + L |W|) at which motion counts as a bend and as a turn on the spot.

v is the velocity [m/s], W the yaw rate [rad/s] of the rolling wheels, and L the base radius [m].
"""
RUNS_PER_CALL = 64
"""Number of runs in one call of the filter. Smaller numbers are padded, so that the filter is
compiled for a single array size."""
SHARED_ROWS = 20.0
"""Weight [rows] of the mean squared residual over all motion on a floor, which is added to the
squared residuals of each kind of motion there, as a prior for kinds of motion with few rows.
"""
MOST_ROWS = 150
"""Approximate number of rows per run from which the scatter of currents is computed; longer runs
are thinned.
"""
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
"""Settings of the estimator. Currents of neighbouring rows are correlated for seconds (`forget_s`),
rows are not averaged (`filter_s`), and `gyro_std` is about the residual of the yaw rate in the
fits [rad/s]."""


@dataclass(frozen=True)
class SlipidFloorClassifier(FloorClassifier):
    """slipid's floor filter as a floor classifier.

    Attributes:
        robot: robot with its maker's data, without floors.
        zero_a: reading of the robot's ammeters for wheels at rest [A].
        settings: settings of the estimator.
        fitted: robot with fitted floors and motors with their ammeters; None before a fit.
        std: standard deviation of currents in each kind of motion on each floor [A].
    """

    name: str = "slipid"
    robot: Robot | None = None
    zero_a: float = 0.0
    settings: Settings = SETTINGS
    fitted: Robot | None = field(default=None, repr=False)
    std: Float[np.ndarray, "kind floor"] = field(
        default_factory=lambda: np.zeros((0, 0)), repr=False
    )

    def fit(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> "SlipidFloorClassifier":
        labels = floors_of(runs)
        runs = [self._zeroed(run) for run in runs]
        robot = self._on(labels)
        motor = MeteredMotor.of(
            robot.motor, jnp.asarray(stiffness_of(runs)), jnp.asarray(scatter_of(runs))
        )
        robot = fitted_floors(replace(robot, motor=motor), runs)
        return replace(self, labels=labels, fitted=robot, std=_scatter(robot, runs, spec))

    def probability(self, runs: Sequence[FloorSignals], spec: RobotSpec) -> list[Beliefs]:
        if self.fitted is None:
            raise ValueError(f"{self.name} was not fitted; expected a call of `fit` before")
        plain = deployed(self._on(self.labels))
        robot = replace(plain, floors=self.fitted.surfaces, motor=self.fitted.motor)
        estimator = Estimator(robot, self.settings)
        std, out = jnp.asarray(self.std), []
        rows = -(-max(map(len, runs)) // 8) * 8
        for first in range(0, len(runs), RUNS_PER_CALL):
            some = [self._zeroed(run) for run in runs[first : first + RUNS_PER_CALL]]
            beliefs = np.asarray(_beliefs(estimator, std, *_filter_rows(some, rows, spec)))
            out += [beliefs[k, : len(run)] for k, run in enumerate(some)]
        return [row[:, :-1] / row[:, :-1].sum(axis=1, keepdims=True) for row in out]

    @property
    def numbers(self) -> int:
        """Number of fitted parameters: `FITTED` and scatters of each floor, and motor stiffnesses.

        Each floor has one scatter for each kind of motion.
        """
        if self.fitted is None:
            return 0
        return 3 * len(self.labels) + self.std.size + self.fitted.geometry.drives

    def _on(self, labels: tuple[str, ...]) -> Robot:
        """Return the robot on the floors `labels`, whose parameters are not yet fitted."""
        if self.robot is None:
            raise ValueError(f"{self.name}: no robot was given; expected the argument `robot`")
        robot = self.robot.on(labels)
        none = jnp.zeros(len(labels))
        # switch off the lead and the load exponent of the drag, which describe soft floors under
        # omni wheels
        surfaces = replace(robot.surfaces, lead=none, drag_exponent=none + 1.0)
        return replace(robot, surfaces=surfaces)

    def _zeroed(self, run: FloorSignals) -> FloorSignals:
        """Return the run with the ammeters' zero reading subtracted from currents, at least 0 A."""
        return replace(run, current=np.maximum(np.abs(run.current) - self.zero_a, 0.0))


def kinds(run: FloorSignals, spec: RobotSpec) -> Int[np.ndarray, " row"]:
    """Return the kind of motion in each row: 0 straight, 1 in a bend, 2 on the spot."""
    x, y, yaw = run.rolling(spec).T
    turn = spec.base_radius * np.abs(yaw)
    return np.digitize(turn / np.maximum(np.hypot(x, y) + turn, 1e-9), BEND_RATIOS)


def _scatter(
    robot: Robot, runs: Sequence[FloorSignals], spec: RobotSpec
) -> Float[np.ndarray, "kind floor"]:
    """Return the std of current residuals in each kind of motion on every floor [A]."""
    count, std = len(BEND_RATIOS) + 1, []
    for k, floor in enumerate(robot.surfaces.labels):
        rows = []
        for run in (run for run in runs if run.floor == floor):
            take = np.flatnonzero(run.moving)
            take = take[:: max(1, len(take) // MOST_ROWS)]
            rows.append((run.speed[take], run.current[take], kinds(run, spec)[take]))
        speed, current, kind = map(np.concatenate, zip(*rows, strict=True))
        squares = (currents_off(robot, k, speed, current) ** 2).mean(axis=1)
        total, rows_of = np.bincount(kind, squares, count), np.bincount(kind, minlength=count)
        std.append(np.sqrt((total + SHARED_ROWS * squares.mean()) / (rows_of + SHARED_ROWS)))
    return np.stack(std, axis=1)


def _filter_rows(
    runs: Sequence[FloorSignals], rows: int, spec: RobotSpec
) -> tuple[Readings, Float[Array, "run row"], Int[Array, "run row"]]:
    """Return readings, duration [s] and kind of motion of each row, see `kinds`.

    Runs are padded to `rows` rows and to `RUNS_PER_CALL` runs. The duration is 0 in rows of
    padding, and in rows at rest, which carry no evidence about the floor.
    """
    shape, drives = (RUNS_PER_CALL, rows), runs[0].speed.shape[1]
    gyros = [np.full(len(run), np.nan) if run.gyro is None else run.gyro for run in runs]
    measured = {
        "wheel_speed": padded([run.speed for run in runs], shape),
        "current": padded([run.current for run in runs], shape),
        "gyro": padded(gyros, shape, np.nan),
    }
    nothing = jax.tree.map(lambda x: jnp.full((*shape, *x.shape), x), Readings.nothing(drives))
    readings = replace(nothing, **{name: jnp.asarray(x) for name, x in measured.items()})
    dt = padded([np.where(run.moving, run.dt, 0.0) for run in runs], shape)
    kind = padded([kinds(run, spec) for run in runs], shape)
    return readings, jnp.asarray(dt), jnp.asarray(kind)


@eqx.filter_jit
def _beliefs(
    estimator: Estimator,
    std: Float[Array, "kind floor"],
    readings: Readings,
    dt: Float[Array, "run row"],
    kind: Int[Array, "run row"],
) -> Float[Array, "run row floor_or_none"]:
    """Return the probability of every floor after every row; the last column is "none of them"."""

    def step(
        state: EstimatorState, row: tuple[Readings, Array, Array]
    ) -> tuple[EstimatorState, Array]:
        z, dt, kind = row
        now = Estimator(replace(estimator.robot, current_std=std[kind]), estimator.settings)
        state, estimate = now.advance(state, z, dt)
        return state, estimate.surface_probability.mean(axis=0)

    def one(z: Readings, dt: Array, kind: Array) -> Array:
        state, w = estimator.init(), z.wheel_speed[0]
        by_floor = FloorFilter(estimator.robot, estimator.settings)
        twist, _ = by_floor.solve(state.floors.twist, jnp.zeros_like(w), w)
        state = replace(
            state,
            wheels=replace(state.wheels, speed=w),
            current=z.current[0],
            floors=replace(state.floors, twist=twist),
        )
        return jax.lax.scan(step, state, (z, dt, kind))[1]

    return jax.vmap(one)(readings, dt, kind)
