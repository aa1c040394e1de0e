"""What benchmarks of the closed loop share: the fit they drive with."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def fit_folder() -> Path:
    """Folder that `slipid identify` wrote, named by SLIPID_FIT."""
    folder = os.environ.get("SLIPID_FIT")
    if not folder:
        pytest.skip("no fit: set SLIPID_FIT to a folder that slipid identify wrote")
    return Path(folder)


@pytest.fixture(scope="session")
def robot(fit_folder):
    """The robot of that fit."""
    from slipid.deploy.deploy import read_robot

    return read_robot(fit_folder)
