"""Filter of the pose and its covariance, with the errors of the model as further states.

Process noise and effects increase the covariance. The effects, the friction of the floors and the
bias of a gyro are further states, which pose fixes correct; the bias is also corrected at rest.
Friction affects the motion only while wheels stand on several floors, so fitted runs that each stay
on a single floor do not determine it. Uncertainty about the floors is the scatter S of the
hypotheses' twists xi_c about their mean xi, with probabilities p_c. An error d of the belief
persists for a while:

    S = sum_c p_c (xi_c - xi) (xi_c - xi)^T = L L^T,   xi_true = xi + L d,   d ~ N(0, 1)
    d <- k d + sqrt(1 - k^2) noise,   k = exp(-far / doubt_m)

where `far` is the path length of the step [m] and `doubt_m` the path length over which d decays
[m], see `Settings`.
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
from slipid.robot.filter.gyro import LEAST_STD
from slipid.robot.filter.pose_fix import (
    HISTORY_STEPS,
    FixState,
    PoseState,
    apply_fix,
    history_after_jump,
    nearest,
    rebased,
)
from slipid.robot.interface import Readings, Settings

CREEP_SPEED = 0.05
"""Speed below which a gyro's difference from the contact model is not used, since fitted runs are
faster and the model is not known there [m/s]."""

LASTING_ERROR = 0.004
"""Std of an error of the model that lasts over `Settings.doubt_m`, such as while wheels cross the
edges of floors, as a fraction of the rim speed [1]."""


class _StepMotion(eqx.Module):
    """Motion of the body in a step with its derivatives.

    Attributes:
        speed: `RolledMotion.speed`, the speed that effects are relative to [m/s].
        axes: unit vectors along, across and in yaw, as columns in the body frame.
        slope: derivative of the twist with respect to the nuisance states, except the gyro's bias.
        share: expected fraction of the weight on each floor [1].
        by_gyro: True if a gyro measures the yaw rate.
    """

    speed: Float[Array, ""]
    axes: Float[Array, "3 3"]
    slope: Float[Array, "3 push"]
    share: Float[Array, " floor"]
    by_gyro: Bool[Array, ""]


class PoseFilter(eqx.Module):
    """Filter of the pose and its covariance."""

    robot: RobotArrays
    settings: Settings

    def init(
        self, pose: Float[Array, "3"], std: Float[Array, "2"] | tuple[float, float] = (0.0, 0.0)
    ) -> PoseState:
        """Return the state at rest at a pose [m, m, rad] with stds [m], [rad]."""
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
            history=jnp.broadcast_to(entry, (HISTORY_STEPS, 15)),
            fixes=FixState.init(),
        )

    def gyro_gap(
        self, now: PoseState, gyro: Array, yaw: Array, var: Array, tick: TimeStep
    ) -> tuple[Array, Array]:
        """Return the difference of a gyro from the model's yaw rate, and its variance.

        The model's yaw rate counts as an interval: from its value in the last step, or when the
        reading was taken, to the present one.

        Args:
            now: state before the step.
            gyro: yaw rate by the gyro [rad/s].
            yaw: the model's present yaw rate [rad/s].
            var: variance of `yaw` over the floors [rad^2/s^2].
            tick: the time step.
        """
        then, before = self._yaw_rate_then(now, yaw), now.history[0, 4]
        low = jnp.minimum(jnp.minimum(then, before), yaw)
        high = jnp.maximum(jnp.maximum(then, before), yaw)
        turn = gyro - now.nuisance[-1]
        var = var + self.settings.gyro_std**2 + LEAST_STD**2
        var = var * (1 + (tick.acceleration / INERTIA_ACCELERATION) ** 2)
        return turn - jnp.clip(turn, low, high), var + now.covariance[-1, -1]

    def turned(self, now: PoseState, turn: Array, doubt: Array) -> PoseState:
        """Return the state after a robot was turned otherwise than the model predicted.

        Args:
            now: state before.
            turn: rotation that is believed; the robot may have been moved as well [rad].
            doubt: rotation that may have happened or not [rad].
        """
        aside = self.robot.frame.base * turn
        more = jnp.diag(jnp.stack([aside, aside, doubt]) ** 2)
        return replace(
            now,
            pose=now.pose.at[2].add(turn),
            covariance=now.covariance.at[:3, :3].add(more),
        )

    def mapped(
        self, now: PoseState, floor: Floor, hypotheses: Int[np.ndarray, "hypothesis wheel"]
    ) -> tuple[Float[Array, "3 3"], Float[Array, "sample hypothesis"]]:
        """Return the pose covariance's root, and `Floor.supports` at pose samples drawn with it."""
        root, floors = cholesky_root(now.covariance[:3, :3]), len(self.robot.labels)
        return root, floor.supports(now.pose, root, self.robot.places, hypotheses, floors)

    def step(
        self, old: PoseState, motion: BodyMotion, gyro: Array, z: Readings, tick: TimeStep
    ) -> tuple[PoseState, Float[Array, "3"], Float[Array, "3 3"]]:
        """Return the state one time step later, the twist of the step, and a matrix (3, 3).

        A pose fix also corrects the poses of the hypotheses: the caller must multiply their
        distances from the estimated pose, in body axes, by the matrix. Without a fix the matrix is
        the identity.

        Args:
            old: state before the step.
            motion: motion that the floor filter returned.
            gyro: gyro's yaw rate; NaN without a gyro [rad/s].
            z: readings, of which only the pose fix is used.
            tick: the time step.
        """
        dt = tick.dt
        body = self._step_motion(motion, gyro)
        old = self._forgotten(old, motion, tick)
        # correct the twist by the nuisance states at any speed, since even slow motion adds up
        free = motion.twist + body.slope @ old.nuisance[:-1]
        old = replace(old, history=old.history.at[:, 0].add(dt))
        twist = free.at[2].set(self._turned(old, free[2], gyro))
        pose = compose(old.pose, advance(twist, dt) + motion.jump)
        still = jnp.where(tick.moves, 0.0, jnp.minimum(old.still + dt, 1e3))
        old = replace(old, history=history_after_jump(old, motion, self.robot.frame.base))
        new = replace(self._moved(old, pose, body, tick), still=still)
        new = self._gyro_update(new, body, gyro, free[2], tick)
        new = self._bias_at_rest(new, gyro, self._yaw_rate_then(new, free[2]))
        begun, ended = jnp.concatenate([jnp.zeros(1), new.pose, free[2:]]), new.far[None]
        entry = jnp.concatenate([begun, new.noise.reshape(-1), ended])
        history = jnp.where(dt > 0, jnp.roll(old.history, 1, axis=0).at[0].set(entry), old.history)
        new, left = apply_fix(rebased(replace(new, history=history)), z)
        world = axes_rotation(new.pose[2])
        return new, twist, world.T @ left @ world

    def _step_motion(self, motion: BodyMotion, gyro: Array) -> _StepMotion:
        """Return the motion of a step with its derivatives, from the result of the floor filter."""
        share = self.robot.rest @ motion.under
        speed, axes = motion.rolled.speed, motion.rolled.axes
        std = speed * share[:, None] * motion.left
        by_effect = (std[:, :, None] * axes.T).reshape(-1, 3).T
        # take the root of the scatter per metre and multiply it by the speed afterwards, so that
        # the small variance that `cholesky_root` adds vanishes while the robot is at rest
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
        """Return the state with effects and belief errors decorrelated over the step.

        The estimates of these states decay towards 0, and their variances return towards 1, their
        stationary value.
        """
        f = self.robot
        speed = length(motion.twist[:2]) + f.frame.base * jnp.abs(motion.twist[2])
        far = speed * tick.dt  # path length with slip
        left = jnp.prod(1 - motion.under, axis=0)
        now = travel_direction(motion.rolling, f.frame.base)
        toward, keep = effect_correlation(old.toward, now, left, far)
        toward = jnp.where(far > 0, toward, old.toward)
        doubt = jnp.exp(-far / self.settings.doubt_m)
        parts = [jnp.repeat(keep, 3), jnp.ones(len(left)), jnp.full(3, doubt), jnp.ones(1)]
        kept = jnp.concatenate(parts)
        whole = jnp.concatenate([jnp.ones(3), kept])
        covariance = whole[:, None] * old.covariance * whole + jnp.diag(1 - whole**2)
        return replace(old, nuisance=kept * old.nuisance, covariance=covariance, toward=toward)

    def _turned(self, old: PoseState, free: Array, gyro: Array) -> Array:
        """Return the present yaw rate: the gyro's reading less its bias, extrapolated [rad/s].

        A gyro's reading is delayed, so the contact model's change of yaw rate over that delay is
        added. Without a gyro, the contact model's yaw rate `free` [rad/s] is returned. The ages in
        the history of `old` must already include the present step.
        """
        then = self._yaw_rate_then(old, free)
        return jnp.where(jnp.isfinite(gyro), free + gyro - old.nuisance[-1] - then, free)

    def _yaw_rate_then(self, now: PoseState, free: Array) -> Array:
        """Return the contact model's yaw rate when the gyro's reading was taken [rad/s].

        `free` is the model's present yaw rate.
        """
        delay = self.settings.gyro_delay_s
        if not isinstance(delay, jax.core.Tracer) and float(delay) == 0.0:
            # a delay known to be 0 needs no search through the history, also in exported code
            return free
        return jnp.where(delay == 0.0, free, nearest(now.history, delay)[4])

    def _gyro_update(
        self, now: PoseState, body: _StepMotion, gyro: Array, free: Array, tick: TimeStep
    ) -> PoseState:
        """Return the state corrected by comparing a moving robot's gyro with the contact model.

        The gyro's reading is the model's yaw rate plus the model's errors and the gyro's bias:

            gyro = (twist + slope nuisance)_yaw + bias + noise

        The noise is the gyro's noise plus the model's process noise, whose std grows with the root
        of the path length, and an error that lasts (`LASTING_ERROR`), taken for process noise of
        the same effect. Otherwise floors that no run showed would teach a wrong bias. A reading far
        from the expected value has less weight, and so has every reading while wheels accelerate,
        since the equilibrium neglects inertia. Only heading and bias are updated; the errors of the
        model contribute to the variance but keep their values (Schmidt 1966), since the gyro has
        already been used for the belief about floors.
        """
        dt, cov = jnp.maximum(tick.dt, 1e-3), now.covariance
        look = jnp.concatenate([jnp.zeros(3), body.slope[2], jnp.ones(1)])
        usable = (body.speed > CREEP_SPEED) & jnp.isfinite(gyro) & (tick.dt > 0)
        then = self._yaw_rate_then(now, free)
        gap = jnp.where(usable, gyro - now.nuisance[-1] - then, 0.0)
        lasting = (LASTING_ERROR / self.robot.frame.base) ** 2 * self.settings.doubt_m
        walk = (body.share @ self.robot.process[:, 2] ** 2 + lasting) * body.speed / dt
        noise = (self.settings.gyro_std**2 + walk) * (
            1 + (tick.acceleration / INERTIA_ACCELERATION) ** 2
        )
        var = look @ cov @ look + noise
        var = var * jnp.maximum(gap**2 / (9.0 * var), 1.0)
        learns = usable * jnp.zeros(len(cov)).at[jnp.array([2, -1])].set(1.0)
        return _scalar_update(now, look, gap, var, learns)

    def _bias_at_rest(self, now: PoseState, gyro: Array, free: Array) -> PoseState:
        """Return the state with the gyro's bias updated while the robot rests.

        A robot that rests may still be turned slowly by a controller that follows the drift of the
        heading, so the yaw rate `free` by its wheels is subtracted [rad/s]. The bias is not updated
        if the reading differs from it by more than 3 stds: the robot then probably creeps on an
        edge or is turned by hand.
        """
        cov = now.covariance
        gap = gyro - now.nuisance[-1] - free
        var = cov[-1, -1] + self.settings.gyro_std**2
        rests = jnp.isfinite(gyro) & (now.still > 0.3) & (gap**2 < 9.0 * var)
        look, learns = jnp.zeros(len(cov)).at[-1].set(1.0), jnp.broadcast_to(rests, len(cov))
        return _scalar_update(now, look, jnp.where(rests, gap, 0.0), var, learns.astype(float))

    def _moved(self, old: PoseState, pose: Array, body: _StepMotion, tick: TimeStep) -> PoseState:
        """Return the state at the pose after the step, with the covariance propagated to it."""
        f, s, dt = self.robot, self.settings, tick.dt
        world = axes_rotation(old.pose[2] + 0.5 * (pose[2] - old.pose[2]))
        gone = pose[:2] - old.pose[:2]
        # a gyro's yaw rate replaces the model's, so the model's errors then do not affect the yaw
        keep = jnp.where(body.by_gyro, jnp.array([1.0, 1.0, 0.0]), jnp.ones(3))
        far = body.speed * dt
        push = world @ (keep[:, None] * body.slope)
        drift = jnp.array([[0.0], [0.0], [1.0]]) * jnp.where(body.by_gyro, -dt, 0.0)
        turned = jnp.array([[1.0, 0.0, -gone[1]], [0.0, 1.0, gone[0]], [0.0, 0.0, 1.0]])
        by = jnp.concatenate([turned, push * dt, drift], axis=1)  # d pose / d (pose, nuisance)
        grown = (body.share @ f.process**2) * far
        floor_axes = world @ (keep[:, None] * body.axes)
        noise = (floor_axes * grown) @ floor_axes.T
        noise = noise.at[2, 2].add(jnp.where(body.by_gyro, (s.gyro_std * dt) ** 2, 0.0))
        rows = by @ old.covariance  # compute only the pose's rows; the nuisance's do not change
        pose_rows = jnp.concatenate([rows @ by.T + noise, rows[:, 3:]], axis=1)
        rest = jnp.concatenate([rows[:, 3:].T, old.covariance[3:, 3:]], axis=1)
        return replace(
            old,
            pose=pose,
            covariance=jnp.concatenate([pose_rows, rest]),
            noise=old.noise + noise,
            far=old.far + far,
            fixes=replace(old.fixes, far=jnp.minimum(old.fixes.far + far, 1e3)),
            push=jnp.where(far > 1e-6, push / jnp.maximum(body.speed, 1e-9), old.push),
        )


