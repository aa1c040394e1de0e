"""Contact equilibrium: the twist at which wheel traction, roller drag and scrub balance.

The forces are those of `slipid.model.contact_law`. The root of their balance is found by chord
steps, which approach it from any start, followed by damped Newton steps with the analytic 3x3
Jacobian; its derivative follows from the implicit function theorem. Where wheels hardly creep,
chord steps approach the root slowly and Newton steps may end beside it: both are then repeated.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from slipid.model.contact_balance import Balance, Stance, stand, total
from slipid.model.contact_law import ContactSurface
from slipid.model.geometry import WheelFrame
from slipid.model.se2 import Columns, Planar, solve3

_CHORD_STEPS = 30
"""Number of chord steps of `root` in an attempt."""
_NEWTON_STEPS = 8
"""Number of damped Newton steps of `root` in an attempt, after the chord steps."""
_BALANCED, _MOST_ATTEMPTS = 1e-16, 20
"""Squared residual force at which `root` ends [(mu m g)^2], and its largest number of attempts."""
_DAMPING = (1.0, 0.3, 0.05)
"""Factors of Newton's step that are tried in each damped step."""
_ROUNDING = 1e-20
"""Squared residual force [(mu m g)^2] below which no better step exists because of rounding."""
_CONVERGED_STEP = 1e-6
"""Largest component of the last step with which `root_near` has converged [m/s], [rad/s]."""
_MOST_NEAR_STEPS = 12
"""Largest number of Newton steps of `root_near`."""
START_SHARE = 0.8
"""Assumed ratio of the twist, or of its change, to that without slip; `root` and `settle` start
there [1]."""
SETTLE_NEWTON_STEPS = 2
"""Number of Newton steps of `settle`."""


class ContactProblem(eqx.Module):
    """Inputs that determine the twist of a robot.

    Attributes:
        rim: r w, rim speed of each wheel [m/s].
        frame: wheel directions.
        surface: floor under all wheels, or floor under each wheel (see `ContactSurface.at`).
        rest: load shares at rest, whose sum is 1.
    """

    rim: Float[Array, " wheel"]
    frame: WheelFrame
    surface: ContactSurface
    rest: Float[Array, " wheel"]

    def balance(self) -> Balance:
        """Return the forces as a function of the twist."""
        return Balance(self.rim, stand(self.frame, self.surface, self.rest))


def _damped(balance: Balance, xi: Planar) -> Planar:
    """Return the best of several damped Newton steps, or a chord step if none of them improves."""
    here = balance.at(xi)
    step, before = here.newton, balance.size(here.force)

    def less(alpha: Array) -> Planar:
        return jax.tree.map(lambda x, d: x - alpha * d, xi, step)

    def merit(alpha: Array) -> Array:
        size = balance.size(balance.force(less(alpha)))
        return jnp.where(jnp.isfinite(size), size, jnp.inf)

    damping = jnp.asarray(_DAMPING)
    tried = jax.vmap(merit)(damping)
    best = jnp.argmin(tried)
    # where all wheels slide, forces depend little on the twist and Newton's step leads far away, so
    # a chord step replaces it
    stuck = (tried[best] >= before) & (before > _ROUNDING)
    return jax.tree.map(partial(jnp.where, stuck), here.chord(), less(damping[best]))


@jax.jit
def root(problem: ContactProblem) -> Float[Array, "3"]:
    """Return the twist at which the forces balance, found from the twist without slip.

    Derivatives of the twist are those of `differentiable`; the derivative of this function itself
    is that of its iterations.
    """
    balance = problem.balance()

    def chord(xi: Array, _: None) -> tuple[Array, None]:
        return jnp.stack(balance.at(Planar(*xi)).chord()), None

    def newton(xi: Array, _: None) -> tuple[Array, None]:
        return jnp.stack(_damped(balance, Planar(*xi))), None

    def attempt(state: tuple[Array, Array]) -> tuple[Array, Array]:
        near = jax.lax.scan(chord, state[0], None, length=_CHORD_STEPS)[0]
        return jax.lax.scan(newton, near, None, length=_NEWTON_STEPS)[0], state[1] + 1

    def goes_on(state: tuple[Array, Array]) -> Array:
        size = balance.size(balance.force(Planar(*state[0])))
        return (size > _BALANCED) & (state[1] < _MOST_ATTEMPTS)

    start = _start(problem.rim, problem.frame)
    return jax.lax.while_loop(goes_on, attempt, (start, jnp.zeros((), int)))[0]


