"""The trust in a fit is in run.json, in pictures and in the exit code."""

import json

import pytest

from slipid.infer.verdicts.disputed import EndPoints, Trust
from slipid.plots import drawing


def judged(word):
    return Trust(word, ("it predicts worse",), {"gray": EndPoints(0.4, 0.1)}, 12)


def test_pictures_of_a_fit_that_is_not_to_be_trusted_have_a_warning():
    bad = judged("not to be trusted")
    assert bad.is_bad
    made = drawing.figure(4.0, 3.0, "a title")
    drawing.add_warning(made, bad.warning)
    assert made.get_suptitle() == "THIS FIT IS NOT TO BE TRUSTED\na title"


@pytest.mark.parametrize("word", ["trusted", "doubtful"])
def test_others_carry_no_warning(word):
    assert not judged(word).is_bad
    assert judged(word).warning is None


@pytest.mark.slow
def test_identify_keeps_its_errors_beside_those_of_encoders(small):
    folder, said = small
    found = json.loads((folder / "out" / "run.json").read_text())["trust"]
    assert found["verdict"] == "trusted"
    assert found["runs"] > 0
    for e in found["endpoint_error_over_path"].values():
        assert 0 < e["model"] < e["encoders"]
    assert "verdict: trusted" in said.stdout
