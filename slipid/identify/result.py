"""The result of a fit: a frozen value that prints, saves and loads, identifiability included."""

import hashlib
import io
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from slipid.data.dataset import Dataset
from slipid.data.files import json_text, read_json, write_bytes
from slipid.data.log import DataError
from slipid.identify import curves as curves_of
from slipid.identify.fit import Optimum
from slipid.identify.flat import Flat, flat_directions, sentences
from slipid.identify.identifiability import Estimate, derived, estimates
from slipid.identify.mixed import Update, informed
from slipid.identify.predictive import contact_of
from slipid.identify.problem import Problem
from slipid.model.geometry import Geometry
from slipid.model.robot import Robot, build
from slipid.parameter import Choice, Space, entries

SCHEMA, SCHEMA_FIT = "slipid.identified/1", "slipid.fit/1"
CONFLICT = 4.0
"""Prior stds from the prior mean beyond which a reader is told."""
REMAINING = 0.3
"""Largest remaining Gauss-Newton step of a fit that may be called converged [posterior std]."""


@dataclass(frozen=True, eq=False)
class Fit:
    """What a fit found, how sure it is and how it went.

    Attributes:
        space: free and fixed numbers, priors; its template holds the fixed values.
        choices: what the user wanted.
        z: search vector at the optimum.
        covariance: of the search vector: Laplace, grown by what runs of a session share
            (`slipid.identify.sessions`).
        laplace: without what they share, the curvature of the likelihood alone.
        variance: every variance component by name, those of sessions included [unit squared].
        variance_unit: unit of each component's std.
        runs: (name, sha256) of every run that was fitted, those over several floors last.
        piece_run: number of the run each residual row belongs to.
        residual: predicted less measured, one row per piece, by block.
        whitened: the same in units of its expected scatter.
        weight: of each piece in the last round, by block; about 1, small for an outlier.
        spectrum: singular values of the prior-scaled whitened Jacobian; at 1 the data know as much
            as the prior.
        has: which of current, voltage were logged.
        curves: slip over torque per floor, as in identified.json.
        current_trend: a + b v, measured currents over the model's at speed v [A], [A s/m].
        validity: what each floor was seen with.
        converged, reason, rounds, history: how the fit ended.
        remaining: largest step a full Gauss-Newton step would still take, in posterior stds; a
            solver that finds no way ahead is not at an optimum because of it.
        settings: of windows and seed, as used; `mixed` says what runs over several floors did.
        baselines: what simpler models learnt from the same runs, for comparison.
    """

    space: Space
    choices: tuple[Choice, ...]
    z: Float[np.ndarray, " free"]
    covariance: Float[np.ndarray, "free free"]
    laplace: Float[np.ndarray, "free free"]
    variance: Mapping[str, float]
    variance_unit: Mapping[str, str]
    runs: tuple[tuple[str, str], ...]
    piece_run: np.ndarray
    residual: Mapping[str, np.ndarray]
    whitened: Mapping[str, np.ndarray]
    weight: Mapping[str, np.ndarray]
    spectrum: Float[np.ndarray, " free"]
    has: Mapping[str, bool]
    curves: Mapping[str, Any]
    validity: Mapping[str, Any]
    converged: bool
    reason: str
    rounds: int
    remaining: float
    history: tuple[float, ...]
    settings: Mapping[str, Any]
    baselines: Mapping[str, Any] = field(default_factory=dict)
    current_trend: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def robot(self) -> Robot:
        """The robot with every number at its fitted or fixed value."""
        return self.space.tree(jnp.asarray(self.z))

    @cached_property
    def parameters(self) -> dict[str, Estimate]:
        """Every number by path, with interval and verdict."""
        found = estimates(self.space, self.choices, self.z, self.covariance, self.has["voltage"])
        # a number whose scale rests on another one's prior was not measured, however narrow
        open_ = {path for f in self.flat for path in f.paths}
        return {
            e.path: replace(e, provenance="borrowed")
            if e.path in open_ and e.provenance == "measured"
            else e
            for e in found
        }

    @cached_property
    def flat(self) -> tuple[Flat, ...]:
        """Directions the likelihood leaves open; what sessions share blurs numbers, opens none."""
        has = self.has["current"], self.has["voltage"]
        return flat_directions(self.space, self.laplace, *has, self.validity)

    @cached_property
    def derived(self) -> dict[str, Estimate]:
        """Ratios that may be known where the numbers themselves are not."""
        found = derived(self.space, self.z, self.covariance, self.has["voltage"])
        return {e.path: e for e in found}

    @property
    def messages(self) -> tuple[str, ...]:
        """What a reader of the numbers must know, one sentence each."""
        said = list(sentences(self.flat))
        said += [
            f"{e.path} ended at its bound ({e.value:.3g} {e.unit})"
            for e in self.parameters.values()
            if e.verdict == "at_bound" and isinstance(e.value, float)
        ]
        said += [
            f"{e.path} lies {abs(e.pull):.1f} prior stds from its prior: "
            "the prior is wrong, or the model lacks something"
            for e in self.parameters.values()
            if e.pull is not None and abs(e.pull) > CONFLICT and e.verdict != "at_bound"
        ]
        if not self.converged:
            said.append(f"the fit did not converge: {self.reason}")
        return tuple(said)

    @property
    def data_hash(self) -> str:
        """Hash of the runs and their files."""
        return hash_of(self.runs)

    def draws(self, count: int, seed: int = 0) -> Float[np.ndarray, "draw free"]:
        """Search vectors drawn from the Gaussian of z and covariance."""
        return draws(self.z, self.covariance, count, seed)

    def with_baselines(self, baselines: Mapping[str, Any]) -> "Fit":
        """The fit, with what simpler models learnt (plain numbers, as JSON holds them)."""
        return replace(self, baselines=dict(baselines))

    def to_identified(self) -> dict[str, Any]:
        """Content of identified.json."""
        return {
            "schema": SCHEMA,
            "parameters": {path: as_identified(e) for path, e in self.parameters.items()},
            "derived": {path: as_identified(e) for path, e in self.derived.items()},
            "surfaces": list(self.robot.surfaces.labels),
            "curves": dict(self.curves),
            "validity": dict(self.validity),
            "messages": list(self.messages),
            "data": {"hash": self.data_hash, "runs": [name for name, _ in self.runs]},
        }

    def to_fit_json(self) -> dict[str, Any]:
        """Content of fit.json: everything but the large arrays, which go to fit.npz."""
        return {
            "schema": SCHEMA_FIT,
            "converged": self.converged,
            "reason": self.reason,
            "rounds": self.rounds,
            "remaining": self.remaining,
            "history": [x if np.isfinite(x) else None for x in self.history],
            "parameters": {p: asdict(e) for p, e in self.parameters.items()},
            "derived": {p: asdict(e) for p, e in self.derived.items()},
            "flat": [asdict(f) | {"text": f.text} for f in self.flat],
            "messages": list(self.messages),
            "variances": {
                name: {"std": float(np.sqrt(v)), "unit": self.variance_unit[name]}
                for name, v in self.variance.items()
            },
            "spectrum": self.spectrum.tolist(),
            "names": self.space.names,
            "z": self.z.tolist(),
            "robot": _robot_json(self.space.template),
            "choices": [asdict(c) for c in self.choices],
            "variance": dict(self.variance),
            "has": dict(self.has),
            "curves": dict(self.curves),
            "validity": dict(self.validity),
            "settings": dict(self.settings),
            "current_trend": list(self.current_trend),
            "baselines": dict(self.baselines),
            "data": {"hash": self.data_hash, "runs": [list(r) for r in self.runs]},
        }

    def save(self, folder: Path) -> None:
        """Write fit.json, fit.npz and identified.json, each whole or not at all."""
        arrays = {name: getattr(self, name) for name in ("covariance", "laplace", "piece_run")}
        for name in ("residual", "whitened", "weight"):
            arrays |= {f"{name}/{k}": v for k, v in getattr(self, name).items()}
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **arrays)
        texts = [json_text(self.to_fit_json()), json_text(self.to_identified())]
        write_bytes(folder / "fit.npz", buffer.getvalue())
        for name, text in zip(("fit.json", "identified.json"), texts, strict=True):
            write_bytes(folder / name, text.encode())


