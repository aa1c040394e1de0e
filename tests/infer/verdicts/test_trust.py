"""Trust in a fit depends on its errors, its convergence and its numbers."""

import pytest

from slipid.infer.verdicts.estimates import Estimate
from slipid.infer.verdicts.trust import verdict_of_trust
from slipid.predict.selection import FloorSelection


def number(path="motor.resistance", value=5.95, verdict="identified"):
    return Estimate(
        path=path,
        unit="ohm",
        doc="",
        value=value,
        std=0.1,
        interval90=(value, value),
        labels=(),
        verdict=verdict,
        provenance="measured",
        ratio=0.1,
        pull=0.0,
        prior_mean=value,
        prior_std=1.0,
    )


def floor(model="contact", held_out=True, **errors):
    order = {name: errors[name] for name in ("nominal", "calibrated", "contact") if name in errors}
    return FloorSelection(model, order, {}, 6, held_out)


GOOD = {"gray": floor(nominal=0.4, calibrated=0.1, contact=0.02)}


def test_a_fit_that_predicts_and_settled_is_trusted():
    found = verdict_of_trust(GOOD, True, [number()])
    assert (found.word, found.reasons, str(found)) == ("trusted", (), "trusted")


@pytest.mark.parametrize(
    ("floors", "converged", "numbers", "word", "reason_text"),
    [
        (GOOD, False, [number()], "not to be trusted", "did not converge"),
        (
            {"ice": floor(nominal=0.02, calibrated=0.05, contact=0.03)},
            True,
            [number()],
            "not to be trusted",
            "off by 3.00 % of the path, and the simpler nominal by 2.00 %",
        ),
        (
            {"ice": floor(model="calibrated", nominal=0.9, calibrated=0.6)},
            True,
            [],
            "not to be trusted",
            "which is useless",
        ),
        (
            {"ice": floor(nominal=0.02, calibrated=0.08, contact=0.01)},
            True,
            [number()],
            "doubtful",
            "on ice the calibrated lengths are off by 8.00 % of the path, and the config's by 2.00",
        ),
        (
            {"ice": floor(model="nominal", nominal=0.02, calibrated=0.08)},
            True,
            [],
            "doubtful",
            "some runs contradict the others",
        ),
        ({"a": floor(contact=float("nan"))}, True, [number()], "not to be trusted", "not finite"),
        (
            {"a": floor(held_out=False, nominal=0.1, contact=0.01)},
            True,
            [number()],
            "doubtful",
            "only one run",
        ),
        (GOOD, True, [number(value=4e4)], "not to be trusted", "motor.resistance = 4e+04 ohm"),
        (GOOD, True, [number(verdict="at_bound")], "doubtful", "is at its bound"),
        (GOOD, True, 3 * [number("a", 1.0, "at_bound")], "not to be trusted", "at their bounds"),
        (GOOD, True, [number(verdict="not_identified")], "doubtful", "no parameter of the fit"),
        (GOOD, True, [number("surface.gray.friction", 40.0)], "not to be trusted", "0.005 to 5"),
    ],
)
def test_every_reason_against_it_is_reported(floors, converged, numbers, word, reason_text):
    found = verdict_of_trust(floors, converged, numbers)
    assert found.word == word
    assert any(reason_text in reason for reason in found.reasons)


def test_errors_that_are_both_tiny_are_no_reason():
    floors = {"a": floor(nominal=0.003, contact=0.0039)}
    assert verdict_of_trust(floors, True, [number()]).word == "trusted"


def test_the_worst_reason_comes_first():
    found = verdict_of_trust({"ice": floor(nominal=0.02, contact=0.03)}, False, [number()])
    assert "ice" in found.reasons[0]
    assert "converge" in found.reasons[1]
    lone = {"ice": floor(held_out=False, nominal=0.1, contact=0.01)}
    found = verdict_of_trust(lone, False, [number()])
    assert "converge" in found.reasons[0]
    assert "only one run" in found.reasons[1]


def test_a_force_balance_that_is_not_selected_does_not_lower_the_trust():
    floors = {"a": floor(model="calibrated", nominal=0.1, calibrated=0.01, contact=0.02)}
    found = verdict_of_trust(floors, False, 3 * [number("a", 1.0, "at_bound")])
    assert found.word == "trusted"
    assert any("did not converge" in note for note in found.notes)
