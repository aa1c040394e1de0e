"""Which floor a skid-steer robot feels by currents and a gyro alone, without a pose.

    make bench
    .venv/bin/python -m pytest -s -o python_files='bench_*.py' tests/benchmarks/bench_floors_felt.py

(about two minutes of one processor). The runs of "borealtc": a Husky on five floors, 6.5 rows a
second, currents without a sign. What a free wheel draws is from runs of another Husky with its
wheels in the air. Friction, creep and rolling resistance of every floor are fitted to every other
run; the estimator then drives the others, told nothing but the wheels, the currents and the gyro.
Prints what it believed, run by run and in all. Without a pose the numbers of a floor are only those
that make its currents and its turning; they are no identification, and frictions count in units of
the motors' unknown torque constant.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from slipid.control.estimator import Estimator
from slipid.control.interface import Readings, Settings
from slipid.model.geometry import skid_steer
from slipid.model.robot import Robot, build, motor_current, twist
from tests.helpers.known_robot import deploy_known

RADIUS = 0.165
"""Of the wheels [m], by the maker."""
SHAPE = skid_steer(0.256, 0.275, RADIUS, 78.71, drive_of=(0, 1, 0, 1))
LONGEST_S = 0.5
"""Steps that are longer are gaps between two parts of a file [s]."""
FITTED = ("friction", "creep", "rolling_resistance")
"""What is fitted of every floor, as logarithms."""
START = np.log([0.4, 0.3, 0.02])


@dataclass(frozen=True, eq=False)
class Felt:
    """A run without a pose: wheel speeds [rad/s], sizes of currents [A], yaw rates [rad/s]."""

    name: str
    floor: str
    time: np.ndarray
    speed: np.ndarray
    current: np.ndarray
    gyro: np.ndarray


def runs(root: Path) -> list[Felt]:
    found = []
    for path in sorted(root.glob("*/*.csv")):
        a = np.genfromtxt(path, delimiter=",", names=True)
        found.append(
            Felt(
                name=f"{path.parent.name}/{path.stem}",
                floor=path.parent.name.lower(),
                time=a["time"],
                speed=np.stack([a["velL"], a["velR"]], axis=1) / RADIUS,
                current=np.stack([a["curL"], a["curR"]], axis=1),
                gyro=a["gyro_z"],
            )
        )
    return found


def no_load(root: Path) -> tuple[float, float, float]:
    """Zero of the ammeter [A] and friction [A] and its growth [A s/rad] of wheels in the air."""
    speed, amps = [], []
    for path in sorted(root.glob("*.csv")):
        a = np.genfromtxt(path, delimiter=",", names=True)
        for side in "lr":
            good = np.isfinite(a[f"w{side}"]) & np.isfinite(a[f"i{side}"])
            steady = good & (np.abs(np.gradient(np.nan_to_num(a[f"w{side}"]))) < 0.05)
            speed.append(np.abs(a[f"w{side}"][steady]))
            amps.append(a[f"i{side}"][steady])
    w, i = np.concatenate(speed), np.concatenate(amps)
    zero = float(np.median(i[w < 0.02]))
    moving = w > 0.5
    slope, level = np.polyfit(w[moving], np.minimum(i[moving] - zero, 3.0), 1)
    return zero, max(float(level), 0.01), max(float(slope), 1e-4)


def believed(zero: float, friction: tuple[float, float], floors: tuple[str, ...]) -> Robot:
    """A Husky with what its makers say; no floor has been fitted."""
    robot = build(SHAPE, floors)
    gain = float(robot.motor.gain)
    return eqx.tree_at(
        lambda r: (
            r.body.mass,
            r.motor.current_offset,
            r.motor.coulomb_friction,
            r.motor.viscous_friction,
            r.surfaces.lead,
            r.surfaces.drag_exponent,
        ),
        robot,
        (
            jnp.asarray(60.0),
            jnp.asarray(zero),
            jnp.asarray(gain * friction[0]),
            jnp.asarray(gain * friction[1]),
            jnp.zeros(len(floors)),
            jnp.ones(len(floors)),
        ),
    )


@eqx.filter_jit
def said(robot: Robot, number: jax.Array, speed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sizes of currents [A] and yaw rates [rad/s] of wheel speeds on a floor."""
    frame, load = robot.geometry.frame(), jnp.zeros((), int)

    def one(w: jax.Array) -> tuple[jax.Array, jax.Array]:
        xi = twist(robot, frame, robot.geometry.at_wheels(w), number, load)
        amps = motor_current(robot, frame, xi, w, number, load)
        return jnp.sqrt(amps**2 + 0.03**2) + robot.motor.current_offset, xi[2]

    return jax.vmap(one)(speed)


def smooth(x: np.ndarray) -> np.ndarray:
    """Mean of five rows: accelerations, which the model does not know, mostly cancel in it."""
    padded = np.concatenate([x[:1]] * 2 + [x] + [x[-1:]] * 2)
    return np.asarray(sum(padded[k : k + len(x)] for k in range(5)) / 5)


