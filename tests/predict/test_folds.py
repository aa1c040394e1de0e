"""Left-out comparison: densities, errors of differences, verdicts, restarts."""

from __future__ import annotations

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import binom, chi2, multivariate_t
from typer.testing import CliRunner

from slipid.app import compare
from slipid.app.compare import finished
from slipid.app.logs import packaged_config
from slipid.cli.main import app
from slipid.data.runs import collect
from slipid.data.windows import windows
from slipid.fitting.likelihood import batch
from slipid.fitting.problem import Problem
from slipid.fitting.session_effects import LinearModel, with_session_effects
from slipid.fitting.variances import DEGREES
from slipid.infer.design.planned_runs import PlannedRun
from slipid.lab.selftest.logs import SimulatedSensors, heading_grid, simulate_logs, true_robot
from slipid.predict import open_loop as replay
from slipid.predict.fitted_slip_model import fit_with_noise, slopes
from slipid.predict.folds import folds_of, inner_folds, like_held_out, problem_of_runs
from slipid.predict.predictive import ForceBalance, by_name, log_student
from slipid.predict.ranking import errors_by_floor, ranking, transfer
from slipid.predict.score import Score, forecast, mean_error
from slipid.predict.slip_models import slip_models
from slipid.predict.validation import ScoredRun
from slipid.search_space import Choice
from slipid.support.checkpoint import Checkpoint
from slipid.support.errors import DataError
from tests.helpers.made_logs import write_logs
from tests.helpers.made_windows import SCALE, made
from tests.helpers.made_windows import robot as made_robot

ROBOT = made_robot(sessions=("one",))
ALL = {model.name: model for model in slip_models(ROBOT.geometry, has_current=True)}
STD = {
    "run.along": 0.02,
    "run.across": 0.02,
    "run.yaw": 0.05,
    "process.along": 0.006,
    "process.across": 0.004,
    "process.yaw": 0.02,
    "camera.place": 0.0005,
    "camera.heading": 0.003,
}
HELD = [Choice("camera.scale", fixed=SCALE)]


# densities and errors ---------------------------------------------------------------------------


def test_the_density_is_that_of_scipy():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 4, 4))
    scale, gap = root @ root.transpose(0, 2, 1) + np.eye(4), rng.normal(size=(5, 4))
    oracle = [
        multivariate_t.logpdf(x, shape=v, df=DEGREES) for x, v in zip(gap, scale, strict=True)
    ]
    np.testing.assert_allclose(log_student(gap, scale), oracle, rtol=1e-10)


def test_regions_and_energy_scores_are_those_of_many_draws():
    cov, gap = np.array([[0.04, 0.01], [0.01, 0.02]]), np.array([[0.0, 0.0], [0.3, -0.1]])
    draws = multivariate_t(shape=cov, df=DEGREES).rvs(20_000, random_state=1)
    level, score = forecast(gap, np.array([cov, cov]))
    far = np.einsum("ni,ij,nj->n", gap, np.linalg.inv(cov), gap)
    inside = np.einsum("ni,ij,nj->n", draws, np.linalg.inv(cov), draws) <= far[1]
    np.testing.assert_allclose(level, [0.0, inside.mean()], atol=0.01)
    near = [np.linalg.norm(draws - one, axis=1).mean() for one in gap]
    apart = np.linalg.norm(draws[::2] - draws[1::2], axis=1).mean()
    # of a few hundred draws; half of the distance between two draws is 0.14
    np.testing.assert_allclose(score, np.array(near) - 0.5 * apart, atol=0.03)
    level, score = forecast(gap, None)
    assert level is None
    np.testing.assert_allclose(score, np.linalg.norm(gap, axis=1))


