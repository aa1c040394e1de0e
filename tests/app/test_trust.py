"""The trust in a fit is in run.json, identified.json, in pictures and in the exit code."""

import json
from dataclasses import replace

import pytest

from slipid.app import identify
from slipid.infer.result import Fit
from slipid.infer.verdicts.trust import Trust
from slipid.plots import drawing
from slipid.predict.selection import FloorSelection
from tests.helpers.shared import invoke


def judged(word):
    return Trust(word, ("it predicts worse",), (), {})


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


def in_files(out):
    """Trust in the two files that identify writes it to."""
    texts = (out / "run.json").read_text(), (out / "identified.json").read_text()
    return tuple(json.loads(text)["trust"] for text in texts)


@pytest.mark.slow
def test_the_selected_model_is_no_worse_than_simpler_ones_and_every_output_says_the_same(small):
    folder, said = small
    found, again = in_files(folder / "out")
    assert found == again
    assert found["verdict"] == "trusted"
    assert said.exit_code == 0
    assert "verdict: trusted" in said.stdout
    chosen = json.loads((folder / "out" / "identified.json").read_text())["selected_model"]
    for floor, errors in found["held_out_error_over_path"].items():
        assert found["held_out"][floor]
        assert found["runs"][floor] > 0
        assert 0 < errors[chosen[floor]] < errors["nominal"]
        for error in errors.values():
            assert f"{100 * error:.2f}" in said.stdout


@pytest.mark.slow
def test_a_fit_that_predicts_worse_than_a_simpler_model_ends_with_exit_code_1(
    small, tmp_path, monkeypatch
):
    folder, _ = small
    good = Fit.load(folder / "out")
    errors = {"nominal": 0.0234, "contact": 0.0345}
    behind = dict.fromkeys(errors, (0.0, 0.001))
    worse = FloorSelection("contact", errors, behind, 6, True)
    fit = replace(good, selection=dict.fromkeys(good.selection, worse))
    monkeypatch.setattr(identify, "fitted", lambda *_: (fit, None, None))
    logs, out = folder / "logs", tmp_path / "out"
    done = invoke("identify", folder / "my.toml", "--data", logs, "--out", out, "--quiet")
    assert done.exit_code == 1
    found, again = in_files(out)
    assert found == again
    assert found["verdict"] == "not to be trusted"
    (reason,) = found["reasons"]
    assert "contact is off by 3.45 % of the path, and the simpler nominal by 2.34 %" in reason
    assert f"verdict: not to be trusted: {reason}" in " ".join(done.stdout.split())
    assert found["held_out_error_over_path"] == {f: dict(worse.errors) for f in good.selection}
