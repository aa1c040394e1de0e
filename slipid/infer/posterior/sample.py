"""Posterior of a fit by sampling, and its file posterior.nc in the layout of ArviZ.

Where currents were logged the posterior is p(motion | motion data) p(electric | motion, data). Its
density cannot be evaluated, since the normalising constant of the second factor depends on the
motion. Therefore the motion is sampled first. Given the motion, the residuals are nearly linear in
the electric parameters, which are drawn by Metropolis-Hastings steps with proposals around their
most likely values. The friction that moves runs over several floors is sampled with the motion
(`slipid.infer.posterior.multi_floor_anchor`).
"""

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from arviz_base import from_dict
from jaxtyping import Float
from xarray import DataTree

from slipid.fitting import likelihood as lk
from slipid.fitting.problem import Problem
from slipid.fitting.variances import DEGREES
from slipid.infer.posterior import diagnosis, ensemble
from slipid.infer.posterior.blocks import Chain, ChainBlock, Plan
from slipid.infer.posterior.coordinates import (
    ELECTRIC,
    EVERYTHING,
    MOTION,
    Fitted,
    around,
    on_one_floor,
)
from slipid.infer.posterior.density import (
    LEAST_ACCEPTED,
    MOST_REFUSED,
    Density,
    electric_given_motion,
    refused,
)
from slipid.infer.posterior.diagnosis import Posterior
from slipid.infer.posterior.left_out import log_likelihoods
from slipid.infer.posterior.variance_draws import added_covariance, drawn_variances, widened
from slipid.infer.result import Fit, required
from slipid.search_space import Space
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from slipid.support.files import write_bytes
from slipid.support.folder import temporary_of
from slipid.support.progress import COMPILING_S, Reporter


def sampled(
    fit: Fit, plan: Plan, draws: int, checkpoint: Checkpoint | None, report: Reporter
) -> Posterior:
    """Return the posterior sampled around a fit, with `draws` draws from each ensemble.

    Sampling resumes after the blocks that an earlier call has stored in the checkpoint.
    """
    problem, fitted = around(required(fit.problem), Fitted.of(fit))
    parts = (EVERYTHING,) if problem.objective.joint else (MOTION, ELECTRIC)
    first = Density(problem, fitted, parts[0])
    shape = (plan.ensembles, draws)
    stop = threading.Event()
    with ThreadPoolExecutor(1) as pool:  # beside the chain, which leaves a core idle at times
        try:
            variances = pool.submit(drawn_variances, problem, fitted, shape, plan.seed, stop=stop)
            blocks = ensemble.extended(first.target(), plan, parts[0], checkpoint, report)
            if not variances.done():
                report.stage("drawing the variances of the noise")
            log_variance = variances.result()
        finally:
            stop.set()
    chain = ensemble.chain(blocks, plan)
    found = diagnosis.diagnose(chain, plan)
    x, log_prob = thinned(chain, blocks[ensemble.warm_up(blocks, plan) :], draws)
    # The chain has the variances of the fit; their uncertainty adds to that of the parameters.
    added = added_covariance(problem, fitted, log_variance)
    rng = np.random.default_rng([plan.seed, 2])
    x = widened(x, added[np.ix_(*[first.structure] * 2)], rng)
    out = np.broadcast_to(fitted.z, (*shape, len(fitted.z))).copy()
    out[..., first.structure] = x
    accepted = {parts[0]: float(np.mean([b.accepted for b in blocks]))}
    few, reason = 0.0, f"{found.reason} ({first.names[found.worst]})"
    if len(parts) > 1:
        second = Density(problem, fitted, ELECTRIC)
        if second.size:
            report.stage(f"sampling {ELECTRIC}", usual_s=COMPILING_S)
            drawn, moved = electric_given_motion(first, second, fitted.covariance, x, plan.seed)
            of_electric = added[np.ix_(*[second.structure] * 2)]
            out[..., second.structure] = widened(drawn, of_electric, rng)
            accepted[ELECTRIC] = float(moved.mean())
            few = refused(moved)
    if not np.isfinite(out).all():
        few, reason = 1.0, "electric draws that are not finite"
    elif found.converged and few > MOST_REFUSED:
        reason = (
            f"{100 * few:.1f} % of the electric draws, which accepted less than "
            f"{100 * LEAST_ACCEPTED:.0f} % of their proposals"
        )
    return Posterior(
        fit=fit,
        z=out,
        log_variance=_of_all(fit, problem, log_variance),
        log_prob=log_prob,
        names=first.names,
        diagnosis=found,
        accepted=accepted,
        converged=found.converged and few <= MOST_REFUSED,
        reason=reason,
    )


