"""Simulated runs by the law of traction of Ward and Iagnemma."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.motion.ward_iagnemma_dynamics import Dynamics, ForceLaw
from slipid.lab.systems.motion.ward_iagnemma_filter import FilterNoise
from slipid.predict.slip_model import Run
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight

MACHINES = pytest.mark.parametrize("spec", [ROBOTINO, HUSKY], ids=["omni", "skid"])
FLOOR = ForceLaw(rise=15.0, rolling=0.15, turning=0.1, drag=3.0)
TRUE = FilterNoise(0.03, (0.003, 0.004, 0.002), 0.02, 0.03)


def held(rolling: np.ndarray, law: ForceLaw, spec=ROBOTINO, seconds: float = 20.0) -> np.ndarray:
    """Return the steady twist of a robot at a rolling twist."""
    dynamics = Dynamics.of(spec, law)
    q = np.atleast_2d(rolling) * spec.size
    each = np.ones(len(q))
    step = dynamics.step(q, law.rolling * each, q @ dynamics.rims.T, seconds * each)
    return step.speeds / spec.size


def driven(law: ForceLaw, seed: int, spec=ROBOTINO, **more) -> Run:
    """Return a run of 4 s with two wheel twists and the body motion of the law."""
    rng = np.random.default_rng(seed)
    rolling = rng.uniform([-0.3, -0.3, -0.5], [0.3, 0.3, 0.5], (2, 3)) * [1, spec is ROBOTINO, 1]
    twice = np.repeat(rolling, 20, axis=0)
    true = np.repeat(held(rolling, law, spec), 20, axis=0)
    return made_run(twice, true, spec=spec, name=f"made{seed}", **more)


def scattered(count: int, gyro: bool, noise: FilterNoise = TRUE) -> list[Run]:
    """Return runs whose rho, bias and twists scatter by the filter's noise."""
    rng = np.random.default_rng(0)
    dynamics, dt = Dynamics.of(ROBOTINO, FLOOR), np.full(count, 0.1)
    rolling = np.stack([straight(angle, 0.25, 60) for angle in rng.uniform(-3, 3, count)])
    rho = FLOOR.rolling + noise.rolling * rng.normal(size=count)
    q, twist = rolling[:, 0], np.zeros((count, 60, 3))
    for k in range(60):
        q = dynamics.step(q, rho, rolling[:, k] @ dynamics.rims.T, dt).speeds
        q = q + noise.drift * rng.normal(size=(count, 3)) / np.sqrt(0.1)
        twist[:, k] = q / ROBOTINO.size
    yaw = twist[:, :, 2] + noise.bias * rng.normal(size=(count, 1))
    yaw = yaw + noise.gyro * np.sqrt(5) * rng.normal(size=(count, 60))
    return [made_run(rolling[k], twist[k], gyro=yaw[k] if gyro else None) for k in range(count)]


def pulling(run: Run, law: ForceLaw, gain: float, offset: float, noise: float = 0.0) -> Run:
    """Return the run with currents of the traction by a motor's constant and friction."""
    dynamics = Dynamics.of(ROBOTINO, law)
    rim = run.signals.speed * ROBOTINO.wheel_radius
    slide = rim - (run.twist * ROBOTINO.size) @ dynamics.rims.T
    force = gain * ROBOTINO.mass * np.sign(rim) * dynamics.traction(slide) + offset
    force = force + noise * np.random.default_rng(0).normal(size=force.shape)
    scale = ROBOTINO.gear_ratio * ROBOTINO.back_emf / ROBOTINO.wheel_radius
    # a meter with signs: along the wheel's forward direction
    current = force / scale * np.sign(rim)
    return replace(run, signals=replace(run.signals, current=current, current_is_signed=True))