def as_identified(e: Estimate) -> dict[str, Any]:
    """An estimate as identified.json has it."""
    return {
        "value": e.value,
        "unit": e.unit,
        "shape": [len(e.labels)] if e.labels else [],
        "labels": list(e.labels),
        "std": e.std,
        "interval90": e.interval90,
        "source": e.source,
        "verdict": e.verdict,
        "provenance": e.provenance,
    }


def load(folder: Path) -> Fit:
    """Fit from the files `Fit.save` wrote.

    One that knows nothing of sessions, of a version before they had effects, has none.

    Raises:
        DataError: absent, damaged, or of another schema.
    """
    path = folder / "fit.json"
    kept = read_json(path, "the result of `slipid identify`")
    if not isinstance(kept, dict) or kept.get("schema") != SCHEMA_FIT:
        raise DataError(f"{path}: no {SCHEMA_FIT}; expected the result of `slipid identify`")
    try:
        # opened here: numpy leaves a damaged file open
        with (folder / "fit.npz").open("rb") as file, np.load(file, allow_pickle=False) as npz:
            arrays = {k: npz[k] for k in npz.files}
        return _from_files(kept, arrays)
    except OSError as error:
        raise DataError(f"{folder / 'fit.npz'}: {error.strerror or error}") from error
    except (KeyError, TypeError, ValueError, BadZipFile) as error:
        raise DataError(
            f"{folder}: fit.json and fit.npz do not belong together or are damaged ({error}); "
            "expected them as `slipid identify` wrote them"
        ) from error


