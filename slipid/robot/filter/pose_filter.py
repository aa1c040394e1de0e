"""Pose and its covariance, with what the fit says the model misses carried along.

Process noise and effects that stay for a while grow the covariance; the effects, the floors'
friction and a gyro's bias are further unknowns that pose fixes and rest correct. Friction counts
where wheels stand on several floors: on one it moves no robot, so that runs on one floor each
leave it open. Which floors are under the wheels is in doubt as the hypotheses scatter, and what is
wrongly believed stays wrong for a while:

    S = sum_c p_c (xi_c - xi) (xi_c - xi)^T = L L^T,   xi_true = xi + L d,   d ~ N(0, 1)
    d <- k d + sqrt(1 - k^2) noise,   k = exp(-far / doubt_m)
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from slipid.model.se2 import advance, compose
from slipid.robot.deployed import RobotArrays
from slipid.robot.filter.effects import effect_correlation, travel_direction
from slipid.robot.filter.floor import Floor
from slipid.robot.filter.floor_filter import INERTIA_ACCELERATION, BodyMotion, TimeStep, length
from slipid.robot.filter.pose_fix import (
    HISTORY,
    PoseState,
    apply_fix,
    history_after_jump,
    nearest,
    rebased,
)
from slipid.robot.interface import Readings, Settings

CREEP_SPEED = 0.05
"""Speed up to which no fit has seen how a robot turns [m/s]."""


class _StepMotion(eqx.Module):
    """Where the body goes in a step, and what pushes it off.

    Attributes:
        speed: at which the effects of floors count, that of wheels that do not slip [m/s].
        slope: d twist / d nuisance, the gyro's bias left out.
        axes: along, across and yaw as columns in the body frame.
        share: of the load on each floor.
        by_gyro: whether yaw is measured.
    """

    speed: Float[Array, ""]
    axes: Float[Array, "3 3"]
    slope: Float[Array, "3 push"]
    share: Float[Array, " floor"]
    by_gyro: Bool[Array, ""]


class PoseFilter(eqx.Module):
    """Filter of the pose."""

    robot: RobotArrays
    settings: Settings

    def init(self, pose: Float[Array, "3"], std: tuple[float, float] = (0.0, 0.0)) -> PoseState:
        """At rest at a pose [m, m, rad], known this well [m], [rad]."""
        place, turn = std
        begin, bias = jnp.asarray([place, place, turn]), jnp.asarray([self.settings.gyro_bias_std])
        floors = len(self.robot.labels)
        parts = [begin, jnp.ones(3 * floors), jnp.zeros(floors), jnp.ones(3), bias]
        friction = slice(3 + 3 * floors, 3 + 4 * floors)
        entry = jnp.concatenate([jnp.zeros(1), pose, jnp.zeros(11)])
        return PoseState(
            pose=pose,
            nuisance=jnp.zeros(4 * floors + 4),
            covariance=jnp.diag(jnp.concatenate(parts) ** 2)
            .at[friction, friction]
            .set(self.robot.friction_covariance),
            toward=jnp.zeros(3),
            still=jnp.zeros(()),
            noise=jnp.zeros((3, 3)),
            far=jnp.zeros(()),
            push=jnp.zeros((3, 4 * floors + 3)),
            history=jnp.broadcast_to(entry, (HISTORY, 15)),
        )

    def mapped(
        self, now: PoseState, floor: Floor, hypotheses: Int[np.ndarray, "hypothesis wheel"]
    ) -> tuple[Float[Array, "3 3"], Float[Array, "sample hypothesis"]]:
        """Root of the pose's covariance, and what a map supports at poses drawn from it."""
        root, floors = cholesky_root(now.covariance[:3, :3]), len(self.robot.labels)
        return root, floor.supports(now.pose, root, self.robot.places, hypotheses, floors)

    def step(
        self, old: PoseState, motion: BodyMotion, gyro: Array, z: Readings, tick: TimeStep
    ) -> tuple[PoseState, Float[Array, "3"], Float[Array, "3 3"]]:
        """Pose a time step later, and the twist that took it there.

        The third is what a pose fix leaves of how far another pose is from it, in the body's axes.

        Args:
            old, tick: the state before the step, and the step.
            motion: what the floors say of it.
            gyro: yaw rate, NaN without one [rad/s].
            z: for its pose fix.
        """
        dt = tick.dt
        way = self._way(motion, gyro)
        old = self._forgotten(old, motion, tick)
        free = motion.twist + way.slope @ old.nuisance[:-1]  # however slow: creeping adds up
        old = replace(old, history=old.history.at[:, 0].add(dt))
        twist = free.at[2].set(self._turned(old, free[2], gyro))
        pose = compose(old.pose, advance(twist, dt) + motion.jump)
        still = jnp.where(tick.moves, 0.0, jnp.minimum(old.still + dt, 1e3))
        old = replace(old, history=history_after_jump(old, motion, self.robot.frame.base))
        new = replace(self._grow(old, pose, way, tick), still=still)
        new = self._rest(self._turns(new, way, gyro, free[2], tick), gyro)
        begun, ended = jnp.concatenate([jnp.zeros(1), new.pose, free[2:]]), new.far[None]
        entry = jnp.concatenate([begun, new.noise.reshape(-1), ended])
        history = jnp.where(dt > 0, jnp.roll(old.history, 1, axis=0).at[0].set(entry), old.history)
        new, left = apply_fix(rebased(replace(new, history=history)), z)
        world = axes_rotation(new.pose[2])
        return new, twist, world.T @ left @ world

    def _way(self, motion: BodyMotion, gyro: Array) -> _StepMotion:
        share = self.robot.rest @ motion.under
        speed, axes = motion.course.speed, motion.course.axes
        std = speed * share[:, None] * motion.left
        by_effect = (std[:, :, None] * axes.T).reshape(-1, 3).T
        # by the way, so that a robot that stands has none
        per_metre = motion.scatter / jnp.maximum(speed**2, 1e-12)
        doubt = speed * axes @ cholesky_root(axes.T @ per_metre @ axes)
        return _StepMotion(
            speed=speed,
            axes=axes,
            slope=jnp.concatenate([by_effect, motion.by_friction, doubt], axis=1),
            share=share,
            by_gyro=jnp.isfinite(gyro),
        )

    def _forgotten(self, old: PoseState, motion: BodyMotion, tick: TimeStep) -> PoseState:
        """With effects as far as they stay the same over the step, their variance as it was."""
        f = self.robot
        speed = length(motion.twist[:2]) + f.frame.base * jnp.abs(motion.twist[2])
        far = speed * tick.dt  # what is truly left behind
        left = jnp.prod(1 - motion.under, axis=0)
        now = travel_direction(motion.rolling, f.frame.base)
        toward, keep = effect_correlation(old.toward, now, left, far)
        toward = jnp.where(far > 0, toward, old.toward)
        doubt = jnp.exp(-far / self.settings.doubt_m)
        parts = [jnp.repeat(keep, 3), jnp.ones(len(left)), jnp.full(3, doubt), jnp.ones(1)]
        kept = jnp.concatenate(parts)
        std = jnp.concatenate(
            [jnp.ones(3 * len(left)), jnp.zeros(len(left)), jnp.ones(3), jnp.zeros(1)]
        )
        new = (1 - kept**2) * std**2
        whole = jnp.concatenate([jnp.ones(3), kept])
        covariance = whole[:, None] * old.covariance * whole
        covariance = covariance + jnp.diag(jnp.concatenate([jnp.zeros(3), new]))
        return replace(old, nuisance=kept * old.nuisance, covariance=covariance, toward=toward)

    def _turned(self, old: PoseState, free: Array, gyro: Array) -> Array:
        """Yaw rate: the gyro's less its bias; over its delay, as the contact model goes on from it.

        `free` is the contact model's [rad/s]; the history is as old as after the step.
        """
        then = self._then(old, free)
        return jnp.where(jnp.isfinite(gyro), free + gyro - old.nuisance[-1] - then, free)

    def _then(self, now: PoseState, free: Array) -> Array:
        """Yaw rate of the contact model at the time of the gyro's reading [rad/s]."""
        delay = self.settings.gyro_delay_s
        if not isinstance(delay, jax.core.Tracer) and float(delay) == 0.0:
            return free  # code that is exported for one robot goes without the search
        return jnp.where(delay == 0.0, free, nearest(now.history, delay)[4])

    def _turns(
        self, now: PoseState, way: _StepMotion, gyro: Array, free: Array, tick: TimeStep
    ) -> PoseState:
        """Compare a gyro with the contact model while the robot moves.

        The gyro reads the model's yaw rate, what pushes it off, and its own bias, so that it tells
        of both and of whatever pushes the body sideways together with them:

            gyro = (twist + slope nuisance)_yaw + bias + noise

        The noise is the gyro's and that of the model per root of the distance; a reading far from
        what is believed counts less, as do all while wheels speed up, which the equilibrium does
        not know. Only heading and bias learn from it: what pushes the body is considered and stays
        as it is (Schmidt 1966), since the floors are told by the same gyro.
        """
        dt, cov = jnp.maximum(tick.dt, 1e-3), now.covariance
        look = jnp.concatenate([jnp.zeros(3), way.slope[2], jnp.ones(1)])
        told = (way.speed > CREEP_SPEED) & jnp.isfinite(gyro) & (tick.dt > 0)
        gap = jnp.where(told, gyro - now.nuisance[-1] - self._then(now, free), 0.0)
        walk = (way.share @ self.robot.process[:, 2] ** 2) * way.speed / dt
        noise = (self.settings.gyro_std**2 + walk) * (
            1 + (tick.acceleration / INERTIA_ACCELERATION) ** 2
        )
        var = look @ cov @ look + noise
        var = var * jnp.maximum(gap**2 / (9.0 * var), 1.0)
        learns = told * jnp.zeros(len(cov)).at[jnp.array([2, -1])].set(1.0)
        return _scalar_update(now, look, gap, var, learns)

    def _rest(self, now: PoseState, gyro: Array) -> PoseState:
        """Learn the gyro's bias while the robot rests.

        A reading that differs from what is known is a robot that creeps on an edge or is turned by
        hand, no bias.
        """
        cov = now.covariance
        gap = gyro - now.nuisance[-1]
        var = cov[-1, -1] + self.settings.gyro_std**2
        rests = jnp.isfinite(gyro) & (now.still > 0.3) & (gap**2 < 9.0 * var)
        look, learns = jnp.zeros(len(cov)).at[-1].set(1.0), jnp.broadcast_to(rests, len(cov))
        return _scalar_update(now, look, jnp.where(rests, gap, 0.0), var, learns.astype(float))

    def _grow(self, old: PoseState, pose: Array, way: _StepMotion, tick: TimeStep) -> PoseState:
        """At the pose after the step, with the covariance and what came into it."""
        f, s, dt = self.robot, self.settings, tick.dt
        world = axes_rotation(old.pose[2] + 0.5 * (pose[2] - old.pose[2]))
        gone = pose[:2] - old.pose[:2]
        # yaw comes from the gyro, not from the floor
        keep = jnp.where(way.by_gyro, jnp.array([1.0, 1.0, 0.0]), jnp.ones(3))
        far = way.speed * dt
        push = world @ (keep[:, None] * way.slope)
        drift = jnp.array([[0.0], [0.0], [1.0]]) * jnp.where(way.by_gyro, -dt, 0.0)
        turned = jnp.array([[1.0, 0.0, -gone[1]], [0.0, 1.0, gone[0]], [0.0, 0.0, 1.0]])
        by = jnp.concatenate([turned, push * dt, drift], axis=1)  # d pose / d (pose, nuisance)
        grown = (way.share @ f.process**2) * far
        floor_axes = world @ (keep[:, None] * way.axes)
        noise = (floor_axes * grown) @ floor_axes.T
        noise = noise.at[2, 2].add(jnp.where(way.by_gyro, (s.gyro_std * dt) ** 2, 0.0))
        rows = by @ old.covariance  # what is not the pose stays as it is
        pose_rows = jnp.concatenate([rows @ by.T + noise, rows[:, 3:]], axis=1)
        rest = jnp.concatenate([rows[:, 3:].T, old.covariance[3:, 3:]], axis=1)
        return replace(
            old,
            pose=pose,
            covariance=jnp.concatenate([pose_rows, rest]),
            noise=old.noise + noise,
            far=old.far + far,
            push=jnp.where(far > 1e-6, push / jnp.maximum(way.speed, 1e-9), old.push),
        )