def test_a_camera_errs_at_both_ends_of_a_way_and_turns_it_by_the_heading_at_its_start():
    w = made(ROBOT, runs=4)
    tracks = replay.tracks_from_increments(
        ROBOT, w, np.asarray(replay.contact_increments(ROBOT, batch(w, ROBOT)))
    )
    none = np.zeros((4, 3, 3)), np.zeros((4, 2, 2))
    variance = {"camera.place": 4e-6, "camera.heading": 0.0}
    found = replay.end_covariance(ROBOT, w, tracks, variance, *none)
    np.testing.assert_allclose(found, [2 * 4e-6 * SCALE**2 * np.eye(2)] * 4, rtol=1e-12)
    variance = {"camera.place": 0.0, "camera.heading": 9e-6}
    found = replay.end_covariance(ROBOT, w, tracks, variance, *none)
    way = (tracks.predicted[:, -1] - tracks.predicted[:, 0])[:, :2]
    across = way[:, ::-1] * [-1.0, 1.0]
    expected = 9e-6 * across[:, :, None] * across[:, None, :]
    np.testing.assert_allclose(found, expected, atol=1e-18)


def test_the_error_of_a_paired_difference_is_that_of_a_mean_and_clusters_count_once():
    rng = np.random.default_rng(1)
    x = rng.normal(size=40)
    mean, se, clustered = mean_error(x, np.arange(40))
    assert (mean, se) == pytest.approx((x.mean(), x.std(ddof=1) / np.sqrt(40)))
    assert clustered == pytest.approx(se)
    # the same value three times is one observation
    again = mean_error(np.repeat(x, 3), np.repeat(np.arange(40), 3))
    assert again[0] == pytest.approx(mean)
    assert again[2] == pytest.approx(se)
    assert again[1] < 0.6 * se
    assert np.isnan(mean_error(x[:1], np.zeros(1, int))[1])


def rows(densities, seed=0):
    """Rows of 36 headings for models with these log densities per run."""
    rng = np.random.default_rng(seed)
    return [
        ScoredRun(
            name=f"run{k}",
            surface="floor",
            load="as_built",
            heading_deg=10.0 * k,
            speed=0.1,
            chord=0.5,
            path=0.5,
            measured_end=(0.5, 0.0, 0.0),
            models={
                name: Score(
                    predicted_end=(0.5, 0.0, 0.0),
                    endpoint_error=float(rng.uniform(0.01, 0.02)),
                    endpoint_error_over_path=float(rng.uniform(0.01, 0.02)),
                    length_error=0.01,
                    heading_error_deg=1.0,
                    level=float(rng.uniform()),
                    covered90=True,
                    energy_score=0.01,
                    log_density=float(values[k]),
                )
                for name, values in densities.items()
            },
        )
        for k in range(36)
    ]


def test_a_judged_run_comes_back_from_its_file():
    run = rows({"identified": np.arange(36.0)})[3]
    back = ScoredRun.of_json(json.loads(json.dumps(run.to_json())))
    assert back.models["identified"].log_density == 3.0
    assert back.to_json() == json.loads(json.dumps(run.to_json()))


def test_a_clear_winner_is_named_and_a_difference_within_its_error_is_not():
    rng = np.random.default_rng(2)
    base = rng.normal(30.0, 3.0, 36)
    ranked = ranking(
        rows(
            {
                "identified": base,
                "constant": base - 4.0 + rng.normal(0.0, 1.0, 36),
                "linear": base + rng.normal(-0.05, 1.0, 36),
            }
        )
    )["floor"]
    verdicts = {name: one.verdict for name, one in ranked.models.items()}
    assert sorted(verdicts.values()) == ["best", "tied", "worse"]
    assert verdicts["constant"] == "worse"
    assert "cannot distinguish contact equilibrium from linear" in ranked.sentence
    alone = ranking(rows({"identified": base, "constant": base - 4.0}))["floor"]
    assert alone.sentence.startswith("floor: contact equilibrium is best; next constant, 4.0")


def test_errors_that_neighbouring_headings_share_do_not_make_a_winner():
    """A difference that is one sector's luck is clear per run and not per sector."""
    base = np.full(36, 30.0)
    luck = np.where(np.arange(36) < 9, 1.0, 0.01)
    one = ranking(rows({"identified": base, "constant": base - luck}))["floor"].models["constant"]
    assert abs(one.difference) > 2 * one.se
    assert one.verdict == "tied"


