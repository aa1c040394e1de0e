"""Trust in a fit depends on its errors, its convergence and its numbers."""

import pytest

from slipid.infer.verdicts.disputed import EndPoints, verdict_of_trust
from slipid.infer.verdicts.estimates import Estimate


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


GOOD = {"gray": EndPoints(model=0.02, encoders=0.4)}


def test_a_fit_that_predicts_and_settled_is_trusted():
    found = verdict_of_trust(GOOD, True, [number()])
    assert (found.word, found.reasons, str(found)) == ("trusted", (), "trusted")


@pytest.mark.parametrize(
    ("floors", "converged", "numbers", "word", "reason_text"),
    [
        (GOOD, False, [number()], "doubtful", "did not converge"),
        (
            {"ice": EndPoints(0.24, 0.2)},
            True,
            [number()],
            "doubtful",
            "off by 24.0 %",
        ),
        ({"ice": EndPoints(0.8, 0.3)}, True, [number()], "not to be trusted", "80.0 % of the path"),
        ({"ice": EndPoints(0.6, 0.9)}, True, [number()], "doubtful", "neither is useful"),
        (
            {"a": EndPoints(float("nan"), 0.1)},
            True,
            [number()],
            "not to be trusted",
            "not finite",
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
    assert verdict_of_trust({"a": EndPoints(0.006, 0.003)}, True, [number()]).word == "trusted"


def test_the_worst_reason_comes_first():
    found = verdict_of_trust({"ice": EndPoints(0.8, 0.3)}, False, [number()])
    assert "ice" in found.reasons[0]
    assert "converge" in found.reasons[1]
