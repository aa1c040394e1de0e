"""Feed-forward gains of motors on a bench, from the fit of a made log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipid.infer.bench.fit import fit_motor
from slipid.infer.bench.verdict import bench_fit
from slipid.infer.feedforward import bench_feedforwards
from slipid.model.feedforward import DriveNumbers
from slipid.report.html.bench_page import bench_page
from slipid.report.html.blocks import TableBlock
from tests.helpers import made_bench as made


@pytest.fixture(scope="module")
def record():
    return made.logged(made.driven(made.FLYWHEEL), 100, seed=3)


@pytest.fixture(scope="module")
def fit(record):
    return bench_fit([fit_motor([record])])


@pytest.fixture(scope="module")
def gains(fit):
    (found,) = bench_feedforwards(fit)
    return found


def test_the_gains_of_a_made_motor_are_in_their_intervals(gains):
    t = made.TRUTH
    torque = t["resistance"] / t["back_emf"]
    truth = {
        "kS": torque * t["coulomb_friction"],
        "kV": t["back_emf"] + torque * t["viscous_friction"],
        "kA": torque * made.FLYWHEEL,
    }
    assert gains.name == "motor"
    for name, gain in gains.gains.items():
        assert abs(gain.value - truth[name]) < 3 * gain.std, name
        assert gain.std < 0.06 * gain.value, name
        assert gain.verdict == "identified", name


def test_intervals_are_those_of_draws_of_the_fit(fit):
    """Resistance and friction of ten percent each, which nearly cancel in kS."""
    slices = fit.fits[0].space.slices
    covariance = 1e-12 * np.eye(len(fit.fits[0].z))
    at = [slices[f"motor.{name}"].start for name in ("resistance", "coulomb_friction")]
    covariance[np.ix_(at, at)] = 0.01 * np.array([[1.0, -0.9], [-0.9, 1.0]])
    uncertainty = replace(fit.fits[0].uncertainty, covariance=covariance)
    one = replace(fit.fits[0], uncertainty=uncertainty, ranges={})
    (gains,) = bench_feedforwards(bench_fit([one]))
    paths = {name: f"motor.{name}" for name in DriveNumbers._fields}
    used = {name: one.space.slices[p] for name, p in paths.items() if p in one.space.slices}
    rng = np.random.default_rng(0)
    z = rng.multivariate_normal(one.z, one.covariance, size=20_000)
    entry = {e.path: e for e in one.space.free}
    draws = DriveNumbers(
        **{n: entry[paths[n]].declaration.to_si(z[:, at])[:, 0] for n, at in used.items()}
    ).gains()
    for gain, row in zip(gains.gains.values(), np.asarray(draws), strict=True):
        assert gain.interval90 == pytest.approx(np.quantile(row, [0.05, 0.95]), rel=0.01)
    assert gains.kS.std < 0.06 * gains.kS.value


def test_without_a_voltage_there_are_no_gains(record):
    found = bench_fit([fit_motor([replace(record, voltage=None)])])
    assert bench_feedforwards(found) == ()
    assert "feedforward" not in [s.name for s in bench_page(found, "log").sections]


def test_motors_of_one_log_have_gains_by_their_labels(fit):
    left = fit.fits[0]
    found = bench_fit([replace(left, label=label) for label in ("left", "right")])
    assert [one.name for one in bench_feedforwards(found)] == ["left", "right"]


def test_the_page_and_the_text_of_a_motor_show_its_gains(fit, gains):
    from slipid.report.estimates import show_bench
    from slipid.report.page import text_of

    section = {s.name: s for s in bench_page(fit, "log").sections}["feedforward"]
    (table,) = (b for b in section.blocks if isinstance(b, TableBlock))
    assert [row[0] for row in table.rows] == ["motor: kS", "motor: kV", "motor: kA"]
    text = text_of(show_bench, fit)
    assert f"{gains.kA.value:.5f}" in text
    assert "velocity loop kP" in text
