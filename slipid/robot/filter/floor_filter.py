"""Filter over the floors under the wheels, with one hypothesis for all wheels together.

All wheels move the same body, so every hypothesis assigns a floor to each wheel (`hypotheses`); one
further hypothesis is "unknown". In every step, after wheels may have changed floors:

    xi_c, I_c     body twist by contact equilibrium, and motor currents, of hypothesis c at the
                  wheel speeds; with all wheels on one floor xi_c includes the mean effect there,
                  or follows from calibrated kinematics, if these were selected for the floor
    p_c <- p_c * (p(I | I_c) p(gyro | xi_c))^(dt / tau)   probability of c
    g_c <- g_c * exp(xi_c dt)                             pose if c is true
    g = sum_c p_c g_c                                     mean pose

where the units of xi_c are [m/s, m/s, rad/s], I are the measured and I_c the predicted currents
[A], and tau is the time within which measurements count as one piece of evidence
(`Settings.forget_s`) [s].

A wheel's current shows the wheel's fraction of the total drag, not the drag of the floor beneath
it; only all currents together distinguish the floors. Evidence that comes late corrects the pose by
the distance between the hypotheses' poses (interacting multiple models; Blom and Bar-Shalom 1988).
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.model.contact import settle
from slipid.model.contact_balance import Balance, stand
from slipid.model.kinematics import rolled as rolled_motion
from slipid.model.motor import sign_of_motion
from slipid.model.robot import GRAVITY
from slipid.model.se2 import Planar, advance, compose, solve3
from slipid.robot.deployed import RobotArrays
from slipid.robot.filter.effects import RolledMotion
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.filter.wheels import MotorCurrents
from slipid.robot.interface import Settings

INERTIA_ACCELERATION = 30.0
"""Wheel acceleration at which evidence on floors has half its weight, since the contact equilibrium
neglects inertia [rad/s^2]."""
CHANGE = 0.1
"""Probability that the floors have changed without being noticed, for the plausibility of a gyro
[1]."""
SLIP = 0.05
"""Std of slip that no floor explains, as a fraction of the rim speed, for the same purpose [1]."""
UNKNOWN_EFFECT = 0.3
"""Std of the yaw that an unknown floor causes, for the same purpose [rad/m]."""


class TimeStep(eqx.Module):
    """One time step.

    Attributes:
        dt: duration as `slipid.robot.filter.wheels.time_step` returns it [s].
        moves: True if a wheel turns.
        acceleration: acceleration of the fastest changing wheel [rad/s^2].
    """

    dt: Float[Array, ""]
    moves: Bool[Array, ""]
    acceleration: Float[Array, ""]


class FloorState(eqx.Module):
    """Belief over the hypotheses.

    Attributes:
        belief: probability of each hypothesis; the last element is that of "unknown".
        expected: probability of each hypothesis without measurements: by the map at the robot's
            pose, or by the prior without a map.
        twist: twist by contact equilibrium, without effects, if the hypothesis were true
            [m/s, m/s, rad/s].
        apart: pose if the hypothesis were true, relative to the estimated pose [m, m, rad].
    """

    belief: Float[Array, " hypothesis_or_none"]
    expected: Float[Array, " hypothesis"]
    twist: Float[Array, "hypothesis 3"]
    apart: Float[Array, "hypothesis 3"]


class BodyMotion(eqx.Module):
    """Motion of the body, averaged over all hypotheses.

    Attributes:
        twist: mean twist [m/s, m/s, rad/s].
        scatter: covariance of the twist over hypotheses.
        rolling: twist of the body if no wheel slipped [m/s, m/s, rad/s].
        rolled: direction and speed of `rolling`.
        left: remaining std of every floor's effects in the direction of `rolling`
            [m/m, m/m, rad/m].
        by_friction: derivative of the mean twist with respect to each floor's log friction
            [m/s, m/s, rad/s].
        known: probability of every hypothesis after this step, given that one of them is true.
        before: probability like `known`, but without the evidence of this step.
        under: probability of each floor under each wheel, given that one hypothesis is true.
        jump: change of the pose by late evidence, added to the motion by the twist [m, m, rad].
        correction: change of the mean twist caused by this step's evidence [m/s, m/s, rad/s].
    """

    twist: Float[Array, "3"]
    scatter: Float[Array, "3 3"]
    rolling: Float[Array, "3"]
    rolled: RolledMotion
    left: Float[Array, "floor 3"]
    by_friction: Float[Array, "3 floor"]
    known: Float[Array, " hypothesis"]
    before: Float[Array, " hypothesis"]
    under: Float[Array, "wheel floor"]
    jump: Float[Array, "3"]
    correction: Float[Array, "3"]


class Prediction(eqx.Module):
    """Predictions of every hypothesis at the wheel speeds of a step.

    Attributes:
        wheel_speed: wheel speed of every drive [rad/s].
        settled: twist by contact equilibrium, without effects [m/s, m/s, rad/s].
        twist: twist with the mean effects, or by calibrated kinematics [m/s, m/s, rad/s].
        amps: motor currents [A].
        rolling: twist of the body if no wheel slipped [m/s, m/s, rad/s].
        rolled: direction and speed of `rolling`.
        part: remaining fraction of the std of every floor's effects [1].
    """

    wheel_speed: Float[Array, " drive"]
    settled: Float[Array, "hypothesis 3"]
    twist: Float[Array, "hypothesis 3"]
    amps: Float[Array, "hypothesis drive"]
    rolling: Float[Array, "3"]
    rolled: RolledMotion
    part: Float[Array, "floor 3"]


class FloorFilter(eqx.Module):
    """Filter over the floors under the wheels.

    Attributes:
        robot: identified robot.
        settings: settings of the estimator.
        angle: steering angle of a robot that steers [rad]; None for others.
    """

    robot: RobotArrays
    settings: Settings
    angle: Float[Array, ""] | None = None

    def init(self) -> FloorState:
        """Return the state before any measurement."""
        count = len(hypotheses_of(self.robot))
        return FloorState(
            belief=jnp.concatenate([self.prior() * 0.99, jnp.asarray([0.01])]),
            expected=self.prior(),
            twist=jnp.zeros((count, 3)),
            apart=jnp.zeros((count, 3)),
        )

    def prior(self) -> Float[Array, " hypothesis"]:
        """Return the probability of every hypothesis before any measurement.

        Each further floor under the robot reduces the probability by `further_floor_penalty`. All
        hypothetical floors (`slipid.robot.deployed`) together count as one further floor.
        """
        under = hypotheses_of(self.robot).under
        kinds = np.array([len(set(row)) for row in under.tolist()])
        unseen = np.array(self.robot.unseen)[under[:, 0]]
        further = kinds - 1 + unseen  # number of further floors under the robot
        weight = jnp.exp(-self.settings.further_floor_penalty * further) / np.where(
            unseen, unseen.sum(), 1
        )
        return weight / jnp.sum(weight)

    def predict(
        self, old: FloorState, w: Float[Array, " drive"], before: Float[Array, " drive"]
    ) -> Prediction:
        """Return the predictions of every hypothesis at the wheel speeds `w` [rad/s].

        `before` are the wheel speeds of the last step [rad/s].
        """
        f, hypotheses = self.robot, hypotheses_of(self.robot)
        settled, amps = self.solve(old.twist, before, w)
        rolling = f.inverse @ (f.frame.radius * w)
        if f.steering is not None:
            rolling = settled[hypotheses.uniform[0]]
        rolled = RolledMotion.of(rolling, f.frame.base)
        mean, part = f.effect_table.at(rolled)
        # add mean effects only to hypotheses with all wheels on one floor: only these were fitted
        effect = rolled.speed * mean @ rolled.axes.T
        twist = settled + jnp.zeros((len(hypotheses), 3)).at[hypotheses.uniform].set(effect)
        if f.steering is None and any(f.calibrated):
            floors = np.flatnonzero(f.calibrated)
            twist = twist.at[hypotheses.uniform[floors]].set(f.kinematics[floors] @ w)
        return Prediction(w, settled, twist, amps, rolling, rolled, part)

    def yaw_rate(self, old: FloorState, of: Prediction, tick: TimeStep) -> tuple[Array, Array]:
        """Return the predicted yaw rate [rad/s] and its variance [rad^2/s^2].

        The variance includes that of hypotheses which become likely when the floor changes, and of
        slip that none of them explains.
        """
        f, yaw = self.robot, of.twist[:, 2]
        known = old.belief[:-1] / jnp.maximum(jnp.sum(old.belief[:-1]), 1e-12)
        mean = known @ yaw
        over = (1 - CHANGE) * known + CHANGE * old.expected
        unknown = UNKNOWN_EFFECT * old.belief[-1] + SLIP / f.frame.base
        per_metre = unknown**2 + jnp.max(f.effect[:, 2]) ** 2
        speed, walk = of.rolled.speed, jnp.max(f.process[:, 2]) ** 2
        var = per_metre * speed**2 + walk * speed / jnp.maximum(tick.dt, 1e-3)
        return mean, over @ (yaw - mean) ** 2 + var

    def step(
        self,
        old: FloorState,
        of: Prediction,
        currents: MotorCurrents,
        turn: Array,
        tick: TimeStep,
        mapped: Float[Array, " hypothesis"] | None = None,
    ) -> tuple[FloorState, BodyMotion]:
        """Return the belief one time step later, and the resulting motion.

        Args:
            old: belief before the step.
            of: predictions of the hypotheses in this step.
            currents: motor currents.
            turn: gyro's yaw rate less its bias; NaN without a gyro [rad/s].
            tick: the time step.
            mapped: probability that a floor map gives every hypothesis at the robot's pose; None
                without a map.
        """
        f, hypotheses, w, xi = self.robot, hypotheses_of(self.robot), of.wheel_speed, of.twist
        if f.steering is not None:
            # no motor is modelled, so that currents tell nothing of the floor
            currents = replace(currents, measured=jnp.zeros_like(currents.measured))
        known_log, unknown_log = self._evidence(xi, of.amps, currents, w, turn)
        # give evidence less weight while wheels accelerate, since the equilibrium neglects inertia
        weight = jnp.where(tick.moves, tick.dt / self.settings.forget_s, 0.0)
        weight = weight / (1 + (tick.acceleration / INERTIA_ACCELERATION) ** 2)
        prior, apart = self._after_floor_changes(old, xi, tick, mapped)
        log = jnp.log(jnp.maximum(prior, 1e-12)) + weight * jnp.append(known_log, unknown_log)
        belief = jax.nn.softmax(log)
        known = belief[:-1] / jnp.maximum(jnp.sum(belief[:-1]), 1e-12)
        middle = known @ xi
        before = prior[:-1] / jnp.maximum(jnp.sum(prior[:-1]), 1e-12)
        apart, jump = self._relative_poses(apart, known, xi, turn, tick)
        under = jnp.einsum("c,cwf->wf", known, hypotheses.on.astype(float))
        motion = BodyMotion(
            twist=middle,
            scatter=(xi - middle).T @ (known[:, None] * (xi - middle)),
            rolling=of.rolling,
            rolled=of.rolled,
            left=f.effect * self._remaining_std(of.part, known, under),
            by_friction=self._by_friction(known @ of.settled, w, under),
            known=known,
            before=before,
            under=under,
            jump=jump,
            correction=jnp.where(jnp.isfinite(turn), jnp.array([1.0, 1.0, 0.0]), 1.0)
            * ((known - before) @ xi),
        )
        expected = old.expected if mapped is None else mapped
        return FloorState(belief, expected, twist=of.settled, apart=apart), motion

    def _remaining_std(self, part: Float[Array, "floor 3"], known: Array, under: Array) -> Array:
        """Return the remaining std of every floor's effects as a fraction of the whole std [1].

        The whole std is the std without an effect table. While wheels are on several floors the
        whole std remains, since the table's estimates are for all wheels on one floor.
        """
        alone = known[hypotheses_of(self.robot).uniform]
        share = alone / jnp.maximum(self.robot.rest @ under, 1e-12)
        return jnp.sqrt(1 - share[:, None] * (1 - part**2))

    def solve(
        self,
        near: Float[Array, "hypothesis 3"],
        before: Float[Array, " drive"],
        w: Float[Array, " drive"],
    ) -> tuple[Float[Array, "hypothesis 3"], Float[Array, "hypothesis drive"]]:
        """Return twist [m/s, m/s, rad/s] and currents [A] of every hypothesis.

        `w` are the wheel speeds [rad/s]. The iteration starts from the twists `near` of the last
        step, whose wheel speeds are `before`.
        """
        f = self.robot
        if f.steering is not None:
            twists = self._steered(w)
            return twists, jnp.zeros((len(twists), f.drives))
        on = stand(f.frame, f.floors.at(hypotheses_of(f).under.T), f.rest)
        rim, past = (f.frame.radius * f.at_wheels(x) for x in (w, before))
        twist, pull = settle(near.T, past, rim, on, f.by_wheels)
        drag = Balance(rim[:, None], on).at(Planar(*twist)).rolling_drag
        opposing = f.motor.opposing_force(jnp.stack([pull, drag], axis=-1))
        force = on.friction * f.mass * GRAVITY * opposing
        torque = f.at_drives((force * f.frame.radius).T)
        amps = f.motor.current(torque, jnp.broadcast_to(w, torque.shape))
        more = f.current_trend @ jnp.stack([1.0, length((f.inverse @ (f.frame.radius * w))[:2])])
        return twist.T, amps + jnp.sign(amps) * more

    def _steered(self, w: Float[Array, " drive"]) -> Float[Array, "hypothesis 3"]:
        """Return the twist of every hypothesis of a robot that steers, the mean over its wheels."""
        f, angle = self.robot, self.angle if self.angle is not None else jnp.zeros(())
        # a step of a second turns the wheels by their speeds
        columns = jnp.concatenate([w, jnp.stack([angle * jnp.mean(w), jnp.ones(())])])
        on_floor = jax.vmap(rolled_motion, (0, None, 0))(f.kinematics, columns, f.steering)
        return hypotheses_of(f).on.mean(axis=1) @ on_floor

    def _by_friction(self, twist: Array, w: Array, under: Array) -> Float[Array, "3 floor"]:
        """Return the derivative of a twist with respect to each floor's log friction.

        The derivative follows from the balance of forces. Its magnitude is limited to the body's
        speed, since linearization fails if all wheels slide.
        """
        f = self.robot
        if f.steering is not None:
            return jnp.zeros((3, len(f.labels)))
        rim = f.frame.radius * f.at_wheels(w)
        shared = f.floors.mixed(under)
        on, xi = stand(f.frame, shared, f.rest), Planar(*twist)
        mu, each = on.floor.friction, under * f.floors.friction / jnp.mean(shared.friction)

        def force(mu: Array) -> Planar:
            return Balance(rim, replace(on, floor=replace(on.floor, friction=mu))).force(xi)

        def pushed(part: Array) -> Planar:
            # a wheel's force depends on its friction divided by the mean friction, so the change of
            # the mean is subtracted
            return jax.jvp(force, (mu,), (part - mu * jnp.mean(part),))[1]

        slope = solve3(Balance(rim, on).at(xi).jacobian(), jax.vmap(pushed)(each.T))
        most = length(twist[:2]) + f.frame.base * jnp.abs(twist[2])
        most = most * jnp.stack([jnp.ones(()), jnp.ones(()), 1 / f.frame.base])[:, None]
        return -jnp.nan_to_num(jnp.clip(jnp.stack(slope), -most, most))

    def _evidence(
        self, xi: Array, predicted: Array, currents: MotorCurrents, w: Array, turn: Array
    ) -> tuple[Array, Array]:
        """Return the log likelihoods of the measurements under every hypothesis, and "unknown".

        Variances are divided by their mean over hypotheses. This adds the same constant to the log
        likelihoods of all hypotheses and keeps the product within the range of single precision.
        """
        f, s = self.robot, self.settings
        amps, measured = currents.filtered, currents.measured
        var = f.on_average(f.current_std[hypotheses_of(f).under] ** 2)
        size = jnp.sqrt(predicted**2 + 0.03**2)
        gap = jnp.where(measured == 2, predicted - amps, size - jnp.abs(amps))
        var = var + (currents.variance + self._stiction(w)) + self._of_friction(predicted)
        yaw = jnp.mean(f.effect[:, 2]) * jnp.maximum(length(xi[:, :2]), 0.02)
        gyro_gap, gyro_var = xi[:, 2] - turn, s.gyro_std**2 + yaw**2
        gap = jnp.concatenate([gap, gyro_gap[:, None]], axis=1)
        var = jnp.concatenate([var, gyro_var[:, None]], axis=1)
        counts = jnp.append(measured > 0, jnp.isfinite(turn))
        worst = (s.unknown_std + 1.0) ** 2
        score = jnp.sum(jnp.where(counts, jnp.minimum(gap**2 / var, worst), 0.0), axis=1)
        # take one logarithm of the product, which is cheaper than the sum of several logarithms
        spread = jnp.prod(jnp.where(counts, var / jnp.mean(var, axis=0), 1.0), axis=1)
        return -0.5 * (score + jnp.log(spread)), -0.5 * s.unknown_std**2 * jnp.sum(counts)

    def _of_friction(self, amps: Float[Array, "hypothesis drive"]) -> Array:
        """Return the variance of currents due to uncertain friction of several floors [A^2].

        A wheel's fraction of the total drag is proportional to its floor's friction divided by the
        mean friction, so with all wheels on one floor the variance is 0.
        """
        on = hypotheses_of(self.robot).on.astype(float)
        over = (on - on.mean(axis=1, keepdims=True)).reshape(-1, on.shape[2])
        var = jnp.sum((over @ self.robot.friction_covariance) * over, axis=1)
        return amps**2 * self.robot.on_average(var.reshape(on.shape[:2]))

    def _stiction(self, w: Array) -> Array:
        """Return the variance of currents due to static friction [A^2]; 0 for turning wheels.

        At a wheel at rest, static friction lets the current lie anywhere between two bounds; the
        current is assumed to be uniformly distributed.
        """
        motor = self.robot.motor
        return (1 - sign_of_motion(w) ** 2) * (motor.coulomb_friction / motor.gain) ** 2 / 3

    def _after_floor_changes(
        self, old: FloorState, xi: Array, tick: TimeStep, mapped: Array | None
    ) -> tuple[Array, Array]:
        """Return probabilities and relative poses after wheels may have changed floors.

        A change leads to the "unknown" floor with probability 0.05; while the floor is unknown, a
        change leads back to the hypotheses with probability 0.2.
        """
        known, unknown = jnp.maximum(old.belief[:-1], 1e-12), old.belief[-1]
        sure = jnp.sum(known)
        speed = length((known @ xi)[:2] / sure)
        change = 1 - jnp.exp(-speed * tick.dt / self.settings.patch_m)
        whole = jnp.concatenate([known[:, None], known[:, None] * old.apart], axis=1)
        if mapped is None:
            fresh, whole = self.prior(), self._changed(whole, change)
        else:
            fresh, whole = mapped, _followed(whole, old.expected, mapped, change)
        stayed = whole[:, 0] * (1 - 0.05 * change)
        of_known = stayed + 0.2 * change * unknown * fresh
        # belief that returns from "unknown" has relative pose 0 (the mean pose), so it adds only to
        # the divisor
        apart = whole[:, 1:] * ((1 - 0.05 * change) / of_known)[:, None]
        of_none = unknown * (1 - 0.2 * change) + 0.05 * change * sure
        return jnp.append(of_known, of_none), apart

    def _changed(self, p: Float[Array, "hypothesis column"], change: Array) -> Array:
        """Return the belief after each wheel in turn may have changed its floor.

        The new floor is drawn from the prior, given the floors under the other wheels. The columns
        of `p` are the probability and its products with the relative pose.
        """
        prior, none = self.prior(), jnp.zeros((1, p.shape[1]))
        for beside in hypotheses_of(self.robot).beside:
            given = prior / jnp.sum(jnp.append(prior, 0.0)[beside], axis=1)
            others = jnp.sum(jnp.concatenate([p, none])[beside], axis=1)
            p = (1 - change) * p + change * given[:, None] * others
        return self._unseen_changed(p, change)

    def _unseen_changed(self, p: Float[Array, "hypothesis column"], change: Array) -> Array:
        """Return the belief after the whole robot may have moved to or from a hypothetical floor.

        Such a change is as improbable as a change to the "unknown" floor.
        """
        unseen = np.array(self.robot.unseen)
        if not unseen.any():
            return p
        whole = hypotheses_of(self.robot).uniform
        fresh = self.prior()[whole] / jnp.sum(self.prior()[whole])
        strange = unseen[:, None] | unseen[None, :]
        to = 0.05 * change * jnp.where(strange, fresh, 0.0)
        leaves = jnp.sum(to, axis=1, keepdims=True)
        own = p[whole]
        return p.at[whole].set((1 - leaves) * own + to.T @ own)

    def _relative_poses(
        self, apart: Array, known: Array, xi: Array, turn: Array, tick: TimeStep
    ) -> tuple[Array, Array]:
        """Return poses of the hypotheses relative to their mean, and the jump of the mean pose.

        Each hypothesis moves on from its own pose with its own twist, whose yaw rate is replaced by
        the gyro's if there is a gyro. The jump is the change of the mean pose less the motion
        by the mean twist; late evidence on the floors causes it.
        """
        xi = xi.at[:, 2].set(jnp.where(jnp.isfinite(turn), turn, xi[:, 2]))
        poses = jax.vmap(compose)(apart, jax.vmap(advance, (0, None))(xi, tick.dt))
        mean = known @ poses
        x, y, yaw = (poses - mean).T
        c, s = jnp.cos(mean[2]), jnp.sin(mean[2])
        relative = jnp.stack([c * x + s * y, c * y - s * x, yaw], axis=-1)
        return relative, mean - advance(known @ xi, tick.dt)


def _followed(
    p: Float[Array, "hypothesis column"], before: Array, now: Array, change: Array
) -> Float[Array, "hypothesis column"]:
    """Return the belief after a step of a robot whose map predicts the floors at its new pose.

    If the probability that the map gives a hypothesis fell (from `before` to `now`), the hypothesis
    loses the same fraction of its belief to the hypotheses whose probability rose. In addition, a
    fraction `change` of the belief returns to the map's probabilities, so that evidence against the
    map is forgotten as the robot drives on.
    """
    gone = jnp.clip(1 - now / jnp.maximum(before, 1e-12), 0.0, 1.0)[:, None]
    more = jnp.maximum(now - before, 0.0)
    more = more / jnp.maximum(jnp.sum(more), 1e-12)
    p = p * (1 - gone) + more[:, None] * jnp.sum(gone * p, axis=0)
    return (1 - change) * p + change * now[:, None] * jnp.sum(p, axis=0)


def length(v: Float[Array, "*batch axis"]) -> Float[Array, "*batch"]:
    """Return the length of a vector; 1e-24 under the root gives it a derivative at zero."""
    return jnp.sqrt(jnp.sum(v * v, axis=-1) + 1e-24)