def _from_files(kept: dict[str, Any], arrays: dict[str, np.ndarray]) -> Fit:
    choices = tuple(Choice(**c) for c in kept["choices"])
    space = Space(_robot_of(kept["robot"]), choices)
    if space.names != kept["names"]:
        raise ValueError("other parameters than this version declares")

    def of(name: str) -> dict[str, np.ndarray]:
        start = f"{name}/"
        return {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}

    return Fit(
        space=space,
        choices=choices,
        z=np.asarray(kept["z"], float),
        covariance=arrays["covariance"],
        laplace=arrays.get("laplace", arrays["covariance"]),
        variance=kept["variance"],
        variance_unit={k: v["unit"] for k, v in kept["variances"].items()},
        runs=tuple((str(name), str(sha)) for name, sha in kept["data"]["runs"]),
        piece_run=arrays["piece_run"],
        residual=of("residual"),
        whitened=of("whitened"),
        weight=of("weight"),
        spectrum=np.asarray(kept["spectrum"], float),
        has=kept["has"],
        curves=kept["curves"],
        validity=kept["validity"],
        converged=kept["converged"],
        reason=kept["reason"],
        rounds=kept["rounds"],
        remaining=kept["remaining"],
        history=tuple(np.inf if x is None else x for x in kept["history"]),
        settings=kept["settings"],
        baselines=kept["baselines"],
        current_trend=tuple(kept.get("current_trend", (0.0, 0.0))),
    )


