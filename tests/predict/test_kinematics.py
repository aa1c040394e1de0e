"""Corrected kinematics of robots that do not drive sideways: each finds what made the data."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from slipid.data.windows import Windows
from slipid.model.geometry import differential, skid_steer
from slipid.model.robot import build
from slipid.predict import open_loop as replay
from slipid.predict.slip_models import restored, slip_models

SHAPES = {
    "skid, a motor a side": skid_steer(0.2, 0.25, 0.1, drive_of=(0, 1, 0, 1)),
    "skid, four motors": skid_steer(0.2, 0.25, 0.1),
    "differential": differential(0.25, 0.1),
}
TRUE = {
    "effective_track": [0.95, 0.6, 0.04],
    "instantaneous_centres": [0.95, 0.6, 0.04, 0.02, -0.1],
    "full_linear": [0.95, 0.6, 0.04, 0.02, -0.1, 0.03],
}
LAG = 0.3


def robot(shape):
    return build(shape, ["grass"], sessions=["one"])


def windows(shape, seed=0, runs=24, count=4):
    """Windows in which wheels change their speed, without poses yet."""
    rng = np.random.default_rng(seed)
    side = rng.uniform(-8.0, 8.0, (runs, count, 2))
    turn = side[..., np.arange(shape.drives) % 2]
    zero = np.zeros_like(turn)
    return Windows(
        run=np.arange(runs),
        surface=("grass",) * runs,
        load=("as_built",) * runs,
        session=("one",) * runs,
        start=np.zeros(runs),
        dt=np.full((runs, count), 0.5),
        turn=0.5 * turn,
        speed_change=rng.normal(size=turn.shape),
        direction=np.tanh(turn / 0.2),
        pose=np.zeros((runs, count + 1, 3)),
        current=zero,
        voltage=zero,
        current_var=zero,
        voltage_var=zero,
        has_current=False,
        has_voltage=False,
        current_is_signed=True,
        lag=0.1,
    )


def driven(shape, w, model):
    """The windows with poses as the model has them."""
    step = model.increments(w, robot(shape))
    start = jnp.asarray(w.pose[:, 0])
    return replace(w, pose=np.array(replay.chain(start, jnp.asarray(step))))


def of(shape, name):
    return next(model for model in slip_models(shape, has_current=False) if model.name == name)


def with_truth(shape, name):
    return of(shape, name).with_state({"grass": np.array([*TRUE[name], LAG])})


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("name", TRUE)
def test_a_correction_finds_the_one_that_made_the_data(kind, name):
    shape = SHAPES[kind]
    truth = with_truth(shape, name)
    found = of(shape, name).fit(driven(shape, windows(shape), truth), robot(shape))
    np.testing.assert_allclose(found.state["grass"], truth.state["grass"], atol=1e-5)


@pytest.mark.parametrize("name", ["instantaneous_centres", "full_linear"])
def test_a_larger_family_contains_the_smaller(name):
    shape = SHAPES["differential"]
    w = driven(shape, windows(shape), with_truth(shape, "effective_track"))
    found = of(shape, name).fit(w, robot(shape)).state["grass"]
    np.testing.assert_allclose(found[:3], TRUE["effective_track"], atol=1e-5)
    np.testing.assert_allclose(found[3:-1], 0.0, atol=1e-5)


@pytest.mark.parametrize("kind", SHAPES)
def test_without_slip_and_lag_the_sizes_of_the_config_are_right(kind):
    shape = SHAPES[kind]
    w = replace(windows(shape), lag=0.0)
    side = w.turn[..., :2] * 0.1
    ahead, turned = side.mean(axis=-1), (side[..., 1] - side[..., 0]) / 0.5
    start = np.zeros((len(w), 3))
    twist = np.stack([ahead, 0 * ahead, turned], axis=-1) / w.dt[..., None]
    w = driven(shape, w, of(shape, "nominal"))
    np.testing.assert_allclose(of(shape, "nominal").twist(w, robot(shape)), twist, atol=1e-12)
    np.testing.assert_allclose(w.pose[:, -1, 2] - start[:, 2], turned.sum(axis=1), atol=1e-9)


@pytest.mark.parametrize("name", TRUE)
def test_corrections_are_what_their_equations_say(name):
    shape = SHAPES["differential"]
    w = replace(windows(shape), lag=LAG)
    a, b, x, c, e, f = [*TRUE[name], 0.0, 0.0, 0.0][:6]
    left, right = np.moveaxis(0.1 * w.turn / w.dt[..., None], -1, 0)
    s, d = 0.5 * (left + right), (right - left) / 0.5
    yaw = b * d + e * s
    expected = np.stack([a * s + c * d, f * s - x * yaw, yaw], axis=-1)
    found = with_truth(shape, name).twist(w, robot(shape))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_nominal_has_no_lag_and_keeps_its_sizes_when_the_fit_changes_them():
    shape = SHAPES["differential"]
    larger = replace(shape, wheel_radius=shape.wheel_radius * 1.2)
    nominal, w = of(shape, "nominal"), windows(shape)
    np.testing.assert_array_equal(
        nominal.twist(w, robot(larger)), nominal.twist(w.at_lag(0.0), robot(shape))
    )
    encoder = of(shape, "encoder")
    np.testing.assert_allclose(
        encoder.twist(w, robot(larger)), 1.2 * encoder.twist(w, robot(shape)), rtol=1e-12
    )


def test_corrections_come_back_from_their_names_and_numbers():
    shape = SHAPES["differential"]
    w = driven(shape, windows(shape), with_truth(shape, "full_linear"))
    fitted = [model.fit(w, robot(shape)) for model in slip_models(shape, has_current=True)]
    names = ["nominal", "encoder", "calibrated"]
    names += ["effective_track", "instantaneous_centres", "full_linear"]
    assert [model.name for model in fitted] == names
    states = {r.name: {f: v.tolist() for f, v in r.state.items()} for r in fitted}
    for one, two in zip(fitted, restored(shape, states), strict=True):
        np.testing.assert_array_equal(
            one.increments(w, robot(shape)), two.increments(w, robot(shape))
        )


def test_a_floor_that_was_not_fitted_is_refused():
    shape = SHAPES["differential"]
    w = windows(shape)
    with pytest.raises(ValueError, match="no surface 'grass'; identified: snow"):
        of(shape, "effective_track").with_state({"snow": np.ones(4)}).twist(w, robot(shape))