def _scalar_update(
    now: PoseState, look: Array, gap: Array, var: Array, learns: Float[Array, " unknown"]
) -> PoseState:
    """Return the state corrected by one scalar reading.

    Only the states selected by `learns` are updated; Joseph's form of the update gives the right
    covariance also for the gain of 0 of all other states.

    Args:
        now: state before the reading.
        look: derivative of the reading with respect to pose and nuisance.
        gap: measured less predicted reading [unit of the reading].
        var: variance of the gap [unit of the reading, squared].
        learns: 1 for each element of pose and nuisance that is updated, else 0.
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
    """Return the matrix that rotates a motion (x, y, yaw) from body axes to world axes."""
    c, s = jnp.cos(heading), jnp.sin(heading)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def cholesky_root(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the lower triangular Cholesky root of a covariance of poses, or of motions per metre.

    A std of 0.1 mm and 0.1 mrad (or 0.1 mm/m and 0.1 mrad/m) is added, so that the root also
    exists for a singular covariance.
    """
    a = jnp.sqrt(m[0, 0] + 1e-8)
    b, d = m[1, 0] / a, m[2, 0] / a
    c = jnp.sqrt(jnp.maximum(m[1, 1] - b * b, 0.0) + 1e-8)
    e = (m[2, 1] - b * d) / c
    f = jnp.sqrt(jnp.maximum(m[2, 2] - d * d - e * e, 0.0) + 1e-8)
    return jnp.array([[a, 0.0, 0.0], [b, c, 0.0], [d, e, f]])
