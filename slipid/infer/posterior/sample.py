"""Posterior of a fit by sampling: motion first, then electric numbers given each draw of it.

Where currents were logged the posterior is p(motion | motion data) p(electric | motion,
data), which no single density describes: its normaliser depends on the motion. Given the motion the
electric numbers are nearly linear with Gaussian noise, so that they are drawn by
Metropolis-Hastings steps with proposals around their most likely values.

posterior.nc: draws in the layout of ArviZ, with names for everything.
"""

import importlib
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from arviz_base import from_dict
from jaxtyping import Float
from xarray import DataTree

from slipid.fit import likelihood as lk
from slipid.fit.hierarchy import effect_information, pooled_stds
from slipid.fit.problem import Problem, linear
from slipid.fit.variances import DEGREES, VARIANCE_SPREAD, information
from slipid.infer.posterior import diagnosis, ensemble
from slipid.infer.posterior.blocks import (
    BlockStore,
    Chain,
    ChainBlock,
    LogDensity,
    Plan,
    packed,
    unpacked,
)
from slipid.infer.posterior.coordinates import ELECTRIC, EVERYTHING, MOTION, Fitted, effects_at
from slipid.infer.posterior.density import Density, electric_given_motion
from slipid.infer.posterior.diagnosis import Posterior
from slipid.infer.result import Fit, required
from slipid.search_space import Space
from slipid.support.checkpoint import Checkpoint
from slipid.support.files import write_bytes
from slipid.support.progress import Reporter

for _module in ("arviz_base", "arviz_stats", "h5netcdf"):
    importlib.import_module(_module)  # they are used after hours of work: what is missing shows now

STILL = 0.01
"""Part of the draws whose electric numbers may never have moved."""


def sampled(
    fit: Fit, plan: Plan, draws: int, kept: Checkpoint | None, report: Reporter
) -> Posterior:
    """Posterior of a fit by the likelihood it was made of, with progress.

    It goes on from the blocks that an earlier call has kept, and keeps new ones.
    """

    def done(part: str) -> list[ChainBlock]:
        blocks: list[ChainBlock] = []
        if kept is None:
            return blocks
        while (arrays := kept.load(f"{part}-{len(blocks):04d}")) is not None:
            blocks.append(unpacked(arrays))
        if blocks:
            report.line(f"going on from block {len(blocks)} ({part}) of {kept.folder}")
        return blocks

    def keep(part: str, block: ChainBlock) -> None:
        if kept is not None:
            kept.save(f"{part}-{block.number:04d}", packed(block))
        _tell(block, plan, report)

    def steps(part: str, count: int) -> None:
        report.stage(f"sampling {part}")

    return sample(fit, plan, draws, BlockStore(done, keep, steps))


def _tell(block: ChainBlock, plan: Plan, report: Reporter) -> None:
    """Progress of a chain; the time left is what it takes at most."""
    count = block.number + 1
    warm = "warm-up, " if count <= plan.warm_up[-1] else ""
    what = (
        f"block {count}: {warm}{count * block.chain.shape[1]} steps, "
        f"{100 * block.accepted.mean():.0f} % moved, "
        f"log density {block.log_prob[:, -1].mean():.1f}"
    )
    report.advance(count, plan.most, what)


def sample(fit: Fit, plan: Plan, draws: int = 400, record: BlockStore | None = None) -> Posterior:
    """Posterior around a fit, so many draws of each ensemble."""
    problem, fitted = required(fit.problem), Fitted.of(fit)
    assert problem.multi_floor is None, "runs on one floor each"
    record = record or BlockStore()
    parts = (EVERYTHING,) if problem.objective.joint else (MOTION, ELECTRIC)
    first = Density(problem, fitted, parts[0])
    at = first.coordinates
    target = LogDensity(first.terms, first.slope, at.group, first.centre, first.covariance)
    blocks = ensemble.extended(target, plan, parts[0], record)
    chain = ensemble.chain(blocks, plan)
    found = diagnosis.diagnose(chain, plan)
    x, log_prob = thinned(chain, blocks[plan.warm_up[-1] :], draws)
    shape = (plan.ensembles, draws)
    out = np.broadcast_to(fitted.z, (*shape, len(fitted.z))).copy()
    out[..., at.structure] = x
    accepted = {parts[0]: float(np.mean([b.accepted for b in blocks]))}
    still, reason = 0.0, f"{found.reason} ({first.names[found.worst]})"
    if len(parts) > 1:
        second = Density(problem, fitted, ELECTRIC)
        if second.size:
            record.tell(ELECTRIC, 0)
            later = electric_given_motion(first, second, fitted.covariance, x, plan.seed)
            out[..., second.coordinates.structure] = later.x
            accepted[ELECTRIC], still = later.accepted, later.still
    if not np.isfinite(out).all():
        still, reason = 1.0, "electric draws that are not finite"
    elif found.converged and still > STILL:
        reason = f"{100 * still:.1f} % of the electric draws, which never moved"
    return Posterior(
        fit=fit,
        z=out,
        log_variance=drawn_variances(problem, fitted, shape, plan.seed),
        log_prob=log_prob,
        names=at.names,
        diagnosis=found,
        accepted=accepted,
        converged=found.converged and still <= STILL,
        reason=reason,
    )


