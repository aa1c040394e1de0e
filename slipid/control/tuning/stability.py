"""Is the sampled loop of controller, delay, wheels and floor stable? Its linearisation says.

At constant speed on one floor, with the pose known, a period maps the state (pose error, integral,
observer, wheel speeds, commands on their way) to the next; at the point it settles at this map has
a Jacobian A, and the loop is stable where the spectral radius

    rho(A) = lim |A^k|^(1/k),   k = 2^16 by repeated squaring (Gelfand 1941)

is below 1. The margin is 1 - rho. Gains may be out by a factor, so what is asked of a loop is asked
with all gains `SPARE` times as large.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from slipid.control.closed_loop import PERIOD
from slipid.control.controller import Controller, ControllerState, Gains
from slipid.control.deployed import DeployedRobot, RobotArrays
from slipid.control.filter.hypotheses import hypotheses_of
from slipid.control.interface import Believed, Estimate
from slipid.control.tuning.actuation import RING, Habits
from slipid.model import contact
from slipid.model.se2 import advance, compose

SPARE = 1.5
"""Factor by which gains may be too large."""
SPEED = 0.1
"""At which the loop is linearised, far from the limits of the wheels [m/s]."""
WAYS = (0.0, 0.7)
"""Directions of motion [rad]."""
SETTLING, MILD = 40, 2.0
"""Steps until the loop stands still with mild gains [1/s]."""


def spectral_radius(a: Float[Array, "n n"]) -> Float[Array, ""]:
    """Largest absolute eigenvalue, with a derivative where eigenvectors have none."""

    def square(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        m, log = carry
        size = jnp.sqrt(jnp.sum(m * m) + 1e-200)
        m = m / size
        return (m @ m, 2 * (log + jnp.log(size))), None

    (m, log), _ = jax.lax.scan(square, (a, jnp.zeros(())), None, length=16)
    return jnp.exp((log + 0.5 * jnp.log(jnp.sum(m * m) + 1e-200)) / 2**16)


class LoopState(eqx.Module):
    """What a period maps to the next: the pose's error [m, m, rad], and as `TwinState` has it."""

    pose: Float[Array, "3"]
    speed: Float[Array, " wheel"]
    ring: Float[Array, "command wheel"]
    control: ControllerState


class Loop(eqx.Module):
    """One period of a controller on a robot at constant speed; the reference rests at the origin.

    Attributes:
        controller: with its gains.
        truth: the robot it drives.
        surface: number of the floor.
        rates: of the reference [m/s, m/s, rad/s].
        habits: of the wheels.
    """

    controller: Controller
    truth: DeployedRobot
    surface: Array
    rates: Float[Array, "3"]
    habits: Habits = eqx.field(static=True)

    def start(self) -> LoopState:
        """Moving without error."""
        w = self.truth.forward @ self.rates / self.truth.frame.radius
        ring = jnp.broadcast_to(w, (RING, *w.shape))
        return LoopState(pose=jnp.zeros(3), speed=w, ring=ring, control=self.controller.init())

    def step(self, state: LoopState) -> LoopState:
        """State one period later."""
        old = state
        reference = jnp.concatenate([jnp.zeros(3), self.rates])
        seen = self._estimate(old)
        control, command = self.controller.step(old.control, reference, seen, PERIOD)
        ring = jnp.concatenate([command[None], old.ring[:-1]])
        wanted = jnp.asarray(self.habits.held()) @ ring
        pose, w = old.pose, old.speed
        for k in range(self.habits.substeps):
            w = w + self.habits.follow * (wanted[k] - w)
            pose = compose(pose, advance(self._twist(self.truth, w), self.habits.substep))
        pose = pose - self.rates * PERIOD
        return LoopState(pose=pose, speed=w, ring=ring, control=control)

    def _twist(self, robot: RobotArrays, w: Array) -> Array:
        floor = robot.floors.at(self.surface)
        return contact.equilibrium(robot.frame.radius * w, robot.frame, floor, robot.rest)

    def _estimate(self, old: LoopState) -> Estimate:
        """Of an observer that knows pose, wheel speeds and floor."""
        f, no = self.controller.robot, jnp.zeros((), bool)
        floor = jnp.zeros((f.wheels, len(f.labels) + 1))
        return Estimate(
            pose=old.pose,
            twist=self._twist(f, old.speed),
            slip=jnp.zeros(f.wheels),
            wheel_speed=old.speed,
            current=jnp.zeros(f.wheels),
            surface_probability=floor.at[:, self.surface].set(1.0),
            covariance=jnp.zeros((3, 3)),
            believed=self._believed(old.speed),
            stale=no,
            immobilised=no,
            out_of_range=no,
            labels=f.labels,
        )

    def _believed(self, speed: Array) -> Believed:
        """All wheels on the floor, for sure."""
        f = self.controller.robot
        ways = hypotheses_of(f)
        same = jnp.arange(len(ways)) == jnp.asarray(ways.uniform)[self.surface]
        twist = jnp.broadcast_to(self._twist(f, speed), (len(ways), 3))
        return Believed(jnp.append(same.astype(float), 0.0), twist)


def linearised(loop: Loop) -> Float[Array, "state state"]:
    """Jacobian of a period where the loop settles.

    It is found with mild gains, its pose error then scaled to the gains; an integral without gain
    is no state.
    """
    gains = loop.controller.gains
    mild = replace(Gains.at((MILD, MILD, 0.0, 0.0, 0.0, 0.0)), ahead=gains.ahead)
    calm = eqx.tree_at(lambda x: x.controller.gains, loop, mild)
    state = jax.lax.scan(lambda s, _: (calm.step(s), None), loop.start(), None, length=SETTLING)[0]
    loops = jnp.stack([gains.place, gains.place, gains.yaw])
    state = replace(state, pose=state.pose * (MILD / jnp.maximum(loops, 0.1)))
    flat, tree = ravel_pytree(state)
    a = jax.jacfwd(lambda x: ravel_pytree(loop.step(tree(x)))[0])(jax.lax.stop_gradient(flat))
    none = jax.tree.map(jnp.zeros_like, state)
    own = replace(none, control=replace(none.control, integral=jnp.ones(2)))
    idle = (ravel_pytree(own)[0] > 0) & (gains.integral < 1e-6)
    return jnp.where(idle[:, None] | idle[None, :], 0.0, a)


@eqx.filter_jit
def radii(
    controller: Controller, truths: DeployedRobot, habits: Habits, spare: float = 1.0
) -> Float[Array, "draw floor way"]:
    """Spectral radius of the loop for every draw of the robot, floor and direction.

    Args:
        controller: with its gains; habits: of the wheels.
        truths: robots it may drive, stacked.
        spare: factor on the pose, heading, integral and observer gains.
    """
    gains, raised = controller.gains, ("place", "yaw", "integral", "observer")
    more = replace(gains, **{name: spare * getattr(gains, name) for name in raised})
    ready = eqx.tree_at(lambda c: c.gains, controller, more)

    def one(truth: DeployedRobot, surface: Array, way: Array) -> Array:
        rates = SPEED * jnp.stack([jnp.cos(way), jnp.sin(way), jnp.zeros(())])
        return spectral_radius(linearised(Loop(ready, truth, surface, rates, habits)))

    floors, ways = jnp.arange(len(controller.robot.labels)), jnp.asarray(WAYS)
    over = jax.vmap(jax.vmap(jax.vmap(one, (None, None, 0)), (None, 0, None)), (0, None, None))
    return over(truths, floors, ways)