# predictive distributions of slip models --------------------------------------------------------


def driven(name, state, seed, runs=96):
    """Windows whose poses a model made, with noise of STD, and the same problem's start."""
    w = made(ROBOT, runs=runs, count=2, seed=seed, voltage=False)
    amps = np.random.default_rng(seed).uniform(0.1, 2.0, w.current.shape)
    w = replace(w, current=amps)
    by_floor = {f: np.asarray(b, float) for f, b in zip(ROBOT.surfaces.labels, state, strict=True)}
    step = ALL[name].with_state(by_floor).increments(w, ROBOT)
    noise = made(ROBOT, runs=runs, count=2, seed=seed, voltage=False, std=STD)
    still = made(ROBOT, runs=runs, count=2, seed=seed, voltage=False, std={})
    step = step + increments_of(noise) - increments_of(still)
    pose = np.array(replay.chain(jnp.asarray(w.pose[:, 0]), jnp.asarray(step)))
    pose[..., :2] /= SCALE
    return replace(w, pose=pose)


def increments_of(w):
    from slipid.fitting.likelihood import measured_increments

    return np.asarray(measured_increments(ROBOT, jnp.asarray(w.pose)))


def judged(w, names):
    """Rows of the odd runs under slip models fitted to the even ones, at the true camera."""
    problem = Problem(w, ROBOT, HELD)
    z = problem.space.vector(ROBOT)
    variance = by_name(problem, 2 * np.log(problem.noise.typical))
    contact = ForceBalance(ROBOT, variance, 1e-12 * np.eye(len(z)), problem.space, z, {}, {})
    half = w.run // 4 % 2
    keep = (half == 0).astype(float)
    models = [fit_with_noise(ALL[name], contact, problem, keep) for name in names]
    density = {m.name: m.log_density(problem) for m in models}
    out = rows({name: values[half == 1] for name, values in density.items()})
    floors = np.asarray(w.surface)[half == 1]
    out = [replace(row, surface=str(f)) for row, f in zip(out, floors, strict=False)]
    return out, dict(zip(names, models, strict=True)), problem, half


CONSTANT = ([0.1, 0.0], [0.3, 0.0])
"""Affine curves of two floors on which all wheels slip by 10 % and 30 % at any torque."""


def width_of_student(m):
    """Mean of q / m where a Student t's scale was fitted to m Gaussian numbers."""

    def slope(width):
        def weighed(q):
            return (DEGREES + m) * width * q / (DEGREES + width * q) * chi2.pdf(q, m)

        return quad(weighed, 0, np.inf)[0] - m

    return brentq(slope, 0.5, 3.0)


@pytest.mark.slow
def test_linear_slip_is_told_from_constant_slip():
    ranked, models, _, _ = judged(
        driven("linear", ([1.0], [3.0]), 3, runs=480), ("encoder", "calibrated", "linear", "affine")
    )
    for floor in ranking(ranked).values():
        verdict = {name: one.verdict for name, one in floor.models.items()}
        assert verdict["encoder"] == verdict["calibrated"] == "worse"
        assert "worse" not in (verdict["linear"], verdict["affine"])  # affine contains linear
    linear = models["linear"]
    for axis in ("along", "across", "yaw"):
        found = [np.sqrt(linear.variance[f"run.{f}.{axis}"]) for f in ROBOT.surfaces.labels]
        np.testing.assert_allclose(found, STD[f"run.{axis}"], rtol=0.25)


@pytest.mark.slow
def test_the_distribution_of_runs_it_has_not_seen_is_as_wide_as_it_has_to_be():
    """As a Student t fitted to Gaussian gaps is; 0.1 is three stds of the mean of four seeds."""
    found = []
    for seed in range(20, 24):
        made = driven("linear", ([1.0], [3.0]), seed, runs=480)
        _, models, problem, half = judged(made, ("linear",))
        gap, scale = models["linear"].scale(problem)
        per_logged = models["linear"].log_density(problem) - log_student(gap, scale)
        np.testing.assert_allclose(per_logged, 4 * np.log(SCALE))  # two moves of two coordinates
        q = np.einsum("ni,ni->n", gap, np.linalg.solve(scale, gap[..., None])[..., 0])[half == 1]
        found.append(q.mean() / gap.shape[1])
    assert np.mean(found) == pytest.approx(width_of_student(gap.shape[1]), abs=0.1)


