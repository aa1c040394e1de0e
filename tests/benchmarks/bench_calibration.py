"""Do intervals hold what they say? 200 made experiments with truths from the fit's own prior.

Ranks and intervals of every replicate are kept in the folder that SLIPID_BENCH names, if any, so
that an interrupted run goes on; the picture of the ranks goes there, too. A process of one thread
for every core: with more, they wait for each other and take twice the time.
"""

from __future__ import annotations

import json
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from scipy.stats import binom, chi2

from slipid.support.jax_setup import one_blas_thread
from tests.benchmarks.quick import QUICK, quick
from tests.helpers import calibration

REPLICATES = quick(200, 2)
VARIANCES, HELD_OUT = quick(60, 2), 1000
"""Number of experiments of which only the variances are drawn, and the seed of the first."""
BINS = 10


def test_coverage_and_ranks():
    folder = Path(os.environ.get("SLIPID_BENCH") or "/nonexistent")
    kept = folder / "calibration.jsonl"
    rows = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    names = list(calibration.names())
    rows = [row for row in rows if row.get("names") == names]
    began, done = time.perf_counter(), {row["seed"] for row in rows}
    missing = [k for k in range(REPLICATES) if k not in done]
    cores = len(os.sched_getaffinity(0))
    while missing:  # workers' memory grows, and a pool that replaces its workers may hang
        some, missing = missing[: 50 * cores], missing[50 * cores :]
        with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
            for answer in as_completed([pool.submit(replicate, k) for k in some]):
                rows.append(answer.result())
                if folder.is_dir():
                    with kept.open("a") as file:
                        file.write(json.dumps(rows[-1]) + "\n")
                took = time.perf_counter() - began
                print(f"{len(rows)}: {took:.0f} s, R-hat {rows[-1]['r_hat']:.3f}", flush=True)
    covered, even = report(rows, folder)
    assert QUICK or covered.all()
    assert QUICK or even.all()


def test_coverage_of_variances():
    """Intervals of variances, whose draws do not need those of the numbers."""
    seeds = range(HELD_OUT, HELD_OUT + VARIANCES)
    rank = np.array([calibration.variance_ranks(seed) for seed in seeds])
    report_kinds(calibration.problem().noise.names, rank)
    inside = (rank >= 0.05) & (rank <= 0.95)
    assert QUICK or inside.mean() > 0.85


def replicate(seed):
    """What is kept of one experiment, of a process of its own."""
    jax.config.update("jax_enable_x64", True)
    one_blas_thread()
    return calibration.row(calibration.replicate(seed)) | {"seed": seed}


def report(rows, folder):
    """Print it all; whether each number is covered as it says, and whether its ranks are even."""
    names = rows[0]["names"]
    rank, inside, ratio = (np.array([r[k] for r in rows]) for k in ("rank", "inside", "ratio"))
    count = len(rows)
    low, high = calibration.band(count, len(names))
    bins = np.stack([np.histogram(c, BINS, (0, 1))[0] for c in rank.T])
    uneven = ((bins - count / BINS) ** 2 / (count / BINS)).sum(axis=1)
    most = chi2.ppf(1 - 0.01 / len(names), BINS - 1)
    print(f"\n{count} replicates, R-hat {np.max([r['r_hat'] for r in rows]):.3f} at most")
    print(f"coverage must be {low:.3f} to {high:.3f}, chi square of the ranks below {most:.1f}")
    print(f"{'coordinate':32}{'std/prior':>10}{'coverage':>10}{'chi2':>7}  ranks")
    for k, name in enumerate(names):
        print(
            f"{name:32}{np.median(ratio[:, k]):10.3f}{inside[:, k].mean():10.3f}{uneven[k]:7.1f}  "
            + " ".join(f"{n:3d}" for n in bins[k])
        )
    print(f"all together: coverage {inside.mean():.4f}")
    variances = [k for k, name in enumerate(names) if name.startswith("noise.")]
    report_kinds([names[k].removeprefix("noise.") for k in variances], rank[:, variances])
    repeated = [k for k, name in enumerate(names) if name.startswith("repeated.")]
    print_kinds({"repeated runs": repeated}, rank)
    if folder.is_dir():
        draw(names, bins, count, folder / "ranks.png")
    share = inside.mean(axis=0)
    return (low <= share) & (share <= high), uneven < most


def report_kinds(names, rank):
    """Print the coverage of each kind of variance, its Monte Carlo error, and the ranks."""
    kinds = {}
    for k, name in enumerate(names):
        kind, *_, what = name.split(".")
        of_axis = kind in ("process", "run", "neighbours", "session")
        kinds.setdefault(kind if of_axis else f"{kind}.{what}", []).append(k)
    print_kinds(kinds | {"all": list(range(len(names)))}, rank)


def print_kinds(kinds, rank):
    """Print the coverage of kinds of coordinates (their places), and their ranks."""
    print(f"\n{len(rank)} experiments, coverage of 90 % intervals with its Monte Carlo error")
    for kind, mine in kinds.items():
        of = rank[:, mine]
        share = ((of >= 0.05) & (of <= 0.95)).mean(axis=1)
        print(
            f"{kind:20}{len(mine):4d}{share.mean():8.3f} +- {share.std() / np.sqrt(len(of)):.3f}  "
            + " ".join(f"{n:3d}" for n in np.histogram(of, BINS, (0, 1))[0])
        )


def draw(names, bins, count, path):
    """Rank histograms with the band that 99 % of uniform ones stay in."""
    from slipid.plots import drawing

    made, axes = drawing.panels(
        len(names),
        2.1,
        1.5,
        f"Ranks of the truth among draws, {count} made experiments\n"
        "(gray: where 99 % of bins of a right posterior are)",
    )
    low, high = binom.ppf((0.005, 0.995), count, 1 / BINS)
    for ax, name, row in zip(axes, names, bins, strict=False):
        drawing.plain(ax)
        ax.axhspan(low, high, color="#dddddd", zorder=0)
        ax.bar((np.arange(BINS) + 0.5) / BINS, row, 0.09, color=drawing.BLUE)
        ax.set_title(name.removeprefix("surface."), fontsize=7)
        ax.set_xticks([0, 1])
        ax.tick_params(labelsize=7)
    drawing.save(made, path)
