"""Nothing of a left-out run is learnt, and what sessions share widens the regions of such runs."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from slipid.app.compare import without
from slipid.app.config import FitSection
from slipid.app.problem import FitTask, lag_from_motion, robot_for_runs
from slipid.data.runs import collect
from slipid.fitting.optimise import optimise
from slipid.lab.selftest.logs import (
    SimulatedSensors,
    heading_grid,
    nominal_robot,
    simulate_logs,
    true_robot,
)
from slipid.predict import fitted_slip_model, folds, predictive
from slipid.predict import open_loop as replay
from slipid.predict.fitted_slip_model import FittedSlipModel
from slipid.predict.predictive import force_balance_of
from slipid.predict.selection import contact_errors, selection_folds
from slipid.search_space import Choice

PLAN = heading_grid(
    setups=(("firm", "as_built"), ("soft", "as_built")), headings=6, speeds=(0.1, 0.2), turns=0
)
QUESTION = "sectors"
same = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
CHOICES = (Choice("camera.lag", free=False), Choice("camera.scale", free=True))
fit = partial(optimise, most_rounds=3)
pytestmark = pytest.mark.slow


def garbage(log, rng):
    """The log with finite nonsense in every measured channel; what was commanded stays."""

    def noise(x):
        return rng.normal(scale=3.0, size=x.shape)

    steps = rng.uniform(-0.1, 1.0, log.wheel_angle.shape)
    return replace(
        log,
        wheel_angle=np.cumsum(steps, axis=0),
        wheel_speed=noise(log.wheel_speed),
        current=np.abs(noise(log.current)),
        voltage=noise(log.voltage),
        pose=noise(log.pose),
    )


def backwards(log, rng):
    """The log with finite nonsense in every measured channel but for wheels that turn backwards.

    Its speed stays, so that a problem of such runs has arrays of the same shapes.
    """
    return replace(garbage(log, rng), wheel_angle=-log.wheel_angle)


def task_of(logs):
    data = collect(logs)
    robot = robot_for_runs(nominal_robot(PLAN), data, (0.0, 0.0))
    return FitTask(data, robot, CHOICES, FitSection(windows_per_piece=3))


@pytest.fixture(scope="module")
def logs():
    """Runs of which those of one speed look longer than those of the other."""
    made = simulate_logs(true_robot(PLAN), PLAN, 1, SimulatedSensors())
    longer = [1.0 + 0.03 * np.sign(d.speed - 0.15) for d in PLAN]
    return [replace(log, pose=log.pose * [k, k, 1.0]) for log, k in zip(made, longer, strict=True)]


@pytest.fixture(scope="module")
def judged(logs):
    """Runs of the sector that is left out: 60 degrees, at both speeds and on both floors."""
    return np.flatnonzero(folds.folds_of(collect(logs), QUESTION) == 1)


@pytest.fixture(scope="module")
def learnt(logs, judged):
    task = task_of(logs)
    return folds.fit_fold(task.problem(), CHOICES, task.dataset, QUESTION, judged, fit)


def test_nothing_of_a_left_out_run_is_learnt(logs, judged, learnt):
    """All of them but one are replaced by nonsense: fits, and what they say of that one, stay.

    Up to rounding: shared effects have coefs for every speed that any run was driven at, and those
    that no fitted run was near add nothing.
    """
    rng = np.random.default_rng(0)
    witness, spoilt = judged[0], judged[1:]
    other = task_of([garbage(log, rng) if k in spoilt else log for k, log in enumerate(logs)])
    again = folds.fit_fold(other.problem(), CHOICES, other.dataset, QUESTION, judged, fit)
    assert len(spoilt) > 2
    w = learnt.problem.windows
    kept = w.segments(np.flatnonzero(~np.isin(w.run, judged)))
    std = np.sqrt(np.diag(learnt.optimum.covariance))
    same(again.optimum.state.z / std, learnt.optimum.state.z / std)
    same(again.optimum.state.log_variance, learnt.optimum.state.log_variance)
    same(
        again.optimum.covariance / std / std[:, None],
        learnt.optimum.covariance / std / std[:, None],
    )
    for now, before in zip(again.models, learnt.models, strict=True):
        assert now.variance == pytest.approx(before.variance, rel=1e-4), now.name
        assert any(name.startswith("session.") for name in now.variance)
        size = np.sqrt(np.diag(before.covariance))
        both = size * size[:, None]
        same(now.covariance / both, before.covariance / both, err_msg=now.name)
        if isinstance(now, FittedSlipModel):
            assert now.model.state.keys() == before.model.state.keys()
            # of a curve that is straight where it was seen, numbers may be anything
            one, two = (m.model.twist(kept, m.robot) for m in (now, before))
            same(one, two, err_msg=now.name)

    def rows(task, found):
        return judge_as(found, task, judged)[list(judged).index(witness)].to_json()

    one, two = rows(other, again), rows(task_of(logs), learnt)
    for name, score in one.pop("models").items():
        expected = two["models"][name]
        same(score.pop("predicted_end"), expected.pop("predicted_end"), err_msg=name)
        assert score == pytest.approx(expected, rel=1e-4, abs=1e-6), name
    del two["models"]
    same(one.pop("measured_end"), two.pop("measured_end"))
    for length in ("chord", "path"):
        assert one.pop(length) == pytest.approx(two.pop(length)), length
    assert one == two


def numbers_of(found):
    """Everything that the models of a fold have learnt, keyed by model and name."""
    state, contact = found.optimum.state, found.models[0]
    out = {"z": state.z, "log_variance": state.log_variance, "loss": state.loss}
    out |= {
        f"shared {floor} {k}": v
        for floor, of in contact.shared.items()
        for k, v in vars(of).items()
    }
    out |= {f"extrapolation {k}": v for k, v in contact.extrapolation.items()}
    for m in found.models:
        learnt = m.model.state if isinstance(m, FittedSlipModel) else {}
        parts = {"covariance": m.covariance, **m.variance, **learnt}
        out |= {f"{m.name} {k}": v for k, v in parts.items()}
    return out


def test_no_bit_of_what_is_learnt_depends_on_left_out_runs(logs, judged, learnt):
    """Fits, variances, shared effects, ridges, and how they judge a run of the same fold."""
    rng = np.random.default_rng(0)
    witness, spoilt = judged[0], judged[1:]
    other = task_of([backwards(log, rng) if k in spoilt else log for k, log in enumerate(logs)])
    again = folds.fit_fold(other.problem(), CHOICES, other.dataset, QUESTION, judged, fit)
    before, now = numbers_of(learnt), numbers_of(again)
    assert before.keys() == now.keys()
    assert len(before) > 100
    for name, value in before.items():
        np.testing.assert_array_equal(now[name], value, err_msg=name)
    first, *rest = judge_as(learnt, task_of(logs), judged)
    first_now, *rest_now = judge_as(again, other, judged)
    assert first_now.to_json() == first.to_json()
    assert first.name == logs[witness].name
    for one, two in zip(rest_now, rest, strict=True):
        assert (
            one.models["calibrated"].endpoint_error > 10 * two.models["calibrated"].endpoint_error
        )


def test_what_runs_of_a_floor_share_moves_with_no_number_of_another_floor(learnt):
    space = learnt.problem.space
    for floor, other in (("firm", "soft"), ("soft", "firm")):
        slope = learnt.models[0].shared[floor].by_number
        assert not slope[..., space.where(lambda e, f=other: e.surface == f)].any()
        assert slope[..., space.where(lambda e, f=floor: e.surface == f)].any()


def test_a_fold_that_is_fitted_to_one_speed_holds_viscosities(logs, learnt):
    task = task_of(logs)
    one_speed = np.flatnonzero(folds.folds_of(task.dataset, "speeds") == 1)
    held = partial(folds.fit_fold, fit=lambda *_, **__: learnt.optimum)
    for judged, holds in ((one_speed, True), (one_speed[::2], False)):
        found = held(task.problem(), CHOICES, task.dataset, "speeds", judged)
        assert found.problem.space.held.any() == holds


def test_how_uncertain_other_directions_are_is_estimated_from_fitted_runs(
    learnt, judged, monkeypatch
):
    counted, of_axes = [], predictive.axis_effects

    def spied(objective, motion, keep, *more):
        counted.append(np.asarray(keep))
        return of_axes(objective, motion, keep, *more)

    monkeypatch.setattr(predictive, "axis_effects", spied)
    problem, optimum = learnt.problem, learnt.optimum
    keep = (~np.isin(problem.windows.run, judged)).astype(float)
    force_balance_of(problem, optimum.state, optimum.covariance, keep)
    np.testing.assert_array_equal(counted, [keep])


def test_a_step_without_a_fold_uses_nothing_of_it(logs, learnt):
    """The errors by which a force balance is selected: its optimum is that of all runs."""
    rng = np.random.default_rng(0)
    witness, *spoilt = np.flatnonzero(selection_folds(collect(logs)) == 1)
    other = task_of([backwards(log, rng) if k in spoilt else log for k, log in enumerate(logs)])
    before = contact_errors(collect(logs), learnt.problem, learnt.optimum)
    now = contact_errors(other.dataset, other.problem(), learnt.optimum)
    assert now[witness] == before[witness] < 0.1
    assert (now[spoilt] != before[spoilt]).all()


def test_no_bit_of_how_a_fold_starts_depends_on_left_out_runs(logs, judged):
    """Neither the prior of the lag nor the geometry nor the windows of the other runs."""
    rng = np.random.default_rng(0)

    def late(log):
        return replace(backwards(log, rng), pose=np.roll(log.pose, 20, axis=0))

    whole = [
        task_of(logs),
        task_of([late(log) if k in judged else log for k, log in enumerate(logs)]),
    ]
    whole = [replace(t, choices=(*lag_from_motion(t.dataset), *CHOICES[1:])) for t in whole]
    one, other = (without(task, judged) for task in whole)
    assert whole[0].choices != whole[1].choices
    assert one.choices == other.choices
    assert [c.pattern for c in one.choices] == ["camera.lag", "camera.scale", "camera.lag"]
    first, second = (task.problem().windows for task in (one, other))
    kept = np.flatnonzero(~np.isin(first.run, judged))
    assert first.lag == second.lag == one.choices[-1].start
    for name in ("dt", "turn", "pose", "current", "voltage"):
        x, y = (getattr(w.segments(kept), name) for w in (first, second))
        np.testing.assert_array_equal(x, y, err_msg=name)


def judge_as(found, task, judged):
    """Rows of `judge` where all has been learnt."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folds, "fit_fold", lambda *_: found)
        return folds.judge(found.problem, CHOICES, task.dataset, QUESTION, judged).rows


