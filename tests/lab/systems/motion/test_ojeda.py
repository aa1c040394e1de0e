"""Ojeda's correction by currents: its flags, and k0 and k1 by each way of tuning."""

from dataclasses import replace

import numpy as np
import pytest

from slipid.lab.systems.motion.ojeda import HardFloor, Ojeda, forgetful, hard_runs, ojeda_rows
from slipid.predict.slip_model import TRIES
from slipid.predict.slip_models import ByFloor
from slipid.predict.steps import Steps
from tests.helpers.made_runs import HUSKY, ROBOTINO, made_run, straight

CONTINUOUS, SPORADIC, GYRO = ojeda_rows()


@pytest.fixture
def rng():
    return np.random.default_rng(2006)


def corrected_run(rng, line, *, floor, level, spec=ROBOTINO, rolling=None, spread=0.15):
    """Return a run on a floor with this current level [A] that slips as the method assumes."""
    while rolling is None or np.abs(rolling @ spec.forward.T).min() < 0.15:
        # no wheel so slow that slip would turn it backwards
        rolling = straight(rng.uniform(-np.pi, np.pi), 0.6, 60) + np.array(
            [0, 0, rng.uniform(-1, 1)]
        )
    drives = len(spec.forward)
    # the same all through a window, and long enough for the low pass not to lag
    current = level + np.tile(rng.uniform(-spread, spread, drives), (len(rolling), 1))
    rim = rolling @ spec.forward.T
    twist = (rim - np.sign(rim) * (line[0] + line[1] * current)) @ spec.back.T
    kept = {"spec": spec, "current": current, "gyro": twist[:, 2], "floor": floor}
    return made_run(rolling, twist, **kept)


def two_floors(rng, line, count=12, **extra):
    """Return runs on a hard floor without slip, and on a soft one."""
    hard = [corrected_run(rng, (0, 0), floor="hard", level=0.3, **extra) for _ in range(count)]
    soft = [corrected_run(rng, line, floor="soft", level=1.2, **extra) for _ in range(count)]
    return hard, soft


def path_error(method, runs, spec=ROBOTINO):
    predicted = method.predict([run.signals for run in runs], spec)
    return max(np.abs(s.path - run.pose).max() for s, run in zip(predicted, runs, strict=True))


# the two numbers


@pytest.mark.parametrize("method", [CONTINUOUS, SPORADIC, GYRO], ids=lambda m: m.name)
def test_both_numbers_come_back(rng, method):
    line = (0.02, 0.05)
    hard, soft = two_floors(rng, line)
    fitted = method.fit(hard + soft[:8], ROBOTINO)
    assert fitted.lines["soft"] == pytest.approx(line, rel=1e-3)
    assert np.array_equal(fitted.lines["hard"], [0.0, 0.0])
    assert fitted.numbers == 8
    assert path_error(fitted, soft[8:] + hard) < 1e-3


@pytest.mark.parametrize("method", [CONTINUOUS, SPORADIC, GYRO], ids=lambda m: m.name)
def test_both_numbers_of_a_skid_steer_come_back(rng, method):
    line = (0.05, 0.1)
    # turning on the spot is what tells a gyro how much all wheels slip alike
    spin = np.tile([0.02, 0.0, 1.5], (60, 1))
    bend = np.tile([0.6, 0.0, 0.5], (60, 1))
    hard, soft = [], []
    for rolling in (spin, -spin, bend, -bend, spin, bend):
        a, b = two_floors(rng, line, count=1, spec=HUSKY, rolling=rolling)
        hard, soft = hard + a, soft + b
    fitted = method.fit(hard + soft, HUSKY)
    assert fitted.lines["soft"] == pytest.approx(line, rel=1e-3)
    assert path_error(fitted, soft, HUSKY) < 1e-3


def test_places_are_relative_to_the_start_of_a_run(rng):
    hard, soft = two_floors(rng, (0.02, 0.05))
    c, s = np.cos(2.0), np.sin(2.0)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    elsewhere = [replace(run, pose=run.pose @ turn + np.array([3.0, -1.0, 2.0])) for run in soft]
    fitted = SPORADIC.fit(hard + elsewhere, ROBOTINO)
    assert fitted.lines["soft"] == pytest.approx([0.02, 0.05], rel=1e-3)
    assert hard_runs(elsewhere + hard, ROBOTINO) == hard


def test_a_gyro_without_information_gives_no_slip_at_the_hard_floors_current(rng):
    straight_on = np.tile([0.5, 0.0, 0.0], (60, 1))
    hard, soft = two_floors(rng, (0.05, 0.1), spec=HUSKY, rolling=straight_on)
    fitted = GYRO.fit(hard + soft, HUSKY)
    offset, gain = fitted.lines["soft"]
    assert gain == pytest.approx(0.1)
    assert offset + gain * fitted.hard.mean == pytest.approx(0.0, abs=1e-9)


