"""Maps made from pictures: the rectangle with one against the true map, and how fast one is asked.

    SLIPID_FIT=demo_out/result .venv/bin/python -m pytest -s -o python_files='bench_*.py' \
        tests/benchmarks/bench_floor_map.py

(twenty minutes on two cores). A rectangle over patches of the test site is filmed by a camera that
sees all of them; the map of the site is made from that video, and the trial is driven on the twin
from 99 starts with the true map and with the made one. Needs a folder that `slipid identify` wrote
for the test site's firm and soft floors.
Asserts that the median closures differ by less than 5 points of what encoders close at, and that a
million poses are looked up in a second.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.floor_map import patchwork, read_map
from slipid.deploy.floors import FloorLookup
from slipid.support.files import read_json
from tests.benchmarks.quick import QUICK, quick
from tests.helpers.shared import invoke

SITE = """
seed = 21
formats = ["slipid"]
video = ["*"]
[maps.site]
kind = "patchwork"
surfaces = ["firm", "soft"]
seed = 77
patch_m = 0.35
half_m = 1.2
[[runs]]
kind = "rectangle"
map = "site"
[camera]
height_m = 3.0
frame_s = 0.5
"""
PALETTE = """
schema = "slipid.palette/1"
[palette]
firm = "#e8e4da"
soft = "#1f6b45"
"""
STARTS = quick(99, 2)
"""Where a run goes is hard to foretell on patches: a median of few starts says little."""
MANY = quick(1_000_000, 10_000)
"""Poses that are looked up."""


@pytest.fixture(scope="module")
def maps(tmp_path_factory) -> tuple[Path, Path]:
    """The true map, and the one made from a video."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "site.toml").write_text(SITE)
    (folder / "palette.toml").write_text(PALETTE)
    made = folder / "made"
    for words in (
        ("simulate", folder / "site.toml", "--out", folder),
        (
            *("map", folder / "video/as_built/site/run000.avi", "--out", made),
            *("--camera", folder / "video/camera.json", "--config", folder / "palette.toml"),
        ),
    ):
        done = invoke(*words, "--quiet")
        assert done.exit_code == 0, done.output
    return folder / "maps" / "site.toml", made / "map.geojson"


def test_the_made_map_is_the_true_one_where_the_rectangle_is(maps):
    true, made = (read_map(path) for path in maps)
    places = np.stack(np.meshgrid(np.arange(-0.9, 0.9, 0.005), np.arange(-0.85, 0.85, 0.005)), -1)
    named = [np.array(floor.surfaces)[floor.at(places)] for floor in (true, made)]
    same = float((named[0] == named[1]).mean())
    print(f"\nsame surface: {same:.2%} of the floor around the rectangle")
    assert QUICK or same > 0.98


def test_the_rectangle_closes_as_with_the_true_map(maps, fit_folder, tmp_path):
    true, made = maps
    told = {"true map": (), "made map": ("--told-map", made)}
    closure = {}
    for name, words in told.items():
        out = tmp_path / f"{name}.json"
        rows = ("--controllers", "encoder,contact_map", "--starts", STARTS, "--json", out)
        place = ("--plant", "twin", "--map", true, *words, "--jobs", os.cpu_count() or 1)
        done = invoke("trial", fit_folder, *place, *rows, "--quiet")
        assert done.exit_code == 0, done.output
        runs = read_json(out, "a trial")["runs"]
        for row in ("encoder", "contact_map"):
            errors = [run["closure_mm"] for run in runs if run["controller"] == row]
            closure[name, row] = float(np.median(errors))
    base = closure["true map", "encoder"]
    for (name, row), error in closure.items():
        print(f"{name:10}{row:14}{error:8.1f} mm {error / base:8.1%} of the encoders'")
    points = (closure["made map", "contact_map"] - closure["true map", "contact_map"]) / base
    print(f"difference: {100 * points:+.1f} points")
    assert QUICK or abs(points) < 0.05


def test_a_million_poses_are_looked_up_in_a_second():
    lookup = FloorLookup.of(patchwork(["a", "b", "c"], 0))
    poses = jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (MANY, 3)))
    wheels = jnp.array([[0.1, 0.0], [0.0, 0.1], [-0.1, 0.0]])
    took = []
    for _ in range(5):
        began = time.perf_counter()
        jax.block_until_ready(lookup.under(poses, wheels))
        took.append(time.perf_counter() - began)
    print(
        f"\n{min(took):.2f} s for a million poses of three wheels, {took[0]:.2f} s with compiling"
    )
    assert QUICK or min(took) < 1.0
