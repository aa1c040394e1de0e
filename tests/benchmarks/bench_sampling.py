"""The posterior of one real floor by slipid, by NUTS and by stock emcee: do they agree, how fast?

All three see the motion part of the same posterior (2022 logs of one floor, what runs share
marginalised) and begin at its Laplace approximation, whose covariance NUTS has as its metric. emcee
has its default move and the same likelihood in vectorised numpy. Time is that of sampling after the
warm-up; reading, fitting and compiling are left out.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from tests.benchmarks.quick import QUICK, quick

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SLIPID_DATA") or ROOT.parent / "shared" / "data") / "robotino2022"
FLOOR = os.environ.get("SLIPID_BENCH_FLOOR", "brown")
LONGER = int(os.environ.get("SLIPID_BENCH_LONGER", "1"))
"""Factor on the numbers of draws of NUTS."""
STRETCH_S, NUTS_WARM_UP, NUTS_DRAWS = quick((240.0, 400, 1500 * LONGER), (5.0, 10, 20))
CHAINS = quick(2, 1)

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"no real logs: {DATA} is no folder")


def problem_of(floor):
    """Likelihood of the runs on one floor."""
    from slipid.app.config import read_config
    from slipid.app.logs import read_dataset
    from slipid.app.problem import fit_task
    from slipid.support.jax_setup import setup_jax
    from slipid.support.progress import Reporter

    setup_jax(quiet=True)
    config = read_config(ROOT / "configs" / "robotino2022.toml")
    logs = config.content.logs
    dataset, _ = read_dataset(config, logs, DATA, Reporter(quiet=True))
    mine = [k for k, log in enumerate(dataset.logs) if log.surface == floor][:: quick(1, 3)]
    return fit_task(config, dataset.subset(mine), [], Reporter(quiet=True)).problem()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The problem, where its fit ended, and a file of the latter."""
    from slipid.fitting.optimise import optimise
    from slipid.infer.posterior.coordinates import Fitted

    problem = problem_of(FLOOR)
    optimum = optimise(problem)
    found = Fitted(optimum.state.z, optimum.state.log_variance, optimum.covariance)
    path = tmp_path_factory.mktemp("fit") / "fitted.pickle"
    path.write_bytes(pickle.dumps(found))
    return problem, found, path


def density_of(problem, found):
    from slipid.infer.posterior.coordinates import MOTION
    from slipid.infer.posterior.density import Density

    return Density(problem, found, MOTION)


def ess_of(chain):
    """Effective draws of every coordinate, bulk or tails (chain, draw, coordinate)."""
    from arviz_stats.base import array_stats

    return np.minimum(
        array_stats.ess(chain, chain_axis=0, draw_axis=1, method="bulk"),
        array_stats.ess(chain, chain_axis=0, draw_axis=1, method="tail", prob=(0.05, 0.95)),
    )


def by_slipid(density):
    """Chains (chain, draw, coordinate), seconds of sampling and of the warm-up."""
    from slipid.infer.posterior import ensemble as sampler
    from slipid.infer.posterior.blocks import Plan
    from slipid.infer.posterior.coordinates import MOTION
    from slipid.infer.posterior.diagnosis import diagnose
    from slipid.support.progress import Reporter

    d, target = density, density.target()
    few = Plan(ensembles=2, walkers=16, block=10, warm_up=(1, 2), most=7, rows=200)
    plan = quick(Plan(), few)
    d.terms(d.centre[None])  # compiles
    times, report = [time.perf_counter()], Reporter(quiet=True)
    report.advance = lambda *_: times.append(time.perf_counter())
    blocks = sampler.extended(target, plan, MOTION, None, report)
    warm = sampler.warm_up(blocks, plan)
    chain = sampler.chain(blocks, plan)
    found = diagnose(chain, plan)
    print(f"slipid: {found.steps} steps, R-hat {found.r_hat.max():.4f}, {found.converged=}")
    walkers = chain.transpose(0, 2, 1, 3).reshape(-1, chain.shape[1], d.size)
    return walkers, times[-1] - times[warm], times[warm] - times[0]


def by_nuts(path):
    """The same by numpyro, each chain in a process of its own, side by side."""
    files = [path.with_name(f"nuts{k}.npz") for k in range(CHAINS)]
    command, env = [sys.executable, __file__, str(path)], os.environ | {"PYTHONPATH": str(ROOT)}
    runs = [
        subprocess.Popen([*command, str(k), str(file)], cwd=ROOT, env=env)
        for k, file in enumerate(files)
    ]
    assert [run.wait() for run in runs] == [0] * CHAINS
    made = [np.load(file) for file in files]
    seconds = max(float(m["seconds"]) for m in made)
    return np.stack([m["x"] for m in made]), seconds, max(float(m["warm_up"]) for m in made)