def test_forgetting_ends_where_the_recursion_does(rng):
    parts, gap = rng.normal(size=(80, 3, 2)), rng.normal(size=(80, 3))
    found, spread = np.zeros(2), 0.5 * np.eye(2)
    for a, b in zip(parts, gap, strict=True):
        gain = spread @ a.T @ np.linalg.inv(0.9 * np.eye(3) + a @ spread @ a.T)
        found = found + gain @ (b - a @ found)
        spread = (spread - gain @ a @ spread) / 0.9
    assert forgetful(parts, gap, 0.9, 0.5) == pytest.approx(found)


def test_the_recursion_is_weighted_least_squares(rng):
    parts, gap = rng.normal(size=(400, 3, 2)), rng.normal(size=(400, 3))
    weight = np.repeat(0.995 ** np.arange(399, -1, -1), 3)
    a, b = parts.reshape(-1, 2), gap.ravel()
    expected = np.linalg.solve((a.T * weight) @ a, (a.T * weight) @ b)
    assert forgetful(parts, gap, 0.995, 1e9) == pytest.approx(expected)


def test_the_pose_known_all_the_time_is_forgotten_and_that_known_now_and_then_is_not(rng):
    hard, _ = two_floors(rng, (0.0, 0.0), count=4)
    old, new = (
        [corrected_run(rng, line, floor="soft", level=1.2) for _ in range(45)]
        for line in ((0.01, 0.02), (0.02, 0.05))
    )
    continuous, sporadic = (m.fit(hard + old + new, ROBOTINO) for m in (CONTINUOUS, SPORADIC))
    run = new[0]
    middle = corrected_run(rng, (0.015, 0.035), floor="soft", level=1.2)
    assert path_error(continuous, [run]) < 0.25 * path_error(sporadic, [run])
    assert path_error(sporadic, [middle]) < 0.3 * path_error(sporadic, [run])


# flags


def with_level(current):
    """Return steps with these currents in all wheels [A]."""
    return made_run(straight(0.3), current=np.tile(np.reshape(current, (-1, 1)), (1, 3))).signals


def test_slip_is_flagged_three_stds_above_the_hard_floors_mean():
    line = {None: np.array([0.05, 0.0])}
    method = replace(CONTINUOUS, hard=HardFloor(0.3, 0.1), lines=line)
    below, above = with_level(np.full(40, 0.59)), with_level(np.full(40, 0.61))
    predicted = method.predict([below, above], ROBOTINO)
    assert np.allclose(predicted[0].path, made_run(straight(0.3)).pose)
    assert np.allclose(predicted[0].slipping, 2.9)
    assert np.allclose(predicted[1].slipping, 3.1)
    rim = straight(0.3) @ ROBOTINO.forward.T
    twist = (rim - 0.05 * np.sign(rim)) @ ROBOTINO.back.T
    assert np.allclose(predicted[1].path, made_run(straight(0.3), twist).pose)


def test_one_wheel_alone_does_not_flag_slip():
    method = replace(CONTINUOUS, hard=HardFloor(0.3, 0.1), lines={None: np.array([0.05, 0.0])})
    one = made_run(straight(0.3), current=np.tile([1.1, 0.3, 0.3], (40, 1)))
    assert np.allclose(method.predict([one.signals], ROBOTINO)[0].path, one.pose)


def test_flags_wait_for_the_low_pass():
    method = replace(
        CONTINUOUS, hard=HardFloor(0.0, 0.1), lines={None: np.array([9.0, 0.0])}, time_constant=1.0
    )
    path = method.predict([with_level(np.append(0.0, np.ones(39)))], ROBOTINO)[0].path
    # 1 - exp(-k 0.1 s / 1 s) passes 0.3 in the fourth step after the jump; then all wheels stand
    assert np.allclose(np.diff(path[5:], axis=0)[1:], 0.0)
    assert np.linalg.norm(path[4]) == pytest.approx(4 * 0.02, rel=1e-6)
    assert np.linalg.norm(path[-1]) == pytest.approx(4 * 0.02, rel=1e-6)


def test_the_hard_floor_is_where_encoders_err_least(rng):
    hard, soft = two_floors(rng, (0.02, 0.05), count=3)
    assert hard_runs(soft + hard, ROBOTINO) == hard
    fitted = CONTINUOUS.fit(soft + hard, ROBOTINO)
    means = np.concatenate([run.signals.current.mean(axis=1) for run in hard])
    assert fitted.hard.mean == pytest.approx(means.mean())
    assert fitted.hard.std == pytest.approx(means.std())


def test_standing_still_does_not_change_the_hard_floor():
    moving = made_run(straight(0.3), current=np.full((40, 3), 0.4), floor="hard")
    still = made_run(straight(0.3) * 0.0, current=np.zeros((40, 3)), floor="hard")
    soft = made_run(straight(0.3), straight(0.3) * 0.5, current=np.ones((40, 3)), floor="soft")
    assert CONTINUOUS.fit([moving, still, soft], ROBOTINO).hard.mean == pytest.approx(0.4)
    assert CONTINUOUS.fit([still], ROBOTINO).hard.mean == pytest.approx(0.0)


