"""Which floor is under each wheel: a filter over all ways in which the wheels may stand.

A robot whose wheels stand on several floors moves as one body, so every hypothesis is one floor per
wheel, all of them together (`hypotheses`), and one that says "unknown":

    xi_c, I_c     contact equilibrium, with what runs on one floor tell that it misses there, and
                  motor currents of hypothesis c at the wheel speeds
    p_c <- p_c * (p(I | I_c) p(gyro | xi_c))^(dt / tau)   once wheels may be on other floors
    g_c <- g_c * exp(xi_c dt)                             pose if c is true, ways to c averaged
    g = sum_c p_c g_c

A wheel's current shows its share of the whole drag, not the drag beneath it; only together do they
tell the floors. News that comes late corrects the pose by the ways that the hypotheses went apart
(interacting multiple models; Blom and Bar-Shalom 1988).
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.model.contact import settle
from slipid.model.contact_balance import Balance, stand
from slipid.model.robot import GRAVITY
from slipid.model.se2 import Planar, advance, compose, solve3
from slipid.robot.deployed import RobotArrays
from slipid.robot.filter.effects import RolledMotion
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.filter.wheels import MotorCurrents
from slipid.robot.interface import Settings

INERTIA_ACCELERATION = 30.0
"""Wheel acceleration from which inertia, which the equilibrium lacks, hides floors [rad/s^2]."""


class TimeStep(eqx.Module):
    """One time step [s], as `slipid.robot.filter.wheels.time_step` counts it.

    Attributes:
        moves: whether a wheel turns.
        acceleration: of the fastest changing wheel [rad/s^2].
    """

    dt: Float[Array, ""]
    moves: Bool[Array, ""]
    acceleration: Float[Array, ""]


class FloorState(eqx.Module):
    """What is believed of the hypotheses.

    Attributes:
        belief: probability of each, and of none of them in the last place.
        expected: probability of each before anything is measured, where the robot is.
        twist: of the body by the contact alone, if it were true [m/s, m/s, rad/s].
        apart: pose if it were true, seen from the believed one [m, m, rad].
    """

    belief: Float[Array, " hypothesis_or_none"]
    expected: Float[Array, " hypothesis"]
    twist: Float[Array, "hypothesis 3"]
    apart: Float[Array, "hypothesis 3"]


class BodyMotion(eqx.Module):
    """What the hypotheses together say of the body's motion.

    Attributes:
        twist: mean [m/s, m/s, rad/s]; scatter: covariance over hypotheses.
        rolling: twist of wheels that do not slip; course: where it leads.
        left: std of the effects of every floor that is left along this course.
        by_friction: derivative of the mean by the log friction of each floor [m/s, m/s, rad/s].
        known: probability of every hypothesis, given that it is one of them; before: that without
            the evidence of this step.
        under: probability of each floor under each wheel, given that it is one of them.
        jump: what the pose moves beyond the mean twist, news that came late [m, m, rad].
        news: mean twist less what it was believed to be before the news [m/s, m/s, rad/s].
    """

    twist: Float[Array, "3"]
    scatter: Float[Array, "3 3"]
    rolling: Float[Array, "3"]
    course: RolledMotion
    left: Float[Array, "floor 3"]
    by_friction: Float[Array, "3 floor"]
    known: Float[Array, " hypothesis"]
    before: Float[Array, " hypothesis"]
    under: Float[Array, "wheel floor"]
    jump: Float[Array, "3"]
    news: Float[Array, "3"]


class FloorFilter(eqx.Module):
    """Filter over the floors under the wheels."""

    robot: RobotArrays
    settings: Settings

    def init(self) -> FloorState:
        """Before anything is measured."""
        count = len(hypotheses_of(self.robot))
        return FloorState(
            belief=jnp.concatenate([self.prior() * 0.99, jnp.asarray([0.01])]),
            expected=self.prior(),
            twist=jnp.zeros((count, 3)),
            apart=jnp.zeros((count, 3)),
        )

    def prior(self) -> Float[Array, " hypothesis"]:
        """Probability of every hypothesis before anything is measured.

        All floors together that nobody drove on are as rare as one further floor under the robot.
        """
        under = hypotheses_of(self.robot).under
        kinds = np.array([len(set(row)) for row in under.tolist()])
        unseen = np.array(self.robot.unseen)[under[:, 0]]
        further = kinds - 1 + unseen  # floors beside the one that is under the robot for sure
        weight = jnp.exp(-self.settings.alike * further) / np.where(unseen, unseen.sum(), 1)
        return weight / jnp.sum(weight)

    def step(
        self,
        old: FloorState,
        w: Array,
        currents: MotorCurrents,
        turn: Array,
        tick: TimeStep,
        mapped: Float[Array, " hypothesis"] | None = None,
    ) -> tuple[FloorState, BodyMotion]:
        """Beliefs a time step later, and the motion they say.

        Args:
            old, tick: the beliefs before the step, and the step.
            w: wheel speed of every drive [rad/s]; currents: what is known of them.
            turn: yaw rate by the gyro, its bias taken off, NaN without one [rad/s].
            mapped: probability of every hypothesis by a floor map where the robot now is.
        """
        settled, predicted = self.solve(old.twist, w)
        f = self.robot
        rolling = f.inverse @ (f.frame.radius * w)
        course = RolledMotion.of(rolling, f.frame.base)
        mean, part = f.told.at(course)
        xi = settled + effects_by_hypothesis(f, course.speed * mean @ course.axes.T)
        told, none = self._evidence(xi, predicted, currents, w, turn)
        # what the equilibrium does not know, inertia, weighs little while wheels speed up
        weight = jnp.where(tick.moves, tick.dt / self.settings.forget_s, 0.0)
        weight = weight / (1 + (tick.acceleration / INERTIA_ACCELERATION) ** 2)
        prior, apart = self._mixed(old, xi, tick, mapped)
        log = jnp.log(jnp.maximum(prior, 1e-12)) + weight * jnp.append(told, none)
        belief = jax.nn.softmax(log)
        known = belief[:-1] / jnp.maximum(jnp.sum(belief[:-1]), 1e-12)
        middle = known @ xi
        before = prior[:-1] / jnp.maximum(jnp.sum(prior[:-1]), 1e-12)
        apart, jump = self._moved(apart, known, xi, turn, tick)
        under = self._marginal(known)
        motion = BodyMotion(
            twist=middle,
            scatter=(xi - middle).T @ (known[:, None] * (xi - middle)),
            rolling=rolling,
            course=course,
            left=f.effect * self._left(part, known, under),
            by_friction=self._by_friction(known @ settled, w, under),
            known=known,
            before=before,
            under=under,
            jump=jump,
            news=jnp.where(jnp.isfinite(turn), jnp.array([1.0, 1.0, 0.0]), 1.0)
            * ((known - before) @ xi),
        )
        expected = old.expected if mapped is None else mapped
        return FloorState(belief, expected, twist=settled, apart=apart), motion

    def _left(self, part: Float[Array, "floor 3"], known: Array, under: Array) -> Array:
        """Part of the std of every floor's effects that is left; all of it, wheels on several."""
        alone = known[hypotheses_of(self.robot).uniform]
        share = alone / jnp.maximum(self.robot.rest @ under, 1e-12)
        return jnp.sqrt(1 - share[:, None] * (1 - part**2))

    def solve(
        self, near: Float[Array, "hypothesis 3"], w: Float[Array, " drive"]
    ) -> tuple[Float[Array, "hypothesis 3"], Float[Array, "hypothesis drive"]]:
        """Twist [m/s, m/s, rad/s] and currents [A] of every hypothesis, `near` a moment ago."""
        f = self.robot
        on = stand(f.frame, f.floors.at(hypotheses_of(f).under.T), f.rest)
        rim = f.frame.radius * f.at_wheels(w)
        twist, pull = settle(near.T, rim, on, f.by_wheels)
        drag = Balance(rim[:, None], on).rolling_drag(Planar(*twist))
        opposing = f.motor.opposing_force(jnp.stack([pull, drag], axis=-1))
        force = on.friction * f.mass * GRAVITY * opposing
        torque = f.at_drives((force * f.frame.radius).T)
        amps = f.motor.current(torque, jnp.broadcast_to(w, torque.shape))
        more = f.current_trend @ jnp.stack([1.0, length((f.inverse @ (f.frame.radius * w))[:2])])
        return twist.T, amps + jnp.sign(amps) * more

    def _by_friction(self, twist: Array, w: Array, under: Array) -> Float[Array, "3 floor"]:
        """Derivative of a twist by the log friction of each floor, of which wheels have a share.

        The balance moves, and the twist with it; no more than there is of it, since a straight line
        leads too far where all wheels slide.
        """
        f = self.robot
        rim = f.frame.radius * f.at_wheels(w)
        shared = f.floors.mixed(under)
        on, xi = stand(f.frame, shared, f.rest), Planar(*twist)
        mu, each = on.floor.friction, under * f.floors.friction / jnp.mean(shared.friction)

        def force(mu: Array) -> Planar:
            return Balance(rim, replace(on, floor=replace(on.floor, friction=mu))).force(xi)

        def pushed(part: Array) -> Planar:  # frictions count over their mean
            return jax.jvp(force, (mu,), (part - mu * jnp.mean(part),))[1]

        slope = solve3(Balance(rim, on).jacobian(xi), jax.vmap(pushed)(each.T))
        most = length(twist[:2]) + f.frame.base * jnp.abs(twist[2])
        most = most * jnp.stack([jnp.ones(()), jnp.ones(()), 1 / f.frame.base])[:, None]
        return -jnp.nan_to_num(jnp.clip(jnp.stack(slope), -most, most))

    def _evidence(
        self, xi: Array, predicted: Array, currents: MotorCurrents, w: Array, turn: Array
    ) -> tuple[Array, Array]:
        """Log likelihood of what is measured under every hypothesis, and under none of them.

        Variances count over their means: a constant in all, and no product that leaves the range
        of single precision.
        """
        f, s = self.robot, self.settings
        amps, effects_by_hypothesis = currents.filtered, currents.told
        var = f.on_average(f.current_std[hypotheses_of(f).under] ** 2)
        size = jnp.sqrt(predicted**2 + 0.03**2)
        gap = jnp.where(effects_by_hypothesis == 2, predicted - amps, size - jnp.abs(amps))
        var = var + (currents.variance + self._stiction(w)) + self._of_friction(predicted)
        yaw = jnp.mean(f.effect[:, 2]) * jnp.maximum(length(xi[:, :2]), 0.02)
        gyro_gap, gyro_var = xi[:, 2] - turn, s.gyro_std**2 + yaw**2
        gap = jnp.concatenate([gap, gyro_gap[:, None]], axis=1)
        var = jnp.concatenate([var, gyro_var[:, None]], axis=1)
        heard = jnp.append(effects_by_hypothesis > 0, jnp.isfinite(turn))
        worst = (s.unknown_std + 1.0) ** 2
        score = jnp.sum(jnp.where(heard, jnp.minimum(gap**2 / var, worst), 0.0), axis=1)
        # a logarithm of a product costs a robot's computer less than several
        spread = jnp.prod(jnp.where(heard, var / jnp.mean(var, axis=0), 1.0), axis=1)
        return -0.5 * (score + jnp.log(spread)), -0.5 * s.unknown_std**2 * jnp.sum(heard)

    def _of_friction(self, amps: Float[Array, "hypothesis drive"]) -> Array:
        """Variance of currents as frictions of several floors under the wheels are unsure [A^2].

        A wheel has so much of the whole drag as its friction is over their mean.
        """
        on = hypotheses_of(self.robot).on.astype(float)
        over = (on - on.mean(axis=1, keepdims=True)).reshape(-1, on.shape[2])
        var = jnp.sum((over @ self.robot.friction_covariance) * over, axis=1)
        return amps**2 * self.robot.on_average(var.reshape(on.shape[:2]))

    def _stiction(self, w: Array) -> Array:
        """Variance of the current that holds a standing wheel, between friction's bounds [A^2]."""
        motor = self.robot.motor
        return (1 - jnp.tanh(w / 0.2) ** 2) * (motor.coulomb_friction / motor.gain) ** 2 / 3

    def _mixed(
        self, old: FloorState, xi: Array, tick: TimeStep, mapped: Array | None
    ) -> tuple[Array, Array]:
        """Probabilities and ways once wheels may have come to other floors."""
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
        # what comes back from "unknown" has gone the mean way
        apart = whole[:, 1:] * ((1 - 0.05 * change) / of_known)[:, None]
        of_none = unknown * (1 - 0.2 * change) + 0.05 * change * sure
        return jnp.append(of_known, of_none), apart

    def _changed(self, p: Float[Array, "hypothesis column"], change: Array) -> Array:
        """Every wheel may come to another floor, as likely as the prior says given the others."""
        prior, none = self.prior(), jnp.zeros((1, p.shape[1]))
        for beside in hypotheses_of(self.robot).beside:
            given = prior / jnp.sum(jnp.append(prior, 0.0)[beside], axis=1)
            others = jnp.sum(jnp.concatenate([p, none])[beside], axis=1)
            p = (1 - change) * p + change * given[:, None] * others
        return self._estranged(p, change)

    def _estranged(self, p: Float[Array, "hypothesis column"], change: Array) -> Array:
        """The whole robot may come to a floor that nobody drove on, from one to another, or back.

        That is as rare as a floor that none of the hypotheses knows.
        """
        unseen = np.array(self.robot.unseen)
        if not unseen.any():
            return p
        whole = hypotheses_of(self.robot).uniform
        fresh = self.prior()[whole] / jnp.sum(self.prior()[whole])
        strange = unseen[:, None] | unseen[None, :]
        to = 0.05 * change * jnp.where(strange, fresh, 0.0)
        leaves = jnp.sum(to, axis=1, keepdims=True)
        mine = p[whole]
        return p.at[whole].set((1 - leaves) * mine + to.T @ mine)

    def _moved(
        self, apart: Array, known: Array, xi: Array, turn: Array, tick: TimeStep
    ) -> tuple[Array, Array]:
        """Poses of the hypotheses seen from their mean after the step; its way beyond the twist.

        Each goes on from where it was by its own twist, all of them turning as a gyro says.
        """
        xi = xi.at[:, 2].set(jnp.where(jnp.isfinite(turn), turn, xi[:, 2]))
        ways = jax.vmap(compose)(apart, jax.vmap(advance, (0, None))(xi, tick.dt))
        mean = known @ ways
        x, y, yaw = (ways - mean).T
        c, s = jnp.cos(mean[2]), jnp.sin(mean[2])
        seen = jnp.stack([c * x + s * y, c * y - s * x, yaw], axis=-1)
        return seen, mean - advance(known @ xi, tick.dt)

    def _marginal(self, known: Array) -> Array:
        """Probability of each floor under each wheel (wheel, floor)."""
        return jnp.einsum("c,cwf->wf", known, hypotheses_of(self.robot).on.astype(float))


