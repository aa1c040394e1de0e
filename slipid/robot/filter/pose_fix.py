"""Pose state of the estimator, and its corrections by pose fixes, maps and late evidence."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from slipid.robot.filter.floor import SPREAD
from slipid.robot.filter.floor_filter import BodyMotion
from slipid.robot.interface import Readings

HISTORY_STEPS = 48
"""Number of entries in the history, the last step included; it limits the age of a delayed
measurement."""
MAP_EXPONENT = 0.25
"""Exponent applied to the likelihood of a pose, which follows from the belief about floors [1]. It
is below 1 because an error of the map affects many steps, so that the evidence of these steps is
not independent."""


MOST_STDS = 6.0
"""Distance of a pose fix from the expected pose above which it is set aside [1]."""
AGREEING_FIXES = 3
"""Number of pose fixes in a row that are believed against the estimate if they agree."""
DRIFT = (0.1, 0.3)
"""Std of the motion between two pose fixes that are compared [m/m], [rad/m]."""


class FixState(eqx.Module):
    """Pose fixes that contradict the estimate.

    Attributes:
        fix: last fix that was set aside [m, m, rad].
        std: its std of position [m] and heading [rad].
        pose: estimated pose at the time of that fix [m, m, rad].
        far: path length since then [m].
        agreeing: number of fixes in a row that were set aside and agree with each other.
        rejected: number of fixes that were set aside since the start.
    """

    fix: Float[Array, "3"]
    std: Float[Array, "2"]
    pose: Float[Array, "3"]
    far: Float[Array, ""]
    agreeing: Float[Array, ""]
    rejected: Float[Array, ""]

    @classmethod
    def init(cls) -> "FixState":
        """Return the state before the first fix."""
        zero = jnp.zeros(())
        return cls(jnp.zeros(3), jnp.ones(2), jnp.zeros(3), zero, zero, zero)

    def after(
        self, fix: Array, std: Array, pose: Array, fits: Bool[Array, ""]
    ) -> tuple["FixState", Bool[Array, ""]]:
        """Return the state after a fix, and whether it is believed against the estimate.

        Args:
            fix: the fix [m, m, rad].
            std: its std of position [m] and heading [rad].
            pose: estimated pose at the time of the fix [m, m, rad].
            fits: True if the fix does not contradict the estimate.
        """
        gone, turn = pose[:2] - self.pose[:2], wrapped(self.fix[2] - self.pose[2])
        c, s = jnp.cos(turn), jnp.sin(turn)
        expected = self.fix[:2] + jnp.stack([c * gone[0] - s * gone[1], s * gone[0] + c * gone[1]])
        gap = jnp.append(fix[:2] - expected, wrapped(fix[2] - pose[2] - turn))
        var = self.std**2 + std**2 + (jnp.array(DRIFT) * self.far) ** 2
        across = self.std[1] ** 2 * (gone @ gone)  # by the error of the first fix's heading
        far = gap[:2] @ gap[:2] / (var[0] + across) + gap[2] ** 2 / var[1]
        same = (self.agreeing > 0) & (far < MOST_STDS**2)
        agreeing = jnp.where(same, jnp.minimum(self.agreeing + 1.0, AGREEING_FIXES), 1.0)
        believed = ~fits & (agreeing >= AGREEING_FIXES)
        new = FixState(
            fix=fix,
            std=std,
            pose=pose,
            far=jnp.zeros(()),
            agreeing=jnp.where(fits | believed, 0.0, agreeing),
            rejected=self.rejected + ~(fits | believed),
        )
        return new, believed


class PoseState(eqx.Module):
    """Pose, nuisance states, and their covariance.

    Attributes:
        pose: x, y [m], heading [rad].
        nuisance: effects of every floor along, across and in yaw, less their means and in units of
            their remaining stds; errors of the floors' log frictions; three belief errors d [1];
            the gyro's bias [rad/s].
        covariance: covariance of pose and nuisance [products of their units].
        toward: settled direction of travel, see `slipid.robot.filter.effects`.
        still: time since the robot last moved [s].
        noise: covariance that process noise has added to the pose since the oldest entry of the
            history, in products of [m, m, rad].
        far: path length since the oldest entry of the history [m].
        push: derivative of the pose with respect to the nuisance, except the gyro's bias, per metre
            of the last motion [m/m, m/m, rad/m].
        history: last steps, the newest first. Columns: age [s], pose [m, m, rad], yaw rate of the
            contact model [rad/s], `noise` in row-major order and `far` [m] after the step.
        fixes: pose fixes that contradict the estimate.
    """

    pose: Float[Array, "3"]
    nuisance: Float[Array, " nuisance"]
    covariance: Float[Array, "unknown unknown"]
    toward: Float[Array, "3"]
    still: Float[Array, ""]
    noise: Float[Array, "3 3"]
    far: Float[Array, ""]
    push: Float[Array, "3 push"]
    history: Float[Array, "entry 15"]
    fixes: FixState


def apply_fix(now: PoseState, z: Readings) -> tuple[PoseState, Float[Array, "3 3"]]:
    """Return the state corrected by a pose fix, if there is one, and a matrix (3, 3).

    A fix more than `MOST_STDS` stds from the expected pose is set aside. If as many as
    `AGREEING_FIXES` in a row agree with each other, the pose moves to the last of them. The caller
    must multiply the distance of each hypothesis's pose from the estimated pose, in world axes, by
    the matrix. Without a fix the matrix is the identity.
    """
    age = jnp.where(jnp.isfinite(z.fix_age) & (z.fix_age >= 0), z.fix_age, 0.0)
    has = (
        jnp.all(jnp.isfinite(z.fix))
        & jnp.all(jnp.abs(z.fix) < 1e4)
        & jnp.all(jnp.isfinite(z.fix_std))
        & jnp.all(z.fix_std > 0)
        & (age < now.history[-1, 0] + 1e-6)
    )
    std = jnp.clip(z.fix_std, 1e-4, 10.0)
    return jax.lax.cond(
        has, lambda: _corrected(now, z.fix, std, age), lambda: (now, jnp.eye(3, dtype=float))
    )


def _corrected(
    now: PoseState, fix: Array, std: Array, age: Array
) -> tuple[PoseState, Float[Array, "3 3"]]:
    """Return the state and the matrix of `apply_fix` after a pose fix.

    The fix measures the pose at the time `age` [s] ago. Between that time and now, nuisance states
    are assumed to act on the pose as they did in the last motion. The fix contains no information
    about process noise that was added after that time, so the covariance of this noise is
    subtracted from the covariance of the pose before the update and added again after it. A part of
    it may no longer be in the covariance of the pose, because a later fix removed it; this part is
    treated as noise of the present fix.
    """
    pose, cov, history = now.pose, now.covariance, now.history
    then = nearest(history, age)
    since = now.noise - then[5:14].reshape(3, 3)
    held = _within(since, _given(cov))
    aside = jnp.zeros_like(cov).at[:3, :3].set(held)
    cov = cov - aside
    gap = fix - then[1:4]
    gap = gap.at[2].set(wrapped(gap[2]))
    gone = pose[:2] - then[1:3]
    look = jnp.zeros((3, cov.shape[0])).at[:, :3].set(jnp.eye(3))
    look = look.at[0, 2].set(gone[1]).at[1, 2].set(-gone[0])
    look = look.at[:, 3:-1].set(-now.push * (now.far - then[14]))
    noise = jnp.diag(jnp.stack([std[0], std[0], std[1]]) ** 2) + since - held
    rows = look @ cov
    total = rows @ look.T + noise
    far = gap @ _inverse(total) @ gap
    fits = far < MOST_STDS**2
    fixes, believed = now.fixes.after(fix, std, then[1:4], fits)
    # enlarge the noise of a fix more than 3 stds from the expected pose
    total = total + noise * jnp.maximum((far / 9.0) ** 2 - 1.0, 0.0)
    gain = jnp.where(fits, rows.T @ _inverse(total), 0.0)
    change = gain @ gap
    cov = cov - gain @ rows
    cov = 0.5 * (cov + cov.T) + aside
    history = shifted(history, pose, jnp.broadcast_to(change[:3], (len(history), 3)))
    corrected = replace(
        now,
        pose=pose + change[:3],
        nuisance=now.nuisance + change[3:],
        covariance=cov,
        history=history,
        fixes=fixes,
    )
    left = jnp.eye(3) - gain[:3] @ look[:, :3]
    moved = _moved_to(corrected, fix, then[1:4], std), jnp.zeros((3, 3))
    return jax.tree.map(lambda a, b: jnp.where(believed, b, a), (corrected, left), moved)


def _moved_to(
    now: PoseState, fix: Float[Array, "3"], then: Float[Array, "3"], std: Float[Array, "2"]
) -> PoseState:
    """Return the state with the path moved and turned so that the pose `then` becomes `fix`.

    The pose's covariance becomes that of the fix, with noise since the oldest entry of the history.
    """
    turn = wrapped(fix[2] - then[2])
    c, s = jnp.cos(turn), jnp.sin(turn)

    def at(poses: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        x, y = poses[..., 0] - then[0], poses[..., 1] - then[1]
        moved = fix[0] + c * x - s * y, fix[1] + s * x + c * y, poses[..., 2] + turn
        return jnp.stack(moved, axis=-1)

    pose = at(now.pose)
    gone = pose[:2] - fix[:2]
    by = jnp.eye(3).at[0, 2].set(-gone[1]).at[1, 2].set(gone[0])
    var = by @ jnp.diag(jnp.stack([std[0], std[0], std[1]]) ** 2) @ by.T + now.noise
    cov = now.covariance.at[:3].set(0.0).at[:, :3].set(0.0).at[:3, :3].set(var)
    history = now.history.at[:, 1:4].set(at(now.history[:, 1:4]))
    return replace(now, pose=pose, covariance=cov, history=history)


def apply_map(
    now: PoseState,
    root: Float[Array, "3 3"],
    supports: Float[Array, "sample hypothesis"],
    motion: BodyMotion,
) -> tuple[PoseState, Float[Array, "3 3"]]:
    """Return the state after comparing the belief about floors with a map, and a matrix (3, 3).

    The caller must multiply the distance of each hypothesis's pose from the estimated pose, in
    world axes, by the matrix.

    Args:
        now: pose and covariance.
        root: root of the pose's covariance, with which the pose samples were drawn.
        supports: probability that the map gives every hypothesis at every pose sample, see
            `Floor.supports`.
        motion: motion of the step; its `before` and `known` are the probabilities of the hypotheses
            before and after this step's evidence.
    """
    share = supports / jnp.maximum(jnp.mean(supports, axis=0), 1e-12)
    weight = (share @ motion.known) / jnp.maximum(share @ motion.before, 1e-12)
    weight = weight**MAP_EXPONENT
    weight = weight / jnp.sum(weight)
    mean = weight @ SPREAD
    scatter = (SPREAD - mean).T @ (weight[:, None] * (SPREAD - mean))
    whole = root @ root.T
    gain = now.covariance[:, :3] @ _inverse(whole)
    lost = gain @ (whole - root @ scatter @ root.T) @ gain.T
    change = gain @ (root @ mean)
    history = shifted(now.history, now.pose, jnp.broadcast_to(change[:3], (len(now.history), 3)))
    new = replace(
        now,
        pose=now.pose + change[:3],
        nuisance=now.nuisance + change[3:],
        covariance=now.covariance - lost,
        history=history,
    )
    return new, root @ scatter @ root.T @ _inverse(whole)


def history_after_jump(
    old: PoseState, motion: BodyMotion, base: Float[Array, ""]
) -> Float[Array, "entry 15"]:
    """Return the history after late evidence on the floors moved the pose by a jump J.

    The beliefs before and after the evidence predict different twists. The poses by the two beliefs
    are assumed to have diverged at the present rate j per metre until now, when they differ by J.
    So a path length s [m] ago, the fraction

        1 - s (j . J) / |J|^2

    of J (limited to 0 ... 1, with yaw multiplied by the base radius) already existed, and a past
    pose is shifted by this fraction of J. Without the shift, a fix of an earlier pose would move
    the pose by the jump once more.
    """
    scale = jnp.stack([jnp.ones(()), jnp.ones(()), base])
    jump, apart = scale * motion.jump, scale * motion.correction
    rate = apart @ jump / jnp.maximum(jump @ jump, 1e-18)
    since = (old.far - old.history[:, 14]) / jnp.maximum(motion.rolled.speed, 1e-6)
    part = jnp.clip(1 - rate * since, 0.0, 1.0)
    c, s = jnp.cos(old.pose[2]), jnp.sin(old.pose[2])
    x, y, yaw = motion.jump
    world = jnp.stack([c * x - s * y, s * x + c * y, yaw])
    return shifted(old.history, old.pose, part[:, None] * world)


def shifted(
    history: Float[Array, "entry 15"], pose: Float[Array, "3"], change: Float[Array, "entry 3"]
) -> Float[Array, "entry 15"]:
    """Return the history with past poses corrected by `change`, one row per entry.

    A correction of heading also rotates the past position about the present `pose`.
    """
    back = history[:, 1:3] - pose[:2]
    moved = change[:, :2] + change[:, 2:] * jnp.stack([-back[:, 1], back[:, 0]], axis=-1)
    return history.at[:, 1:3].add(moved).at[:, 3].add(change[:, 2])


def _given(cov: Float[Array, "unknown unknown"]) -> Float[Array, "3 3"]:
    """Return the conditional covariance of the pose, given all nuisance states.

    No more than this can be subtracted from the pose's own covariance: its other part is correlated
    with the nuisance states, and subtracting more would give an indefinite joint covariance.
    """

    def known(k: Int[Array, ""], c: Array) -> Array:
        column, var = c[:, k], c[k, k]
        gain = jnp.where(var > 1e-12, column / jnp.maximum(var, 1e-12), 0.0)
        return c - jnp.outer(gain, column)

    return jax.lax.fori_loop(3, len(cov), known, cov)[:3, :3]


def _within(part: Float[Array, "3 3"], whole: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the covariance `part`, scaled down if needed so that it does not exceed `whole`.

    The scale is 1 / b, where b is a bound on the largest eigenvalue of whole^-1 part: the eighth
    root of the trace of the matrix's eighth power, at most 1.15 times that eigenvalue.
    """
    m = _inverse(whole) @ part
    for _ in range(3):
        m = m @ m
    most = jnp.maximum(jnp.trace(m), 1e-12) ** 0.125
    return jnp.where(jnp.isfinite(most), part / jnp.maximum(most, 1.0), 0.0)


def rebased(now: PoseState) -> PoseState:
    """Return the state with noise and path length counted from the oldest entry of the history.

    Noise and path length then stay small even on long drives, so that 32-bit numbers suffice. For
    the same reason the history stores ages instead of times.
    """
    first = now.history[-1, 5:]
    history = now.history.at[:, 5:].add(-first)
    return replace(
        now, history=history, noise=now.noise - first[:9].reshape(3, 3), far=now.far - first[9]
    )


def wrapped(angle: Float[Array, ""]) -> Float[Array, ""]:
    """Return an angle between -pi and pi [rad]."""
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def nearest(history: Array, age: Array | float) -> Array:
    """Return the entry of `PoseState.history` whose age is nearest to `age` [s]."""
    return history[jnp.argmin(jnp.abs(history[:, 0] - age))]


def _inverse(m: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the inverse of a positive definite matrix, computed by the adjugate."""
    rows = jnp.stack([jnp.cross(m[1], m[2]), jnp.cross(m[2], m[0]), jnp.cross(m[0], m[1])], axis=1)
    return rows / jnp.maximum(m[0] @ rows[:, 0], 1e-30)