@pytest.mark.slow
def test_models_that_say_the_same_can_hardly_be_told_apart():
    """What made the runs is never worse; numbers too many cost little, told in a few folds only."""
    others = []
    for seed in (4, 5, 6):
        ranked, *_ = judged(driven("affine", CONSTANT, seed), ("affine", "calibrated", "quadratic"))
        for name, floor in ranking(ranked).items():
            verdict = {model: one.verdict for model, one in floor.models.items()}
            assert verdict.pop("affine") in ("best", "tied")
            others += verdict.values()
            if "worse" not in verdict.values():
                assert f"{name}: the data cannot distinguish" in floor.sentence
    assert others.count("worse") <= 4  # of twelve


@pytest.mark.slow
@pytest.mark.parametrize("name", ["affine", "paper", "heading_lookup"])
def test_slopes_by_a_models_numbers_are_those_of_a_step_in_them(name):
    w = made(ROBOT, runs=24, count=2, seed=5, voltage=False)
    model = ALL[name].fit(w, ROBOT)
    slope = slopes(model, w, lambda r: r.twist(w, ROBOT))
    rng = np.random.default_rng(0)
    step = {key: rng.normal(size=value.shape) for key, value in model.state.items()}
    moved = model.with_state({key: model.state[key] + step[key] for key in step})
    expected = slope @ np.concatenate([v.ravel() for v in step.values()])
    np.testing.assert_allclose(moved.twist(w, ROBOT) - model.twist(w, ROBOT), expected, atol=1e-6)


# transfer ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("other", [0.1, 0.4])
def test_a_curve_carries_over_where_floors_share_it_and_nowhere_else(other):
    w = driven("affine_current", ([0.05, 0.1], [0.05 + other - 0.1, other]), 7)
    every = transfer(w, ROBOT)["all"]
    lost = every["pooled"]["rows"] / every["per_surface"]["rows"]
    assert lost < 1.05 if other == 0.1 else lost > 1.5


def test_a_curve_for_a_floor_is_that_of_the_other_floors():
    """Whatever the floor itself shows: two lines, and how far each is off where the other is."""
    amps = np.tile(np.linspace(0.0, 2.0, 21), 2)
    floor = np.repeat(["firm", "soft"], 21)
    line = {"firm": (0.1, 0.05), "soft": (0.4, 0.0)}
    slip = np.array([line[f][0] + line[f][1] * x for f, x in zip(floor, amps, strict=True)])
    found = errors_by_floor(slip, amps, floor)
    off = np.sqrt(np.mean((0.3 - 0.05 * amps) ** 2))
    assert found["pooled"]["each"] == pytest.approx({"firm": off, "soft": off})
    assert found["per_surface"]["rows"] == pytest.approx(0.0, abs=1e-12)
    assert found["constant"]["each"]["soft"] == pytest.approx(0.4 - 0.15)
    assert found["count"] == 42


def test_rows_of_a_transfer_are_those_of_both_loads_unless_one_is_asked_for():
    w = driven("affine_current", ([0.05, 0.1], [0.05, 0.1]), 7)
    counts = {name: of["count"] for name, of in transfer(w, ROBOT).items()}
    mine = np.asarray(w.load) == "as_built"
    parts = [transfer(w.segments(np.flatnonzero(x)), ROBOT) for x in (mine, ~mine)]
    filtered = "0 < s <= 1, I > 0.25 A only"
    for name in ("all", filtered):
        assert counts[name] == sum(part[name]["count"] for part in parts)
    assert counts["as built only"] == parts[0]["all"]["count"]
    assert counts[filtered] < counts["all"]
    assert counts["fast wheels only"] < counts["all"] < counts["slower wheels too"]