def effects_by_hypothesis(
    robot: RobotArrays, of_floor: Float[Array, "floor 3"]
) -> Float[Array, "hypothesis 3"]:
    """What is told of the body under every hypothesis: of all wheels on one floor, no more."""
    ways = hypotheses_of(robot)
    return jnp.zeros((len(ways), 3)).at[ways.uniform].set(of_floor)


def _followed(
    p: Float[Array, "hypothesis column"], before: Array, now: Array, change: Array
) -> Float[Array, "hypothesis column"]:
    """Hypotheses as a map has them follow each other where the robot goes.

    Of what the map expects less than before, so much goes over to what it expects more, and no more
    than that; beyond it, a wheel may have come to what the map does not show.
    """
    gone = jnp.clip(1 - now / jnp.maximum(before, 1e-12), 0.0, 1.0)[:, None]
    more = jnp.maximum(now - before, 0.0)
    more = more / jnp.maximum(jnp.sum(more), 1e-12)
    p = p * (1 - gone) + more[:, None] * jnp.sum(gone * p, axis=0)
    return (1 - change) * p + change * now[:, None] * jnp.sum(p, axis=0)


def length(v: Float[Array, "*batch axis"]) -> Float[Array, "*batch"]:
    """Length of a vector, with a derivative at zero."""
    return jnp.sqrt(jnp.sum(v * v, axis=-1) + 1e-24)
