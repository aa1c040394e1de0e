"""posterior.nc: draws in the layout of ArviZ, with names for everything."""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from arviz_base import from_dict
from jaxtyping import Float
from xarray import DataTree

from slipid.identify.fit import likelihood as lk
from slipid.identify.fit.problem import Problem
from slipid.identify.fit.variances import DEGREES
from slipid.identify.posterior.coordinates import EVERYTHING, Fitted
from slipid.identify.posterior.density import Density
from slipid.identify.posterior.diagnosis import Posterior
from slipid.identify.result import known
from slipid.search_space import Space
from slipid.support.files import write_bytes

SCHEMA = "slipid.posterior/1"
REPLICATES = 50
"""Replicated data sets of each ensemble."""
_AXES = ("x", "y", "yaw")


def tree(found: Posterior, about: Mapping[str, str] | None = None) -> DataTree:
    """All groups of the file, with these attributes of the whole beside schema and data."""
    fit, problem = found.fit, known(found.fit.problem)
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
    measured = {"increment": np.asarray(jax.jit(lk.measured)(middle, problem.batch.pose))}
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
