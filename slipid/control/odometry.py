"""Odometry that knows no contact: of the encoders alone, or with a curve of slip over current."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.control.deployed import DeployedRobot
from slipid.control.interface import AbstractEstimator, Estimate, Pose, Readings, Settings
from slipid.control.wheels import WheelState, read_wheels, time_step
from slipid.model.se2 import advance, compose

CURRENT_FROM = 0.4
"""Current from which the 2021 paper's deployed estimator counts slip [A]."""


class OdometryState(eqx.Module):
    """Pose [m, m, rad], how the wheels turn, and smoothed currents without a sign [A]."""

    pose: Float[Array, "3"]
    wheels: WheelState
    current: Float[Array, " wheel"]


class Odometry(AbstractEstimator[OdometryState]):
    """Wheel-by-wheel odometry, w_eff = w (1 - s).

    Attributes:
        settings: by default as the robot's logs were.
        curve: whether slip is taken from `DeployedRobot.wheel_curve`, a + b |I| where the smoothed
            current exceeds `CURRENT_FROM`, as the 2021 paper's robot did; else the encoders are
            believed.
    """

    robot: DeployedRobot
    settings: Settings = eqx.field(static=True)
    curve: bool = eqx.field(static=True)

    def __init__(self, robot: DeployedRobot, settings: Settings | None = None, curve: bool = False):
        self.robot, self.curve = robot, curve
        self.settings = Settings.of(robot) if settings is None else settings

    def init(self, pose: Pose = (0.0, 0.0, 0.0)) -> OdometryState:
        """State of a robot at rest at a pose [m, m, rad]."""
        return OdometryState(
            pose=jnp.asarray(pose, dtype=float),
            wheels=WheelState.init(self.robot, self.settings),
            current=jnp.zeros(self.robot.wheels),
        )

    def advance(
        self, state: OdometryState, z: Readings, dt: Float[Array, ""]
    ) -> tuple[OdometryState, Estimate]:
        """One time step; see `AbstractEstimator.step`. Neither gyro nor pose fixes are used."""
        f, s, old = self.robot, self.settings, state
        dt = time_step(dt, s)
        wheels = read_wheels(f, s, old.wheels, z, dt)
        w = wheels.speed
        known = jnp.isfinite(z.current) & (jnp.abs(z.current) < 10.0 * f.highest[1])
        a = 1 - jnp.exp(-dt / 0.6)  # exponential with 0.97 a row, as on the paper's robot
        smoothed = old.current + a * (jnp.abs(z.current) - old.current)
        amps = jnp.where(known, smoothed, old.current)
        slip = jnp.zeros_like(w)
        if self.curve:
            line = f.wheel_curve[:, 0] + f.wheel_curve[:, 1] * amps
            slip = jnp.where(amps > CURRENT_FROM, jnp.clip(line, 0.0, 0.95), 0.0)
        twist = f.inverse @ (f.frame.radius * w * (1 - slip))
        pose = compose(old.pose, advance(twist, dt))
        unknown = jnp.zeros((f.wheels, len(f.labels) + 1)).at[:, -1].set(1.0)
        return OdometryState(pose=pose, wheels=wheels, current=amps), Estimate(
            pose=pose,
            twist=twist,
            slip=slip,
            wheel_speed=w,
            current=amps,
            surface_probability=unknown,
            covariance=jnp.zeros((3, 3)),
            stale=jnp.any(wheels.age > s.stale_s),
            immobilised=jnp.zeros((), bool),
            out_of_range=jnp.max(jnp.abs(w)) > 1.3 * f.highest[0],
            labels=f.labels,
        )
