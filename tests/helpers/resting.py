"""A differential drive that rests before and after it drives, and in between: logs from numpy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slipid.data.log import Log
from slipid.data.runs import Runs, collect
from slipid.data.wheel_signals import integral
from slipid.model.geometry import differential
from slipid.model.robot import Robot

HALF_TRACK, RADIUS, GEAR, MASS = 0.15, 0.05, 20.0, 8.0
RESISTANCE, BACK_EMF, EFFICIENCY = 1.2, 0.03, 0.9
DRY, VISCOUS = 0.05, 0.012
PERIOD, REST, PAUSE, DRIVE, RAMP = 0.02, 1.0, 1.5, 2.0, 0.2
TICK = 2 * np.pi / 2048
TRUTH = {
    "motor.coulomb_friction": DRY,
    "motor.viscous_friction": VISCOUS,
    "motor.resistance": RESISTANCE,
    "motor.back_emf": BACK_EMF,
}


def robot() -> Robot:
    """The robot as a user knows it."""
    return Robot.of(differential(HALF_TRACK, RADIUS, GEAR), mass=MASS)


def runs(signed: bool = True, voltage: bool = True) -> Runs:
    """Runs at two speeds, straight and in arcs, each with a second of rest at both ends."""
    rng = np.random.default_rng(0)
    drives = [(v * d, w) for v in (0.15, 0.45) for d in (1, -1) for w in (0.0, 0.0, 0.4, -0.4)]
    return collect([_log(k, v, w, signed, voltage, rng) for k, (v, w) in enumerate(drives)])


def torques() -> Runs:
    """The same runs, with the torque of every joint [N m] in place of currents and voltages."""
    logs = []
    for log in runs(voltage=False).logs:
        torque = log.current * GEAR * EFFICIENCY * BACK_EMF
        logs.append(replace(log, current=torque, current_is_torque=True))
    return collect(logs)


def _log(
    number: int, ahead: float, turn: float, signed: bool, voltage: bool, rng: np.random.Generator
) -> Log:
    time = np.arange(0.0, 2 * REST + 2 * DRIVE + PAUSE, PERIOD)
    moves = np.zeros_like(time)
    for start in (REST, REST + DRIVE + PAUSE):
        rise, fall = (time - start) / RAMP, (start + DRIVE - time) / RAMP
        moves += np.clip(np.minimum(rise, fall), 0.0, 1.0)
    speed = moves[:, None] * (ahead + np.array([-turn, turn]) * HALF_TRACK) / RADIUS
    heading = integral(time, turn * moves[:, None])
    way = np.concatenate([np.cos(heading), np.sin(heading)], axis=1) * ahead * moves[:, None]
    pose = np.concatenate([integral(time, way), heading], axis=1)
    torque = DRY * np.sign(speed) + VISCOUS * speed
    amps = torque / (GEAR * EFFICIENCY * BACK_EMF)
    volts = RESISTANCE * amps + GEAR * BACK_EMF * speed
    shown = amps if signed else np.abs(amps)
    return Log(
        name=f"run{number:02d}.csv",
        path=Path(f"run{number:02d}.csv"),
        sha256="0",
        time=time,
        wheel_angle=np.round(integral(time, speed) / TICK) * TICK,
        current=shown + rng.normal(0.0, 0.01, speed.shape),
        current_is_signed=signed,
        voltage=volts + rng.normal(0.0, 0.02, speed.shape) if voltage else None,
        pose=pose + rng.normal(0.0, [5e-4, 5e-4, 2e-3], pose.shape),
        surface="lab",
        load="as_built",
    )
