"""Posterior of a robot given windows of its runs, compiled, and one round of its ascent.

Structural numbers are found by Levenberg-Marquardt (optimistix) on residuals whitened with the
current variances and Student-t weights; variances by Fisher scoring of the restricted likelihood
with the structural Jacobian taken into account.
"""

import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from slipid.data.dataset import Windows
from slipid.identify import likelihood as lk
from slipid.identify.linear import inverse_root
from slipid.model.robot import Robot
from slipid.parameter import Choice, Space

Vector = Array | np.ndarray
"""One-dimensional, of jax or numpy."""
DEGREES = 8.0
"""Degrees of freedom of the Student-t weight of a run."""
_REFUSED = 12
"""Steps of the solver that may be refused in a round."""
VARIANCE_SPREAD = 3.0
"""Std of the prior of every log variance."""


@dataclass(frozen=True)
class State:
    """Where a fit stands; enough to go on from.

    Attributes:
        z: structural vector in the search space.
        log_variance: of every variance component.
        round: rounds done.
        loss: minus log posterior up to a constant.
        moved: largest step of the last round, in posterior stds.
        stage: what it was doing, for progress.
    """

    z: Float[np.ndarray, " free"]
    log_variance: Float[np.ndarray, " variance"]
    round: int
    loss: float
    moved: float
    stage: str


def is_electric(path: str) -> bool:
    """Whether a number is read from currents and voltages given the motion."""
    return path.startswith("motor.") or path.endswith(".friction")


class Data(eqx.Module):
    """What differs between sets of windows of the same shapes; an argument of compiled functions.

    Attributes:
        batch: measured.
        base, which: covariance pieces and the variance each belongs to, per block.
    """

    batch: lk.Batch
    base: dict[str, Array]
    which: dict[str, Array]