def _scalar_update(
    now: PoseState, look: Array, gap: Array, var: Array, learns: Float[Array, " unknown"]
) -> PoseState:
    """Corrected by a reading that differs by `gap` from `look` times what is unknown.

    What does not learn keeps its value, and its covariance with what does is right (Joseph's form).

    Args:
        now: before the reading.
        look: derivative of the reading by pose and nuisance; gap: measured less predicted.
        var: of the gap; learns: 1 for each unknown that learns, else 0.
    """
    by = now.covariance @ look
    gain = learns * by / var
    change = gain * gap
    off = jnp.outer(gain, by) + jnp.outer(by, gain)
    return replace(
        now,
        pose=now.pose + change[:3],
        nuisance=now.nuisance + change[3:],
        covariance=now.covariance - off + var * jnp.outer(gain, gain),
    )


def axes_rotation(heading: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Turns a covariance of a body's motion from its axes to the world's."""
    c, s = jnp.cos(heading), jnp.sin(heading)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def cholesky_root(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Lower triangular root of a covariance of ways per metre or of poses.

    It has 0.1 mm/m, or 0.1 mm and 0.1 mrad, more, so that there is one.
    """
    a = jnp.sqrt(m[0, 0] + 1e-8)
    b, d = m[1, 0] / a, m[2, 0] / a
    c = jnp.sqrt(jnp.maximum(m[1, 1] - b * b, 0.0) + 1e-8)
    e = (m[2, 1] - b * d) / c
    f = jnp.sqrt(jnp.maximum(m[2, 2] - d * d - e * e, 0.0) + 1e-8)
    return jnp.array([[a, 0.0, 0.0], [b, c, 0.0], [d, e, f]])
