"""Which floor is under each wheel: a filter over all ways in which the wheels may stand.

A robot whose wheels stand on several floors moves as one body, so every hypothesis is one floor per
wheel, all of them together (27 with three wheels on three floors), and one that says "unknown":

    xi_c, I_c     contact equilibrium and motor currents of hypothesis c at the wheel speeds
    p_c <- p_c * (p(I | I_c) p(gyro | xi_c))^(dt / tau)   once wheels may be on other floors
    xi = sum_c p_c xi_c

A wheel's current shows its share of the whole drag, not the drag beneath it; only together do they
tell the floors.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from slipid.control.deployed import DeployedRobot
from slipid.control.interface import Settings
from slipid.control.wheels import Currents
from slipid.model.contact import settle
from slipid.model.contact_balance import stand
from slipid.model.robot import GRAVITY

HASTE = 30.0
"""Wheel acceleration from which inertia, which the equilibrium lacks, hides floors [rad/s^2]."""


class Tick(eqx.Module):
    """One time step [s], as `slipid.control.wheels.time_step` counts it.

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
        twist: of the body if it were true [m/s, m/s, rad/s].
        apart: how far the way it would have gone is from the mean one [m, m, rad].
    """

    belief: Float[Array, " hypothesis_or_none"]
    twist: Float[Array, "hypothesis 3"]
    apart: Float[Array, "hypothesis 3"]


class Motion(eqx.Module):
    """What the hypotheses together say of the body's motion.

    Attributes:
        twist: mean [m/s, m/s, rad/s]; scatter: covariance over hypotheses.
        under: probability of each floor under each wheel, given that it is one of them.
        jump: correction of the pose by what was not believed in time [m, m, rad].
    """

    twist: Float[Array, "3"]
    scatter: Float[Array, "3 3"]
    under: Float[Array, "wheel floor"]
    jump: Float[Array, "3"]


class FloorFilter(eqx.Module):
    """Filter over the floors under the wheels."""

    robot: DeployedRobot
    settings: Settings = eqx.field(static=True)

    @property
    def hypotheses(self) -> np.ndarray:
        """Floor under every wheel in every hypothesis (hypothesis, wheel)."""
        floors, wheels = len(self.robot.labels), self.robot.wheels
        return np.array(list(itertools.product(range(floors), repeat=wheels)))

    def init(self) -> FloorState:
        """Before anything is measured."""
        count = len(self.robot.labels) ** self.robot.wheels
        return FloorState(
            belief=jnp.concatenate([self.prior() * 0.99, jnp.asarray([0.01])]),
            twist=jnp.zeros((count, 3)),
            apart=jnp.zeros((count, 3)),
        )

    def prior(self) -> Float[Array, " hypothesis"]:
        """Probability of every hypothesis before anything is measured."""
        kinds = np.array([len(set(row)) for row in self.hypotheses.tolist()])
        weight = np.exp(-self.settings.alike * (kinds - 1))
        return jnp.asarray(weight / weight.sum())

    def step(
        self, old: FloorState, w: Array, currents: Currents, turn: Array, tick: Tick
    ) -> tuple[FloorState, Motion]:
        """Beliefs a time step later, and the motion they say.

        A hypothesis keeps the way it would have gone: when currents later speak for it, the pose is
        corrected by what was not believed in time (interacting multiple models; Blom and
        Bar-Shalom 1988).

        Args:
            old, tick: the beliefs before the step, and the step.
            w: wheel speeds [rad/s]; currents: what is known of them.
            turn: yaw rate by the gyro, its bias taken off, NaN without one [rad/s].
        """
        xi, predicted = self.solve(old.twist, w)
        told, none = self._evidence(xi, predicted, currents, w, turn)
        # what the equilibrium does not know, inertia, weighs little while wheels speed up
        weight = jnp.where(tick.moves, tick.dt / self.settings.forget_s, 0.0)
        weight = weight / (1 + (tick.acceleration / HASTE) ** 2)
        prior, way = self._mixed(old, xi, tick)
        log = jnp.log(jnp.maximum(prior, 1e-12)) + weight * jnp.append(told, none)
        belief = jax.nn.softmax(log)
        known = belief[:-1] / jnp.maximum(jnp.sum(belief[:-1]), 1e-12)
        mean = known @ xi
        scatter = (xi - mean).T @ (known[:, None] * (xi - mean))
        jump = known @ way
        motion = Motion(twist=mean, scatter=scatter, under=self._marginal(known), jump=jump)
        return FloorState(belief=belief, twist=xi, apart=way - jump), motion

    def solve(
        self, near: Float[Array, "hypothesis 3"], w: Float[Array, " wheel"]
    ) -> tuple[Float[Array, "hypothesis 3"], Float[Array, "hypothesis wheel"]]:
        """Twist [m/s, m/s, rad/s] and currents [A] of every hypothesis, `near` a moment ago."""
        f = self.robot
        on = stand(f.frame, f.floors.at(self.hypotheses.T), f.rest)
        rim = f.frame.radius * w
        twist, pull = settle(near.T, rim, on, f.inverse)
        torque = on.friction * f.mass * GRAVITY * f.frame.radius * pull
        amps = f.motor.current(torque.T, jnp.broadcast_to(w, torque.T.shape))
        more = f.current_trend @ jnp.stack([1.0, length((f.inverse @ rim)[:2])])
        return twist.T, amps + jnp.sign(amps) * more

    def _evidence(
        self, xi: Array, predicted: Array, currents: Currents, w: Array, turn: Array
    ) -> tuple[Array, Array]:
        """Log likelihood of what is measured under every hypothesis, and under none of them."""
        f, s = self.robot, self.settings
        amps, told_of = currents.filtered, currents.told
        std = f.current_std[jnp.asarray(self.hypotheses)]
        size = jnp.sqrt(predicted**2 + 0.03**2)
        gap = jnp.where(told_of == 2, predicted - amps, size - jnp.abs(amps))
        var = std**2 + (currents.variance + self._stiction(w))
        worst = (s.unknown_std + 1.0) ** 2
        score = jnp.minimum(gap**2 / var, worst)
        told = jnp.sum(jnp.where(told_of > 0, -0.5 * (score + jnp.log(var)), 0.0), axis=1)
        of_none = -0.5 * (s.unknown_std**2 + jnp.log(jnp.mean(var, axis=0)))
        none = jnp.sum(jnp.where(told_of > 0, of_none, 0.0))
        yaw = jnp.mean(f.effect[:, 2]) * jnp.maximum(length(xi[:, :2]), 0.02)
        gyro_var = s.gyro_std**2 + yaw**2
        off = jnp.minimum((xi[:, 2] - turn) ** 2 / gyro_var, worst)
        has = jnp.isfinite(turn)
        told += jnp.where(has, -0.5 * (off + jnp.log(gyro_var)), 0.0)
        none += jnp.where(has, -0.5 * (s.unknown_std**2 + jnp.log(jnp.mean(gyro_var))), 0.0)
        return told, none

    def _stiction(self, w: Array) -> Array:
        """Variance of the current that holds a standing wheel, between friction's bounds [A^2]."""
        motor = self.robot.motor
        return (1 - jnp.tanh(w / 0.2) ** 2) * (motor.coulomb_friction / motor.gain) ** 2 / 3

    def _mixed(self, old: FloorState, xi: Array, tick: Tick) -> tuple[Array, Array]:
        """Probabilities and ways once wheels may have come to other floors."""
        known, unknown = old.belief[:-1], old.belief[-1]
        mean = known @ xi / jnp.maximum(jnp.sum(known), 1e-12)
        change = 1 - jnp.exp(-length(mean[:2]) * tick.dt / self.settings.patch_m)
        way = old.apart + jnp.where(tick.moves, tick.dt, 0.0) * (xi - mean)
        whole = jnp.concatenate([known[:, None], known[:, None] * way], axis=1)
        whole = jax.vmap(self._changed, (1, None), 1)(whole, change)
        moved = whole[:, 0]
        way = whole[:, 1:] / jnp.maximum(moved, 1e-9)[:, None]
        of_known = moved * (1 - 0.05 * change) + 0.2 * change * unknown * self.prior()
        of_none = unknown * (1 - 0.2 * change) + 0.05 * change * jnp.sum(known)
        return jnp.append(of_known, of_none), way

    def _changed(self, p: Array, change: Array) -> Array:
        """Every wheel may come to another floor, as likely as the prior says given the others."""
        wheels, floors = self.robot.wheels, len(self.robot.labels)
        prior = self.prior().reshape((floors,) * wheels)
        p = p.reshape((floors,) * wheels)
        for axis in range(wheels):
            given = prior / jnp.sum(prior, axis=axis, keepdims=True)
            p = (1 - change) * p + change * jnp.sum(p, axis=axis, keepdims=True) * given
        return p.reshape(-1)

    def _marginal(self, known: Array) -> Array:
        """Probability of each floor under each wheel (wheel, floor)."""
        wheels, floors = self.robot.wheels, len(self.robot.labels)
        p = known.reshape((floors,) * wheels)
        others = [tuple(k for k in range(wheels) if k != axis) for axis in range(wheels)]
        return jnp.stack([jnp.sum(p, axis=o) for o in others])


def length(v: Float[Array, "*batch axis"]) -> Float[Array, "*batch"]:
    """Length of a vector, with a derivative at zero."""
    return jnp.sqrt(jnp.sum(v * v, axis=-1) + 1e-24)
