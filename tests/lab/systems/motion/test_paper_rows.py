"""The 2021 paper's rows: its own numbers by hand, and each form refitted where it is the truth."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.svm import SVR

from slipid.lab.paper2021.deployed_form import (
    MOST_SAMPLES,
    PaperCode,
    PaperPrint,
    PaperSvr,
    insensitive_curve,
    paper_rows,
    recipe_samples,
    refits,
)
from slipid.lab.paper2021.table import CURRENT_SVR, field_table
from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.predict.slip_model import SHAFT_W0, TRIES, RobotSpec
from slipid.predict.slip_models import ByFloor
from slipid.predict.steps import TrainingWindows
from tests.helpers.made_runs import ROBOTINO, made_run, straight

PRINT_REFIT, CODE_REFIT = refits()
FOUR = RobotSpec.of(build(omni([45.0, 135.0, 225.0, 315.0], 0.2, 0.05, 20.0), ("gray",)))


@pytest.fixture
def rng():
    return np.random.default_rng(2021)


def slipping(rng, curve, *, angle=None, low=0.2, high=0.8, dt=0.1, spec=ROBOTINO, noise=0.0):
    """Return a run with random currents, constant over half a second, and slip `curve` of them."""
    angle = rng.uniform(-np.pi, np.pi) if angle is None else angle
    rolling = straight(angle) + np.array([0.0, 0.0, 0.2])
    hold = round(0.5 / dt)
    drives = len(spec.forward)
    current = rng.uniform(low, high, (40 // hold + 1, drives)).repeat(hold, axis=0)[:40]
    run = made_run(rolling, current=current, spec=spec, dt=dt)
    rim = run.signals.speed * spec.wheel_radius
    twist = (rim * (1 - curve(run.signals))) @ spec.back.T + noise * rng.normal(size=(40, 3))
    return made_run(rolling, twist, current=current, spec=spec, dt=dt)


def torque(heard):
    return heard.torque(ROBOTINO)


def path_error(method, runs, spec=ROBOTINO):
    said = method.predict([run.signals for run in runs], spec)
    return max(np.abs(s.path - run.pose).max() for s, run in zip(said, runs, strict=True))


def said_slip(method, heard, spec=ROBOTINO):
    """Return the slip of each drive in the first step, by the predicted path."""
    path = method.predict([heard], spec)[0].path
    run = replace(made_run(straight(0.0)), signals=heard, pose=path)
    return 1 - run.twist @ spec.forward.T / (heard.speed * spec.wheel_radius)


# as printed


def test_the_printed_curve_by_hand():
    amps = np.tile([0.3, 0.5, 0.7], (40, 1))
    heard = made_run(straight(0.4), current=amps).signals
    shaft = np.abs(heard.speed[0]) * 16
    m = 0.0501 * amps[0] + 5.3361 * amps[0] ** 2 * shaft / (shaft**2 + SHAFT_W0**2)
    expected = -0.072 + 4.888 * m - 5.456 * m**2
    assert np.all((expected > 0) & (expected < 1))
    assert said_slip(PaperPrint(), heard) == pytest.approx(np.tile(expected, (40, 1)))


def test_printed_slip_is_held_between_none_and_all():
    turning = np.tile([0.0, 0.0, 0.5], (40, 1))
    shaft = 0.5 * 0.125 / 0.040 * 16
    heat = 5.3361 * shaft / (shaft**2 + SHAFT_W0**2)
    # the current at which M is where the parabola is highest, above one
    peak = (-0.0501 + np.sqrt(0.0501**2 + 4 * heat * 0.448)) / (2 * heat)
    assert -0.072 + 4.888 * 0.448 - 5.456 * 0.448**2 > 1.0
    idle = made_run(turning, current=np.full((40, 3), 0.05))
    stalled = made_run(turning, current=np.full((40, 3), peak))
    idle_said, stalled_said = PaperPrint().predict([idle.signals, stalled.signals], ROBOTINO)
    assert np.allclose(idle_said.path, idle.pose)
    assert np.allclose(stalled_said.path, 0.0)


def test_nothing_printed_or_deployed_depends_on_the_runs(rng):
    run = slipping(rng, lambda heard: 0.3 * heard.current)
    for method in (PaperPrint(), PaperCode()):
        fitted = ByFloor.of(method).fit([run], ROBOTINO)
        assert fitted.numbers == 0
        plain = method.predict([run.signals], ROBOTINO)[0].path
        assert np.array_equal(fitted.predict([run.signals], ROBOTINO)[0].path, plain)


# as run


def test_the_deployed_lines_by_hand():
    heard = made_run(straight(0.4), current=np.tile([0.5, 0.6, 0.39], (40, 1))).signals
    expected = [1 - (-0.639 * 0.5 + 0.988), 1 - (-0.4559 * 0.6 + 0.9678), 0.0]
    assert said_slip(PaperCode(), heard) == pytest.approx(np.tile(expected, (40, 1)))


@pytest.mark.parametrize("samples", [1, 3])
def test_deployed_currents_are_smoothed_over_the_authors_samples(samples):
    current = np.full((40, 3), 1.0)
    current[0] = 0.0
    heard = made_run(straight(0.4), current=current, dt=0.031 * samples).signals
    smoothed = 1 - 0.97 ** (samples * np.arange(40))
    expected = np.where(smoothed > 0.4, 1 - (-0.639 * smoothed + 0.988), 0.0)
    assert said_slip(PaperCode(), heard)[:, 0] == pytest.approx(expected)


def test_four_drives_get_the_mean_of_the_three_motors():
    amps = np.array([0.5, 0.6, 0.7, 0.3])
    heard = made_run(straight(0.3), current=np.tile(amps, (40, 1)), spec=FOUR).signals
    grip = np.mean([-0.639, -0.4559, -0.6294]) * amps + np.mean([0.988, 0.9678, 0.9913])
    slip = np.where(amps > 0.4, 1 - grip, 0.0)
    run = made_run(straight(0.3), spec=FOUR)
    twist = (run.signals.speed * FOUR.wheel_radius * (1 - slip)) @ FOUR.back.T
    expected = made_run(straight(0.3), twist, spec=FOUR).pose
    assert np.allclose(PaperCode().predict([heard], FOUR)[0].path, expected)


# refitted


def test_the_printed_form_comes_back(rng):
    truth = np.array([0.1, 1.5, -2.0])

    def curve(heard):
        return np.polynomial.polynomial.polyval(torque(heard), truth)

    runs = [slipping(rng, curve) for _ in range(20)]
    method = PRINT_REFIT.fit(runs[:10], ROBOTINO)
    assert method.coefficients == pytest.approx(truth)
    assert method.numbers == 3
    assert path_error(method, runs[10:]) < 1e-9
    assert path_error(PaperPrint(), runs[10:]) > 0.02


def test_the_refit_is_least_squares_in_displacement(rng):
    runs = [slipping(rng, lambda heard: 0.4 * heard.current, noise=0.05, dt=0.5) for _ in range(12)]
    rows, gaps = [], []
    for run in runs:
        rim = run.signals.speed * ROBOTINO.wheel_radius
        for k in range(40):
            m = torque(run.signals)[k]
            lost = np.stack([ROBOTINO.back @ (rim[k] * m**power) for power in range(3)], axis=1)
            gap = run.signals.rolling(ROBOTINO)[k] - run.twist[k]
            rows.append(lost * [[1.0], [1.0], [0.125]])
            gaps.append(gap * [1.0, 1.0, 0.125])
    oracle = LinearRegression(fit_intercept=False).fit(np.concatenate(rows), np.concatenate(gaps))
    method = PRINT_REFIT.fit(runs, ROBOTINO)
    assert method.coefficients == pytest.approx(oracle.coef_, rel=1e-6)


def test_the_deployed_form_comes_back_for_each_motor(rng):
    gain, offset = np.array([0.5, 0.3, 0.7]), np.array([0.02, 0.05, -0.01])

    def curve(heard):
        memory = 0.97 ** (0.5 / 0.031)
        x = heard.current.copy()
        for k in range(1, len(x)):
            x[k] = memory * x[k - 1] + (1 - memory) * x[k]
        return np.where(x > 0.4, gain * x + offset, 0.0)

    runs = [slipping(rng, curve, dt=0.5) for _ in range(20)]
    method = CODE_REFIT.fit(runs[:10], ROBOTINO)
    assert method.coefficients == pytest.approx(np.stack([gain, offset], axis=1).ravel())
    assert method.numbers == 6
    assert path_error(method, runs[10:]) < 1e-9


def test_a_motor_that_never_draws_enough_is_not_corrected(rng):
    runs = [slipping(rng, lambda heard: 0.0 * heard.current, high=0.39) for _ in range(3)]
    method = CODE_REFIT.fit(runs, ROBOTINO)
    assert np.array_equal(method.coefficients, np.zeros(6))
    assert path_error(method, runs) < 1e-12


def test_a_refit_never_turns_a_wheel_backwards():
    heard = made_run(straight(0.4), current=np.full((40, 3), 2.0)).signals
    for slip, held in ((3.0, 1.0), (-3.0, -1.0)):
        method = replace(PRINT_REFIT, coefficients=np.array([slip, 0.0, 0.0]))
        path = method.predict([heard], ROBOTINO)[0].path
        assert np.allclose(path, (1 - held) * made_run(straight(0.4)).pose)


# by the authors' recipe


def test_the_recipe_keeps_what_the_authors_kept():
    slip = np.array([0.3, -0.2, 1.2])
    current = np.array([0.3, 0.5, 0.5])
    drifting = made_run(straight(0.4), current=np.tile(current, (40, 1)))
    rim = drifting.signals.speed * ROBOTINO.wheel_radius
    twist = (rim * (1 - slip)) @ ROBOTINO.back.T
    run = made_run(straight(0.4), twist, current=np.tile(current, (40, 1)))
    found = recipe_samples(TrainingWindows.of([run]), ROBOTINO)
    assert np.allclose(found.slip, np.full(8, 0.3))
    assert np.allclose(found.torque, run.signals.torque(ROBOTINO)[0, 0])
    idle = replace(run, signals=replace(run.signals, current=np.full((40, 3), 0.25)))
    assert len(recipe_samples(TrainingWindows.of([idle]), ROBOTINO)) == 0


def test_at_most_so_many_samples_are_drawn_and_always_the_same(rng):
    slips = np.linspace(0.1, 0.5, 30)
    runs = [slipping(rng, lambda heard, s=s: s + 0 * heard.current, dt=0.5, low=0.3) for s in slips]
    found, again = (
        recipe_samples(TrainingWindows.of(runs), ROBOTINO),
        recipe_samples(TrainingWindows.of(runs), ROBOTINO),
    )
    assert len(found) == MOST_SAMPLES < 30 * 40 * 3
    assert np.array_equal(found.slip, again.slip)
    # by lot, not those of the first runs alone
    assert found.slip.mean() == pytest.approx(slips.mean(), abs=0.01)


@pytest.mark.parametrize("truth", [(0.1, 1.2), (0.05, 2.0, -1.5)])
def test_a_curve_that_is_the_truth_comes_back_within_the_tube(rng, truth):
    def curve(heard):
        return np.polynomial.polynomial.polyval(torque(heard), truth)

    runs = [slipping(rng, curve, low=0.26, angle=0.3) for _ in range(30)]
    name = "paper_linear_svr" if len(truth) == 2 else "paper_quadratic_svr"
    method = PaperSvr(name, len(truth) - 1, c=1.0, tube=0.0).fit(runs, ROBOTINO)
    assert method.coefficients == pytest.approx(truth, abs=0.02)
    assert method.numbers == len(truth)
    assert path_error(method, runs) < 0.01


@pytest.mark.parametrize("degree", [1, 2])
def test_regression_is_that_of_a_linear_kernel(rng, degree):
    x = rng.uniform(0.02, 0.4, 300)
    slip = 0.1 + 2.0 * x - 2.0 * x**2 + 0.05 * rng.standard_t(3, 300)
    found = insensitive_curve(x, slip, degree, c=0.05, tube=0.5)
    powers = x[:, None] ** np.arange(1, degree + 1)
    epsilon = 0.5 * np.subtract(*np.percentile(slip, (75, 25))) / 1.349
    scaled = (powers - powers.mean(axis=0)) / powers.std(axis=0)
    oracle = SVR(kernel="linear", C=0.05, epsilon=epsilon, tol=1e-6).fit(scaled, slip)
    predicted = np.polynomial.polynomial.polyval(x, found)
    assert predicted == pytest.approx(oracle.predict(scaled), abs=0.003)


def test_regressions_fall_back_to_encoders_where_the_recipe_leaves_nothing(rng):
    run = slipping(rng, lambda heard: -0.1 + 0.0 * heard.current)
    for degree in (1, 2):
        method = PaperSvr("paper_svr", degree).fit([run], ROBOTINO)
        assert method.coefficients.tolist() == [0.0] * (degree + 1)
        path = method.predict([run.signals], ROBOTINO)[0].path
        assert np.allclose(path, made_run(run.signals.rolling(ROBOTINO)).pose)


def test_one_torque_alone_makes_no_curve_but_a_level(rng):
    rolling = np.tile([0.0, 0.0, 0.5], (40, 1))
    # the same but for rounding
    current = 0.5 + 1e-13 * rng.normal(size=(40, 3))
    run = made_run(rolling, 0.7 * rolling, current=current)
    for degree in (1, 2):
        curve = PaperSvr("svr", degree).fit([run], ROBOTINO).coefficients
        assert curve == pytest.approx([0.3, 0.0, 0.0][: degree + 1])


def test_regressed_slip_is_held_between_none_and_all():
    run = made_run(straight(0.4), current=np.full((40, 3), 0.5))
    for curve, share in (((-0.5, 0.0), 1.0), ((1.5, 0.0), 0.0), ((0.5, 0.0), 0.5)):
        path = (
            PaperSvr("svr", coefficients=np.array(curve)).predict([run.signals], ROBOTINO)[0].path
        )
        assert np.allclose(path, share * run.pose)


def test_the_line_of_figure_2_comes_back_from_the_authors_samples(real_data):
    samples = field_table(real_data / "robotino2021").samples
    usual = PaperSvr("paper_linear_svr", 1)
    line = insensitive_curve(samples.current, samples.slip, 1, usual.c, usual.tube)
    assert line == pytest.approx(CURRENT_SVR, abs=0.01)
    # which is not what least squares say
    squares = np.polynomial.Polynomial.fit(samples.current, samples.slip, 1).convert().coef
    assert np.abs(squares - CURRENT_SVR).min() > 0.03


# rows


def test_every_row_wants_currents_and_a_twist_and_has_a_name_of_its_own():
    names = [method.name for method in paper_rows()]
    assert len(set(names)) == len(names) == 6
    assert all(method.needs == {"current", "twist"} for method in paper_rows())
    assert all(name.startswith("paper_") for name in names)
    for method in (PaperSvr("paper_linear_svr", 1), PaperSvr("paper_quadratic_svr", 2)):
        tried = {(m.c, m.tube) for m in method.candidates()}
        assert len(tried) == len(method.candidates()) == TRIES
        assert {m.degree for m in method.candidates()} == {method.degree}


@pytest.mark.parametrize("method", [PRINT_REFIT, CODE_REFIT, PaperSvr("svr")])
def test_what_is_fitted_does_not_predict_before(method):
    with pytest.raises(ValueError, match="not fitted"):
        method.predict([made_run(straight(0.1), current=np.ones((40, 3))).signals], ROBOTINO)