# folds, checkpoints, command --------------------------------------------------------------------

PLAN = heading_grid(setups=(("soft", "as_built"),), headings=6, speeds=(0.1, 0.3), turns=0)


@pytest.fixture(scope="module")
def logs():
    return simulate_logs(true_robot(PLAN), PLAN, 1, SimulatedSensors())


@pytest.mark.slow
def test_a_turn_on_the_spot_has_no_speed_to_leave_out(logs):
    spin = simulate_logs(
        true_robot(PLAN), [PlannedRun("soft", "as_built", 0.0, 0.0, 0.5)], 1, SimulatedSensors()
    )
    fold = folds_of(collect([*logs, *spin]), "speeds")
    assert sorted(set(fold[:-1])) == [0, 1]
    assert fold[-1] == -1


@pytest.mark.slow
def test_runs_that_nothing_could_be_fitted_for_are_never_left_out(logs):
    slow = [log for log in logs if np.hypot(*np.median(log.twist_command, axis=0)[:2]) < 0.2]
    assert sorted(set(folds_of(collect(logs), "speeds"))) == [0, 1]
    assert set(folds_of(collect(slow), "speeds")) == {-1}
    assert set(folds_of(collect([logs[0]]), "sectors")) == {-1}
    with pytest.raises(DataError, match="expected one of sectors, speeds, random"):
        folds_of(collect(logs), "luck")


def test_folds_that_are_left_out_together_leave_some_of_every_floor(logs):
    data = collect(logs)
    every = folds_of(data, "sectors")
    np.testing.assert_array_equal(folds_of(data, "sectors", 2), every % 2)
    even = collect([log for log, k in zip(logs, every, strict=True) if k % 2 == 0])
    assert set(folds_of(even, "sectors", 2)) == {-1}
    with pytest.raises(ValueError, match="1 parts; expected 2 or more"):
        folds_of(data, "sectors", 1)


def test_a_model_that_tunes_itself_leaves_out_gaps_as_wide_as_the_one_it_is_asked_about(logs):
    data = collect(logs)
    sector = folds_of(data, "sectors")
    inner = inner_folds(data, "sectors", np.flatnonzero(sector == 0))
    assert set(inner[(sector == 1) | (sector == 5)]) == {-1}
    np.testing.assert_array_equal(
        inner[(sector > 1) & (sector < 5)], sector[(sector > 1) & (sector < 5)]
    )
    every_second = inner_folds(data, "sectors", np.flatnonzero(sector % 2 == 0))
    np.testing.assert_array_equal(every_second, sector)
    for question in ("speeds", "random"):
        mine = folds_of(data, question)
        np.testing.assert_array_equal(inner_folds(data, question, np.flatnonzero(mine == 0)), mine)


@pytest.mark.parametrize("question", ["sectors", "speeds", "random"])
def test_runs_over_several_floors_are_held_out_with_runs_of_their_heading_or_speed(logs, question):
    """The same runs, in another order, in two sets, one run of them without a command."""
    data = collect(logs)
    fold = folds_of(data, question)
    wandering = replace(logs[0], twist_command=None)
    others = [collect(logs[5:]), collect([*logs[:5], wandering])]
    for k in sorted(set(fold[fold >= 0].tolist())):
        found = like_held_out(data, np.flatnonzero(fold == k), others, question)
        np.testing.assert_array_equal(found[:-1], np.concatenate([fold[5:], fold[:5]]) == k)
        assert not found[-1]
        assert found.any()


def test_a_fold_is_kept_whole_and_only_for_the_job_it_is_of(tmp_path):
    path = tmp_path / "folds" / "one.json"

    def interrupted():
        raise KeyboardInterrupt

    def again(work, make):
        return finished(Checkpoint(path.parent, work), path.stem, make)

    with pytest.raises(KeyboardInterrupt):
        again("a", interrupted)
    assert not path.exists()
    value = {"x": np.pi, "rows": [1.0 / 3.0]}
    assert again("a", lambda: value) == value
    assert again("a", interrupted) == value
    assert again("b", lambda: {"x": 1}) == {"x": 1}
    path.write_text(path.read_text()[:-9])
    assert again("b", lambda: {"x": 2}) == {"x": 2}