def _of_all(
    fit: Fit, alone: Problem, drawn: Float[np.ndarray, "ensemble draw variance"]
) -> Float[np.ndarray, "ensemble draw every"]:
    """Return draws of all log variances; those of runs over several floors stay as fitted."""
    names, fitted = required(fit.problem).noise.names, Fitted.of(fit).log_variance
    out = np.broadcast_to(fitted, (*drawn.shape[:2], len(names))).copy()
    out[..., [names.index(name) for name in alone.noise.names]] = drawn
    return out


def thinned(
    chain: Chain, blocks: Sequence[ChainBlock], draws: int
) -> tuple[Float[np.ndarray, "ensemble draw size"], Float[np.ndarray, "ensemble draw"]]:
    """Return positions and log densities of `draws` draws, spread evenly over steps and walkers.

    Steps are used repeatedly if the chain has fewer steps than draws.
    """
    log_prob = np.concatenate([b.log_prob for b in blocks], axis=1)
    _, steps, walkers, _ = chain.shape
    step = ((np.arange(draws) + 0.5) / draws * steps).astype(int)
    walker = np.arange(draws) * 7 % walkers if walkers % 7 else np.arange(draws) % walkers
    return chain[:, step, walker], log_prob[:, step, walker]


SCHEMA = "slipid.posterior/1"
REPLICATES = 50
"""Number of replicated data sets (posterior predictive draws) from each ensemble."""
_AXES = ("x", "y", "yaw")


def tree(found: Posterior, about: Mapping[str, str] | None = None) -> DataTree:
    """Return the content of posterior.nc; `about` holds further attributes of the file."""
    fit, problem = found.fit, required(found.fit.problem)
    alone, fitted = on_one_floor(problem, Fitted.of(fit))
    w, robot, runs = problem.windows, problem.robot, [name for name, _ in fit.runs]
    values, dims, units = _numbers(problem.space, found)
    noise, noise_dims = _noise(problem, found)
    x = found.z
    density = Density(alone, replace(fitted, z=x.mean(axis=(0, 1))), EVERYTHING)
    per_segment = log_likelihoods(density, x, np.asarray(w.run))
    run = np.unique(w.run)
    onto = (np.asarray(w.run)[:, None] == run).astype(float)
    kept = [problem.noise.names.index(name) for name in alone.noise.names]
    new = _replicates(density, x, found.log_variance[..., kept])
    measured, predicted, data_dims = _data(problem, found, new)
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
            "log_likelihood": {k: v @ onto for k, v in per_segment.items()},
            "posterior_predictive": predicted,
            "observed_data": measured,
            "unconstrained_posterior": {"z": x, "log_variance": found.log_variance},
        },
        coords=coords,
        dims=dims
        | noise_dims
        | data_dims
        | {"z": ["coordinate"], "log_variance": ["component"]}
        | {k: ["run"] for k in per_segment},
    )
    for name, unit in units.items():
        made["posterior"][name].attrs["units"] = unit
    made["observed_data"].attrs["run_of_piece"] = [runs[k] for k in w.run]
    made.attrs.update({"schema": SCHEMA, "data_hash": fit.data_hash, **(about or {})})
    return made


