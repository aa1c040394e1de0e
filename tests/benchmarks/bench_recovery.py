"""Known truth over 40 seeds: errors, z-scores and their spread, starting two-fold off."""

from __future__ import annotations

import time

import numpy as np

from tests.benchmarks.quick import QUICK, quick
from tests.helpers import recovery

SEEDS = quick(40, 1)


def test_recovery_over_seeds():
    found, began = [], time.perf_counter()
    for seed in range(SEEDS):
        found.append(recovery.recover(seed))
        seconds = time.perf_counter() - began
        print(f"seed {seed}: {seconds:.0f} s, converged {found[-1].converged}", flush=True)
    summary(found)
    by_plan = recovery.design()
    z = np.stack([f.score for f in found])[:, by_plan]
    of_load = np.array(["load" in name for name in np.array(found[0].names)[by_plan]])
    for path in ("motor.resistance", "motor.back_emf"):
        assert QUICK or max(abs(f.relative_error(path)) for f in found) < 0.02
    assert QUICK or max(gap for f in found for gap in f.curve_gap.values()) < 0.02
    assert QUICK or 0.8 < z[:, ~of_load].std() < 1.25
    assert (
        QUICK or z[:, of_load].std() < 1.25
    )  # two floors cannot show that their law is right about loads
    assert QUICK or np.abs(z).max() < 4
    assert QUICK or all(f.converged for f in found)


def summary(found):
    names, by_plan = found[0].names, recovery.design()
    z = np.stack([f.score for f in found])
    std = np.stack([f.std for f in found])
    verdict = np.stack([f.identified for f in found])
    print(f"{'coordinate':34}{'plan':>5}{'fits':>6}{'std':>8}{'z mean':>8}{'z std':>7}{'max':>6}")
    for k, name in enumerate(names):
        row = z[:, k]
        print(
            f"{name:34}{'yes' if by_plan[k] else '-':>5}{verdict[:, k].mean():6.0%}"
            f"{np.median(std[:, k]):8.4f}{row.mean():+8.2f}{row.std():7.2f}{np.abs(row).max():6.2f}"
        )
    for path in ("motor.resistance", "motor.back_emf"):
        worst = max(abs(f.relative_error(path)) for f in found)
        print(f"{path}: largest error {worst:.2%}")
    for floor in found[0].curve_gap:
        gaps = [f.curve_gap[floor] for f in found]
        print(
            f"curve of {floor}: largest error {max(gaps):.4f} in slip, median {np.median(gaps):.4f}"
        )
    sensors = recovery.SimulatedSensors()
    for name in found[0].noise:
        if name.startswith(("camera", "process", "run")):
            got = np.array([f.noise[name] for f in found])
            print(
                f"{name:24} true {sensors.of(name):.4f} mean {got.mean():.4f} std {got.std():.4f}"
            )
    load = np.array(["load" in name for name in names])
    planned = {"but loads": by_plan & ~load, "loads": by_plan & load}
    shown = [(f"by plan, {k}", np.broadcast_to(v, z.shape)) for k, v in planned.items()]
    for label, chosen in (*shown, ("by fit", verdict)):
        picked = z[chosen]
        print(
            f"identified {label}: {picked.size} z-scores, std {picked.std():.3f}, "
            f"rms {np.sqrt((picked**2).mean()):.3f}, largest {np.abs(picked).max():.2f}, "
            f"{(np.abs(picked) > 4).sum()} above 4"
        )
