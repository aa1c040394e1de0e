"""What benchmarks share: the real logs, and the fit that those of the closed loop drive with."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.benchmarks.quick import QUICK, thinned


@pytest.fixture(scope="session", autouse=True)
def laplace_intervals() -> None:
    """Fits of benchmarks have their short chain, unlike those of tests."""


@pytest.fixture(scope="session")
def real_data(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the real logs; in the quick form one with few of them."""
    return thinned(real_data, tmp_path_factory.mktemp("data")) if QUICK else real_data


@pytest.fixture(scope="module", autouse=True)
def _nothing_kept(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> None:
    """In the quick form nothing is kept in `out/` and nothing of it is found again."""
    if QUICK and hasattr(request.module, "OUT"):
        request.module.OUT = tmp_path_factory.mktemp("out")


@pytest.fixture(scope="session")
def fit_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that `slipid identify` wrote, named by SLIPID_FIT; in the quick form a made one."""
    folder = os.environ.get("SLIPID_FIT")
    if folder:
        return Path(folder)
    if not QUICK:
        pytest.skip("no fit: set SLIPID_FIT to a folder that slipid identify wrote")
    from slipid.lab.selftest.logs import heading_grid
    from tests.helpers.shared import identify

    floors = ("firm", "as_built"), ("soft", "as_built")
    made = tmp_path_factory.mktemp("fit")
    done = identify(made, heading_grid(setups=floors, headings=6, speeds=(0.1, 0.3), turns=0))
    assert done.exit_code in (0, 1), done.stderr
    return made / "out"


@pytest.fixture(scope="session")
def robot(fit_folder: Path):
    """The robot of that fit."""
    from slipid.deploy.deploy import read_robot

    return read_robot(fit_folder)