def _numbers(space: Space, found: Posterior) -> tuple[dict, dict, dict]:
    """Return draws, dimensions and units of free parameters, keyed by `Entry.quantity`."""
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
    """Return draws of the std of every noise component, and their dimensions, keyed by name.

    The same component of several floors is one array with the dimension `surface`.
    """
    rows = np.moveaxis(np.exp(0.5 * found.log_variance), -1, 0)
    labels = problem.robot.surfaces.labels
    stds: dict[str, np.ndarray] = {}
    dims: dict[str, list[str]] = {}
    for component, std in zip(problem.noise.components, rows, strict=True):
        name = f"noise.{component.kind}.{component.what}"
        if component.floor is None:
            stds[name], dims[name] = std, []
            continue
        # The array starts at zero, as a floor with a single session has no session component.
        whole = stds.setdefault(name, np.zeros((*std.shape, len(labels))))
        whole[..., labels.index(component.floor)], dims[name] = std, ["surface"]
    return stds, dims


def _data(
    problem: Problem, found: Posterior, new: dict[str, np.ndarray]
) -> tuple[dict, dict, dict]:
    """Return measurements of all windows, their replicates and dimensions, keyed by channel.

    `new` contains replicates less measurements. Marker increments are in metres corrected by the
    fitted camera model.
    """
    w = problem.windows
    middle = problem.space.tree(jnp.asarray(found.z.mean(axis=(0, 1))))
    measured = {
        "increment": np.asarray(jax.jit(lk.measured_increments)(middle, problem.batch.pose))
    }
    dims = {"increment": ["piece", "window", "direction"]}
    differences = {"increment": new["motion"]}
    if w.has_current:
        measured["current"], dims["current"] = np.asarray(w.current), ["piece", "window", "drive"]
        differences["current"] = new["current"]
    predicted = {
        k: differences[k].reshape(*differences[k].shape[:2], *y.shape) + y
        for k, y in measured.items()
    }
    return measured, predicted, dims


def write(made: DataTree, path: Path) -> None:
    """Write the tree to a NetCDF file, completely or not at all."""
    write_bytes(path, packed(made, path))


def packed(made: DataTree, path: Path) -> bytes:
    """Return the content of the NetCDF file of a tree.

    A temporary file beside `path` is used, since the system's folder for such files may be full.

    Raises:
        DataError: the temporary file cannot be written.
    """
    whole = temporary_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        made.to_netcdf(whole, engine="h5netcdf")
        return whole.read_bytes()
    except OSError as error:
        raise DataError(
            f"{path}: cannot be written ({error.strerror or error}); expected a writable folder "
            "with enough space"
        ) from error
    finally:
        with suppress(OSError):
            whole.unlink(missing_ok=True)


def _replicates(
    density: Density,
    x: Float[np.ndarray, "ensemble draw size"],
    log_variance: Float[np.ndarray, "ensemble draw variance"],
) -> dict[str, Float[np.ndarray, "ensemble replicate segment m"]]:
    """Return replicated less measured data of every segment, for `REPLICATES` draws per ensemble.

    A replicate is the prediction of a draw plus noise with the variances of the same draw.
    """
    picked = np.linspace(0, x.shape[1] - 1, REPLICATES).astype(int)
    some, noise = x[:, picked], log_variance[:, picked].reshape(-1, log_variance.shape[-1])
    rng = np.random.default_rng(0)
    flat = some.reshape(-1, x.shape[-1])
    residuals = density.mapped(Density.residual_blocks, flat, None)
    out = {k: np.array(v) for k, v in residuals.items()}
    for k, r in out.items():
        for one, log_v in zip(r, noise, strict=True):
            root = np.linalg.cholesky(np.asarray(density.problem.covariance(k, log_v)))
            normal = rng.standard_normal(one.shape)
            normal *= np.sqrt(DEGREES / rng.chisquare(DEGREES, (len(normal), 1)))
            one += np.einsum("nij,nj->ni", root, normal)
    return {k: v.reshape(*some.shape[:2], *v.shape[1:]) for k, v in out.items()}