def test_what_runs_of_one_speed_cannot_tell_is_held_unless_the_user_says_otherwise(logs):
    data = collect(logs)
    robot = true_robot(PLAN)
    problem = Problem(windows(data, 0.04, float(robot.camera.lag)), robot, [])
    of_one_speed = np.flatnonzero(folds_of(data, "speeds") == 0)
    viscous = {"surface.soft.slide_viscosity", "surface.soft.roller_viscosity"}
    assert problem_of_runs(problem, [], data, np.arange(len(data))) is problem
    some = problem_of_runs(problem, [], data, of_one_speed).space
    assert some.names == problem.space.names
    assert {name for name, held in zip(some.names, some.held, strict=True) if held} == viscous
    np.testing.assert_allclose(some.start[some.held], np.log(1e-4))
    np.testing.assert_allclose(some.prior_mean[some.held], np.log(1e-4))
    mine = [Choice("surface.soft.slide_viscosity", prior_mean=0.03, prior_std=0.01)]
    kept = problem_of_runs(problem, mine, data, of_one_speed).space
    assert kept.held.sum() == 1


@pytest.mark.slow
def test_compare_goes_on_where_it_was_and_ends_the_same(tmp_path, logs, monkeypatch):
    held_out, of_others = [], compare.without

    def spied(task, runs):
        held_out.extend(runs.tolist())
        return of_others(task, runs)

    monkeypatch.setattr(compare, "without", spied)
    write_logs(logs, true_robot(PLAN), tmp_path / "logs", tmp_path / "truth")
    (tmp_path / "my.toml").write_text(packaged_config("robotino.toml"), encoding="utf-8")
    out = tmp_path / "out"
    words = ("compare", tmp_path / "my.toml", "--data", tmp_path / "logs", "--out", out)
    words = [str(word) for word in (*words, "--folds", "speeds", "--quiet")]
    first = CliRunner().invoke(app, words)
    assert first.exit_code == 0, first.output
    assert sorted(held_out) == list(range(len(PLAN)))  # each fold started without its runs
    assert (out / "comparison.png").stat().st_size > 10_000
    before = json.loads((out / "comparison.json").read_text())
    floor = before["questions"]["speeds"]["floors"]["soft"]
    assert floor["runs"] == len(PLAN)
    assert floor["models"]["identified"]["endpoint_error"] < 0.05
    assert floor["models"]["encoder"]["verdict"] == "worse"
    (out / "folds" / "speeds_1.json").unlink()
    again = CliRunner().invoke(app, [*words, "--json", "-"])
    after = json.loads(again.stdout)
    for kept in (before, after):
        for one in kept["questions"]["speeds"]["cost"].values():
            del one["fit_s"], one["predict_s"]
    assert after == before


# sessions ---------------------------------------------------------------------------------------


def with_sessions(std, seed, session):
    """A linear model of runs on one floor; what those of one session share has this std."""
    rng = np.random.default_rng(seed)
    runs = len(session)
    effect = np.broadcast_to(np.eye(6, 3), (runs, 6, 3)).copy()
    effect[:, 3:] = np.eye(3)
    run, noise = np.array([0.02, 0.02, 0.05]), 0.005
    slope = rng.normal(size=(runs, 6, 2))
    each = (
        rng.normal(size=(runs, 3)) * run + (rng.normal(size=(session.max() + 1, 3)) * std)[session]
    )
    gap = np.einsum("nma,na->nm", effect, each) + noise * rng.normal(size=(runs, 6))
    scale = np.einsum("nma,a,nla->nml", effect, run**2, effect) + noise**2 * np.eye(6)
    info = np.einsum("nmp,nml,nlq->pq", slope, np.linalg.inv(scale), slope)
    model = LinearModel(
        gap=gap,
        slope=slope,
        covariance=np.linalg.inv(info),
        wide=100.0 * np.eye(2),
        scale=scale,
        effect=effect,
        run=np.broadcast_to(run**2, (runs, 3)).copy(),
    )
    w = made(made_robot(floors=("firm",), sessions=("one",)), runs=runs, count=2, voltage=False)
    return model, replace(w, session=tuple(f"s{k}" for k in session))


