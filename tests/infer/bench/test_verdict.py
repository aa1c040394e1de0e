"""Verdicts on fitted motors: held-out rows, rivals, misfits, and models that are as likely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from slipid.infer.bench import fit as motor_fits
from slipid.infer.bench.fit import MotorFit, fit_motor
from slipid.infer.bench.held_out import Errors, HeldOut, folds, held_out
from slipid.infer.bench.motor import BenchRecord
from slipid.infer.bench.open_loop import fit_open_loop
from slipid.infer.bench.verdict import bench_fit, misfits
from slipid.report.estimates import show_bench
from slipid.report.html.bench_page import bench_page
from slipid.report.page import text_of
from slipid.search_space import Choice
from tests.helpers import made_bench as made
from tests.helpers import motor_benches
from tests.helpers.compiled_c import NEEDS_COMPILER

RIVALS = ("least_squares", "least_squares_with_offset")


@pytest.fixture(scope="module")
def record() -> BenchRecord:
    """A log whose voltage is held from row to row."""
    rows = made.driven(made.FLYWHEEL, profile=made.held)
    return made.logged(rows, made.RATE, seed=1, at_changes=True)


@pytest.fixture(scope="module")
def fit(record) -> MotorFit:
    return fit_motor([record], between="held")


# held-out rows -----------------------------------------------------------------------------------


def test_held_out_errors_are_beside_those_of_both_rivals(fit):
    content = bench_fit([fit]).to_json()["held_out"]
    assert set(content) == {"speed_rmse_rad_s", "current_rmse_a", "rivals"}
    assert tuple(content["rivals"]) == RIVALS
    # A motor that is right is simulated within the noise of its meters.
    assert content["speed_rmse_rad_s"] == pytest.approx(1.05, rel=0.05)
    assert content["current_rmse_a"] == pytest.approx(0.051, rel=0.05)
    for name in RIVALS:
        rival = content["rivals"][name]
        assert rival["speed_rmse_rad_s"] > 1.5 * content["speed_rmse_rad_s"]
        assert rival["current_rmse_a"] > 1.1 * content["current_rmse_a"]


def test_held_out_errors_of_several_motors_are_under_their_labels(fit):
    content = bench_fit([replace(fit, label=label) for label in ("left", "right")]).to_json()
    assert set(content["held_out"]) == {"left", "right"}
    assert content["held_out"]["left"] == content["held_out"]["right"]


def test_the_text_and_the_page_show_held_out_errors_beside_both_rivals(fit):
    rivals = {RIVALS[0]: Errors(4.0, 0.25), RIVALS[1]: Errors(3.0, None)}
    one = replace(fit, label="left", held_out=HeldOut(Errors(1.5, None), rivals))
    other = replace(fit, label="right", held_out=HeldOut(Errors(0.5, 0.125), dict(rivals)))
    other.held_out.rivals[RIVALS[1]] = Errors(3.0, 0.2)
    found = bench_fit([one, other])
    lines = [line for line in text_of(show_bench, found).splitlines() if "held-out rows, " in line]
    about = "held-out rows, simulated from the voltage alone: speed within"
    speed = "rad/s (least squares 4, least squares with offsets 3)"
    current = "current within 0.125 A (least squares 0.25, least squares with offsets 0.2)"
    assert lines == [f"left: {about} 1.5 {speed}", f"right: {about} 0.5 {speed}; {current}"]
    (section,) = (s for s in bench_page(found, "log").sections if s.name == "held_out")
    assert section.blocks[0].rows == [
        ("left", "speed", "rad/s", "1.5", "4", "3"),
        ("right", "speed", "rad/s", "0.5", "4", "3"),
        ("right", "current", "A", "0.125", "0.25", "0.2"),
    ]
    assert not [
        s for s in bench_page(without_held_out(fit), "log").sections if s.name == "held_out"
    ]


def without_held_out(fit: MotorFit) -> BenchFit:
    return bench_fit([replace(fit, held_out=None)])


def test_every_row_is_held_out_once(fit):
    one, other = folds(fit.rows)
    np.testing.assert_array_equal(one ^ other, fit.rows.used)
    assert not (one & other).any()
    assert 0.4 < one.sum() / fit.rows.used.sum() < 0.6


def test_errors_are_those_of_rows_that_a_fit_did_not_use(fit):
    measured = np.stack([fit.rows.current, fit.rows.speed])
    found = held_out(fit.rows, lambda use: measured + np.array([0.5, 2.0])[:, None, None] * ~use)
    assert found.errors == Errors(speed=2.0, current=0.5)
    assert found.rivals == fit.held_out.rivals


def test_a_motor_is_judged_by_fits_to_the_other_rows(fit, monkeypatch):
    weights = []

    def spied(rows, space, z, weight, *more):
        weights.append(weight)
        return fit.fit

    monkeypatch.setattr(motor_fits, "fit_open_loop", spied)
    motor_fits._held_out(fit.fit)
    np.testing.assert_array_equal(weights, np.array(folds(fit.rows), float))


def test_rows_without_weight_do_not_change_a_fit(fit):
    use, _ = folds(fit.rows)
    odd = np.where(use, fit.rows.speed, 0.0)
    same, spoilt = (
        fit_open_loop(rows, fit.space, fit.z, use.astype(float), rounds=3)
        for rows in (fit.rows, replace(fit.rows, speed=odd))
    )
    np.testing.assert_allclose(spoilt.z, same.z, rtol=1e-12)
    assert np.abs(same.z - fit.z).max() > 0


@pytest.mark.parametrize(
    ("speed", "current", "beaten"), [(0.9, 2.0, True), (2.0, 0.9, True), (0.99, 0.99, False)]
)
def test_a_rival_that_simulates_better_makes_verdicts_weak(fit, speed, current, beaten):
    own = Errors(speed=1.0, current=1.0)
    rivals = {RIVALS[0]: Errors(5.0, 5.0), RIVALS[1]: Errors(speed, current)}
    found = bench_fit([replace(fit, held_out=HeldOut(own, rivals))])
    verdicts = {e.verdict for e in (*found.parameters.values(), *found.derived.values())}
    assert ("identified" not in verdicts) == beaten
    assert found.good == (not beaten)
    assert any("simulate the held-out rows better" in text for text in found.messages) == beaten


# misfits -----------------------------------------------------------------------------------------


def test_a_misfit_is_named_and_lowers_verdicts(record):
    """No effect of the model depends on the speed like a sine."""
    odd = 0.4 * np.sin(record.speed / 40.0)
    one = fit_motor([replace(record, current=record.current + odd)], between="held")
    found = bench_fit([one])
    assert "current" in misfits(one)
    assert not found.good
    assert any("the model does not include" in text for text in found.messages)
    assert found.parameters["motor.coulomb_friction"].verdict != "identified"
    assert found.to_json()["explained"] is False


def test_a_right_model_has_no_misfit(fit):
    assert misfits(fit) == {}


@pytest.mark.parametrize("drop", [0.0, 0.1])
def test_a_fixed_number_stays(record, drop):
    """A motor without brushes has no drop."""
    choice = Choice("motor.brush_drop", fixed=drop)
    one = fit_motor([record], [choice], between="held")
    found = bench_fit([one]).parameters
    e = found["motor.brush_drop"]
    assert (e.value, e.verdict, e.provenance) == (drop, "fixed", "override")
    assert found["motor.resistance"].value == pytest.approx(5.5, rel=0.02)


# models that a log does not distinguish ----------------------------------------------------------

NO_DROP = (Choice("motor.brush_drop", fixed=1e-9),)
FALLING = (
    *NO_DROP,
    Choice("motor.resistance_fall", free=True),
    Choice("motor.fall_current", free=True),
)


@pytest.mark.slow
def test_a_drop_and_a_falling_resistance_that_are_not_distinguished_widen_the_interval():
    """The brushes reach their drop over such large currents that the resistance might fall."""
    rows = made.driven(made.FLYWHEEL, drop=0.6, turn=1.0, profile=made.held)
    record = made.logged(rows, made.RATE, 1, noise=(0.05, 0.3, 3.0), at_changes=True)
    both = fit_motor([record], between="held")
    assert "falling" in both.other_contacts
    low, high = both.ranges["motor.resistance"]
    falling = fit_motor([record], FALLING, between="held")
    at = both.space.slices["motor.resistance"].start
    std = float(np.sqrt(both.covariance[at, at]))
    for value in (float(both.motor.resistance), float(falling.motor.resistance)):
        assert low < value < high
    assert high / low > np.exp(2 * 1.645 * std) * 1.02
    assert low < 5.5 < high
    found = bench_fit([both])
    assert found.parameters["motor.resistance"].interval90 == (low, high)
    assert any("explain the log about equally well" in text for text in found.messages)


@pytest.mark.slow
def test_a_steep_drop_is_distinguished_from_a_falling_resistance():
    rows = made.driven(made.FLYWHEEL, drop=0.6, profile=made.held)
    fit = fit_motor([made.logged(rows, made.RATE, 1, at_changes=True)], between="held")
    assert "falling" not in fit.other_contacts
    assert float(fit.motor.brush_drop) == pytest.approx(0.6, abs=0.05)


@pytest.mark.slow
@NEEDS_COMPILER
@pytest.mark.parametrize(
    ("seed", "other", "text"),
    [
        (1184, "logarithmic", "logarithm of the current explains"),
        (39, "both", "together with a resistance that falls"),
    ],
)
def test_other_models_of_the_contacts_widen_the_interval_up_to_the_truth(seed, other, text):
    """A drop that is a logarithm, and one beside a contact film."""
    log = motor_benches.bench(seed)
    one = fit_motor([motor_benches.recorded(log)])
    assert other in one.other_contacts
    assert any(text in message for message in bench_fit([one]).messages)
    low, high = one.ranges["motor.resistance"]
    assert low <= log.truth.resistance <= high
    at = one.space.slices["motor.resistance"].start
    off = 1.645 * float(np.sqrt(one.covariance[at, at]))
    alone = np.exp(one.z[at] + np.array([-off, off]))
    assert low < 0.995 * alone[0] or high > 1.05 * alone[1]


@pytest.mark.slow
def test_a_tail_of_the_drop_that_the_user_gives_has_no_logarithmic_rival():
    rows = made.driven(made.FLYWHEEL, drop=0.6, profile=made.held)
    record = made.logged(rows, made.RATE, 3, at_changes=True)
    one = fit_motor([record], [Choice("motor.brush_tail", fixed=1e-6)], between="held")
    assert float(one.motor.brush_drop) == pytest.approx(0.6, abs=0.05)
    assert "logarithmic" not in one.other_contacts


def test_a_resistance_that_models_do_not_agree_on_is_weak(fit):
    path = "motor.resistance"
    low, high = fit.ranges[path]
    assert bench_fit([fit]).parameters[path].verdict == "identified"
    wide = replace(fit, ranges={**fit.ranges, path: (low, 1.6 * high)})
    found = bench_fit([wide]).parameters[path]
    assert found.interval90 == (low, 1.6 * high)
    assert found.verdict == "weak"


def test_forms_of_the_voltage_that_are_about_as_likely_are_named(fit):
    assert not any("--between" in text for text in bench_fit([fit]).messages)
    found = bench_fit([replace(fit, other_forms=("straight",))])
    assert any("is held or straight" in text and "--between" in text for text in found.messages)


@pytest.mark.slow
def test_a_filter_of_the_ammeter_makes_no_identified_resistance(fit, record):
    """A filter of 10 ms, with which the resistance is off by more than its interval."""
    share = 1 - np.exp(-record.period / 0.01)
    filtered = lfilter([share], [1, share - 1], record.current)
    found = bench_fit([fit_motor([replace(record, current=filtered)], between="held")])
    text = "low-pass filter of the ammeter"
    assert not any(text in message for message in bench_fit([fit]).messages)
    assert any(text in message for message in found.messages)
    resistance = found.parameters["motor.resistance"]
    assert resistance.interval90[0] > made.TRUTH["resistance"]
    assert resistance.verdict == "weak"
