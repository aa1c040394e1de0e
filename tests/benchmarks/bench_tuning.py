"""Gains by gradient, by a particle swarm on the same budget, and by hand, on cases not tuned on.

Needs a folder `slipid identify` wrote, named by SLIPID_FIT. Every seed is another draw of robots,
floors, starts, noise and of the search; intervals are over seeds. A case's gain over the hand set
gains is compared with itself, since floors differ more than controllers do.
"""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

SEEDS, ROLLOUTS, JUDGED = 5, 3360, 96


def test_gradient_against_swarm_and_hand(robot):
    rows = compared(robot)
    report(rows)
    # which one wins is what the table says; gains that are handed over must be stable
    for method in ("gradient", "pso"):
        assert len(rows[method]) == SEEDS
        assert min(margin for *_, margin in rows[method]) > 0


def compared(robot, seeds=SEEDS, rollouts=ROLLOUTS):
    """Losses of every method and seed on cases that no search has seen."""
    from slipid.control.controller import Gains
    from slipid.control.tuning.objective import HAND, evaluate
    from slipid.control.tuning.optimisers import Search
    from slipid.deploy import tune

    task = tune.task_of(robot, gyro=False)
    judged = tune.cases(tune.robots_of(robot, 1000)[1], JUDGED, 1000)
    rows = {"hand": [(evaluate(task, HAND, judged), np.asarray(HAND), 0.0)]}
    for seed in range(seeds):
        robots = tune.robots_of(robot, seed)[0]
        stable = jax.tree.map(lambda x: x[: tune.STABLE], robots)
        cases = tune.cases(robots, tune.TRIED, seed)
        for method in ("gradient", "pso"):
            search = Search(task, cases, stable, method, rollouts, seed)
            state, began = search.start(), time.perf_counter()
            while not search.done(state):
                state = search.step(state)
            best = search.best(state)
            took = time.perf_counter() - began
            margin = float(task.margins(Gains.at(best), stable).min())
            rows.setdefault(method, []).append((evaluate(task, best, judged), best, margin))
            print(f"{method} {seed}: {np.round(best, 3)}, {took:.0f} s", flush=True)
    return rows


def report(rows):
    """Print the table."""
    from slipid.control.tuning.objective import combined

    hand = rows["hand"][0][0]
    print(f"\n{'':10}{'mean [mm]':>20}{'mean + worst tenth':>22}{'better in':>11}{'margin':>9}")
    for method, found in rows.items():
        mean = [losses.mean() for losses, *_ in found]
        both = [float(combined(jnp.asarray(losses))) for losses, *_ in found]
        wins = np.mean([(losses < hand).mean() for losses, *_ in found])
        margin = min(m for *_, m in found)
        print(f"{method:10}{_interval(mean):>20}{_interval(both):>22}{wins:11.0%}{margin:9.4f}")


def _interval(values):
    """Mean, and what it is uncertain by over seeds (90 %)."""
    if len(values) == 1:
        return f"{values[0]:.1f}"
    from scipy.stats import t

    half = t.ppf(0.95, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{np.mean(values):.1f} +- {half:.1f}"