def thinned(
    chain: Chain, blocks: Sequence[ChainBlock], draws: int
) -> tuple[Float[np.ndarray, "ensemble draw size"], Float[np.ndarray, "ensemble draw"]]:
    """Draws spread evenly over steps and walkers; some repeat where there are too few."""
    log_prob = np.concatenate([b.log_prob for b in blocks], axis=1)
    _, steps, walkers, _ = chain.shape
    step = ((np.arange(draws) + 0.5) / draws * steps).astype(int)
    walker = np.arange(draws) * 7 % walkers if walkers % 7 else np.arange(draws) % walkers
    return chain[:, step, walker], log_prob[:, step, walker]


def drawn_variances(
    problem: Problem, fitted: Fitted, shape: tuple[int, int], seed: int
) -> Float[np.ndarray, "ensemble draw variance"]:
    """Log variances from the Gaussian with their information at the fit.

    They hardly depend on the numbers of the model, which the chains hold them for. That of the load
    biases of floors, of which there are few, is drawn by how likely each of a grid is.
    """
    log_v, keep = fitted.log_variance, np.ones(len(problem.windows))
    electric = problem.electric(fitted.z, log_v)
    residual, jacobian, motor_force = linear(problem.objective, fitted.z, electric)
    through = problem.voltage_information(fitted.z, log_v, motor_force)
    effect = effects_at(problem, residual, log_v)
    weight = problem.weighed(residual, log_v, keep, effect).whitening.weight["motion"]
    motion = residual["motion"], jacobian["motion"]
    told = np.array(information(problem.noise.blocks, log_v, keep, through))
    of_blocks = np.asarray(problem.objective.scored)
    told *= of_blocks[:, None] & of_blocks
    told += effect_information(problem.objective, motion, weight, fitted.covariance, log_v)
    told[np.diag_indices_from(told)] += np.where(of_blocks, 0.0, 1 / VARIANCE_SPREAD**2)
    root = np.linalg.cholesky(np.linalg.inv(told))
    rng = np.random.default_rng([seed, 1])
    out = log_v + rng.standard_normal((*shape, len(log_v))) @ root.T
    precision = np.linalg.inv(fitted.covariance)
    pooled = pooled_stds(precision, fitted.z, problem.objective, log_v)
    out[..., problem.objective.pooled] = 2 * np.log(rng.choice(pooled.std, shape, p=pooled.weight))
    return np.asarray(out)


SCHEMA = "slipid.posterior/1"
REPLICATES = 50
"""Replicated data sets of each ensemble."""
_AXES = ("x", "y", "yaw")


def tree(found: Posterior, about: Mapping[str, str] | None = None) -> DataTree:
    """All groups of the file, with these attributes of the whole beside schema and data."""
    fit, problem = found.fit, required(found.fit.problem)
    w, robot, runs = problem.windows, problem.robot, [name for name, _ in fit.runs]
    values, dims, units = _numbers(problem.space, found)
    noise, noise_dims = _noise(problem, found)
    means = found.z.mean(axis=(0, 1))
    middle = replace(Fitted.of(fit), z=means)
    density = Density(problem, middle, EVERYTHING)
    x = found.z
    of_piece = density.pointwise(x.reshape(-1, x.shape[-1]))
    per_piece = {k: np.asarray(v).reshape(*x.shape[:2], -1) for k, v in of_piece.items()}
    run = np.unique(w.run)
    onto = (np.asarray(w.run)[:, None] == run).astype(float)
    measured, predicted, data_dims = _data(
        problem, found, _replicates(density, x, found.log_variance)
    )
    unconstrained = {"z": found.z, "log_variance": found.log_variance}
    coords = {
        "surface": list(robot.surfaces.labels),
        "load": list(robot.body.loads),
        "session": list(robot.camera.sessions),
        "wheel": [f"wheel {k + 1}" for k in range(robot.geometry.wheels)],
        "drive": [f"drive {k + 1}" for k in range(robot.geometry.drives)],
        "axis": list(_AXES[:2]),
        "direction": list(_AXES),
        "run": [runs[k] for k in run],
        "coordinate": problem.space.names,
        "component": list(problem.noise.names),
    }
    made = from_dict(
        {
            "posterior": values | noise,
            "sample_stats": {"lp": found.log_prob},
            "log_likelihood": {k: v @ onto for k, v in per_piece.items()},
            "posterior_predictive": predicted,
            "observed_data": measured,
            "unconstrained_posterior": unconstrained,
        },
        coords=coords,
        dims=dims
        | noise_dims
        | data_dims
        | {"z": ["coordinate"], "log_variance": ["component"]}
        | {k: ["run"] for k in per_piece},
    )
    for name, unit in units.items():
        made["posterior"][name].attrs["units"] = unit
    made["observed_data"].attrs["run_of_piece"] = [runs[k] for k in w.run]
    made.attrs.update({"schema": SCHEMA, "data_hash": fit.data_hash, **(about or {})})
    return made


