"""Slip models below the force balance: each recovers the model that generated its data."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.predict import open_loop as replay
from slipid.predict.curves import insensitive
from slipid.predict.kinematics import HeadingLookup
from slipid.predict.score import chords
from slipid.predict.slip_models import FloorModels, restored, slip_models
from tests.helpers.made_windows import SCALE, made
from tests.helpers.made_windows import robot as made_robot

ROBOT = made_robot(sessions=("one",))
ALL = {model.name: model for model in slip_models(ROBOT.geometry, has_current=True)}
SPLINE = np.array([0.02, 0.01, 0.05, 0.1, 0.0, 0.2, 0.1])
TRUE = {
    "calibrated": ([-0.1, -0.12, -0.08, 0.05, 0.0], [-0.5, -0.45, -0.55, -0.1, 0.0]),
    "linear": ([1.0], [4.0]),
    "affine": ([0.03, 1.5], [0.1, 3.0]),
    "quadratic": ([0.02, 2.0, -3.0], [0.0, 5.0, -6.0]),
    "saturating": (np.log([0.1, 0.2]), np.log([0.3, 0.25])),
    "monotone_spline": (SPLINE, 2 * SPLINE),
    "affine_current": ([0.05, 0.2], [0.1, 0.5]),
    "paper": (np.linspace(0.05, 0.3, 6), np.linspace(0.4, 0.1, 6)),
}


def windows(seed=0):
    """Two loads, two floors, every wheel at its own current."""
    w = made(ROBOT, runs=48, count=3, seed=seed)
    amps = np.random.default_rng(seed).uniform(0.1, 2.0, w.current.shape)
    return replace(w, current=amps)


def driven(w, model):
    """The windows with poses as the model has them."""
    step = model.increments(w, ROBOT)
    pose = np.array(replay.chain(jnp.asarray(w.pose[:, 0]), jnp.asarray(step)))
    pose[..., :2] /= SCALE
    return replace(w, pose=pose)


def with_truth(name):
    floors = ROBOT.surfaces.labels
    state = {f: np.asarray(b, float) for f, b in zip(floors, TRUE[name], strict=True)}
    return ALL[name].with_state(state)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRUE)
def test_a_curve_finds_the_curve_that_made_the_data(name):
    truth = with_truth(name)
    found = ALL[name].fit(driven(windows(), truth), ROBOT)
    for floor, beta in truth.state.items():
        np.testing.assert_allclose(found.state[floor], beta, atol=2e-5, err_msg=floor)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRUE)
def test_a_curve_predicts_runs_it_has_not_seen(name):
    truth = with_truth(name)
    found = ALL[name].fit(driven(windows(), truth), ROBOT)
    other = driven(windows(seed=1), truth)
    tracks = replay.tracks_from_increments(ROBOT, other, found.increments(other, ROBOT))
    np.testing.assert_allclose(tracks.gap, 0.0, atol=1e-5)


def test_support_vectors_are_those_of_scikit_learn():
    from sklearn import svm

    rng = np.random.default_rng(6)
    a = np.stack([np.ones(300), rng.uniform(0.0, 2.0, 300)], axis=1)
    b = a @ [0.1, 0.5] + rng.laplace(0.0, 0.1, 300)
    b[::10] += 3.0
    epsilon = np.subtract(*np.percentile(b, (75, 25))) / 13.49
    oracle = svm.LinearSVR(
        epsilon=epsilon, C=100.0, fit_intercept=False, tol=1e-8, max_iter=10**6, random_state=0
    ).fit(a, b)
    ours = insensitive(a, b)

    def loss(beta):
        return np.maximum(np.abs(a @ beta - b) - epsilon, 0.0).sum()

    assert loss(ours) <= loss(oracle.coef_) + 1e-9
    np.testing.assert_allclose(ours, oracle.coef_, atol=0.01)
    np.testing.assert_allclose(ours, [0.1, 0.5], atol=0.06)


def test_support_vectors_do_not_follow_a_few_spoilt_runs():
    truth = with_truth("affine")
    w = driven(windows(), truth)
    pose = w.pose + np.random.default_rng(7).normal(0.0, 0.003, w.pose.shape)
    pose[::8, :, :2] *= 1.5
    w = replace(w, pose=pose)

    def off(name):
        state = ALL[name].fit(w, ROBOT).state
        return np.mean([np.abs(state[f] - beta).mean() for f, beta in truth.state.items()])

    assert off("svr") < 0.5 * off("affine")


def test_encoders_are_right_where_nothing_slips():
    w = driven(windows(), ALL["encoder"])
    j = np.asarray(ROBOT.geometry.pseudo_inverse()) * 0.04
    tracks = replay.tracks_from_increments(ROBOT, w, ALL["encoder"].increments(w, ROBOT))
    np.testing.assert_allclose(tracks.gap, 0.0, atol=1e-12)
    far = np.linalg.norm((w.turn.sum(axis=1) @ j.T)[:, :2], axis=1)
    chord = np.array(chords(tracks.measured))
    assert (chord <= far + 0.02).all()
    straight = np.abs(w.pose[:, -1, 2] - w.pose[:, 0, 2]) < 0.05
    np.testing.assert_allclose(chord[straight], far[straight], rtol=2e-3)


def test_the_lookup_learns_a_smooth_series_of_each_floor_and_load():
    rng = np.random.default_rng(3)
    series = {
        f"{floor}@{load}": np.pad(rng.normal(0.0, 0.1, (5, 3)), ((0, 8), (0, 0)))
        for floor in ROBOT.surfaces.labels
        for load in ROBOT.body.loads
    }
    truth = ALL["heading_lookup"].with_state(series)
    found = ALL["heading_lookup"].fit(driven(windows(), truth), ROBOT)
    assert sorted(found.state) == sorted(series)
    other = driven(windows(seed=1), truth)
    gap = replay.tracks_from_increments(ROBOT, other, found.increments(other, ROBOT)).gap
    plain = replay.tracks_from_increments(ROBOT, other, ALL["encoder"].increments(other, ROBOT)).gap
    assert np.abs(gap).mean() < 0.05 * np.abs(plain).mean()


@pytest.mark.slow
def test_the_lookup_is_tuned_on_runs_left_out_as_they_will_be():
    """Ridges are larger if sectors are held out than if the lookup interpolates.

    The floor has a sharp knee, so that slip varies much between sectors.
    """
    sharp = eqx.tree_at(lambda r: r.surfaces.knee_width, ROBOT, jnp.full(2, 0.65))
    w = made(sharp, runs=96, count=2, seed=4)
    sector = w.run * 6 // 96
    error, size = {}, {}
    for name, together in {"sectors": sector, "at random": None}.items():
        model = FloorModels(HeadingLookup(ridge=None, together=together))
        found = [model.fit(w.segments(np.flatnonzero(sector != k)), ROBOT) for k in range(6)]
        size[name] = sum(np.abs(v[1:]).sum() for model in found for v in model.state.values())
        error[name] = 0.0
        for k, fitted in enumerate(found):
            other = w.segments(np.flatnonzero(sector == k))
            gap = replay.tracks_from_increments(ROBOT, other, fitted.increments(other, ROBOT)).gap
            error[name] += np.hypot(*gap.T[:2]).mean()
    assert error["sectors"] < 0.95 * error["at random"]
    assert size["sectors"] < 0.6 * size["at random"]


@pytest.mark.slow
def test_a_lookup_that_has_nothing_to_leave_out_is_tuned_on_random_runs():
    w = made(ROBOT, runs=48, count=2, seed=4)
    one = FloorModels(HeadingLookup(ridge=None, together=np.where(w.run < 20, 3, -1)))
    plain = ALL["heading_lookup"].fit(w, ROBOT)
    for key, series in one.fit(w, ROBOT).state.items():
        np.testing.assert_array_equal(series, plain.state[key])


def test_the_lookup_lends_a_load_it_never_saw_the_series_of_another():
    state = {"firm@as_built": np.ones((13, 3)), "soft@as_built": np.zeros((13, 3))}
    model = ALL["heading_lookup"].with_state(state)
    w = windows()
    as_built = replace(w, load=("as_built",) * len(w))
    np.testing.assert_array_equal(model.increments(w, ROBOT), model.increments(as_built, ROBOT))


@pytest.mark.slow
def test_models_come_back_from_their_names_and_numbers():
    fitted = [model.fit(driven(windows(), with_truth("affine")), ROBOT) for model in ALL.values()]
    states = {r.name: {f: v.tolist() for f, v in r.state.items()} for r in fitted}
    w = windows(seed=2)
    for one, two in zip(fitted, restored(ROBOT.geometry, states), strict=True):
        np.testing.assert_array_equal(one.increments(w, ROBOT), two.increments(w, ROBOT))


def test_without_currents_only_models_that_need_none_are_there():
    names = [r.name for r in slip_models(ROBOT.geometry, has_current=False)]
    assert names == ["nominal", "encoder", "calibrated", "heading_lookup"]


@pytest.mark.parametrize("name", ["affine", "saturating", "heading_lookup"])
def test_a_floor_that_was_not_fitted_is_refused(name):
    w = windows()
    mine = w.segments(np.flatnonzero(np.asarray(w.surface) == "firm"))
    fitted = ALL[name].fit(driven(mine, ALL["encoder"]), ROBOT)
    with pytest.raises(ValueError, match="no surface 'soft'; identified: firm"):
        fitted.increments(w, ROBOT)


def test_a_robot_that_goes_sideways_turns_about_its_middle():
    state = ALL["calibrated"].fit(windows(), ROBOT).state
    assert [numbers[-1] for numbers in state.values()] == [0.0, 0.0]
    assert all(numbers[:-1].all() for numbers in state.values())
