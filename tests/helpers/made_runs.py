"""Runs of which everything is known, as methods to compare with are given them."""

import numpy as np

from slipid.model.geometry import omni, skid_steer
from slipid.model.robot import build
from slipid.predict.slip_model import RobotSpec, Run, RunSignals, path_of

ROBOTINO = RobotSpec.of(build(omni([60.0, 180.0, 300.0], 0.125, 0.040, 16.0), ("gray",)))
HUSKY = RobotSpec.of(
    build(skid_steer(0.256, 0.275, 0.165, 78.71, drive_of=(0, 1, 0, 1)), ("grass",))
)


def straight(angle: float, speed: float = 0.2, steps: int = 40) -> np.ndarray:
    """Twists of a run in one direction of travel [rad], without turning."""
    return np.tile([speed * np.cos(angle), speed * np.sin(angle), 0.0], (steps, 1))


def made_run(
    rolling: np.ndarray,
    twist: np.ndarray | None = None,
    *,
    spec: RobotSpec = ROBOTINO,
    current: np.ndarray | None = None,
    gyro: np.ndarray | None = None,
    signed: bool = False,
    dt: float = 0.1,
    floor: str = "gray",
    name: str = "made",
) -> Run:
    """A run whose encoders say `rolling` while the body moves by `twist`, both (step, 3)."""
    twist = rolling if twist is None else twist
    each = np.full(len(rolling), dt)
    speed = rolling @ spec.forward.T / spec.wheel_radius
    heard = RunSignals(
        name=name,
        dt=each,
        turn=speed * dt,
        current=current,
        current_is_signed=signed,
        gyro=gyro,
        command=rolling,
        floor=floor,
    )
    angle = np.arctan2(rolling[0, 1], rolling[0, 0])
    size = float(np.hypot(*rolling[0, :2]))
    return Run(heard, path_of(twist, each), floor, heading=float(angle), speed=size)