def _numbers(space: Space, found: Posterior) -> tuple[dict, dict, dict]:
    """Draws of every leaf with a free number, its dimensions and units."""
    shape = found.z.shape[:2]
    robots = jax.vmap(space.tree)(jnp.asarray(found.z.reshape(-1, space.size)))
    values, dims, units = {}, {}, {}
    for e in space.free:
        leaf = np.asarray(e.whole(robots))
        values[e.quantity] = leaf.reshape(*shape, *leaf.shape[1:])
        of = {"surface": e.surface, "load": e.load, "session": e.session}
        of_vector = [] if e.size == 1 else [e.declaration.of]
        dims[e.quantity] = [label for label, name in of.items() if name is not None] + of_vector
        units[e.quantity] = e.declaration.unit
    return values, dims, units


def _noise(problem: Problem, found: Posterior) -> tuple[dict, dict]:
    """Std of every noise component, floors side by side."""
    rows = np.moveaxis(np.exp(0.5 * found.log_variance), -1, 0)
    labels = problem.robot.surfaces.labels
    stds: dict[str, np.ndarray] = {}
    dims: dict[str, list[str]] = {}
    for component, std in zip(problem.noise.components, rows, strict=True):
        name = f"noise.{component.kind}.{component.what}"
        if component.floor is None:
            stds[name], dims[name] = std, []
            continue
        # sessions share nothing on a floor that was driven on in one of them only
        whole = stds.setdefault(name, np.zeros((*std.shape, len(labels))))
        whole[..., labels.index(component.floor)], dims[name] = std, ["surface"]
    return stds, dims


def _data(
    problem: Problem, found: Posterior, new: dict[str, np.ndarray]
) -> tuple[dict, dict, dict]:
    """What was measured of every window, and replicates of it, given less what was measured.

    Marker increments are in metres corrected by the fitted camera.
    """
    w = problem.windows
    middle = problem.space.tree(jnp.asarray(found.z.mean(axis=(0, 1))))
    measured = {
        "increment": np.asarray(jax.jit(lk.measured_increments)(middle, problem.batch.pose))
    }
    dims = {"increment": ["piece", "window", "direction"]}
    gaps = {"increment": new["motion"]}
    if w.has_current:
        measured["current"], dims["current"] = np.asarray(w.current), ["piece", "window", "drive"]
        gaps["current"] = new["current"]
    predicted = {k: gaps[k].reshape(*gaps[k].shape[:2], *y.shape) + y for k, y in measured.items()}
    return measured, predicted, dims


def write(made: DataTree, path: Path) -> None:
    """Write the file, whole or not at all."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / path.name
        made.to_netcdf(whole, engine="h5netcdf")
        write_bytes(path, whole.read_bytes())


def _replicates(
    density: Density,
    x: Float[np.ndarray, "ensemble draw size"],
    log_variance: Float[np.ndarray, "ensemble draw variance"],
) -> dict[str, Float[np.ndarray, "ensemble replicate piece m"]]:
    """Replicated less measured data of every piece, from some draws of each ensemble.

    What the model says, less what was measured, plus noise of the draw's own variances.
    """
    picked = np.linspace(0, x.shape[1] - 1, REPLICATES).astype(int)
    some, noise = x[:, picked], log_variance[:, picked].reshape(-1, log_variance.shape[-1])
    rng = np.random.default_rng(0)
    flat = some.reshape(-1, x.shape[-1])
    out = {k: np.array(v) for k, v in density.residuals(flat).items()}
    for k, r in out.items():
        for one, log_v in zip(r, noise, strict=True):
            root = np.linalg.cholesky(np.asarray(density.problem.covariance(k, log_v)))
            normal = rng.standard_normal(one.shape)
            normal *= np.sqrt(DEGREES / rng.chisquare(DEGREES, (len(normal), 1)))
            one += np.einsum("nij,nj->ni", root, normal)
    return {k: v.reshape(*some.shape[:2], *v.shape[1:]) for k, v in out.items()}