def summarise(
    problem: Problem, optimum: Optimum, data: Dataset, choices: Iterable[Choice], seed: int = 0
) -> Fit:
    """Fit from the end of an optimisation, and what runs of one session were found to share.

    Args:
        problem: as it was optimised.
        optimum: where it ended.
        data: the runs its windows were cut from.
        choices: as the problem was given.
        seed: of the draws the curves' bands are made of.
    """
    z, log_v = optimum.state.z, optimum.state.log_variance
    volt = problem.volt(log_v)
    rows = _rows(problem, z, log_v)
    contact = contact_of(problem, optimum.state, optimum.covariance, np.ones(len(problem.windows)))
    left, name = remaining(problem, z, volt, rows.residual, rows.jacobian, rows.roots)
    settled = left < REMAINING
    stuck = f"the solver stopped {left:.2g} stds of {name} away from where its own step leads"
    windows = problem.windows
    robot = problem.space.tree(jnp.asarray(z))
    unit = dict(zip(problem.noise.names, problem.noise.unit, strict=True))
    effects = {name: u for name, u in unit.items() if name.startswith("run.")}
    unit |= {f"session.{name.removeprefix('run.')}": u for name, u in effects.items()}
    return Fit(
        space=problem.space,
        choices=tuple(choices),
        z=np.asarray(z),
        covariance=contact.covariance,
        laplace=np.asarray(optimum.covariance),
        variance=contact.variance,
        variance_unit={name: unit[name] for name in contact.variance},
        runs=tuple((log.name, log.sha256) for log in data.logs),
        piece_run=np.asarray(windows.run),
        residual=rows.residual,
        whitened=rows.whitened,
        weight=rows.weight,
        spectrum=_spectrum(rows.gram),
        has={"current": bool(windows.has_current), "voltage": bool(windows.has_voltage)},
        curves=curves_of.curves(
            problem.space, z, draws(z, contact.covariance, 400, seed), problem.batch
        ),
        validity=curves_of.validity(data, robot, problem.batch),
        converged=bool(optimum.converged) and settled,
        reason=optimum.reason if settled or not optimum.converged else stuck,
        remaining=left,
        rounds=int(optimum.state.round),
        history=tuple(float(x) for x in optimum.history),
        settings={
            "lag": float(windows.lag),
            "windows_per_piece": int(windows.dt.shape[1]),
            "current_is_signed": bool(windows.current_is_signed),
            "seed": seed,
        },
        current_trend=curves_of.current_trend(robot, problem.batch)
        if windows.has_current
        else (0.0, 0.0),
    )


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residuals at a search vector, with what they are weighed by; attributes as of `Fit`.

    Attributes:
        jacobian: of the residuals.
        roots: of their inverse covariance, weights of outliers included.
        gram: information of all of them without those weights, in prior stds.
    """

    residual: dict[str, np.ndarray]
    jacobian: dict[str, np.ndarray]
    roots: dict[str, np.ndarray]
    weight: dict[str, np.ndarray]
    whitened: dict[str, np.ndarray]
    gram: Float[np.ndarray, "free free"]


def _rows(problem: Problem, z: Any, log_v: Any) -> _Rows:
    blocks, jacobian = problem.linear(jnp.asarray(z), problem.volt(log_v))
    keep = np.ones(len(problem.windows))
    roots, weights, _ = problem.whitening(blocks, jnp.asarray(log_v), keep)
    plain = {  # roots of V^-1 without the weights of outliers
        k: np.asarray(roots[k]) / np.sqrt(np.asarray(weights[k]))[:, None, None] for k in roots
    }
    gram = np.zeros((problem.space.size,) * 2)
    for k, jac in jacobian.items():
        half = np.einsum("nij,njp->nip", plain[k], np.asarray(jac)).reshape(-1, len(gram))
        half = half * problem.space.prior_std
        gram += half.T @ half
    return _Rows(
        residual={k: np.asarray(v) for k, v in blocks.items()},
        jacobian={k: np.asarray(v) for k, v in jacobian.items()},
        roots={k: np.asarray(v) for k, v in roots.items()},
        weight={k: np.asarray(v) for k, v in weights.items()},
        whitened={k: np.einsum("nij,nj->ni", plain[k], np.asarray(r)) for k, r in blocks.items()},
        gram=gram,
    )


def _spectrum(gram: np.ndarray) -> Float[np.ndarray, " free"]:
    return np.sqrt(np.maximum(np.linalg.eigvalsh(gram)[::-1], 0.0))


def updated(fit: Fit, new: Update, problem: Problem, optimum: Optimum, data: Dataset) -> Fit:
    """The fit after runs over several floors.

    Args:
        fit: of `summarise`.
        new: what those runs make of it.
        problem, optimum, data: as given to `summarise`; residuals are still those of its runs.
    """
    rows = _rows(problem, new.z, optimum.state.log_variance)
    outer = problem.space.prior_std[:, None] * problem.space.prior_std
    several = draws(new.z, new.covariance, 400, fit.settings["seed"])
    unsettled = "the runs over several floors: no rest after all steps"
    return replace(
        fit,
        z=np.asarray(new.z),
        covariance=new.covariance,
        laplace=informed(fit.space, fit.laplace, new.information),
        variance=dict(fit.variance) | dict(new.variance),
        variance_unit=dict(fit.variance_unit) | dict(new.unit),
        runs=fit.runs + new.runs,
        residual=rows.residual,
        whitened=rows.whitened,
        weight=rows.weight,
        spectrum=_spectrum(rows.gram + outer * new.information),
        curves=curves_of.curves(problem.space, new.z, several, problem.batch),
        validity=curves_of.validity(data, problem.space.tree(jnp.asarray(new.z)), problem.batch),
        converged=fit.converged and new.settled,
        reason=fit.reason if new.settled or not fit.converged else unsettled,
        settings=dict(fit.settings) | {"mixed": dict(new.about)},
    )


def remaining(
    problem: Problem, z: Any, volt: Any, blocks: Any, jacobian: Any, roots: Any
) -> tuple[float, str]:
    """Largest step of a full Gauss-Newton step in posterior stds, and the number that takes it.

    delta = -(J^T W J + S^-2)^-1 (J^T W r + S^-2 (z - mean) - g), W with the weights of outliers, g
    the slope of log |d residuals / d data|; where currents do not inform motion, their rows move
    the electric numbers only.
    """
    own = np.ones(len(z)) if problem.joint else problem.electric.astype(float)
    prior = problem.space.prior_std**-2
    _, slope = problem.log_jacobian(z, volt, np.ones(len(problem.windows)))
    gradient = prior * (z - problem.space.prior_mean) - np.asarray(slope)
    info = np.diag(prior)
    for k, r in blocks.items():
        root = np.asarray(roots[k])
        white = np.einsum("nij,nj->ni", root, np.asarray(r)).ravel()
        half = np.einsum("nij,njp->nip", root, np.asarray(jacobian[k])).reshape(-1, len(z))
        half = half * (1.0 if k == "motion" else own)
        gradient = gradient + half.T @ white
        info = info + half.T @ half
    std = np.sqrt(np.diag(np.linalg.inv(info)))
    steps = np.abs(np.linalg.solve(info, gradient)) / std
    worst = int(np.argmax(steps))
    return float(steps[worst]), problem.space.names[worst]


def draws(z: Any, covariance: Any, count: int, seed: int) -> Float[np.ndarray, "draw free"]:
    """Draws of a Gaussian in the search space."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(np.asarray(covariance))
    return np.asarray(z) + rng.standard_normal((count, len(root))) @ root.T