class Problem:
    """Likelihood of a set of windows as jitted functions of the search vector.

    Args:
        windows: of the runs, all of them; `keep` below chooses those that count.
        robot: start values and what is fixed.
        choices: free, fixed, priors.
        current_informs_motion: let currents and voltages move the numbers of the motion, too. By
            default they do not ("cut"): the torque scale is read from currents given the motion,
            whose errors are carried along. A friction model good to 5 % in current would otherwise
            outvote forces that motion shows to 1 %.

    Attributes:
        compiled: what was compiled for windows of these shapes by others, under their own keys.
    """

    def __init__(
        self,
        windows: Windows,
        robot: Robot,
        choices: list[Choice],
        current_informs_motion: bool = False,
    ):
        self.space = Space(robot, choices)
        self.electric = np.asarray([is_electric(n) for n in self.space.names], bool)
        self.joint = current_informs_motion or not windows.has_current
        self.robot = self.space.template
        self._read(windows)
        self._mean, self._std = (
            jnp.asarray(self.space.prior_mean),
            jnp.asarray(self.space.prior_std),
        )
        self.solver = optx.LevenbergMarquardt(
            rtol=1e-6, atol=1e-8, linear_solver=lx.Normal(lx.Cholesky())
        )
        self._step = eqx.filter_jit(
            partial(self.solver.step, self._stacked, options={}, tags=frozenset())
        )
        self._begun: dict[Any, Any] = {}
        self._form = self
        self.compiled: dict[Any, Any] = {}

    def of(self, windows: Windows) -> "Problem":
        """The same problem for other windows; those of the same shapes share what is compiled."""
        other = copy.copy(self)
        other._read(windows)
        return other

    def _read(self, windows: Windows) -> None:
        self.windows = windows
        self.noise = lk.noise(windows, self.robot)
        self.data = Data(
            batch=lk.batch(windows, self.robot),
            base={k: jnp.asarray(c.base) for k, c in self.noise.blocks.items()},
            which={k: jnp.asarray(c.which) for k, c in self.noise.blocks.items()},
        )

    @property
    def batch(self) -> lk.Batch:
        """The windows as arrays."""
        return self.data.batch

    # residuals -------------------------------------------------------------------------------
    def linear(self, z: Vector, volt: Vector) -> tuple[dict[str, Array], dict[str, Array]]:
        """Residual blocks (piece, m) and their Jacobians (piece, m, free)."""
        return self._form._linear(self.data, z, volt)[:2]

    @partial(jax.jit, static_argnums=0)
    def _linear(self, data: Data, z: Vector, volt: Vector) -> tuple[dict, dict, Array]:
        def blocks(x: Vector) -> tuple[dict, tuple[dict, Array]]:
            robot = self.space.tree(x)
            p = lk.predict(robot, data.batch)
            motion = {"motion": lk.motion_residual(robot, data.batch, p)}
            out = motion | lk.electric_residuals(robot, data.batch, p.felt, jnp.asarray(volt))
            return out, (out, p.felt)

        jacobian, (out, felt) = jax.jacfwd(blocks, has_aux=True)(z)
        return out, jacobian, felt

    def log_jacobian(self, z: Vector, volt: Vector, keep: Vector) -> tuple[Array, Array]:
        """Log |d residuals / d data| of all pieces, and its gradient by the search vector."""
        return self._form._log_jacobian(self.data, jnp.asarray(z), volt, jnp.asarray(keep))

    @partial(jax.jit, static_argnums=0)
    def _log_jacobian(self, data: Data, z: Array, volt: Vector, keep: Array) -> tuple[Array, Array]:
        def total(x: Array) -> Array:
            return keep @ sum(lk.log_jacobians(self.space.tree(x), data.batch, jnp.asarray(volt)))

        return jax.value_and_grad(total)(z)

    def twists(self, z: Vector) -> tuple[Array, Array]:
        """Body twist of every window (piece, window, 3), and its derivative by z (.., free)."""
        return self._form._twists(self.data, jnp.asarray(z))

    @partial(jax.jit, static_argnums=0)
    def _twists(self, data: Data, z: Array) -> tuple[Array, Array]:
        def twist(x: Array) -> tuple[Array, Array]:
            xi = lk.predict(self.space.tree(x), data.batch).twist
            return xi, xi

        slope, xi = jax.jacfwd(twist, has_aux=True)(z)
        return xi, slope

    def _stacked(self, y: Array, args: Any) -> tuple[Array, None]:
        data, z0, mask, root, volt, felt, slope = args
        z = z0 + mask * self._std * y
        if self.joint:
            blocks = lk.residuals(self.space.tree(z), data.batch, volt)
        else:  # motion by itself; currents and voltages given the motion of the round's start
            robot = self.space.tree(z)
            held = self.space.tree(jnp.where(self.electric, z, z0))
            still = lk.motion_residual(robot, data.batch, lk.predict(robot, data.batch))
            blocks = {"motion": still} | lk.electric_residuals(held, data.batch, felt, volt)
        parts = [jnp.einsum("nij,nj->ni", root[k], r).ravel() for k, r in blocks.items()]
        mean = self._mean + self._std**2 * slope  # adds slope . z to the log posterior
        return jnp.concatenate([*parts, (z - mean) / self._std]), None

    def _begin(self, args: Any) -> Any:
        """State of the solver before its first step; it depends on the shapes only."""
        y = jnp.zeros(self.space.size)
        shapes = jax.tree.structure(args), tuple(x.shape for x in jax.tree.leaves(args))
        if shapes not in self._begun:
            out, aux = jax.eval_shape(self._stacked, y, args)
            begun = self.solver.init(self._stacked, y, args, {}, out, aux, frozenset())
            self._begun[shapes] = begun
        return self._begun[shapes]

    # weights ---------------------------------------------------------------------------------
    def whitening(
        self, blocks: dict[str, Array], log_v: Vector, keep: Vector
    ) -> tuple[dict, dict, Array]:
        """Roots W with W^T W = w V^-1 per piece, the weights w, and minus log likelihood."""
        return self._form._whitening(self.data, blocks, log_v, keep)

    @partial(jax.jit, static_argnums=0)
    def _whitening(
        self, data: Data, blocks: dict[str, Array], log_v: Vector, keep: Vector
    ) -> tuple[dict, dict, Array]:
        roots, weights, loss = {}, {}, jnp.zeros(())
        for k, r in blocks.items():
            inverse = inverse_root(self._covariance(data, k, log_v))
            m = inverse.shape[-1]
            q = jnp.sum(jnp.einsum("nij,nj->ni", inverse, r) ** 2, axis=-1)
            weights[k] = keep * (DEGREES + m) / (DEGREES + q)
            roots[k] = jnp.sqrt(weights[k])[:, None, None] * inverse
            log_det = -jnp.sum(jnp.log(jnp.diagonal(inverse, axis1=-2, axis2=-1)), axis=-1)
            loss += jnp.sum(keep * (log_det + 0.5 * (DEGREES + m) * jnp.log1p(q / DEGREES)))
        return roots, weights, loss

    def covariance(self, k: str, log_v: Vector) -> Array:
        """Covariance of the residuals of block k (piece, m, m)."""
        return self._covariance(self.data, k, log_v)

    def _covariance(self, data: Data, k: str, log_v: Vector) -> Array:
        v = jnp.exp(log_v)[data.which[k]]
        m = data.base[k].shape[-1]
        return jnp.einsum("nc,ncij->nij", v, data.base[k]) + lk.FLOOR[k] * jnp.eye(m)

    def precision(self, jacobian: dict[str, Array], log_v: Vector, keep: Vector) -> Array:
        """Expected information of the search vector, prior included (free, free)."""
        return self._form._precision(self.data, jacobian, log_v, keep)

    @partial(jax.jit, static_argnums=0)
    def _precision(
        self, data: Data, jacobian: dict[str, Array], log_v: Vector, keep: Vector
    ) -> Array:
        total, of_motion = jnp.diag(1 / self._std**2), jnp.diag(1 / self._std**2)
        for k, half in self._whitened(data, jacobian, log_v, keep).items():
            flat = half.reshape(-1, half.shape[-1])
            total += flat.T @ flat
            of_motion += flat.T @ flat if k == "motion" else 0.0
        return total if self.joint else self._cut(total, of_motion)

    def whitened(self, jacobian: dict[str, Array], log_v: Vector) -> dict[str, Array]:
        """Jacobians H (piece, m, free) such that H^T H is the expected information of a piece."""
        keep = jnp.ones(len(self.windows))
        return self._form._whitened(self.data, jacobian, jnp.asarray(log_v), keep)

    @partial(jax.jit, static_argnums=0)
    def _whitened(
        self, data: Data, jacobian: dict[str, Array], log_v: Vector, keep: Vector
    ) -> dict[str, Array]:
        out = {}
        for k, jac in jacobian.items():
            m = jac.shape[1]
            factor = keep * (DEGREES + m) / (DEGREES + m + 2)  # Fisher information of a t location
            root = inverse_root(self._covariance(data, k, log_v)) * jnp.sqrt(factor)[:, None, None]
            out[k] = jnp.einsum("nij,njp->nip", root, jac)
        return out

    def _cut(self, total: Array, of_motion: Array) -> Array:
        """Information when p(electric | motion, all data) multiplies p(motion | motion data)."""
        e = jnp.asarray(self.electric)
        own = jnp.where(e[:, None] & e[None, :], total, jnp.where(jnp.eye(len(e)) > 0, 1.0, 0.0))
        cross = jnp.where(e[:, None] & ~e[None, :], total, 0.0)
        carried = cross.T @ jnp.linalg.solve(own, cross)
        motion = ~e[:, None] & ~e[None, :]
        return jnp.where(motion, of_motion + carried, total)

    def scored(
        self,
        blocks: dict,
        jacobian: dict,
        log_v: Vector,
        keep: Vector,
        typical: Array,
        own: dict[str, Array] | None = None,
    ) -> Array:
        """One Fisher-scoring step of the restricted likelihood in the log variances.

        Args:
            blocks, jacobian: of `linear`.
            log_v: where to start.
            keep: weight of each piece.
            typical: centre of the prior of the log variances.
            own: of `own`; by default the residuals' variance is all the components'.
        """
        return self._form._scored(self.data, blocks, jacobian, log_v, keep, typical, own or {})

    @partial(jax.jit, static_argnums=0)
    def _scored(
        self,
        data: Data,
        blocks: dict,
        jacobian: dict,
        log_v: Vector,
        keep: Vector,
        typical: Array,
        own: dict,
    ) -> Array:
        cov = jnp.linalg.inv(self._precision(data, jacobian, log_v, keep))
        spread = {k: jnp.einsum("nip,pq,njq->nij", jac, cov, jac) for k, jac in jacobian.items()}
        return self._scored_given(data, blocks, spread, log_v, keep, typical, own)

    def scored_given(
        self, blocks: dict, spread: dict, log_v: Vector, keep: Vector, typical: Array
    ) -> Array:
        """The same for a model that is not this problem's own.

        Args:
            blocks: residuals of the model (piece, m).
            spread: their covariance from the model's fitted numbers (piece, m, m); the degrees of
                freedom it stands for are not the variances' to have.
        """
        return self._form._scored_given(self.data, blocks, spread, log_v, keep, typical, {})

    @partial(jax.jit, static_argnums=0)
    def _scored_given(
        self,
        data: Data,
        blocks: dict,
        spread: dict,
        log_v: Vector,
        keep: Vector,
        typical: Array,
        own: dict,
    ) -> Array:
        _, weights, _ = self._whitening(data, blocks, log_v, keep)
        score, steeper = jnp.zeros(log_v.shape[0]), jnp.zeros(log_v.shape[0])
        for k, r in blocks.items():
            root = inverse_root(self._covariance(data, k, log_v))
            inverse = jnp.einsum("nji,njk->nik", root, root)
            base, which = _shared(data.base[k], own.get(k)), data.which[k]
            v = jnp.exp(log_v)[which]
            vr = jnp.einsum("nij,nj->ni", inverse, r)
            fit = jnp.einsum("ni,ncij,nj->nc", vr, base, vr) * weights[k][:, None]
            trace = jnp.einsum("nij,ncij->nc", inverse, base)
            spent = jnp.einsum("nij,njk,nkl->nil", inverse, spread[k], inverse)
            lost = jnp.einsum("nij,ncij->nc", spent, base)
            slope = 0.5 * v * (fit + keep[:, None] * (lost - trace))
            score = score.at[which].add(slope)
            if k in own:  # where others explain the residual the loss bends more than expected
                rest = jnp.clip(1 - 2 * jnp.mean(own[k], axis=1), 0.0)
                steeper = steeper.at[which].add(-rest[:, None] * slope)
        score -= (log_v - typical) / VARIANCE_SPREAD**2
        info = self._variance_precision(data, log_v, keep, own)
        info += jnp.diag(jnp.maximum(steeper, 0.0))
        return jnp.asarray(log_v) + jnp.clip(jnp.linalg.solve(info, score), -1.5, 1.5)

    def variance_precision(self, log_v: Vector, keep: Vector, z: Vector) -> Array:
        """Expected information of the log variances at z, prior included (variance, variance)."""
        log_v, own = jnp.asarray(log_v), self.own(z, log_v)
        return self._form._variance_precision(self.data, log_v, jnp.asarray(keep), own)

    @partial(jax.jit, static_argnums=0)
    def _variance_precision(self, data: Data, log_v: Array, keep: Array, own: dict) -> Array:
        info = jnp.eye(log_v.shape[0]) / VARIANCE_SPREAD**2
        for k, base in data.base.items():
            base, which = _shared(base, own.get(k)), data.which[k]
            root = inverse_root(self._covariance(data, k, log_v))
            vb = jnp.einsum("nji,njk,nckl->ncil", root, root, base)
            v = jnp.exp(log_v)[which]
            cross = 0.5 * jnp.einsum("ncij,ndji->ncd", vb, vb) * (v[:, :, None] * v[:, None, :])
            info = info.at[which[:, :, None], which[:, None, :]].add(keep[:, None, None] * cross)
        return info

    # fitting ---------------------------------------------------------------------------------
    def levenberg(
        self,
        z: Vector,
        root: dict,
        mask: np.ndarray,
        volt: Vector,
        felt: Array,
        slope: Array,
        most: int,
    ) -> np.ndarray:
        """Search vector after at most so many Levenberg-Marquardt steps with fixed whitening.

        Only steps that were taken count: one that is refused shrinks the next, and to stop among
        refused ones would look like having arrived.
        """
        args = (self.data, jnp.asarray(z), jnp.asarray(mask), root, jnp.asarray(volt), felt, slope)
        y = jnp.zeros(self.space.size)
        state = self._form._begin(args)
        taken = 0
        for _ in range(most + _REFUSED):
            before = y
            y, state, _ = self._step(y=y, args=args, state=state)
            taken += bool(jnp.any(y != before))
            if taken == most:
                break
            done, _ = self.solver.terminate(self._stacked, y, args, {}, state, frozenset())
            if bool(done):
                break
        return np.asarray(z + mask * np.asarray(self._std) * np.asarray(y))

    def loss(self, z: Vector, log_v: Vector, keep: Vector, blocks: dict[str, Array]) -> float:
        """Minus log posterior of structure and variances given the residuals, less constants."""
        nll = float(self.whitening(blocks, log_v, keep)[2])
        nll -= float(self.log_jacobian(z, self.volt(log_v), keep)[0])
        pull = (np.asarray(z) - self.space.prior_mean) / self.space.prior_std
        typical = 2 * np.log(self.noise.typical)
        spread = (np.asarray(log_v) - typical) / VARIANCE_SPREAD
        return nll + 0.5 * float(np.sum(pull**2)) + 0.5 * float(np.sum(spread**2))

    def volt(self, log_v: Vector) -> Array:
        """Std of the voltage noise [V], 1 where none is logged."""
        if "voltage" not in self.noise.blocks:
            return jnp.asarray(1.0)
        return lk.voltage_std(jnp.asarray(log_v)[-1])

    def own(self, z: Vector, log_v: Vector) -> dict[str, Array]:
        """Part that the variance components have in the variance of residuals, where not all.

        The ammeter's noise is known and lies in the voltage residual, too (`electric_residuals`).
        """
        if "voltage" not in self.noise.blocks:
            return {}
        return {"voltage": self._form._share(self.data, jnp.asarray(z), self.volt(log_v))}

    @partial(jax.jit, static_argnums=0)
    def _share(self, data: Data, z: Array, volt: Array) -> Array:
        return lk.voltage_share(self.space.tree(z), data.batch, volt)

    def round(
        self, state: State, keep: Vector, mask: np.ndarray, steps: int, scoring: int
    ) -> State:
        """Weights, structure, variances: one turn of each."""
        log_v = jnp.asarray(state.log_variance)
        keep_j = jnp.asarray(keep, dtype=float)
        volt = self.volt(log_v)
        blocks, _, felt = self._form._linear(self.data, jnp.asarray(state.z), volt)
        root, _, _ = self.whitening(blocks, log_v, keep_j)
        _, slope = self.log_jacobian(state.z, volt, keep_j)
        z = self.levenberg(state.z, root, mask, volt, felt, slope, steps)
        typical = jnp.asarray(2 * np.log(self.noise.typical))
        blocks, jacobian = self.linear(jnp.asarray(z), volt)
        own = self.own(z, log_v)
        for _ in range(scoring):
            log_v = self.scored(blocks, jacobian, log_v, keep_j, typical, own)
            before, own = own, self.own(z, log_v)
            for k, share in own.items():  # these residuals are in units of the noise just found
                scale = jnp.sqrt(share / before[k])
                blocks = blocks | {k: blocks[k] * scale}
                jacobian = jacobian | {k: jacobian[k] * scale[..., None]}
        if own and scoring:  # the Jacobian by R changes by more than its scale
            blocks, jacobian = self.linear(jnp.asarray(z), self.volt(log_v))
        std = np.sqrt(np.diag(np.linalg.inv(np.asarray(self.precision(jacobian, log_v, keep_j)))))
        moved = float(np.max(np.abs(z - state.z) / std, initial=0.0))
        moved = max(moved, float(np.max(np.abs(np.asarray(log_v) - state.log_variance)) / 3))
        return State(
            z=z,
            log_variance=np.asarray(log_v),
            round=state.round + 1,
            loss=self.loss(z, log_v, keep_j, blocks),
            moved=moved,
            stage=state.stage,
        )


def _shared(base: Array, own: Array | None) -> Array:
    """How the covariance of residuals grows with each variance, of which only a part is in them."""
    if own is None:
        return base
    root = jnp.sqrt(own)
    return base * root[:, None, :, None] * root[:, None, None, :]