def nuts(path, seed, out):
    """One chain of NUTS in coordinates in which the Laplace approximation is standard."""
    import jax
    import jax.numpy as jnp
    from numpyro.infer import MCMC, NUTS

    d = density = density_of(problem_of(FLOOR), pickle.loads(Path(path).read_bytes()))
    root = np.linalg.cholesky(d.covariance)

    @jax.jit
    def potential(u):
        return -density.log_prob(density.anchor, d.centre + root @ u, None)

    kernel = NUTS(potential_fn=potential, dense_mass=False)
    chain = MCMC(kernel, num_warmup=NUTS_WARM_UP, num_samples=NUTS_DRAWS, progress_bar=False)
    first = jnp.asarray(np.random.default_rng(seed).standard_normal(density.size))
    key = jax.random.PRNGKey(seed)
    began = time.perf_counter()
    chain.warmup(key, init_params=first)
    warm = time.perf_counter()
    chain.run(chain.post_warmup_state.rng_key)
    u = np.asarray(chain.get_samples())
    seconds = time.perf_counter() - warm
    np.savez(out, x=d.centre + u @ root.T, seconds=seconds, warm_up=warm - began)


def by_stretch(density, draws):
    """The same by emcee as it comes, from draws of the posterior on: how far does it move?

    Its chains are too slow for an autocorrelation time to be read off them. With m half the mean
    square of what the normal score of a coordinate (its rank among the draws, as in bulk effective
    draws) moves in t steps, its correlation is 1 - m after them, and its autocorrelation time
    2 t / -log(1 - m) if that decays as it began; if it decays more slowly later, as sums of
    exponentials do, it is longer. The slowest coordinate is found with one half of the walkers and
    measured with the other.
    """
    import emcee
    from threadpoolctl import threadpool_limits

    from tests.helpers.numpy_model import Posterior

    rival, size = Posterior(density), density.size
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(rival(draws[:4]), density.terms(draws[:4]).sum(axis=1), atol=1e-5)
    walkers = 2 * size
    start = draws[rng.choice(len(draws), walkers, replace=False)]
    ensemble = emcee.EnsembleSampler(walkers, size, rival, vectorize=True)
    places, began = [], time.perf_counter()
    with threadpool_limits(1):
        for state in ensemble.sample(start, iterations=10**9, store=False):
            places.append(state.coords.copy())
            if time.perf_counter() - began > STRETCH_S:
                break
    seconds = time.perf_counter() - began
    x, lag, ordered = np.stack(places), len(places) // 2, np.sort(draws, axis=0)
    rank = [np.searchsorted(ordered[:, k], x[..., k]) for k in range(size)]
    score = norm.ppf((np.stack(rank, axis=-1) + 0.5) / (len(draws) + 1))
    moved = 0.5 * ((score[lag:] - score[:-lag]) ** 2).mean(axis=0)
    slowest = int(moved[::2].mean(axis=0).argmin())
    m = float(np.clip(moved[1::2, slowest].mean(), 1e-6, 0.99))
    tau = max(1.0, -2 * lag / np.log1p(-m))
    print(
        f"stretch: {len(x)} steps of {walkers} walkers, "
        f"{1e3 * seconds / len(x) / walkers:.2f} ms an evaluation; {density.names[slowest]} moves "
        f"by {m:.3f} in {lag} steps: an autocorrelation time of {tau:.0f} or more"
    )
    return walkers * len(x) / tau, seconds


def test_agreement_and_speed(fitted):
    problem, found, path = fitted
    density = density_of(problem, found)
    print(f"\n{FLOOR}: {len(problem.windows)} pieces, {density.size} coordinates")
    ours = by_slipid(density)
    rows = {"slipid": ours, "NUTS": by_nuts(path)}
    speed, flat = {}, ours[0].reshape(-1, density.size)
    for name, (chain, took, before) in rows.items():
        ess, other = ess_of(chain), chain.reshape(-1, density.size)
        speed[name] = ess.min() / took
        print(
            f"{name:21} {took:4.0f} s after {before:4.0f} s of warm-up: effective draws "
            f"{ess.min():6.0f} ({density.names[int(ess.argmin())]}), median {np.median(ess):6.0f}; "
            f"{speed[name]:.2f} a second"
        )
        mean, std = np.abs(flat.mean(0) - other.mean(0)) / other.std(0), flat.std(0) / other.std(0)
        worst, wide = int(mean.argmax()), int(np.abs(std - 1).argmax())
        print(
            f"{'':21} means differ from slipid's by at most {mean.max():.3f} std "
            f"({density.names[worst]}), stds by {100 * abs(std[wide] - 1):.1f} % "
            f"({density.names[wide]})"
        )
        error = np.hypot(1 / np.sqrt(ess), 1 / np.sqrt(ess_of(ours[0])))
        off = np.abs(flat.mean(0) - other.mean(0)) / other.std(0) / error
        print(
            f"{'':21} in Monte Carlo errors: {np.sqrt((off**2).mean()):.2f} (root mean square), "
            f"{off.max():.1f} at most"
        )
    draws, took = by_stretch(density, flat)
    speed["stretch"] = draws / took
    print(f"stretch  {draws:.0f} effective draws in {took:.0f} s, {speed['stretch']:.4f} a second")
    for name in ("NUTS", "stretch"):
        print(f"slipid is {speed['slipid'] / speed[name]:.1f} times as fast as {name}")
    assert QUICK or mean.max() < 0.1
    assert QUICK or np.abs(std - 1).max() < 0.1
    assert QUICK or speed["slipid"] > 3 * speed["NUTS"]
    assert QUICK or speed["slipid"] > 100 * speed["stretch"]


if __name__ == "__main__":
    nuts(sys.argv[1], int(sys.argv[2]), sys.argv[3])