def hash_of(runs: Iterable[tuple[str, str]]) -> str:
    """Hash of a set of runs from their names and file hashes, whatever their order."""
    lines = "".join(f"{name} {sha}\n" for name, sha in sorted(runs))
    return hashlib.sha256(lines.encode()).hexdigest()


def _robot_json(robot: Robot) -> dict[str, Any]:
    """A robot as plain values: its shape, its names, every number."""
    shape = robot.geometry
    return {
        "geometry": {
            "place": [list(p) for p in shape.place],
            "drive_angle": list(shape.drive_angle),
            "roller_angle": list(shape.roller_angle),
            "grips": list(shape.grips),
            "gear_ratio": shape.gear_ratio,
        },
        "surfaces": list(robot.surfaces.labels),
        "loads": list(robot.body.loads),
        "sessions": list(robot.camera.sessions),
        "centre": list(robot.camera.centre),
        "values": {e.path: np.asarray(e.get(robot)).tolist() for e in entries(robot)},
    }


def _robot_of(kept: Mapping[str, Any]) -> Robot:
    shape = kept["geometry"]
    geometry = Geometry(
        drive_offset=jnp.zeros(len(shape["place"])),
        place=tuple((p[0], p[1]) for p in shape["place"]),
        drive_angle=tuple(shape["drive_angle"]),
        roller_angle=tuple(shape["roller_angle"]),
        grips=tuple(shape["grips"]),
        gear_ratio=shape["gear_ratio"],
    )
    robot = build(
        geometry, kept["surfaces"], kept["loads"], kept["sessions"], centre=tuple(kept["centre"])
    )
    leaves: dict[tuple[str, ...], list[Any]] = {}
    whole: dict[tuple[str, ...], bool] = {}
    for e in entries(robot):
        leaves.setdefault(e.leaf, []).append(kept["values"][e.path])
        whole[e.leaf] = e.index is None
    values = [jnp.asarray(v[0] if whole[leaf] else v) for leaf, v in leaves.items()]

    def where(tree: Any) -> list[Any]:
        return [reduce(getattr, leaf, tree) for leaf in leaves]

    restored: Robot = eqx.tree_at(where, robot, values)
    return restored
