"""`slipid sample` killed twenty times at random moments, against the same run left in peace."""

from __future__ import annotations

import shutil
import time

import numpy as np
import xarray

from tests.benchmarks.quick import quick
from tests.cli import test_cli

KILLS = quick(20, 1)
JOB = ("--draws", "40", "--most", "600", "--block", "4", "--quiet")


def test_twenty_kills(small, tmp_path):
    rng = np.random.default_rng(0)
    whole, out = tmp_path / "whole", tmp_path / "out"
    for folder in (whole, out):
        shutil.copytree(small[0] / "out", folder)
    began = time.perf_counter()
    run = test_cli.process("sample", whole, *JOB)
    while run.poll() is None and not list(whole.glob("sampling/*.npz")):
        time.sleep(0.05)
    start = time.perf_counter() - began
    run.communicate()
    took = time.perf_counter() - began - start
    print(f"\nleft in peace: {start:.0f} s to the first block, {took:.0f} s more, {run.returncode}")
    kept, killed = [], 0
    while killed < KILLS:
        again = test_cli.process("sample", out, *JOB)
        time.sleep(rng.uniform(0.3, 1.1) * start)  # what was compiled is not compiled again
        assert again.poll() is None, "done before it could be killed so often: a longer job is due"
        again.kill()
        again.communicate()
        killed += 1
        kept.append(len(list(out.glob("sampling/*.npz"))))
    print(f"killed {killed} times, blocks then on disk: {kept}")
    last = test_cli.process("sample", out, *JOB)
    last.communicate()
    assert last.returncode == run.returncode
    with (
        xarray.open_datatree(whole / "posterior.nc", engine="h5netcdf") as one,
        xarray.open_datatree(out / "posterior.nc", engine="h5netcdf") as other,
    ):
        for group in one.children:
            xarray.testing.assert_equal(one[group].to_dataset(), other[group].to_dataset())
    print("the values of all groups of posterior.nc are identical")