@pytest.mark.slow
def test_what_sessions_share_is_found_and_widens_what_was_fitted():
    std = np.array([0.03, 0.02, 0.08])
    found = []
    for seed in range(6):
        model, w = with_sessions(std, seed, np.arange(80) % 8)
        variance, covariance = with_session_effects(model, w, np.ones(len(w)))
        found.append(list(variance.values()))
        assert np.linalg.eigvalsh(covariance - model.covariance).min() > -1e-12
    # 8 sessions know their std to a quarter, six times as many to a tenth
    np.testing.assert_allclose(np.sqrt(np.mean(found, axis=0)), std, rtol=0.3)


@pytest.mark.slow
def test_regions_hold_runs_of_other_sessions_as_often_as_they_say():
    std = np.array([0.03, 0.02, 0.08])
    # of 40 sessions four runs each are fitted; 200 more have a session of their own each
    model, w = with_sessions(std, 8, np.append(np.arange(160) % 40, 40 + np.arange(200)))
    keep, judged = np.arange(360) < 160, np.arange(360) >= 160
    pull = np.swapaxes(model.slope, 1, 2) @ np.linalg.inv(model.scale)
    own = np.linalg.inv((pull @ model.slope)[keep].sum(axis=0))
    z = -own @ (pull @ model.gap[..., None])[keep].sum(axis=0)
    model = replace(model, covariance=own, gap=model.gap + (model.slope @ z)[..., 0])
    variance, covariance = with_session_effects(model, w, keep.astype(float))
    e, j = model.effect[judged], model.slope[judged]

    def covered(v, c):
        """Part of the judged runs in their 90 % regions; all that is drawn is Gaussian."""
        scale = model.scale[judged] + np.einsum("nma,a,nla->nml", e, v, e)
        scale += np.einsum("nmp,pq,nlq->nml", j, c, j)
        gap = model.gap[judged]
        q = np.einsum("nm,nm->n", gap, np.linalg.solve(scale, gap[..., None])[..., 0])
        return (chi2.cdf(q, gap.shape[1]) <= 0.9).mean()

    low, high = binom.interval(0.99, 200, 0.9)
    assert low <= 200 * covered(np.array(list(variance.values())), covariance) <= high
    assert covered(np.zeros(3), own) < 0.6


@pytest.mark.slow
def test_a_run_gone_wrong_hardly_counts_for_what_its_session_shares():
    model, w = with_sessions(np.array([0.03, 0.02, 0.08]), 3, np.arange(80) % 8)
    gap = model.gap.copy()
    gap[0] += model.effect[0] @ [1.0, -1.0, 3.0]
    keep = np.ones(len(w))
    wrong = with_session_effects(replace(model, gap=gap), w, keep)[0]
    keep[0] = 0.0
    without = with_session_effects(model, w, keep)[0]
    np.testing.assert_allclose(list(wrong.values()), list(without.values()), rtol=0.1)


@pytest.mark.slow
def test_runs_that_share_nothing_are_left_as_they_are():
    model, w = with_sessions(0.0, 7, np.arange(240) % 8)
    variance, covariance = with_session_effects(model, w, np.ones(len(w)))
    assert list(variance) == [f"session.firm.{axis}" for axis in ("along", "across", "yaw")]
    assert (np.array(list(variance.values())) < 0.1 * model.run[0]).all()
    np.testing.assert_allclose(covariance, model.covariance, rtol=0.3)
    alone = replace(w, session=("one",) * len(w))
    assert with_session_effects(model, alone, np.ones(len(w)))[0] == {}
