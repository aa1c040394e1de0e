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
from jaxtyping import Array, Bool, Float

from slipid.control.deployed import DeployedRobot
from slipid.control.effects import direction, stays
from slipid.control.floor_filter import Motion, Tick, length
from slipid.control.interface import Readings, Settings
from slipid.model.se2 import advance, compose

HISTORY = 48
"""Steps a delayed measurement may reach back."""


class PoseState(eqx.Module):
    """Pose, what else is unknown, and how sure both are.

    Attributes:
        pose: x, y [m], heading [rad].
        nuisance: effects of every floor along, across [m/m] and in yaw [rad/m], by how much its
            log friction is off, the doubt d, then the gyro's bias [rad/s].
        covariance: of pose and nuisance.
        toward: direction of travel that counts as taken, see `slipid.control.effects`.
        time, still: since the start, and for which the robot has stood [s].
        noise: covariance that has come into the pose since the start; far: way since then [m].
        push: d pose / d nuisance per metre of the last way, the gyro's bias left out.
        history: last steps, the newest first: time, pose, yaw rate of the contact model, noise and
            way until then.
    """

    pose: Float[Array, "3"]
    nuisance: Float[Array, " nuisance"]
    covariance: Float[Array, "unknown unknown"]
    toward: Float[Array, "3"]
    time: Float[Array, ""]
    still: Float[Array, ""]
    noise: Float[Array, "3 3"]
    far: Float[Array, ""]
    push: Float[Array, "3 push"]
    history: Float[Array, "entry 15"]


