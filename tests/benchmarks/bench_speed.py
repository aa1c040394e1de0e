"""Speed of the likelihood and of the whole 2022 fit, as ratios within one run.

The rival is the same model in vectorised numpy, all windows at once, warmed up, with one forward
difference per parameter; both must give the same residuals.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.fitting.problem import Problem
from slipid.search_space import Choice
from tests.benchmarks.quick import QUICK, quick
from tests.helpers.made_windows import made, robot
from tests.helpers.numpy_model import Rival, numbers

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("SLIPID_DATA") or ROOT.parent / "shared" / "data") / "robotino2022"


@pytest.fixture(scope="module")
def problem():
    """The 2022 fit where its logs are present, else made windows of the same size."""
    if DATA.is_dir():
        return real_job().problem()
    floors = ("brown", "gray", "green", "table")
    truth = robot(floors=floors, sessions=tuple("abcdefghi"))
    w = made(truth, runs=quick(472, 48), count=4, signed=False, voltage=False)
    return Problem(
        w, truth, [Choice("camera.*", free=True), Choice("robot.drive_offset", free=True)]
    )


def real_job():
    from slipid.app.config import read_config
    from slipid.app.problem import fit_task, read_fit_task
    from slipid.support.progress import Reporter

    config = read_config(ROOT / "configs" / "robotino2022.toml")
    job = read_fit_task(config, DATA, Reporter(quiet=True))
    if not QUICK:
        return job
    few = job.dataset.subset(np.arange(0, len(job.dataset), 7))
    return fit_task(config, few, [], Reporter(quiet=True))


def best_of(function, repeats):
    """Shortest of several times [s], and the last result; the first call is not timed."""
    result = jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        result = jax.block_until_ready(function())
        times.append(time.perf_counter() - began)
    return min(times), result


def electric(problem, z):
    """What voltages are predicted with, at typical variances."""
    return problem.electric(z, 2 * np.log(problem.noise.typical))


# measurements --------------------------------------------------------------------------------


def test_residual_and_jacobian_against_numpy(problem):
    z, rival = problem.space.start, Rival(problem)
    noise = electric(problem, z)
    ours, (blocks, jacobian) = best_of(lambda: problem.linear(z, noise), quick(10, 2))
    step = 1e-6
    moved = [numbers(problem.space.tree(jnp.asarray(z + step * e))) for e in np.eye(len(z))]
    here = numbers(problem.space.tree(jnp.asarray(z)))

    def differences():
        r = rival.residuals(here)
        return r, [{k: (x - r[k]) / step for k, x in rival.residuals(v).items()} for v in moved]

    theirs, (r, columns) = best_of(differences, 1)
    assert set(r) == set(blocks) - {"voltage"}
    for k in r:
        np.testing.assert_allclose(blocks[k], r[k], atol=1e-8)
        numeric = np.stack([c[k] for c in columns], axis=-1)
        np.testing.assert_allclose(jacobian[k], numeric, atol=1e-3 * np.abs(numeric).max())
    what = "2022 logs" if DATA.is_dir() else "made data"
    print(
        f"\n{what}: {len(problem.windows)} pieces, {len(z)} parameters. Residual and Jacobian: "
        f"slipid {ours * 1e3:.0f} ms, numpy {theirs * 1e3:.0f} ms, ratio {theirs / ours:.1f}"
    )
    assert QUICK or theirs > ours


def repeated(windows, times):
    """The same windows several times over, as of other runs."""

    def again(value):
        return np.concatenate([value] * times) if isinstance(value, np.ndarray) else value * times

    many = {
        f.name: again(getattr(windows, f.name))
        for f in fields(windows)
        if isinstance(getattr(windows, f.name), np.ndarray | tuple)
    }
    number = windows.run.max() + 1
    runs = [windows.run + k * number for k in range(times)]
    return replace(windows, **many | {"run": np.concatenate(runs)})


def test_cost_is_linear_in_the_number_of_runs(problem):
    z, once = problem.space.start, None
    for times in quick((1, 2, 4), (1, 2)):
        more = problem.of(repeated(problem.windows, times))
        noise = electric(more, z)
        took, _ = best_of(lambda more=more, noise=noise: more.linear(z, noise), 5)
        once = once or took
        print(f"\n{times} x the runs: {took / once:.2f} x the time", end="")
    print()
    assert QUICK or took < 8 * once


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real logs: {DATA} is no folder")
def test_whole_2022_fit_cold_and_warm(tmp_path):
    """Two processes one after the other; the first finds an empty cache of compiled functions."""
    cache = {"SLIPID_CACHE": str(tmp_path), "PYTHONPATH": str(ROOT)}
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")} | cache
    env["JAX_PLATFORMS"] = "cpu"
    for name in ("cold", "warm"):
        done = subprocess.run(
            [sys.executable, __file__], env=env, capture_output=True, text=True, check=True
        )
        took = json.loads(done.stdout.splitlines()[-1])
        print(f"\n{name}: " + ", ".join(f"{k} {v}" for k, v in took.items()), end="")
    print()
    assert QUICK or took["converged"]


def main():
    """The whole 2022 fit, once, with the time of each stage."""
    began = time.perf_counter()
    from slipid.fitting.optimise import optimise
    from slipid.support.jax_setup import setup_jax

    setup_jax(quiet=True)
    job = real_job()
    fit = job.config.content.fit
    read = time.perf_counter()
    problem = job.problem()
    optimum = optimise(problem, most_rounds=quick(fit.rounds, 2), tolerance=fit.tolerance)
    done = time.perf_counter()
    took = {
        "runs": len(job.dataset),
        "parameters": problem.space.size,
        "reading_s": round(read - began, 1),
        "fit_s": round(done - read, 1),
        "rounds": optimum.state.round,
        "converged": optimum.converged,
    }
    print(json.dumps(took))


if __name__ == "__main__":
    main()