def learnt(robot: Robot, fitted: list[Felt]) -> tuple[Robot, dict[str, float]]:
    """The robot with numbers of its floors, and stds of what they leave of current and yaw."""
    std: dict[str, float] = {}
    for k, floor in enumerate(robot.surfaces.labels):
        mine = [run for run in fitted if run.floor == floor]
        speed, amps, gyro = (
            np.concatenate([smooth(getattr(run, name)) for run in mine])
            for name in ("speed", "current", "gyro")
        )
        good = np.isfinite(gyro) & np.isfinite(amps).all(axis=1) & np.isfinite(speed).all(axis=1)
        good &= np.abs(speed).max(axis=1) > 0.5
        take = np.random.default_rng(0).permutation(np.flatnonzero(good))[:400]
        w, i, yaw = jnp.asarray(speed[take]), amps[take], gyro[take]

        off = partial(misfit, robot=robot, number=k, speed=w, amps=i, yaw=yaw)
        robot = on_floor(robot, k, least_squares(off, START, loss="soft_l1", diff_step=1e-3).x)
        a, turn = said(robot, jnp.asarray(k), w)
        std[f"current.{floor}.window"] = float(np.std(np.asarray(a) - i))
        std[f"current.{floor}.run"] = 0.0
        std[f"yaw.{floor}"] = float(np.std(np.asarray(turn) - yaw))
    return robot, std


def on_floor(robot: Robot, number: int, logs: np.ndarray) -> Robot:
    """The robot with other numbers of a floor, given as logarithms."""
    for name, value in zip(FITTED, np.exp(logs), strict=True):
        stack = getattr(robot.surfaces, name).at[number].set(value)
        robot = replace(robot, surfaces=replace(robot.surfaces, **{name: stack}))
    return robot


def misfit(
    logs: np.ndarray,
    robot: Robot,
    number: int,
    speed: jax.Array,
    amps: np.ndarray,
    yaw: np.ndarray,
) -> np.ndarray:
    """What numbers of a floor leave of currents and yaw rates, and how unusual they are."""
    sizes, turn = said(on_floor(robot, number, logs), jnp.asarray(number), speed)
    gaps = [((np.asarray(sizes) - amps) / 1.5).ravel(), (np.asarray(turn) - yaw) / 0.1]
    return np.concatenate([*gaps, (logs - START) / [1.5, 1.5, 2.0]])


@eqx.filter_jit
def driven(estimator: Estimator, z: Readings, dt: jax.Array) -> jax.Array:
    """Probability of every floor, and of none, under the robot after every step."""

    def step(state: object, row: tuple[Readings, jax.Array]) -> tuple[object, jax.Array]:
        state, estimate = estimator.advance(state, *row)
        return state, estimate.surface_probability.mean(axis=0)

    return jax.lax.scan(step, estimator.init(), (z, dt))[1]


ROWS = 1200
"""To which runs are filled up with steps in which no time passes."""


def beliefs(estimator: Estimator, run: Felt) -> np.ndarray:
    n = min(len(run.time), ROWS)
    row = np.minimum(np.arange(ROWS), n - 1)
    dt = np.diff(run.time[row], prepend=run.time[0])
    nothing = Readings.nothing(estimator.robot.drives)
    z = replace(
        jax.tree.map(lambda x: jnp.broadcast_to(x, (ROWS, *x.shape)), nothing),
        wheel_speed=jnp.asarray(run.speed[row]),
        current=jnp.asarray(run.current[row]),
        gyro=jnp.asarray(run.gyro[row]),
    )
    dt = np.where(dt > LONGEST_S, 0.0, dt)
    moves = np.abs(run.speed[:n]).max(axis=1) > 0.3
    return np.asarray(driven(estimator, z, jnp.asarray(dt)))[:n][moves]


def test_floors_that_are_felt(real_data: Path) -> None:
    root, air = real_data / "borealtc", real_data / "drive_skid" / "husky_in_the_air"
    if not root.is_dir() or not air.is_dir():
        pytest.skip(f"no logs of robots without a pose: {root} or {air} is no folder")
    zero, level, slope = no_load(air)
    print(f"\nin the air: zero {zero:.2f} A, friction {level:.2f} A + {slope:.3f} A s/rad")
    all_runs = runs(root)
    floors = tuple(sorted({run.floor for run in all_runs}))
    fitted, judged = all_runs[::2], all_runs[1::2]
    robot, std = learnt(believed(zero, (level, slope), floors), fitted)
    for k, floor in enumerate(floors):
        numbers = ", ".join(f"{n} {float(getattr(robot.surfaces, n)[k]):.3g}" for n in FITTED)
        print(
            f"{floor:11} {numbers}, current std {std[f'current.{floor}.window']:.2f} A,"
            f" yaw std {std[f'yaw.{floor}']:.3f} rad/s"
        )
    deployed = deploy_known(robot, std={k: v for k, v in std.items() if k.startswith("current")})
    settings = replace(
        Settings.of(deployed),
        current_is_signed=False,
        forget_s=1.0,
        filter_s=0.3,
        ammeter_std_a=0.3,
        gyro_std=0.05,
        alike=20.0,
        patch_m=2.0,
    )
    estimator = Estimator(deployed, settings)
    table = np.zeros((len(floors), len(floors) + 1))
    ended = np.zeros_like(table)
    for run in judged:
        p = beliefs(estimator, run)
        if not len(p):
            continue
        table[floors.index(run.floor)] += np.bincount(p.argmax(1), minlength=len(floors) + 1)
        ended[floors.index(run.floor), np.log(np.maximum(p, 1e-6)).mean(axis=0).argmax()] += 1
    print("rows in which the most probable floor is, of those on the floor [%]")
    print(f"{'':11}", *(f"{name[:9]:>9}" for name in (*floors, "none")))
    for floor, row, count in zip(floors, table, ended, strict=True):
        print(
            f"{floor:11}",
            *(f"{100 * x / row.sum():9.0f}" for x in row),
            "  runs:",
            count.astype(int),
        )
    right = np.trace(table[:, :-1]) / table.sum()
    print(f"right in {100 * right:.0f} % of the rows")
    assert right > 1.5 / len(floors)