class _Way(eqx.Module):
    """Where the body goes in a step, and what pushes it off.

    Attributes:
        speed: at which the effects of floors count [m/s].
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

    robot: DeployedRobot
    settings: Settings = eqx.field(static=True)

    def init(self, pose: Float[Array, "3"], std: tuple[float, float] = (0.0, 0.0)) -> PoseState:
        """At rest at a pose [m, m, rad], known this well [m], [rad]."""
        place, turn = std
        begin, bias = jnp.asarray([place, place, turn]), jnp.asarray([self.settings.gyro_bias_std])
        floors = len(self.robot.labels)
        parts = [begin, self.robot.effect.reshape(-1), jnp.zeros(floors), jnp.ones(3), bias]
        friction = slice(3 + 3 * floors, 3 + 4 * floors)
        entry = jnp.concatenate([jnp.zeros(1), pose, jnp.zeros(11)])
        return PoseState(
            pose=pose,
            nuisance=jnp.zeros(4 * floors + 4),
            covariance=jnp.diag(jnp.concatenate(parts) ** 2)
            .at[friction, friction]
            .set(self.robot.friction_covariance),
            toward=jnp.zeros(3),
            time=jnp.zeros(()),
            still=jnp.zeros(()),
            noise=jnp.zeros((3, 3)),
            far=jnp.zeros(()),
            push=jnp.zeros((3, 4 * floors + 3)),
            history=jnp.broadcast_to(entry, (HISTORY, 15)),
        )

    def step(
        self, old: PoseState, motion: Motion, gyro: Array, z: Readings, tick: Tick
    ) -> tuple[PoseState, Float[Array, "3"], Float[Array, "3 3"]]:
        """Pose a time step later, and the twist that took it there.

        The third is what a pose fix leaves of how far another pose is from it, in the body's axes.

        Args:
            old, tick: the state before the step, and the step.
            motion: what the floors say of it.
            gyro: yaw rate, NaN without one [rad/s].
            z: for its pose fix.
        """
        dt, moves = tick.dt, tick.moves
        way = self._way(motion, gyro)
        old = self._forgotten(old, motion, way, tick)
        free = jnp.where(moves, motion.twist + way.slope @ old.nuisance[:-1], 0.0)
        time = old.time + dt
        twist = free.at[2].set(self._turned(old, time, free[2], gyro))
        pose = compose(old.pose, advance(twist, dt) + motion.jump)
        still = jnp.where(moves, 0.0, jnp.minimum(old.still + dt, 1e3))
        new = replace(self._grow(old, pose, way, tick), time=time, still=still)
        new = self._rest(new, gyro)
        begun, ended = jnp.concatenate([time[None], new.pose, free[2:]]), new.far[None]
        entry = jnp.concatenate([begun, new.noise.reshape(-1), ended])
        history = jnp.where(dt > 0, jnp.roll(old.history, 1, axis=0).at[0].set(entry), old.history)
        new, left = _fixed(replace(new, history=history), z)
        world = _turned_axes(new.pose[2])
        return new, twist, world.T @ left @ world

    def _way(self, motion: Motion, gyro: Array) -> _Way:
        mean = motion.twist
        share = self.robot.rest @ motion.under
        speed = length(mean[:2]) + self.robot.frame.base * jnp.abs(mean[2])
        u = jnp.where(speed > 1e-6, mean[:2] / jnp.maximum(length(mean[:2]), 1e-9), 0.0)
        axes = jnp.array([[u[0], -u[1], 0.0], [u[1], u[0], 0.0], [0.0, 0.0, 1.0]])
        by_effect = speed * (share[:, None, None] * axes.T).reshape(-1, 3).T
        doubt = axes @ _root(axes.T @ motion.scatter @ axes)
        return _Way(
            speed=speed,
            axes=axes,
            slope=jnp.concatenate([by_effect, motion.by_friction, doubt], axis=1),
            share=share,
            by_gyro=jnp.isfinite(gyro),
        )

    def _forgotten(self, old: PoseState, motion: Motion, way: _Way, tick: Tick) -> PoseState:
        """With effects as far as they stay the same over the step, their variance as it was."""
        f = self.robot
        far = way.speed * jnp.where(tick.moves, tick.dt, 0.0)
        left = jnp.prod(1 - motion.under, axis=0)
        now = direction(motion.rolling, f.frame.base)
        toward, keep = stays(old.toward, now, left, far)
        toward = jnp.where(far > 0, toward, old.toward)
        doubt = jnp.exp(-far / self.settings.doubt_m)
        parts = [jnp.repeat(keep, 3), jnp.ones(len(left)), jnp.full(3, doubt), jnp.ones(1)]
        kept = jnp.concatenate(parts)
        std = jnp.concatenate(
            [f.effect.reshape(-1), jnp.zeros(len(left)), jnp.ones(3), jnp.zeros(1)]
        )
        new = (1 - kept**2) * std**2
        whole = jnp.concatenate([jnp.ones(3), kept])
        covariance = whole[:, None] * old.covariance * whole
        covariance = covariance + jnp.diag(jnp.concatenate([jnp.zeros(3), new]))
        return replace(old, nuisance=kept * old.nuisance, covariance=covariance, toward=toward)

    def _turned(self, old: PoseState, time: Array, free: Array, gyro: Array) -> Array:
        """Yaw rate: the gyro's less its bias; over its delay, as the contact model goes on from it.

        `free` is the contact model's [rad/s], `time` that after the step.
        """
        delay = self.settings.gyro_delay_s
        then = free if delay == 0.0 else _nearest(old.history, time - delay)[4]
        return jnp.where(jnp.isfinite(gyro), free + gyro - old.nuisance[-1] - then, free)

    def _rest(self, now: PoseState, gyro: Array) -> PoseState:
        """Learn the gyro's bias while the robot rests.

        A reading that differs from what is known is a robot that creeps on an edge or is turned by
        hand, no bias.
        """
        cov = now.covariance
        gap = gyro - now.nuisance[-1]
        var = cov[-1, -1] + self.settings.gyro_std**2
        rests = jnp.isfinite(gyro) & (now.still > 0.3) & (gap**2 < 9.0 * var)
        gain = jnp.where(rests, cov[:, -1] / var, 0.0)
        change = gain * jnp.where(rests, gap, 0.0)
        return replace(
            now,
            pose=now.pose + change[:3],
            nuisance=now.nuisance + change[3:],
            covariance=cov - jnp.outer(gain, cov[-1]),
        )

    def _grow(self, old: PoseState, pose: Array, way: _Way, tick: Tick) -> PoseState:
        """At the pose after the step, with the covariance and what came into it."""
        f, s, dt = self.robot, self.settings, tick.dt
        world = _turned_axes(old.pose[2] + 0.5 * (pose[2] - old.pose[2]))
        gone = pose[:2] - old.pose[:2]
        on = jnp.where(tick.moves, dt, 0.0)
        # yaw comes from the gyro, not from the floor
        keep = jnp.where(way.by_gyro, jnp.array([1.0, 1.0, 0.0]), jnp.ones(3))
        far = way.speed * on
        push = world @ (keep[:, None] * way.slope)
        drift = jnp.array([[0.0], [0.0], [1.0]]) * jnp.where(way.by_gyro, -dt, 0.0)
        turned = jnp.array([[1.0, 0.0, -gone[1]], [0.0, 1.0, gone[0]], [0.0, 0.0, 1.0]])
        by = jnp.concatenate([turned, push * on, drift], axis=1)  # d pose / d (pose, nuisance)
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


def _turned_axes(heading: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Turns a covariance of a body's motion from its axes to the world's."""
    c, s = jnp.cos(heading), jnp.sin(heading)
    return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _root(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Lower triangular root of a covariance of twists; 0.1 mm/s more, so that it has one."""
    a = jnp.sqrt(m[0, 0] + 1e-8)
    b, d = m[1, 0] / a, m[2, 0] / a
    c = jnp.sqrt(jnp.maximum(m[1, 1] - b * b, 0.0) + 1e-8)
    e = (m[2, 1] - b * d) / c
    f = jnp.sqrt(jnp.maximum(m[2, 2] - d * d - e * e, 0.0) + 1e-8)
    return jnp.array([[a, 0.0, 0.0], [b, c, 0.0], [d, e, f]])


def _fixed(now: PoseState, z: Readings) -> tuple[PoseState, Float[Array, "3 3"]]:
    """Corrected by a pose fix of some time ago, if there is one, and what it leaves of a gap."""
    age = jnp.where(jnp.isfinite(z.fix_age) & (z.fix_age >= 0), z.fix_age, 0.0)
    has = (
        jnp.all(jnp.isfinite(z.fix))
        & jnp.all(jnp.abs(z.fix[:2]) < 1e4)
        & jnp.all(jnp.isfinite(z.fix_std))
        & jnp.all(z.fix_std > 0)
        & (age < now.time - now.history[-1, 0] + 1e-6)
    )
    std = jnp.clip(z.fix_std, 1e-4, 10.0)
    kept = now.pose, now.nuisance, now.covariance, now.history, jnp.eye(3)
    found = jax.lax.cond(has, lambda: _corrected(now, z.fix, std, age), lambda: kept)
    pose, nuisance, covariance, history, left = found
    new = replace(now, pose=pose, nuisance=nuisance, covariance=covariance, history=history)
    return new, left


def _corrected(
    now: PoseState, fix: Array, std: Array, age: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Pose, nuisance, covariance and history after a fix of the pose as it was `age` ago [s].

    The last is what is left of how far another pose is from this one. What nuisance has done since
    then is as on the last way. The noise that came in since then, a covariance of the pose, the fix
    has not seen: it is set aside. What the pose no longer holds of it, a later fix having seen it,
    is so much noise of this one.
    """
    pose, cov, history = now.pose, now.covariance, now.history
    then = _nearest(history, now.time - age)
    since = now.noise - then[5:14].reshape(3, 3)
    held = _within(since, cov[:3, :3])
    aside = jnp.zeros_like(cov).at[:3, :3].set(held)
    cov = cov - aside
    gap = fix - then[1:4]
    gap = gap.at[2].set(jnp.arctan2(jnp.sin(gap[2]), jnp.cos(gap[2])))
    gone = pose[:2] - then[1:3]
    look = jnp.zeros((3, cov.shape[0])).at[:, :3].set(jnp.eye(3))
    look = look.at[0, 2].set(gone[1]).at[1, 2].set(-gone[0])
    look = look.at[:, 3:-1].set(-now.push * (now.far - then[14]))
    noise = jnp.diag(jnp.stack([std[0], std[0], std[1]]) ** 2) + since - held
    total = look @ cov @ look.T + noise
    # a fix far from what is believed counts less, yet counts
    far = gap @ _inverse(total) @ gap
    total = total + noise * jnp.maximum(far / 9.0 - 1.0, 0.0)
    gain = cov @ look.T @ _inverse(total)
    change = gain @ gap
    cov = cov - gain @ look @ cov
    cov = 0.5 * (cov + cov.T) + aside
    back = history[:, 1:3] - pose[:2]
    moved = change[:2] + change[2] * jnp.stack([-back[:, 1], back[:, 0]], axis=-1)
    history = history.at[:, 1:3].add(moved).at[:, 3].add(change[2])
    left = jnp.eye(3) - gain[:3] @ look[:, :3]
    return pose + change[:3], now.nuisance + change[3:], cov, history, left


def _within(part: Float[Array, "3 3"], whole: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """As much of a covariance as another one can hold.

    The largest eigenvalue of their quotient is at most the eighth root of the trace of its eighth
    power, and at least 1 / 1.15 of that.
    """
    m = _inverse(whole) @ part
    for _ in range(3):
        m = m @ m
    most = jnp.maximum(jnp.trace(m), 1e-12) ** 0.125
    return jnp.where(jnp.isfinite(most), part / jnp.maximum(most, 1.0), 0.0)


def _nearest(history: Array, time: Array) -> Array:
    """Entry nearest to a time: time, pose, yaw rate of the contact model, noise until then."""
    return history[jnp.argmin(jnp.abs(history[:, 0] - time))]


def _inverse(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Inverse of a positive definite matrix by the adjugate."""
    rows = jnp.stack([jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])], axis=1)
    return rows / jnp.maximum(m[0] @ rows[:, 0], 1e-30)