def test_regions_of_left_out_runs_know_what_sessions_share(logs, judged, learnt, monkeypatch):
    task = task_of(logs)
    known = judge_as(learnt, task, judged)
    for model in learnt.models:
        of_session = [name.startswith("session.") for name in model.variance]
        own = dict(
            zip(
                model.variance,
                np.where(of_session, 1e-30, list(model.variance.values())),
                strict=True,
            )
        )
        bare = replace(model, variance=own)
        regions = [
            (model.ends(w)[1], bare.ends(w)[1])
            for w in replay.replay_windows(task.dataset.subset(judged), model.robot)
        ]
        for wide, plain in [*regions, [m.scale(learnt.problem)[1] for m in (model, bare)]]:
            growth = np.linalg.eigvalsh(wide - plain)[:, -1]
            assert (growth > 0.01 * np.linalg.eigvalsh(plain)[:, -1]).all(), model.name
    nothing = {name: 1e-30 for name in learnt.models[0].variance if name.startswith("session.")}
    monkeypatch.setattr(
        fitted_slip_model, "with_session_effects", lambda model, *_: (nothing, model.covariance)
    )
    held = partial(folds.fit_fold, fit=lambda *_, **__: learnt.optimum)
    alone = held(task.problem(), CHOICES, task.dataset, QUESTION, judged)
    problem, state = learnt.problem, learnt.optimum.state
    of_session = [name.startswith("session.") for name in problem.noise.names]
    keep = (~np.isin(problem.windows.run, judged)).astype(float)
    narrow = problem.laplace(state.z, np.where(of_session, -60.0, state.log_variance), keep)
    assert np.linalg.eigvalsh(learnt.optimum.covariance - narrow).max() > 0
    for wide, narrow in zip(learnt.models[1:], alone.models[1:], strict=True):
        assert np.linalg.eigvalsh(wide.covariance - narrow.covariance).max() > 0, wide.name
    for one, other in zip(known, judge_as(alone, task, judged), strict=True):
        for name, score in one.models.items():
            if name == "identified":  # its sessions are in the fit, which is held
                continue
            assert score.predicted_end == other.models[name].predicted_end
            assert score.level < other.models[name].level, name
            assert score.log_density != other.models[name].log_density, name
