"""Odometry that knows no contact: of the encoders alone, or with a curve of slip over current."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.control.estimator import Settings, estimated, read_wheels, sensed
from slipid.control.frozen import Frozen
from slipid.control.packed import Layout
from slipid.model.robot import advance, compose

CURRENT_FROM = 0.4
"""Current from which the 2021 paper's deployed estimator counts slip [A]."""


class Odometry(eqx.Module):
    """Wheel-by-wheel odometry, w_eff = w (1 - s), on the interface of `Estimator`.

    Attributes:
        frozen: the identified robot.
        settings: what is not identified.
        curve: whether slip is taken from `Frozen.wheel_curve`, a + b |I| where the smoothed current
            exceeds `CURRENT_FROM`, as the 2021 paper's robot did; else the encoders are believed.
    """

    frozen: Frozen
    settings: Settings = eqx.field(static=True, default=Settings())
    curve: bool = eqx.field(static=True, default=False)

    @property
    def sensed(self) -> Layout:
        """Layout of a measurement."""
        return sensed(self.frozen.wheels)

    @property
    def estimated(self) -> Layout:
        """Layout of an estimate."""
        return estimated(self.frozen.wheels, len(self.frozen.labels))

    @property
    def _kept(self) -> Layout:
        w = (self.frozen.wheels,)
        return Layout((("pose", (3,)), ("angle", w), ("speed", w), ("age", w), ("amps", w)))

    def init(self, pose: Float[Array, "3"]) -> Float[Array, " state"]:
        """State of a robot at rest at a pose [m, m, rad]."""
        w = self.frozen.wheels
        return self._kept.pack(
            pose=jnp.asarray(pose, dtype=float),
            angle=jnp.full(w, jnp.nan),
            speed=jnp.zeros(w),
            age=jnp.full(w, 10 * self.settings.stale_s),
            amps=jnp.zeros(w),
        )

    def step(
        self,
        state: Float[Array, " state"],
        measurement: Float[Array, " sensed"],
        dt: Float[Array, ""] | float,
    ) -> tuple[Float[Array, " state"], Float[Array, " estimated"]]:
        """One time step; see `Estimator.step`. Neither gyro nor pose fixes are used."""
        f, s, old = self.frozen, self.settings, self._kept.of(state)
        z = self.sensed.of(measurement)
        dt = jnp.asarray(dt, dtype=float)
        dt = jnp.where(jnp.isfinite(dt) & (dt > 0), jnp.clip(dt, 1e-4, s.longest_s), 0.0)
        w, angle, age = read_wheels(f, s, old, z, dt)
        known = jnp.isfinite(z.current) & (jnp.abs(z.current) < 10.0 * f.highest[1])
        a = 1 - jnp.exp(-dt / 0.6)  # exponential with 0.97 a row, as on the paper's robot
        amps = jnp.where(known, old.amps + a * (jnp.abs(z.current) - old.amps), old.amps)
        slip = jnp.zeros_like(w)
        if self.curve:
            line = f.wheel_curve[:, 0] + f.wheel_curve[:, 1] * amps
            slip = jnp.where(amps > CURRENT_FROM, jnp.clip(line, 0.0, 0.95), 0.0)
        twist = f.inverse @ (f.frame.radius * w * (1 - slip))
        pose = compose(old.pose, advance(twist, dt))
        state = self._kept.pack(pose=pose, angle=angle, speed=w, age=age, amps=amps)
        unknown = jnp.zeros((f.wheels, len(f.labels) + 1)).at[:, -1].set(1.0)
        said = self.estimated.pack(
            pose=pose,
            twist=twist,
            slip=slip,
            wheel_speed=w,
            current=amps,
            surface=unknown,
            covariance=jnp.zeros((3, 3)),
            stale=jnp.any(age > s.stale_s),
            immobilised=0.0,
            out_of_range=jnp.max(jnp.abs(w)) > 1.3 * f.highest[0],
        )
        return state, said
