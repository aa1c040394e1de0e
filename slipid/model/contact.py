"""Contact equilibrium: the body moves so that wheel traction, roller drag and scrub balance.

The forces are those of `slipid.model.contact_law`. The root of their balance is found by a fixed
number of chord steps, which come near from anywhere, and then of damped Newton steps with the
analytic 3x3 Jacobian; its derivative comes from the implicit function theorem.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.model.contact_balance import Balance, stand
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import Frame
from slipid.model.se2 import Columns, Planar, solve3

_CHORD_STEPS = 30
_NEWTON_STEPS = 8
_DAMPING = (1.0, 0.3, 0.05)
_ROUNDING = 1e-20
_NEAR = 1e-6
_MOST_NEAR = 12


class Contact(eqx.Module):
    """Forces on the body, in units of mean(mu) m g.

    Attributes:
        traction: along the drive direction of each wheel, what its motor works against.
        drag: along the rolling direction of the rollers.
        load: share of the weight.
        residual: what does not balance, the moment over the base radius; zero at equilibrium.
    """

    traction: Float[Array, " wheel"]
    drag: Float[Array, " wheel"]
    load: Float[Array, " wheel"]
    residual: Float[Array, "3"]


class ContactProblem(eqx.Module):
    """What the twist of a robot depends on.

    Attributes:
        rim: r w, rim speed of each wheel [m/s].
        frame: wheel directions.
        surface: one floor, or one under each wheel.
        rest: load shares at rest, sum 1.
        start: where the twist is looked for; with inertia that before the step.
        mass: mass and inertia over the time step, None in the quasi-static case.
    """

    rim: Float[Array, " wheel"]
    frame: Frame
    surface: ContactSurface
    rest: Float[Array, " wheel"]
    start: Float[Array, "3"]
    mass: Float[Array, "3"] | None = None

    def balance(self) -> Balance:
        """The forces as a function of the twist."""
        on = stand(self.frame, self.surface, self.rest)
        if self.mass is None:
            return Balance(self.rim, on)
        return Balance(self.rim, on, Planar(*self.mass), Planar(*self.start))


def _damped(balance: Balance, xi: Planar) -> Planar:
    """The best of some damped Newton steps, or a chord step."""
    step, before = balance.newton(xi), balance.size(balance.force(xi))

    def less(alpha: Array) -> Planar:
        return jax.tree.map(lambda x, d: x - alpha * d, xi, step)

    def merit(alpha: Array) -> Array:
        size = balance.size(balance.force(less(alpha)))
        return jnp.where(jnp.isfinite(size), size, jnp.inf)

    damping = jnp.asarray(_DAMPING)
    tried = jax.vmap(merit)(damping)
    best = jnp.argmin(tried)
    # where all wheels slide the balance is flat and Newton's direction leads far away
    stuck = (tried[best] >= before) & (before > _ROUNDING)
    return jax.tree.map(partial(jnp.where, stuck), balance.chord(xi), less(damping[best]))


@jax.custom_jvp
@jax.jit
def _root(problem: ContactProblem) -> Float[Array, "3"]:
    balance = problem.balance()

    def chord(xi: Array, _: None) -> tuple[Array, None]:
        return jnp.stack(balance.chord(Planar(*xi))), None

    def newton(xi: Array, _: None) -> tuple[Array, None]:
        return jnp.stack(_damped(balance, Planar(*xi))), None

    near = jax.lax.scan(chord, problem.start, None, length=_CHORD_STEPS)[0]
    return jax.lax.scan(newton, near, None, length=_NEWTON_STEPS)[0]


@jax.custom_jvp
@jax.jit
def _root_near(problem: ContactProblem) -> Float[Array, "3"]:
    balance = problem.balance()

    def far(state: tuple[Array, Array, Array]) -> Array:
        _, step, count = state
        return (jnp.max(jnp.abs(step)) > _NEAR) & (count < _MOST_NEAR)

    def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        xi, _, count = state
        step = jnp.stack(balance.newton(Planar(*xi)))
        return xi - step, step, count + 1

    first = (problem.start, jnp.full(3, jnp.inf), jnp.zeros((), int))
    xi, step, _ = jax.lax.while_loop(far, newton, first)
    return jnp.where(jnp.max(jnp.abs(step)) > _NEAR, jnp.nan, xi)


One = tuple[ContactProblem]


def _implicit(
    root: Callable[[ContactProblem], Array],
) -> Callable[[One, One], tuple[Array, Array]]:
    """Derivative of a root of the balance by what it depends on."""

    def rule(primals: One, tangents: One) -> tuple[Array, Array]:
        xi = root(*primals)
        return xi, moved(xi, primals, tangents)

    @jax.jit
    def moved(xi: Array, primals: One, tangents: One) -> Array:
        at = Planar(*xi)
        _, force = jax.jvp(lambda problem: problem.balance().force(at), primals, tangents)
        return -jnp.stack(solve3(primals[0].balance().jacobian(at), force))

    return rule


_root.defjvp(_implicit(_root))
_root_near.defjvp(_implicit(_root_near))


def guess(rim: Float[Array, " wheel"], frame: Frame) -> Float[Array, "3"]:
    """Start of the root finder: the twist without slip, a little slower (least squares)."""
    j = frame.hold
    m = Columns(*(Planar(*column) for column in j.T @ j + 1e-6 * jnp.eye(3)))
    return 0.8 * jnp.stack(solve3(m, Planar(*(j.T @ (rim * frame.pull)))))


def equilibrium(
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Float[Array, "3"]:
    """Body twist (vx [m/s], vy [m/s], yaw rate [rad/s]) at which the contact forces balance.

    Args:
        rim: r w, rim speed of each wheel [m/s].
        frame: wheel directions.
        surface: one floor, or one under each wheel.
        rest: load shares at rest, sum 1.

    Source: the balance at the head of `slipid.model.contact_law` with M = 0.
    """
    start = jax.lax.stop_gradient(guess(rim, frame))
    return _root(ContactProblem(rim, frame, surface, rest, start))


def equilibrium_near(
    start: Float[Array, "3"],
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Float[Array, "3"]:
    """`equilibrium` by plain Newton steps from a twist nearby, NaN where they do not arrive.

    About ten times cheaper; the last step is below 1e-6, which Newton's squares.
    """
    start = jax.lax.stop_gradient(start)
    return _root_near(ContactProblem(rim, frame, surface, rest, start))


def step_with_inertia(
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
    before: Float[Array, "3"],
    inertia: Float[Array, "3"],
    dt: Float[Array, ""] | float,
) -> Float[Array, "3"]:
    """Twist one implicit Euler step later, with body inertia.

    Args:
        before: twist at the start of the step.
        inertia: (m, m, I_z) / (mu m g) [s^2/m, s^2/m, s^2 m].
        dt: step [s].
    """
    return _root(ContactProblem(rim, frame, surface, rest, before, inertia / dt))


def forces(
    xi: Float[Array, "3"],
    rim: Float[Array, " wheel"],
    frame: Frame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Contact:
    """Forces and loads at a twist, and whether they balance."""
    at, balance = Planar(*xi), Balance(rim, stand(frame, surface, rest))
    x, y, moment = balance.force(at)
    return Contact(
        traction=balance.felt(at),
        drag=balance.dragged(at),
        load=balance.share(at),
        residual=jnp.stack([x, y, moment / frame.base]),
    )
