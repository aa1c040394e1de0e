"""The joint fit of all 2022 logs and its predictions, against reviewed numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

from slipid.app.compare import validate
from slipid.app.identify import checked_task, identify
from slipid.support.progress import Reporter
from tests.helpers import golden_rows as rows

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "robotino2022.toml"
SAME = 1e-3
"""Relative tolerance of numbers: the end of a fit depends on how code is compiled."""
pytestmark = pytest.mark.slow  # fits 472 runs


@pytest.fixture(scope="module")
def out(real_data, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("robotino2022")
    logs, report = real_data / "robotino2022", Reporter(quiet=True)
    done = identify(checked_task(CONFIG, logs, report), logs, folder, report)
    assert done.fit.converged
    return folder


@pytest.fixture(scope="module")
def identified(out):
    from slipid.support.files import read_json

    return read_json(out / "identified.json", "what identify wrote")


def test_identified_numbers(identified, golden):
    golden("real_identified", list(rows.of_identified(identified)), rtol=SAME, atol=1e-6)


def test_slip_curves(identified, golden):
    golden("real_curves", list(rows.of_curves(identified)), rtol=SAME, atol=1e-5)


def test_noise(out, golden):
    from slipid.infer.fit_file import load

    std = {name: value**0.5 for name, value in load(out).variance.items()}
    golden("real_noise", list(rows.of_variances(std)), rtol=SAME)


def test_predictions(out, real_data, golden):
    *_, found = validate(out, real_data / "robotino2022", Reporter(quiet=True))
    golden("real_validation", list(rows.of_validation(found.to_json())), rtol=SAME, atol=1e-6)
