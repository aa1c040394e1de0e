"""Log posterior of many walkers at a time, for samplers: what the fit maximises, as a density.

A coordinate is a free number of the search space, the log of a variance component, or what the
runs of a session share along, across or in yaw, in stds that are held. Floors share some of them
and have the others to themselves, so that the log posterior is a sum

    log p(x | data) = sum_floor l_floor(x_shared, x_floor) + l_shared(x_shared)

and numbers of several floors can be moved, and accepted or not, in one evaluation.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.problem import Problem, linear
from slipid.identify.fit.sessions import AXES
from slipid.identify.fit.variances import VARIANCE_SPREAD, information, whitened
from slipid.identify.posterior.coordinates import ELECTRIC, EVERYTHING, Anchor, Coordinates, Fitted
from slipid.model.robot import Robot

Result = TypeVar("Result")


class Held(NamedTuple):
    """What the electric part holds of the motion of each walker: search vector and traction."""

    z: Float[Array, "*walker free"]
    felt: Float[Array, "*walker piece window wheel"]


class _Seen(NamedTuple):
    """Blocks of residuals (piece, m), the robot and the noise of voltages they are of."""

    residuals: dict[str, Array]
    robot: Robot
    electric: lk.ElectricNoise


class Density:
    """Log posterior of a part of a problem's numbers, the others held.

    The fit is what a chain starts around, and says how far sessions differ. Where currents do not
    inform motion, the part EVERYTHING is no posterior, but has the likelihoods.
    """

    def __init__(self, problem: Problem, fitted: Fitted, part: str):
        self.problem, self.part = problem, part
        self.floors = problem.robot.surfaces.labels
        self.coordinates = Coordinates.of(problem, fitted, part)
        self.anchor = Anchor.at(problem, fitted, self.coordinates.sessions)
        # the first of its form compiles for all
        form = part, self.coordinates.names, self.coordinates.group.tobytes()
        self._each: dict[Callable[..., object], Callable[..., Any]] = {}
        self._form: Density = problem.compiled.setdefault(form, self)
        at = self.coordinates
        effects = np.zeros(len(at.sessions) * len(AXES))
        structure, variance = fitted.z[at.structure], fitted.log_variance[at.variance]
        self.centre = np.concatenate([structure, variance, effects])
        self.covariance = self._laplace(fitted)

    def _laplace(self, fitted: Fitted) -> np.ndarray:
        """Covariance of all coordinates near the fit; variances are apart from the others."""
        problem, at = self.problem, self.coordinates
        n, v = len(at.structure), len(at.variance)
        out = np.zeros((self.size, self.size))
        z, log_v, keep = fitted.z, fitted.log_variance, np.ones(len(problem.windows))
        _, jacobian, felt = linear(problem.target, z, problem.electric(z, log_v))
        told = problem.through_voltage(z, log_v, felt)
        info = information(problem.noise.blocks, log_v, keep, told)
        of_variance = np.linalg.inv(np.asarray(info))
        out[n : n + v, n : n + v] = of_variance[np.ix_(at.variance, at.variance)]
        own = fitted.covariance[np.ix_(at.structure, at.structure)]
        mean = np.concatenate([np.arange(n), np.arange(n + v, self.size)])
        precision = np.zeros((len(mean), len(mean)))
        precision[:n, :n] = np.linalg.inv(own)
        if at.sessions:
            shares = np.asarray(self.anchor.shares)
            member = np.eye(len(at.sessions))[np.asarray(self.anchor.session)]
            moved = -shares[:, :, None, :] * member[:, None, :, None]
            both = [jacobian["motion"][..., at.structure], moved.reshape(*shares.shape[:2], -1)]
            wider = {"motion": jnp.concatenate(both, axis=-1)}
            half = whitened(problem.noise.blocks, wider, log_v, keep)["motion"]
            flat = np.asarray(half).reshape(-1, len(mean))
            of_data = flat.T @ flat
            of_data[:n, :n] = 0.0  # is in the Laplace covariance already
            precision += of_data
            precision[n:, n:] += np.eye(len(mean) - n)
        out[np.ix_(mean, mean)] = np.linalg.inv(precision)
        return out

    @property
    def names(self) -> tuple[str, ...]:
        return self.coordinates.names

    @property
    def size(self) -> int:
        return len(self.names)

    def full(self, anchor: Anchor, x: Array) -> tuple[Array, Array]:
        """Search vector and log variances of chain coordinates, the others as at the fit."""
        at = self.coordinates
        structure, variance, _ = at.parts(x)
        z = anchor.z.at[at.structure].set(structure)
        return z, anchor.log_variance.at[at.variance].set(variance)

    def _of_all(
        self, of: Callable[..., Result], x: np.ndarray | Array, held: Held | None = None
    ) -> Result:
        """A method of one vector for many, by the density of this form that compiles for all."""
        form = self._form
        if of not in form._each:

            def each(anchor: Anchor, x: Array, held: Held | None) -> Result:
                return jax.lax.map(lambda one: of(form, anchor, *one), (x, held))

            # belongs to the density: one that JAX held by its arguments would never be forgotten
            form._each[of] = jax.jit(each)
        compiled: Callable[..., Result] = form._each[of]
        return compiled(self.anchor, jnp.asarray(x), held)

    def terms(
        self, x: Float[np.ndarray, "walker size"], held: Held | None = None
    ) -> Float[np.ndarray, "walker term"]:
        """Terms of the log posterior of every walker: one per floor, then what floors share.

        The electric part needs what it holds of the motion of each walker, as `hold` gives it.
        """
        out = np.array(self._of_all(Density._sums, x, held))
        out[~np.isfinite(out)] = -np.inf
        return out

    def slope(
        self, x: Float[np.ndarray, "walker size"], held: Held | None = None
    ) -> Float[np.ndarray, "walker size"]:
        """Derivative of the log posterior of every walker; the arguments are those of `terms`."""
        return np.array(self._of_all(Density._gradient, x, held))

    def _gradient(self, anchor: Anchor, x: Array, held: Held | None) -> Array:
        return jax.grad(lambda x: jnp.sum(self._sums(anchor, x, held)))(x)

    def _sums(self, anchor: Anchor, x: Array, held: Held | None) -> Array:
        likelihood = sum(self._pieces(anchor, x, held).values())
        at, space = self.coordinates, self.problem.space
        n, v = len(at.structure), len(at.variance)
        unit = np.ones(self.size - n - v)
        centre = [space.prior_mean[at.structure], anchor.typical[at.variance], 0 * unit]
        std = np.concatenate([space.prior_std[at.structure], np.full(v, VARIANCE_SPREAD), unit])
        pull = (x - jnp.concatenate(centre)) / std
        prior = -0.5 * pull**2 - np.log(std) - 0.5 * np.log(2 * np.pi)
        count = len(self.floors)
        out = jnp.zeros(count + 1).at[anchor.batch.surface].add(likelihood)
        return out.at[np.where(at.group < 0, count, at.group)].add(prior)

    def pointwise(self, x: Float[np.ndarray, "draw size"]) -> dict[str, Array]:
        """Log likelihood of every piece, by block of residuals (draw, piece)."""
        return self._of_all(Density._pieces, x)

    def _pieces(self, anchor: Anchor, x: Array, held: Held | None) -> dict[str, Array]:
        seen, log_v = self._residuals(anchor, x, held), self.full(anchor, x)[1]
        out = {k: anchor.log_student(k, r, log_v) for k, r in seen.residuals.items()}
        camera, spread = lk.log_jacobians(seen.robot, anchor.batch, seen.electric)
        if "motion" in out:
            out["motion"] += camera
        if "voltage" in out:
            out["voltage"] += spread
        return out

    def residuals(self, x: Float[np.ndarray, "draw size"]) -> dict[str, Array]:
        """Blocks of residuals of many vectors (draw, piece, m)."""
        return self._of_all(Density._residuals, x).residuals

    def _residuals(self, anchor: Anchor, x: Array, held: Held | None) -> _Seen:
        z, log_v = self.full(anchor, x)
        b, at = anchor.batch, self.coordinates
        if self.part == ELECTRIC:
            assert held is not None, "what the electric part holds of the motion"
            robot = self.problem.space.tree(held.z.at[at.structure].set(z[at.structure]))
            electric = anchor.electric_noise(log_v, robot.motor.resistance)
            return _Seen(lk.electric_residuals(robot, b, held.felt, electric), robot, electric)
        robot = self.problem.space.tree(z)
        electric = anchor.electric_noise(log_v, robot.motor.resistance)
        p = anchor.predict(robot, z)
        out = {"motion": lk.motion_residual(robot, b, p)}
        if at.sessions:
            shared = at.parts(x)[2].reshape(-1, len(AXES))[anchor.session]
            out["motion"] -= jnp.sum(anchor.shares * shared[:, None], axis=-1)
        if self.part == EVERYTHING:
            out |= lk.electric_residuals(robot, b, p.felt, electric)
        # or the root finder is computed again for every consumer
        return _Seen(jax.lax.optimization_barrier(out), robot, electric)

    def hold(self, x: Float[np.ndarray, "walker size"]) -> Held:
        """What the electric part holds of walkers of the motion part."""
        return self._of_all(Density._held, x)

    def _held(self, anchor: Anchor, x: Array, _: None) -> Held:
        z, _log_v = self.full(anchor, x)
        return Held(z, anchor.predict(self.problem.space.tree(z), z).felt)
