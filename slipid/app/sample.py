"""`slipid sample`: blocks on disk while it runs, then posterior.nc and intervals from the draws."""

import hashlib
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax.numpy as jnp
import numpy as np

from slipid.app import files
from slipid.app.progress import Reporter
from slipid.data.files import read_json, write_arrays, write_json
from slipid.data.log import DataError
from slipid.identify import curves as curves_of
from slipid.identify.density import ELECTRIC, Fitted
from slipid.identify.identifiability import (
    NEEDS_VOLTAGE,
    Estimate,
    by_ratio,
    derived,
    from_zero,
    provenance,
)
from slipid.identify.posterior import Posterior
from slipid.identify.result import Fit, as_identified
from slipid.identify.sampler import FORMAT, Block, Plan, packed, unpacked

FOLDER = "sampling"


class Blocks:
    """Blocks of a chain as files `<part>-<number>.npz` of a folder, for one job only.

    Args:
        folder: made with the first block.
        key: of everything the chain depends on; blocks with another one are not used.
    """

    def __init__(self, folder: Path, key: str):
        self.folder, self.key = folder, key

    def keep(self, part: str, block: Block) -> None:
        """Write a block, whole or not at all."""
        arrays = packed(block) | {"key": np.asarray(self.key)}
        write_arrays(self.folder / f"{part}-{block.number:04d}.npz", arrays, compress=False)

    def read(self, part: str) -> list[Block]:
        """Blocks from the first on, up to one that is absent, damaged or of another job."""
        found: list[Block] = []
        while True:
            block = self._one(self.folder / f"{part}-{len(found):04d}.npz")
            if block is None:
                return found
            found.append(block)

    def _one(self, path: Path) -> Block | None:
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
                if str(kept["key"]) != self.key:
                    return None
                return unpacked({k: kept[k] for k in kept.files})
        except (OSError, EOFError, KeyError, TypeError, ValueError, BadZipFile):
            return None

    def remove(self) -> None:
        """Take all blocks away."""
        for path in self.folder.glob("*-????.npz"):
            path.unlink()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()


def key(fit: Fit, plan: Plan, draws: int) -> str:
    """Hash of everything a chain depends on."""
    same = [f"blocks {FORMAT}", fit.data_hash, str(replace(plan, most=0))]
    same += [
        *map(str, files.versions().items()),
        str(draws),
        fit.z.tobytes().hex(),
        np.asarray(fit.laplace).tobytes().hex(),
    ]
    same += [f"{k} {v!r}" for k, v in fit.variance.items()]
    return hashlib.sha256("\n".join(same).encode()).hexdigest()


def sample(
    out: Path, fit: Fit, problem: Any, plan: Plan, draws: int, report: Reporter
) -> Posterior:
    """Posterior of a fit, going on from the blocks an earlier call has left in `out`."""
    from slipid.identify import posterior

    kept = Blocks(out / FOLDER, key(fit, plan, draws))
    watch = Watch(plan, report)

    def done(part: str) -> list[Block]:
        blocks = kept.read(part)
        if blocks:
            report.line(f"going on from block {len(blocks)} ({part}) of {kept.folder}")
        return blocks

    def keep(part: str, block: Block) -> None:
        kept.keep(part, block)
        watch.block(part, block)

    variance = np.array([fit.variance[name] for name in problem.noise.names])
    shared = {k: v for k, v in fit.variance.items() if k.startswith("session.")}
    return posterior.sample(
        problem,
        Fitted(fit.z, np.log(variance), fit.laplace, shared),
        plan,
        draws=draws,
        done=done,
        keep=keep,
        tell=watch.steps,
    )


class Watch:
    """Progress of a chain: how far it is, and how long it takes at most if it goes on like this."""

    def __init__(self, plan: Plan, report: Reporter):
        self.plan, self.report = plan, report
        self.began, self.made = time.monotonic(), 0

    def steps(self, part: str, steps: int) -> None:
        """Every ensemble has done so many steps of a block."""
        self.report.stage(f"sampling {part}")

    def block(self, part: str, block: Block) -> None:
        """A block is done and kept."""
        count = block.number + 1
        self.made += 1
        warm = left = ""
        if not part.startswith(ELECTRIC):
            warm = "warm-up, " if count <= self.plan.warm_up[-1] else ""
            each = (time.monotonic() - self.began) / self.made
            left = f", {max(self.plan.most - count, 0) * each / 60:.0f} min more at most"
        self.report.line(
            f"  block {count}: {warm}{count * block.chain.shape[1]} steps, "
            f"{100 * block.accepted.mean():.0f} % moved, "
            f"log density {block.log_prob[:, -1].mean():.1f}{left}"
        )


