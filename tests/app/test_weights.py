"""Known weight on the wheels becomes the prior of the load shares."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.app.config import WeightsSection, parsed
from slipid.app.problem import read_fit_task, weight_priors
from slipid.model.geometry import mecanum, omni
from slipid.search_space import Space
from slipid.support.errors import DataError
from tests.app.test_config import GOOD
from tests.helpers.broken_logs import write_good
from tests.helpers.said import KeptMessages

SHAPE = omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0)
SCALES = WeightsSection(kg=[3.0, 5.0, 4.0], std_kg=0.06)


def test_scales_are_shares():
    prior = weight_priors({"as_built": SCALES}, SHAPE, "none")["as_built"][0]
    assert prior.pattern == "robot.load_share@as_built"
    assert prior.prior_mean == pytest.approx([0.25, 5 / 12, 1 / 3])
    assert prior.prior_std == pytest.approx([0.005] * 3)


def test_a_mass_at_a_place_keeps_the_balance_of_forces_and_moments():
    added = WeightsSection(like="as_built", mass_kg=1.5, place_m=(0.03, -0.02), std_kg=0.08)
    prior = weight_priors({"moved": added, "as_built": SCALES}, SHAPE, "none")["moved"][0]
    kg = np.asarray(prior.prior_mean) * 13.5
    place = np.asarray(SHAPE.place) * 0.125
    more = kg - SCALES.kg
    assert more.sum() == pytest.approx(1.5)
    np.testing.assert_allclose(more @ place, 1.5 * np.array([0.03, -0.02]), atol=1e-12)
    assert prior.prior_std == pytest.approx([0.1 / 13.5] * 3)


def test_a_mass_above_a_wheel_of_three_is_on_that_wheel():
    place = tuple(np.asarray(SHAPE.place)[1] * 0.125)
    added = WeightsSection(like="as_built", mass_kg=-1.0, place_m=place, std_kg=0.05)
    prior = weight_priors({"as_built": SCALES, "light": added}, SHAPE, "none")["light"][0]
    assert np.asarray(prior.prior_mean) * 11 == pytest.approx([3.0, 4.0, 4.0])


def test_four_wheels_share_what_is_in_the_middle():
    shape = mecanum(0.2, 0.15, 0.05)
    even = WeightsSection(kg=[2.0, 2.0, 3.0, 3.0], std_kg=0.1)
    added = WeightsSection(like="a", mass_kg=4.0, place_m=(0.0, 0.0), std_kg=0.1)
    prior = weight_priors({"a": even, "b": added}, shape, "none")["b"][0]
    assert np.asarray(prior.prior_mean) * 14 == pytest.approx([3.0, 3.0, 4.0, 4.0])


def test_masses_over_that_of_the_first_load_setup_need_both_weights():
    heavy = WeightsSection(kg=[4.0, 6.0, 5.0], std_kg=0.15)
    share, mass = weight_priors({"heavy": heavy, "light": SCALES}, SHAPE, "light")["heavy"]
    assert share.pattern == "robot.load_share@heavy"
    assert (mass.pattern, mass.prior_mean) == ("robot.mass_ratio@heavy", pytest.approx(1.25))
    # of three scales: 0.15 sqrt(3) of 15 kg and 0.06 sqrt(3) of 12 kg
    assert mass.prior_std == pytest.approx(1.25 * np.sqrt(3) * np.hypot(0.01, 0.005))
    assert len(weight_priors({"heavy": heavy}, SHAPE, "light")["heavy"]) == 1
    added = WeightsSection(like="light", mass_kg=3.0, place_m=(0.0, 0.0), std_kg=0.02)
    mass = weight_priors({"heavy": added, "light": SCALES}, SHAPE, "light")["heavy"][1]
    assert mass.prior_mean == pytest.approx(1.25)
    # the scales' errors are in both weights
    assert mass.prior_std == pytest.approx(np.sqrt(3) * np.hypot(0.02, 0.25 * 0.06) / 12)


WEIGHTS = """
[weights.as_built]
kg = [3.0, 5.0, 4.0]
std_kg = 0.06
"""


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("std_kg = 0.1", "weights.as_built: expected kg, or like, mass_kg and place_m"),
        ("kg = [3, 5, 4]", "weights.as_built.std_kg: missing"),
        ('kg = [3, 5, 4]\nlike = "b"\nstd_kg = 1', "expected either kg or the other three"),
        ('like = "b"\nmass_kg = 1\nstd_kg = 1', "expected kg, or like, mass_kg and place_m"),
        ("kg = [3, 5]\nstd_kg = 0.1", "weights.as_built.kg: 2 numbers; expected 3"),
        ("kg = [3, 5, -4]\nstd_kg = 0.1", "weights.as_built.kg"),
        (
            'like = "as_built"\nmass_kg = 1\nplace_m = [0, 0]\nstd_kg = 1',
            "weights.as_built.like = as_built: not in [weights], or it refers back",
        ),
        (
            'like = "b"\nmass_kg = 1\nplace_m = [0, 0]\nstd_kg = 1',
            "weights.as_built.like = b: not in [weights], or it refers back",
        ),
        (
            'like = "b"\nmass_kg = 20\nplace_m = [0.5, 0]\nstd_kg = 1\n'
            "[weights.b]\nkg = [3, 5, 4]\nstd_kg = 1",
            "would be lifted; expected weight on all",
        ),
    ],
)
def test_what_makes_no_weight_is_refused(tmp_path, text, expected):
    write_good(tmp_path)
    whole = f"{GOOD}\n[weights.as_built]\n{text}\n"
    with pytest.raises(DataError, match=r"my\.toml: ") as caught:
        read_fit_task(parsed(tmp_path / "my.toml", whole), tmp_path, KeptMessages())
    assert expected in str(caught.value)


def test_weights_are_the_prior_and_those_of_no_run_are_skipped(tmp_path):
    write_good(tmp_path)
    text = GOOD + WEIGHTS + WEIGHTS.replace("as_built", "loaded")
    job = read_fit_task(parsed(tmp_path / "my.toml", text), tmp_path, KeptMessages())
    assert "skipped: weights.loaded: no run has this load set-up" in job.skipped
    space = Space(job.robot, job.choices)
    at = space.slices["robot.load_share@as_built"]
    entry = next(e for e in space.free if e.path == "robot.load_share@as_built")
    mean = np.asarray(entry.declaration.to_si(jnp.asarray(space.prior_mean[at])))
    assert mean == pytest.approx([0.25, 5 / 12, 1 / 3])
    assert (space.prior_std[at] < 0.03).all()
    plain = read_fit_task(parsed(tmp_path / "my.toml", GOOD), tmp_path, KeptMessages())
    assert (Space(plain.robot, plain.choices).prior_std[at] > 0.2).all()


def test_runs_of_sections_with_one_session_name_belong_together(tmp_path):
    write_good(tmp_path)
    text = GOOD.replace(
        'format = "robotino2022"', 'format = "robotino2022"\nsession_name = "may 3"'
    )
    job = read_fit_task(parsed(tmp_path / "my.toml", text), tmp_path, KeptMessages())
    assert set(job.dataset.session) == {"may 3"}
    both = text.replace("session_name", 'session = "file"\nsession_name')
    with pytest.raises(DataError, match="both session and session_name are given"):
        parsed(tmp_path / "my.toml", both)