@jax.jit
def root_near(problem: ContactProblem, start: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the root of the force balance, found by plain Newton steps from a twist close to it.

    This takes about a tenth of the time of `root`. The result is NaN if the steps do not converge.
    The last step is below 1e-6 m/s or rad/s, so that the remaining error is of the order of the
    square of this step.
    """
    balance = problem.balance()

    def far(state: tuple[Array, Array, Array]) -> Array:
        _, step, count = state
        return (jnp.max(jnp.abs(step)) > _CONVERGED_STEP) & (count < _MOST_NEAR_STEPS)

    def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        xi, _, count = state
        step = jnp.stack(balance.at(Planar(*xi)).newton)
        return xi - step, step, count + 1

    first = (start, jnp.full(3, jnp.inf), jnp.zeros((), int))
    xi, step, _ = jax.lax.while_loop(far, newton, first)
    return jnp.where(jnp.max(jnp.abs(step)) > _CONVERGED_STEP, jnp.nan, xi)


@jax.custom_jvp
def differentiable(problem: ContactProblem, xi: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the root `xi` of a problem, with its derivative with respect to the problem.

    The derivative follows from the implicit function theorem, however the root was found.
    """
    return xi


@differentiable.defjvp
def _implicit_derivative(
    primals: tuple[ContactProblem, Array], tangents: tuple[ContactProblem, Array]
) -> tuple[Array, Array]:
    (problem, _), (change, _) = primals, tangents
    xi = differentiable(*primals)
    return xi, _moved(xi, problem, change)


@jax.jit
def _moved(xi: Array, problem: ContactProblem, change: ContactProblem) -> Array:
    at = Planar(*xi)
    _, force = jax.jvp(lambda p: p.balance().force(at), (problem,), (change,))
    return -jnp.stack(solve3(problem.balance().at(at).jacobian(), force))


def _start(rim: Float[Array, " wheel"], frame: WheelFrame) -> Float[Array, "3"]:
    """Return `START_SHARE` times the twist without slip (least squares), where `root` starts."""
    j = frame.hold
    m = Columns(*(Planar(*column) for column in j.T @ j + 1e-6 * jnp.eye(3)))
    return START_SHARE * jnp.stack(solve3(m, Planar(*(j.T @ (rim * frame.drive_share)))))


def equilibrium(
    rim: Float[Array, " wheel"],
    frame: WheelFrame,
    surface: ContactSurface,
    rest: Float[Array, " wheel"],
) -> Float[Array, "3"]:
    """Return the body twist (vx [m/s], vy [m/s], yaw rate [rad/s]) at which contact forces balance.

    The arguments are those of `ContactProblem`.

    Source: the balance at the head of `slipid.model.contact_law`.
    """
    problem = ContactProblem(rim, frame, surface, rest)
    return differentiable(problem, root(jax.lax.stop_gradient(problem)))


def chord_steps(wheels: int) -> int:
    """Return the number of chord steps that `settle` takes before Newton's.

    Speeds of more than three wheels can contradict each other, which takes more steps. While wheel
    speeds change by up to 1.25 rad/s per time step on two floors, 99 % of all twists are then
    within 1e-9 m/s of the equilibrium with two or three wheels. With four wheels they are within
    1e-4 m/s while the wheels turn as one body needs them to, and within 0.03 m/s if each turns
    independently.
    """
    return max(wheels - 1, 1) if wheels <= 3 else 4


def settle(
    start: Float[Array, "3 floors"],
    before: Array,
    rim: Array,
    on: Stance,
    plain: Float[Array, "3 wheel"],
) -> tuple[Float[Array, "3 floors"], Float[Array, "wheel floors"]]:
    """Return the equilibria on many combinations of floors, found from earlier twists.

    The iteration starts from the last twists plus `START_SHARE` times the change of the twist
    without slip. A few chord steps are followed by Newton steps, whose result is used if it reduces
    the residual force; the small fixed number of steps suits the computer of a robot. If the result
    is not finite, the twist without slip is returned. The error that remains after a jump of the
    wheel speeds is removed in the following calls.

    Args:
        start: twists of the previous time step at its rim speeds `before`, a column for each
            combination of floors [m/s, m/s, rad/s].
        before, rim: rim speeds of the previous time step and of this one, the same on all floors
            (wheel,) or by column (wheel, floors) [m/s].
        on: stance of the robot on each combination of floors, arrays (wheel, floors).
        plain: matrix J^+ from rim speeds to the body twist without slip.

    Returns:
        Twists, and tractions of the wheels [m g mean(mu)].
    """
    rim, before = (x.reshape(plain.shape[1], -1) for x in (rim, before))
    balance = Balance(rim, on)
    free, change = (
        Planar(*(total(row[:, None] * x) for row in plain)) for x in (rim, rim - before)
    )
    follows = jax.tree.map(lambda x, by: x + START_SHARE * by, Planar(*start), change)

    def chord(xi: Planar, _: None) -> tuple[Planar, None]:
        return balance.at(xi).chord(), None

    # `unroll` spares XLA the overhead of a loop; the generated C code has a loop all the same
    count = chord_steps(plain.shape[1])
    near, _ = jax.lax.scan(chord, follows, length=count, unroll=count)
    xi = near
    for _ in range(SETTLE_NEWTON_STEPS):
        xi = jax.tree.map(jnp.subtract, xi, balance.at(xi).newton)
    # use the result of Newton's steps only if it is nearer to the equilibrium; a comparison with
    # NaN is false, so that NaN is never used
    last, first = balance.at(xi), balance.at(near)
    nearer = balance.size(last.force) <= balance.size(first.force)
    found = jax.tree.map(lambda x, n: jnp.where(nearer, x, n), xi, near)
    sound = jnp.isfinite(found.x + found.y + found.yaw)
    twist = jnp.stack(jax.tree.map(lambda x, p: jnp.where(sound, x, p), found, free))
    motor_force = jnp.where(nearer, last.motor_force, first.motor_force)
    return twist, jnp.where(jnp.isfinite(motor_force), motor_force, 0.0)