def estimates(fit: Fit, found: Posterior) -> dict[str, Estimate]:
    """Every number with mean, interval and verdict from the draws.

    Means are taken in the search space, so that shares sum to one and positive numbers have their
    geometric mean.
    """
    flat = found.z.reshape(-1, fit.space.size)
    out = dict(fit.parameters)
    for e in fit.space.free:
        at, d, old = fit.space.place[e.path], e.declaration, fit.parameters[e.path]
        z = flat[:, at]
        values = np.stack([np.asarray(d.to_si(jnp.asarray(row))) for row in z])
        low, high = np.quantile(values, [0.05, 0.95], axis=0)
        scaled = np.cov((z / fit.space.prior_std[at]).T).reshape(e.coordinates, e.coordinates)
        ratio = float(np.sqrt(np.linalg.eigvalsh(scaled)[-1]))
        pairs = tuple(zip(low.tolist(), high.tolist(), strict=True))
        mean = np.asarray(d.to_si(jnp.asarray(z.mean(axis=0)))).tolist()
        std = values.std(axis=0).tolist()
        single = len(pairs) == 1
        kept = old.verdict == "at_bound" or (e.path in NEEDS_VOLTAGE and not fit.has["voltage"])
        verdict = old.verdict if kept else by_ratio(ratio, from_zero(d, z.std(axis=0)))
        pull = (z.mean(axis=0) - fit.space.prior_mean[at]) / fit.space.prior_std[at]
        out[e.path] = replace(
            old,
            value=mean[0] if single else tuple(mean),
            std=std[0] if single else tuple(std),
            interval90=pairs[0] if single else pairs,
            ratio=ratio,
            verdict=verdict,
            provenance=provenance(verdict, ratio),
            pull=float(pull[np.argmax(np.abs(pull))]),
            source="posterior",
        )
    return out


def _drawn(ratio: Estimate, fit: Fit, flat: np.ndarray) -> Estimate:
    """A quotient with the interval and the std of its draws."""
    over, under = (fit.space.place[path] for path in ratio.path.rsplit("/", 1))
    draws = np.exp(flat[:, over] - flat[:, under])
    low, high = np.quantile(draws, [0.05, 0.95]).tolist()
    std = float(draws.std())
    return replace(ratio, std=std, interval90=(low, high), source="posterior")


def identified(fit: Fit, found: Posterior, problem: Any) -> dict[str, Any]:
    """Content of identified.json with what the posterior says."""
    numbers = estimates(fit, found)
    content = fit.to_identified()
    for path, e in numbers.items():
        content["parameters"][path] = as_identified(e)
    flat = found.z.reshape(-1, fit.space.size)
    ratios = derived(fit.space, flat.mean(axis=0), np.cov(flat.T), fit.has["voltage"])
    content["derived"] = {e.path: as_identified(_drawn(e, fit, flat)) for e in ratios}
    some = flat[:: max(1, len(flat) // 400)]
    content["curves"] = curves_of.curves(fit.space, flat.mean(axis=0), some, problem.batch)
    if not found.converged:
        content["messages"].append(f"the posterior did not converge: {found.reason}")
    return content


def summary(found: Posterior, plan: Plan, seconds: float) -> dict[str, Any]:
    """Content of sample.json: what was done and whether to believe it."""
    d = found.diagnosis
    return {
        "schema": "slipid.sample/1",
        "converged": found.converged,
        "reason": found.reason,
        "ensembles": plan.ensembles,
        "walkers": plan.walkers,
        "steps": d.steps,
        "draws": int(np.prod(found.log_prob.shape)),
        "seconds": round(seconds, 1),
        "accepted": found.accepted,
        "electric_unsettled": found.unsettled,
        "seed": plan.seed,
        "worst": {
            "r_hat": float(np.max(d.r_hat)),
            "steps_per_tau": float(d.steps / np.max(d.tau)),
            "effective_draws": float(np.min(d.ess)),
        },
        "coordinates": {
            name: {"r_hat": float(r), "tau": float(t), "effective_draws": float(n)}
            for name, r, t, n in zip(found.names, d.r_hat, d.tau, d.ess, strict=True)
        },
        "versions": files.versions(),
    }


def where_the_logs_are(out: Path, data: Path | None) -> Path:
    """The data folder: as given, else where the fit found its logs.

    Raises:
        DataError: not given and no longer there.
    """
    if data is not None:
        return data
    run = read_json(out / "run.json", "what `slipid identify` keeps of a run")
    folder = Path(run["data"]["folder"])
    if not folder.is_dir():
        raise DataError(f"{folder}: the logs were fitted from there; expected --data DIR")
    return folder


def on_one_floor(fit: Fit) -> None:
    """Refuse a fit that learnt from runs over several floors: their likelihood is not sampled.

    Raises:
        DataError: it did.
    """
    if "mixed" in fit.settings:
        raise DataError(
            "the fit learnt from runs over several floors, which are not sampled yet; "
            "expected a fit without the log sections that have a map (identify again without them)"
        )


def same_logs(fit: Fit, job: Any) -> None:
    """Refuse logs other than those that were fitted.

    Raises:
        DataError: names the first that differs.
    """
    then, now = dict(fit.runs), {log.name: log.sha256 for log in job.dataset.logs}
    for name in [*then, *now]:
        if then.get(name) != now.get(name):
            what = "is missing" if name not in now else "is new" if name not in then else "changed"
            raise DataError(f"{name}: {what} since the fit; expected the very logs it was made of")


def write(out: Path, content: dict[str, Any], about: dict[str, Any]) -> None:
    """Update identified.json and write sample.json."""
    write_json(out / "identified.json", content)
    write_json(out / "sample.json", about)