def test_of_one_floor_the_quarter_that_slips_least_is_the_hard_one():
    rolling = straight(0.3)
    runs = [
        made_run(rolling, rolling * (1 - k / 10), floor="soft") for k in (5, 1, 7, 3, 6, 2, 4, 8)
    ]
    assert [runs.index(run) for run in hard_runs(runs, ROBOTINO)] == [1, 5]
    assert hard_runs(runs[:1], ROBOTINO) == runs[:1]


def test_the_error_of_turning_on_the_spot_is_its_yaw():
    spin = np.tile([0.0, 0.0, 1.0], (40, 1))
    firm, loose = (made_run(spin, spin * k, floor=f) for k, f in ((0.9, "firm"), (0.5, "loose")))
    assert hard_runs([loose, firm], ROBOTINO) == [firm]


# floors


def test_floors_that_are_not_known_get_the_numbers_of_all_runs(rng):
    hard, soft = two_floors(rng, (0.02, 0.05))
    sand = [corrected_run(rng, (0.04, 0.06), floor="sand", level=1.2) for _ in range(12)]
    fitted = SPORADIC.fit(hard + soft + sand, ROBOTINO)
    assert fitted.lines["sand"] == pytest.approx([0.04, 0.06], rel=1e-3)
    offset, gain = fitted.lines[None]
    assert 0.02 + 0.05 * 1.2 < offset + gain * 1.2 < 0.04 + 0.06 * 1.2
    untold, strange = (replace(sand[0].signals, floor=floor) for floor in (None, "ice"))
    own, *others = fitted.predict([sand[0].signals, untold, strange], ROBOTINO)
    assert np.array_equal(others[0].path, others[1].path)
    assert np.abs(own.path - others[0].path).max() > 0.01


def test_runs_on_one_floor_have_one_pair_of_numbers(rng):
    _, soft = two_floors(rng, (0.02, 0.05))
    assert CONTINUOUS.fit(soft, ROBOTINO).numbers == 4
    assert CONTINUOUS.numbers == 0
    by_floor = ByFloor.of(CONTINUOUS).fit(soft, ROBOTINO)
    assert len(by_floor.predict([run.signals for run in soft], ROBOTINO)) == len(soft)


def test_a_wheel_is_never_turned_backwards():
    method = replace(CONTINUOUS, hard=HardFloor(0.3, 0.01), lines={None: np.array([9.0, 0.0])})
    run = with_level(np.full(40, 1.0))
    assert np.allclose(method.predict([run], ROBOTINO)[0].path, 0.0)


def test_runs_of_all_lengths_are_predicted_as_one_by_one(rng):
    hard, soft = two_floors(rng, (0.02, 0.05), count=4)
    fitted = CONTINUOUS.fit(hard + soft, ROBOTINO)
    short = [run.windowed().signals for run in soft]
    runs = [soft[0].signals, short[1], hard[2].signals]
    for predicted, run in zip(fitted.predict(runs, ROBOTINO), runs, strict=True):
        alone = fitted.predict([run], ROBOTINO)[0]
        assert np.allclose(predicted.path, alone.path)
        assert np.allclose(predicted.slipping, alone.slipping)
        assert len(predicted.slipping) == len(run)


def test_signed_currents_count_along_the_wheels_way(rng):
    hard, soft = two_floors(rng, (0.02, 0.05))
    fitted = CONTINUOUS.fit(hard + soft, ROBOTINO)
    run = soft[0]
    way = np.sign(run.signals.speed)
    signed = replace(run.signals, current=run.signals.current * way, current_is_signed=True)
    first, second = (fitted.predict([measured], ROBOTINO)[0] for measured in (run.signals, signed))
    assert np.allclose(first.path, second.path)
    assert np.allclose(Steps.of([signed]).signals.along(ROBOTINO), run.signals.current)


def test_rows_differ_in_what_they_need():
    assert [method.name for method in ojeda_rows()] == [
        "ojeda_continuous",
        "ojeda_sporadic",
        "ojeda_gyro",
    ]
    assert CONTINUOUS.needs == SPORADIC.needs == {"current"}
    assert GYRO.needs == {"current", "gyro"}
    tried = {method.time_constant for method in GYRO.candidates()}
    assert 1 < len(tried) == len(GYRO.candidates()) <= TRIES
    assert {method.tuning for method in GYRO.candidates()} == {"gyro"}
    assert isinstance(GYRO, Ojeda)


def test_missing_channels_raise(rng):
    _, soft = two_floors(rng, (0.02, 0.05))
    with pytest.raises(ValueError, match="not fitted"):
        CONTINUOUS.predict([soft[0].signals], ROBOTINO)
    hard, _ = two_floors(rng, (0.02, 0.05))
    deaf = [replace(run, signals=replace(run.signals, gyro=None)) for run in hard + soft]
    with pytest.raises(ValueError, match="no gyro"):
        GYRO.fit(deaf, ROBOTINO)
