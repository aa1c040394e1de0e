"""Runs over several floors as a part of a fit, on robots of the test site and in the 2022 logs.

Robots drawn anew drive over four floors, one at a time, and over a patchwork of them. Each robot is
fitted without and with the runs over the patchwork, and its runs over another patchwork, which no
fit has, are predicted. Both fits then drive the rectangle of `slipid trial` on the test site.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

from slipid.cli.main import app
from tests.benchmarks.quick import QUICK, quick
from tests.benchmarks.record import record

ROOT = Path(__file__).resolve().parents[2]
SEEDS = quick((41, 42), (41,))
STARTS = quick(40, 1)
FLOORS = quick(("firm", "medium", "soft", "short"), ("firm", "soft"))
SITE = """
seed = {seed}
[robot]
centres_m = {{ as_built = {first}, moved = {second} }}
[maps]
site = {{ kind = "patchwork", surfaces = {floors}, seed = {seed}, patch_m = 0.25 }}
other = {{ kind = "patchwork", surfaces = {floors}, seed = 1{seed}, patch_m = 0.25 }}
"""
ONE_FLOOR = """
[[runs]]
kind = "headings"
surface = "{surface}"
load = "{load}"
step_deg = {step}
speeds_m_s = [0.1, 0.2]
distance_m = 0.6
[[runs]]
kind = "curves"
surface = "{surface}"
load = "{load}"
count = 2
distance_m = 0.6
"""
WANDER = '[[runs]]\nkind = "wander"\nmap = "{map}"\ncount = {count}\n'
FITS = {"one floor at a time": ("site", "other"), "and over several": ("other",)}
"""Fits, each with the maps whose runs it does not have."""


def invoke(*words: object) -> str:
    result = CliRunner().invoke(app, [str(w) for w in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def simulated(seed: int, out: Path) -> Path:
    """Simulate the runs of a robot; return the config that identifies it."""
    rng = np.random.default_rng([11, seed])
    centres = [
        [float(v) for v in rng.uniform(0.004, 0.022) * np.array([np.cos(a), np.sin(a)])]
        for a in rng.uniform(-np.pi, np.pi, 2)
    ]
    text = SITE.format(seed=seed, first=centres[0], second=centres[1], floors=list(FLOORS))
    for surface in FLOORS:
        for load in ("as_built", "moved") if surface == "soft" else ("as_built",):
            text += ONE_FLOOR.format(surface=surface, load=load, step=quick(30, 90))
    for name, count in (("site", quick(24, 4)), ("other", quick(12, 2))):
        text += WANDER.format(map=name, count=count)
    out.mkdir(parents=True, exist_ok=True)
    (out / "site.toml").write_text(text, encoding="utf-8")
    invoke("simulate", out / "site.toml", "--out", out, "--quiet")
    return out / "robot.toml"


def without(config: Path, maps: tuple[str, ...], name: str) -> Path:
    """Write a config beside another one, without the runs over some maps."""
    head, *sections = config.read_text(encoding="utf-8").split("[[logs]]")
    last, rest = sections[-1].split("[parameters]")
    kept = [s for s in (*sections[:-1], last) if not any(f"/{m}/" in s for m in maps)]
    path = config.with_name(f"{name}.toml")
    path.write_text("[[logs]]".join((head, *kept)) + "[parameters]" + rest, encoding="utf-8")
    return path


def errors_over_several(out: Path, config: Path, logs: Path) -> tuple[float, float]:
    """Root mean square errors [m/s], [rad/s] of a fit in the runs with maps of a config."""
    from slipid.app.config import read_config
    from slipid.app.problem import read_fit_task, with_mixed
    from slipid.fitting.multi_floor import (
        MultiFloorBatch,
        multi_floor_runs,
        residuals_at,
        window_errors,
    )
    from slipid.infer.fit_file import load
    from slipid.support.progress import Reporter

    fit, quiet = load(out), Reporter(quiet=True)
    task = with_mixed(read_fit_task(read_config(config), logs, quiet), logs, quiet)
    problem = replace(task, choices=fit.choices).problem(fit.robot)
    batch = MultiFloorBatch.of(multi_floor_runs(task.mixed, fit.robot), fit.robot)
    residuals = residuals_at(problem.space, batch, jnp.asarray(fit.z))
    found = window_errors(batch, [(residuals, np.ones(len(batch.counts)))])
    return found.speed, found.yaw_rate


@pytest.mark.parametrize("seed", SEEDS)
def test_robots_of_the_test_site(seed: int, tmp_path: Path) -> None:
    import json

    from slipid.infer.fit_file import load

    config = simulated(seed, tmp_path)
    unseen = without(config, ("site",), "unseen")
    truth = json.loads((tmp_path / "truth" / "truth.json").read_text())["parameters"]
    rows, speeds = [], []
    for name, maps in FITS.items():
        fitted = without(config, maps, name.replace(" ", "_"))
        out = tmp_path / fitted.stem
        invoke("identify", fitted, "--data", tmp_path / "logs", "--out", out, "--quiet")
        accepted = load(out).mixed is not None
        assert accepted == (name != "one floor at a time")
        speed, yaw = errors_over_several(out, unseen, tmp_path / "logs")
        speeds.append(speed)
        found = json.loads((out / "identified.json").read_text())["parameters"]
        shares = [path for path in truth if path.startswith("robot.load_share")]
        error = max(
            float(np.abs(np.subtract(found[path]["value"], truth[path]["value"])).max())
            for path in shares
        )
        verdicts = sorted({found[path]["verdict"] for path in shares})
        words = ("--controllers", "encoder,contact,contact_gyro", "--starts", STARTS)
        site = ("--site", tmp_path / "site.toml", "--json", out / "t.json", "--quiet")
        invoke("trial", out, *words, *site)
        closing = json.loads((out / "t.json").read_text())["summary"]
        closure = [
            100 * closing[c]["closure_error_median"] / closing["encoder"]["closure_error_median"]
            for c in ("contact", "contact_gyro")
        ]
        numbers = [f"{1000 * speed:.1f}", f"{yaw:.3f}", f"{error:.3f}", ", ".join(verdicts)]
        rows.append([seed, name, *numbers, *(f"{c:.0f}" for c in closure)])
        print(rows[-1], flush=True)
    record("across_floors", rows, keys=2)
    assert QUICK or speeds[1] < speeds[0]


def test_the_pair_of_floors_in_the_2022_logs(real_data: Path, tmp_path: Path) -> None:
    """Each half of the 36 runs over green and table, predicted by a fit with the other half."""
    from slipid.infer.fit_file import load

    text = (ROOT / "configs/robotino2022.toml").read_text(encoding="utf-8")
    section = (
        '[[logs]]\nglob = "two_surfaces/*/*.csv"\nformat = "robotino2022"\nload = "as_built"\n'
        f'map = "{ROOT / "configs/maps/green_table.toml"}"\n\n[camera]'
    )
    config, out = tmp_path / "robot.toml", tmp_path / "out"
    config.write_text(text.replace("[camera]", section, 1), encoding="utf-8")
    invoke("identify", config, "--data", real_data / "robotino2022", "--out", out, "--quiet")
    fit = load(out)
    about = fit.mixed or fit.refused
    for key in ("before", "after", "learnt"):
        print(key, about[key])
    for floor, errors in about["floors"].items():
        print(floor, errors)
    assert QUICK or fit.mixed is not None
    assert QUICK or about["after"]["speed"] < 0.8 * about["before"]["speed"]
