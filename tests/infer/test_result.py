"""Verdicts, intervals, flat directions and files of a fit, on made logs with known truth."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import io
import itertools
import json
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom, chi2, lognorm
from scipy.stats import f as fisher

from slipid.data.runs import collect
from slipid.data.windows import UNREAD_VARIANCE, windows
from slipid.fitting.optimise import Optimum, one_round
from slipid.fitting.problem import FitState, Problem
from slipid.fitting.variances import DEGREES
from slipid.infer.design.planned_runs import PlannedRun
from slipid.infer.fit_file import identified_json, load, save, to_json
from slipid.infer.posterior import diagnosis
from slipid.infer.result import Fit, draws
from slipid.infer.robot_held_out import robot_held_out
from slipid.infer.slip_curves import by_encoders, has_steady_command, validity
from slipid.infer.summary import summarise
from slipid.infer.verdicts.disputed import LoadComparison
from slipid.infer.verdicts.draws import Draws
from slipid.infer.verdicts.estimates import estimates
from slipid.infer.verdicts.unidentified import flat_directions, members
from slipid.lab.selftest.logs import (
    SimulatedSensors,
    heading_grid,
    nominal_robot,
    simulate_logs,
    true_robot,
)
from slipid.predict.validation import validation
from slipid.search_space import Choice
from slipid.support.errors import DataError
from slipid.support.files import checksum, hash_of
from slipid.support.folder import locked
from slipid.support.progress import Reporter
from tests.helpers.killed_writes import Killed, dies_at

pytestmark = pytest.mark.slow  # traces whole fits

DRIVES = heading_grid(setups=(("soft", "as_built"),), headings=6, speeds=(0.1,), turns=0)
TRUTH = true_robot(DRIVES)
CHOICES = (
    Choice("camera.scale", prior_mean=1.117, prior_std=0.002),
    Choice("camera.lag", prior_mean=0.05, prior_std=0.02),
    Choice("camera.marker_place", free=True),
    Choice("robot.mass", fixed=12.0),
)


@functools.cache
def made(voltage: bool):
    """Return a problem, its data, and the Laplace covariance at the truth."""
    data = collect(simulate_logs(TRUTH, DRIVES, 1, SimulatedSensors(has_voltage=voltage)))
    problem = Problem(windows(data, 0.04, lag=0.05), nominal_robot(DRIVES), list(CHOICES))
    z = problem.space.vector(TRUTH)
    state = FitState(z, 2 * np.log(problem.noise.typical), 7, -1.5, 0.01, "joint")
    laplace = problem.laplace(z, state.log_variance, np.ones(len(problem.windows)))
    end = Optimum(state, laplace, True, "it settled", (3.0, -1.5))
    return problem, data, end


@functools.cache
def fit_of(voltage: bool) -> Fit:
    problem, data, end = made(voltage)
    return summarise(problem, end, data, CHOICES)


def test_intervals_are_quantiles_of_the_transformed_gaussian():
    fit = fit_of(True)
    e = fit.parameters["surface.soft.creep"]  # positive: log-normal
    at = fit.space.slices[e.path]
    std = np.sqrt(fit.covariance[at, at][0, 0])
    exact = lognorm(std, scale=e.value).ppf([0.05, 0.95])
    assert e.interval90 == pytest.approx(exact, rel=1e-12)
    assert e.std == pytest.approx(e.value * std)
    lead = fit.parameters["surface.soft.lead"]  # any sign: normal
    assert lead.interval90[1] - lead.value == pytest.approx(1.6448536 * lead.std)


def test_shares_sum_to_one_and_their_intervals_hold_them():
    e = fit_of(True).parameters["robot.load_share@as_built"]
    assert sum(e.value) == pytest.approx(1.0)
    assert e.labels == ("wheel 1", "wheel 2", "wheel 3")
    assert all(low < v < high for v, (low, high) in zip(e.value, e.interval90, strict=True))
    # near a Gaussian the width is 2 x 1.645 stds
    widths = np.array([high - low for low, high in e.interval90])
    assert widths == pytest.approx(2 * 1.645 * np.array(e.std), rel=0.1)


def verdicts(
    ratio: float,
    choices: tuple[Choice, ...] = CHOICES,
    shift: float = 0.0,
    prior_std: float | None = None,
    flat: tuple[str, ...] = (),
):
    """Return estimates when every posterior is `ratio` times its prior, `shift` prior stds from it.

    `prior_std` in the search space is the declared one, or one for all.
    """
    from slipid.search_space import Space

    space = Space(nominal_robot(DRIVES), choices)
    if prior_std:
        space = eqx.tree_at(lambda s: s.prior_std, space, np.full(space.size, prior_std))
    cov = np.diag((ratio * space.prior_std) ** 2)
    z = space.prior_mean + shift * space.prior_std
    return {e.path: e for e in estimates(space, choices, z, cov, has_voltage=True, flat=flat)}


@pytest.mark.parametrize(
    ("ratio", "verdict"),
    [(0.29, "identified"), (0.31, "weak"), (0.79, "weak"), (0.81, "not_identified")],
)
def test_the_verdict_rule(ratio, verdict):
    found = verdicts(ratio, prior_std=1.0)
    free = [e for e in found.values() if e.ratio is not None]
    assert {e.verdict for e in free} == {verdict}
    assert {round(e.ratio, 9) for e in free} == {ratio}


@pytest.mark.parametrize(("std", "verdict"), [(0.33, "identified"), (0.34, "weak")])
def test_a_positive_number_within_three_stds_of_zero_is_not_identified(std, verdict):
    # a wide interval is narrow relative to a wide prior; unbounded numbers are not tested
    found = verdicts(std / 4, prior_std=4.0)
    assert found["surface.soft.creep"].verdict == verdict
    assert found["surface.soft.lead"].verdict == "identified"


def test_provenance():
    found = verdicts(0.2, (*CHOICES, Choice("motor.efficiency", fixed=0.8)))
    assert found["surface.soft.creep"].provenance == "measured"
    assert found["motor.efficiency"].provenance == "override"
    assert found["motor.inductance"].provenance == "borrowed"
    assert (found["motor.inductance"].verdict, found["motor.inductance"].std) == ("fixed", None)
    # half of the information from the prior is where measuring ends
    assert verdicts(0.70)["surface.soft.creep"].provenance == "measured"
    assert verdicts(0.72)["surface.soft.creep"].provenance == "borrowed"


def test_a_number_that_runs_to_zero_is_at_its_bound_and_a_contradicted_prior_is_not():
    found = verdicts(0.1, shift=-4.5)
    assert found["surface.soft.creep"].verdict == "at_bound"  # exp(-6.75) of its prior mean
    assert found["surface.soft.lead"].verdict == "identified"  # has no bound
    assert found["camera.scale"].verdict == "identified"  # 1 % off, against a tight prior
    assert found["camera.scale"].pull == pytest.approx(-4.5)
    assert verdicts(0.1, shift=-3.5)["surface.soft.creep"].verdict == "identified"


def test_without_voltage_neither_resistance_nor_back_emf_is_identified():
    fit = fit_of(False)
    assert fit.channels.voltage is False
    for path in ("motor.resistance", "motor.back_emf"):
        e = fit.parameters[path]
        assert (e.verdict, e.provenance) == ("not_identified", "borrowed")
    text = " | ".join(fit.messages)
    assert "motor.resistance: log the motor voltage (or duty and bus voltage)" in text
    [joint] = [f for f in fit.flat if "motor.back_emf" in f.paths]
    assert "surface.soft.friction" in joint.paths
    assert joint.powers == pytest.approx([1.0] * len(joint.paths), abs=0.05)
    assert "surface.soft.friction/motor.back_emf" in joint.text


def test_a_number_known_as_part_of_a_ratio_is_not_identified_however_narrow_neither_in_draws():
    fit = fit_of(False)
    [joint] = [f for f in fit.flat if "motor.back_emf" in f.paths]
    rng = np.random.default_rng(0)
    narrow = fit.z + 0.01 * fit.space.prior_std * rng.normal(size=(2, 200, fit.space.size))
    sampled = diagnosis.estimates(fit, narrow)
    for path in joint.paths:
        assert sampled[path].ratio < 0.02
        for e in (fit.parameters[path], sampled[path]):
            assert e.provenance == "borrowed"
            assert e.verdict in ("weak", "not_identified")
    assert {sampled[path].verdict for path in joint.paths} == {"weak", "not_identified"}
    known = [e.path for e in fit.space.free if e.path not in members(fit.flat)]
    assert "robot.load_share@as_built" in known
    assert {sampled[path].verdict for path in known} <= {"identified", "at_bound"}
    assert {sampled[path].provenance for path in known} == {"measured"}
    # the same interval by itself would do
    assert verdicts(0.1)["surface.soft.creep"].verdict == "identified"
    assert verdicts(0.1, flat=("surface.soft.creep",))["surface.soft.creep"].verdict == "weak"


def test_no_prior_however_tight_lends_the_motor_a_verdict_without_voltage():
    problem, _, end = made(False)
    tight = end.covariance * 1e-6
    found = estimates(problem.space, CHOICES, end.state.z, tight, has_voltage=False, flat=())
    by = {e.path: e.verdict for e in found}
    assert by["motor.resistance"] == by["motor.back_emf"] == "not_identified"
    assert by["motor.coulomb_friction"] == "identified"


def test_with_voltage_both_are_identified_and_no_flat_direction_holds_them():
    fit = fit_of(True)
    for path in ("motor.resistance", "motor.back_emf"):
        assert fit.parameters[path].verdict == "identified"
        assert fit.parameters[path].provenance == "measured"
    assert not [f for f in fit.flat if {"motor.resistance", "motor.back_emf"} & set(f.paths)]


def test_a_constructed_flat_direction_is_found_with_its_powers():
    problem, _, _ = made(True)
    space = problem.space
    std, names = space.prior_std, space.names
    precision = np.diag(1 / std**2)
    a, b = names.index("motor.back_emf"), names.index("surface.soft.friction")
    held = np.zeros(len(names))
    held[a], held[b] = 2.0, 1.0  # only back_emf^2 * friction is measured
    precision += 1e6 * np.outer(held, held)
    for k, name in enumerate(names):
        if k not in (a, b):
            precision[k, k] += 1e4 / std[k] ** 2
        assert name
    [flat] = flat_directions(space, np.linalg.inv(precision), True, True)
    assert flat.paths == ("motor.back_emf", "surface.soft.friction")
    assert flat.powers == pytest.approx((-0.5, 1.0), abs=0.02)


def test_curves_rise_hold_their_line_and_end_where_the_data_end():
    fit = fit_of(True)
    curve = fit.curves["soft"]
    torque, slip, low, high = (
        getattr(curve, k) for k in ("torque_nm", "slip", "slip_lo", "slip_hi")
    )
    assert (np.diff(torque) > 0).all()
    assert (np.diff(slip) >= 0).all()
    assert slip[0] == 0
    assert (low <= slip + 1e-9).all()
    assert (high >= slip - 1e-9).all()
    assert torque[-1] <= fit.validity["soft"].torque_nm[1]
    # the law itself, at a slip of the curve
    floor, w, share = TRUTH.surfaces, curve.wheel_speed, curve.load_share
    rim, k = 0.04 * w, 30
    x2 = (slip[k] * rim / (0.002 + float(floor.creep[0]) * rim)) ** 2
    a = 1 - float(floor.knee_width[0]) ** 2
    grip = np.sqrt((1 + x2 - np.sqrt((1 + x2) ** 2 - 4 * a * x2)) / (2 * a))
    grip += float(floor.slide_viscosity[0]) * slip[k] * rim
    expected = 0.04 * float(floor.friction[0]) * 12.0 * 9.81 * share * grip
    assert torque[k] == pytest.approx(expected, rel=2e-3)


def test_encoders_show_the_driven_motion_where_no_steady_command_was_logged():
    twist = np.zeros((400, 3))
    angle = np.radians(60.0 * (np.arange(400) % 6))
    speed = np.where(np.arange(400) < 200, 0.1, 0.3)
    twist[:, 0], twist[:, 1] = speed * np.cos(angle), speed * np.sin(angle)
    twist[:40], twist[40:80, 2] = 0.0, 0.5
    twist[80] = 0.3 * np.array([0.0, 1.0, 0.0])  # one window is no direction that was driven
    headings, speeds, turn_rates = by_encoders(twist)
    assert sorted(headings) == [-120.0, -60.0, 0.0, 60.0, 120.0, 180.0]
    assert (min(speeds), max(speeds)) == pytest.approx((0.1, 0.3))
    assert set(turn_rates) == {0.5}
    assert [len(x) for x in by_encoders(np.zeros((5, 3)))] == [0, 0, 0]


def test_a_floor_without_steady_commands_has_the_ranges_of_the_encoders():
    problem, data, _ = made(True)
    robot = problem.space.tree(problem.space.start)
    blind = tuple(replace(log, twist_command=None) for log in data.logs)
    lies = replace(data, heading=data.heading + 0.1)
    commanded, encoders = (
        validity(runs, robot, problem.batch)["soft"] for runs in (lies, replace(lies, logs=blind))
    )
    assert set(np.mod(commanded.headings_deg, 30.0)) != {0.0}
    assert set(np.mod(encoders.headings_deg, 30.0)) == {0.0}


def test_a_command_that_changes_or_rests_does_not_describe_a_run():
    data = made(True)[1]
    log = replace(data.logs[0], twist_command=np.tile([0.2, 0.0, 0.0], (data.logs[0].samples, 1)))
    assert has_steady_command(log)
    assert not has_steady_command(replace(log, twist_command=None))
    wandering = np.linspace(-1.0, 1.0, log.samples)[:, None] * [0.2, 0.1, 0.0]
    assert not has_steady_command(replace(log, twist_command=wandering))
    resting = np.where(np.arange(log.samples)[:, None] % 3 == 0, [0.2, 0.0, 0.0], 0.0)
    assert not has_steady_command(replace(log, twist_command=resting))


def test_a_solver_that_stopped_early_is_not_called_converged():
    """At the truth, which is not the optimum for this noise, a step of some stds remains."""
    problem, data, end = made(True)
    fit = fit_of(True)
    assert end.converged  # the flag alone
    assert fit.remaining > 0.3
    assert not fit.converged
    assert fit.reason.startswith("the solver stopped")
    assert any("did not converge" in m for m in fit.messages)
    # steps with weights kept up to date lead to a point from which none remains
    state = end.state
    for _ in range(6):
        state = one_round(
            problem,
            state,
            np.ones(len(problem.windows)),
            np.ones(problem.space.size),
            steps=8,
            scoring=2,
        )
    there = summarise(problem, dataclasses.replace(end, state=state), data, CHOICES)
    assert there.remaining < 0.1
    assert there.converged


def test_identified_json_has_the_documented_content():
    found = json.loads(json.dumps(identified_json(fit_of(True)), allow_nan=False))
    assert found["schema"] == "slipid.identified/1"
    keys = {"value", "unit", "shape", "labels", "std", "interval90", "source", "verdict"}
    for e in found["parameters"].values():
        assert set(e) == keys | {"provenance"}
    shares = found["parameters"]["robot.load_share@as_built"]
    assert (shares["shape"], len(shares["value"]), len(shares["interval90"])) == ([3], 3, 3)
    assert found["parameters"]["motor.resistance"]["shape"] == []
    assert found["surfaces"] == ["soft"]
    assert set(found["curves"]["soft"]) == {"torque_nm", "slip", "slip_lo", "slip_hi", "at"}
    assert found["data"]["runs"] == [log.name for log in made(True)[1].logs]


def test_differences_of_loads_that_were_found_or_could_be_are_in_text_and_files():
    fit = dataclasses.replace(fit_of(True))
    assert identified_json(fit)["load_comparisons"] == []  # on a single floor
    assert "as disputed" not in str(fit)
    one = LoadComparison(("gray", "green"), 3.2, (0.05, 0.1, 0.05))
    other = LoadComparison(("gray", "table"), 1.0, (0.5, 0.9, 0.5))
    found = dataclasses.replace(fit)
    vars(found)["load_comparisons"] = (one, other)
    assert found.disputes == {("gray", "green"): 3.2}
    assert "estimated on gray and on green differ by 3.2" in " ".join(found.messages)
    assert "differed by 5 % between gray and green would have been reported" in str(found)
    for content in (identified_json(found), to_json(found)):
        kept = [
            LoadComparison.of_json(x) for x in json.loads(json.dumps(content["load_comparisons"]))
        ]
        assert kept == [one, other]


def held_out_of(change):
    """Errors in held-out windows of the problem with voltage, after a change of its windows."""
    problem, _, end = made(True)
    problem = problem.of(change(problem.windows))
    electric = problem.electric(end.state.z, end.state.log_variance)
    return robot_held_out(problem, end.state, problem.linear(end.state.z, electric))


def test_motors_are_judged_by_currents_in_held_out_windows():
    """At the truth, what is left of a current is the noise of both meters."""
    fit, w = fit_of(True), made(True)[0].windows
    found = fit.held_out
    assert fit_of(False).held_out is None
    assert found == held_out_of(lambda w: w)
    motor = TRUTH.motor
    amps = motor.current_at(*map(jnp.asarray, (w.voltage, w.turn / w.dt[..., None], w.direction)))
    shown = np.abs(amps) if not w.current_is_signed else np.asarray(amps)
    noise = np.sqrt(((shown + float(motor.current_offset) - w.current) ** 2).mean())
    assert found.errors.speed is None
    assert found.errors.current == pytest.approx(noise, rel=0.05)
    assert not found.worse_than
    assert identified_json(fit)["held_out"] == found.to_json()
    assert "motors in held-out windows, from voltage and wheel speed: current within" in str(fit)


def test_where_least_squares_predict_currents_better_resistance_is_weak():
    """No robot's motor has a voltage that drives it at rest."""
    name = "least_squares_with_offset"
    found = held_out_of(lambda w: dataclasses.replace(w, voltage=w.voltage + 2.0))
    assert found.worse_than == (name,)
    fit = dataclasses.replace(fit_of(True), held_out=found)
    assert fit_of(True)["motor.resistance"].verdict == "identified"
    assert fit["motor.resistance"].verdict == fit["motor.back_emf"].verdict == "weak"
    assert fit.derived["motor.resistance/motor.back_emf"].verdict == "weak"
    assert fit["surface.soft.friction"] == fit_of(True)["surface.soft.friction"]
    assert any("least squares predict held-out motor currents" in text for text in fit.messages)


def test_windows_without_a_reading_are_not_judged():
    def spoilt(w):
        lost = np.zeros(w.voltage.shape, bool)
        lost[:, 0, 0] = True
        return dataclasses.replace(
            w,
            voltage=np.where(lost, 1e3, w.voltage),
            voltage_var=np.where(lost, UNREAD_VARIANCE, w.voltage_var),
        )

    found, whole = held_out_of(spoilt), fit_of(True).held_out
    assert found.errors.current < 2 * whole.errors.current
    lost = held_out_of(
        lambda w: dataclasses.replace(w, voltage_var=np.full(w.voltage.shape, UNREAD_VARIANCE))
    )
    assert lost is None


def test_the_data_hash_depends_on_names_and_bytes_not_on_order():
    runs = [("a", "1"), ("b", "2")]
    assert hash_of(runs) == hash_of(runs[::-1])
    assert len({hash_of(runs), hash_of(runs[:1]), hash_of([("a", "2"), ("b", "1")])}) == 3


def test_a_saved_fit_comes_back_the_same(tmp_path):
    fit = dataclasses.replace(fit_of(True), baselines={"linear": {"soft": [0.25]}})
    names = save(fit, tmp_path)
    back = load(tmp_path)
    assert identified_json(back) == identified_json(fit)
    assert to_json(back) == to_json(fit)
    for name in ("z", "covariance", "laplace"):
        np.testing.assert_array_equal(getattr(back, name), getattr(fit, name))
    first = (tmp_path / "fit.json").read_bytes()
    assert save(back, tmp_path) == names
    assert (tmp_path / "fit.json").read_bytes() == first
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)


def test_draws_that_contradict_the_laplace_approximation_replace_it_also_in_files(tmp_path):
    """Draws are wider along one parameter only; a quotient with this parameter is wider, too."""
    fit, path = fit_of(True), "motor.coulomb_friction"
    at = fit.space.slices[path]
    z = draws(fit.z, fit.covariance, 64 * 8, 1).reshape(64, 8, -1)
    z[..., at] = fit.z[at] + 2 * (z[..., at] - fit.z[at])
    chained = replace(fit, chain=Draws(z))
    wider, before = chained.parameters[path], fit.parameters[path]
    assert wider.source == "short_chain"
    assert wider.value == before.value
    assert wider.interval90 == pytest.approx(np.quantile(np.exp(z[..., at]), [0.05, 0.95]))
    assert wider.ratio == pytest.approx(2 * before.ratio, rel=0.15)
    kept = [p for p, e in chained.parameters.items() if e == fit.parameters[p]]
    assert len(kept) >= 0.8 * len(fit.parameters)
    assert chained.derived[f"{path}/motor.back_emf"].source == "short_chain"
    assert "intervals of a short chain (at least" in str(chained)
    assert path in str(chained).partition("Laplace approximation, for")[2]
    record = chained.deploy().record
    assert record.source == "short_chain"
    assert record.parameters[path].source == "short_chain"
    save(chained, tmp_path)
    assert load(tmp_path).parameters == chained.parameters
    assert load(tmp_path).derived == chained.derived


def test_a_fit_that_converged_has_a_chain_if_it_is_wanted(monkeypatch):
    from slipid.app import identify
    from slipid.app.config import FitSection

    found = Draws(np.zeros((2, 2, fit_of(True).space.size)))
    monkeypatch.setattr(identify, "short_chain", lambda *_: found)
    fit, quiet = replace(fit_of(True), converged=True), Reporter(quiet=True)

    def chain(fit: Fit, intervals: str) -> Draws | None:
        return identify.with_chain(fit, FitSection(intervals=intervals), quiet).chain

    assert chain(fit, "sampled") is found
    assert chain(fit, "laplace") is None
    assert chain(replace(fit, converged=False), "sampled") is None
    assert chain(replace(fit, mixed={"runs": 3}), "sampled") is found
    assert chain(replace(fit, refused={"reason": "they contradict"}), "sampled") is found


OLD = 4.0
"""A number that distinguishes two fits, in JSON and in an array."""


def of_two() -> tuple[Fit, Fit]:
    old = dataclasses.replace(fit_of(True), remaining=OLD, laplace=OLD * fit_of(True).laplace)
    return old, fit_of(True)


def test_a_refit_that_dies_while_it_is_written_never_leaves_parts_of_two(tmp_path):
    old, new = of_two()
    found = []
    for step in itertools.count():
        folder = tmp_path / str(step)
        save(old, folder)
        ended = False
        with contextlib.suppress(Killed), dies_at(step):
            save(new, folder)
            ended = True
        back = load(folder)
        expected = old if back.remaining == OLD else new
        assert to_json(back) == to_json(expected)
        np.testing.assert_array_equal(back.laplace, expected.laplace)
        found.append(back.remaining)
        names = save(new, folder)  # and the next one cleans up
        with locked(folder, "identify"):
            assert sorted(p.name for p in folder.glob("[!.]*")) == sorted(names)
        assert sorted(p.name for p in folder.iterdir()) == sorted(names)
        assert load(folder).remaining == new.remaining
        if ended:
            break
    assert found == sorted(found, reverse=True)  # first the old one, from some step on the new one
    assert (found[0], found[-1], len(found)) == (OLD, new.remaining, 9)


def test_a_file_of_a_different_fit_is_noticed(tmp_path):
    old, new = of_two()
    names = save(old, tmp_path / "old"), save(new, tmp_path / "new")
    for mine, other in zip(*names, strict=True):
        kept = (tmp_path / "new" / other).read_bytes()
        (tmp_path / "new" / other).write_bytes((tmp_path / "old" / mine).read_bytes())
        with pytest.raises(DataError, match=r"a different fit|damaged|expected the arrays of"):
            load(tmp_path / "new")
        (tmp_path / "new" / other).write_bytes(kept)
    assert load(tmp_path / "new").remaining == new.remaining


def test_damage_of_any_file_is_a_message_and_never_a_traceback(tmp_path):
    names, rng = save(fit_of(True), tmp_path), np.random.default_rng(0)
    for name in names:
        whole = (tmp_path / name).read_bytes()
        for _ in range(40):
            data = bytearray(whole)
            at, most = rng.integers(len(data)), int(rng.integers(1, 40))
            kind = rng.integers(3)
            if kind == 0:
                data[at] ^= 1 << rng.integers(8)
            elif kind == 1:
                del data[at : at + most]
            else:
                data[at:at] = rng.bytes(most)
            (tmp_path / name).write_bytes(bytes(data))
            # identified.json is not read back, and white space means nothing
            with contextlib.suppress(DataError):
                assert to_json(load(tmp_path)) == to_json(fit_of(True))
        (tmp_path / name).unlink()
        if name != "identified.json":
            with pytest.raises(DataError, match=name):
                load(tmp_path)
        (tmp_path / name).write_bytes(whole)
    load(tmp_path)


# sessions ---------------------------------------------------------------------------------------

SHARED = {"along": 0.02, "across": 0.01}
"""Stds of session effects [m/m]: three and two times those of single runs."""


def in_sessions(session, seed):
    """Return runs in these sessions, whose ends have the effects of their sessions."""
    rng = np.random.default_rng(seed)
    drives = [
        PlannedRun("soft", "as_built", h, 0.1) for h in rng.uniform(0, 2 * np.pi, len(session))
    ]
    logs = simulate_logs(TRUTH, drives, seed, SimulatedSensors(has_voltage=False))
    effect = rng.normal(size=(max(session) + 1, 2)) * [*SHARED.values()]
    moved = []
    for log, drive, (along, across) in zip(logs, drives, effect[session], strict=True):
        back = np.linalg.pinv(np.asarray(TRUTH.geometry.forward()))
        step = log.wheel_angle * float(TRUTH.geometry.wheel_radius) @ back.T
        seen_at = log.time - float(TRUTH.camera.lag)
        length = np.interp(seen_at, log.time, np.hypot(*step.T[:2])) / float(TRUTH.camera.scale)
        angle = log.pose[0, 2] + drive.heading
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        pose = log.pose.copy()
        pose[:, :2] += length[:, None] * (np.array([along, across]) @ turn)
        moved.append(dataclasses.replace(log, pose=pose))
    return collect(moved, [f"s{k}" for k in session])


def test_session_effects_are_stored_with_their_unit():
    data = in_sessions(np.arange(24) % 6, 1)
    problem = Problem(windows(data, 0.04, lag=0.056), nominal_robot(DRIVES), list(CHOICES))
    z, log_v = problem.space.vector(TRUTH), 2 * np.log(problem.noise.typical)
    laplace = problem.laplace(z, log_v, np.ones(len(problem.windows)))
    end = Optimum(FitState(z, log_v, 7, -1.5, 0.01, "joint"), laplace, True, "it settled", (0.0,))
    fit = summarise(problem, end, data, CHOICES)
    kept = to_json(fit)["variances"]
    for axis, unit in {**dict.fromkeys(SHARED, "m/m"), "yaw": "rad/m"}.items():
        assert kept[f"session.soft.{axis}"]["unit"] == kept[f"run.soft.{axis}"]["unit"] == unit
    assert np.linalg.eigvalsh(fit.covariance - fit.laplace).min() > -1e-12


@pytest.mark.nightly
def test_session_effects_are_stored_and_widen_validation(tmp_path):
    """At the truth all errors are noise: 200 runs, each in a session of its own."""
    data = in_sessions(np.arange(160) % 40, 1)
    problem = Problem(windows(data, 0.04, lag=0.056), nominal_robot(DRIVES), list(CHOICES))
    z, sensors = problem.space.vector(TRUTH), SimulatedSensors()
    std = problem.noise.typical.copy()
    for k, name in enumerate(problem.noise.names):
        if name.startswith("session.soft."):
            std[k] = SHARED.get(name.rpartition(".")[2], 1e-9)
        elif not name.startswith("current."):
            std[k] = max(sensors.of(name), 1e-9)
    log_v = 2 * np.log(std)
    laplace = problem.laplace(z, log_v, np.ones(len(problem.windows)))
    end = Optimum(FitState(z, log_v, 7, -1.5, 0.01, "joint"), laplace, True, "it settled", (0.0,))
    save(summarise(problem, end, data, CHOICES), tmp_path)
    fit = load(tmp_path)
    assert np.linalg.eigvalsh(fit.covariance - fit.laplace).min() > -1e-12
    new = in_sessions(np.arange(200), 2)
    alone = {n: 1e-30 if n.startswith("session.") else v for n, v in fit.variance.items()}

    def covered(covariance, variance):
        fitted = dataclasses.replace(fit.contact, variance=variance, covariance=covariance)
        return validation(fitted, (), new).summary["soft"]["identified"].coverage90

    # at least the stated share; draws are Gaussian, and the Student t's region holds more of them
    held = chi2.cdf(2 * fisher.ppf(0.9, 2, DEGREES), 2)
    low, high = binom.ppf(0.005, 200, 0.9), binom.ppf(0.995, 200, held)
    assert low <= 200 * covered(fit.covariance, dict(fit.variance)) <= high
    assert covered(fit.laplace, alone) < 0.7


def test_numbers_that_are_not_finite_never_reach_a_file(tmp_path):
    bad = dataclasses.replace(fit_of(True), lag=float("nan"))
    with pytest.raises(ValueError, match="JSON"):
        save(bad, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_damaged_results_are_refused_with_a_message(tmp_path):
    with pytest.raises(DataError, match="expected the result of `slipid identify`"):
        load(tmp_path)
    *_, arrays = save(fit_of(True), tmp_path)
    (tmp_path / arrays).write_bytes(b"PK no zip")
    with pytest.raises(DataError, match="damaged"):
        load(tmp_path)
    (tmp_path / "fit.json").write_text('{"schema": "other/1"}')
    with pytest.raises(DataError, match=r"its schema is other/1; expected slipid\.fit/9"):
        load(tmp_path)
    (tmp_path / "fit.json").write_text("{")
    with pytest.raises(DataError, match="not valid JSON"):
        load(tmp_path)


def sealed(folder, content):
    """Write a content as fit.json with a checksum that fits, as somebody does who edits a file."""
    content = {name: value for name, value in content.items() if name != "checksum"}
    mark = checksum(content)
    (folder / "fit.json").write_text(json.dumps(content | {"checksum": mark}))
    (folder / "identified.json").write_text(json.dumps({"fit": mark}))


NONSENSE = [
    (("robot",), 3, "robot: 3; expected"),
    (("robot",), None, "robot: None; expected"),
    (("z",), ["1"], r"z\[1\]: '1'; expected"),
    (("z",), [0.0], r"z: 1 numbers; expected \d+"),
    (("z", 3), 1e300, "expected finite numbers"),
    (("names",), ["a"], "its parameters differ"),
    (("robot", "geometry", "place"), [[0, 0]], "lists of different lengths"),
    (("robot", "geometry", "drive_of"), [5, 5, 5], "drives of the wheels"),
    (("robot", "geometry", "gear_ratio"), -1, "gear_ratio: -1; expected"),
    (("robot", "values", "motor.resistance"), [1, 2], "motor.resistance: .* expected 1 numbers"),
    (("robot", "values", "motor.resistance"), -1.0, "motor.resistance"),
    (("robot", "surfaces"), [], r"robot.surfaces: \[\]; expected"),
    (("choices",), [{}], r"choices\[1\].pattern: missing"),
    (("curves", "soft", "slip"), [1.0], "curves.soft: lists of different lengths"),
    (("curves", "soft", "at"), {}, "no wheel_speed"),
    (("curves", "hard"), "x", "curves.hard: 'x'; expected"),
    (("validity", "soft", "loads"), 1, "validity.soft.loads: 1"),
    (("validity", "soft", "more"), 1, "validity.soft.more: no such key"),
    (("variances", "camera.place", "variance"), -1, "variance: -1; expected"),
    (("settings", "windows_per_piece"), 0, "windows_per_piece: 0; expected"),
    (("settings", "seed"), 1.5, "seed: 1.5; expected"),
    (("settings", "mixed"), {"near": [1.0], "runs": 1, "windows": 1}, "mixed.near: 1 numbers"),
    (("history",), 1, "history: 1; expected"),
    (("current_trend",), [1], "current_trend"),
    (("held_out",), {"rivals": 3}, "held_out"),
    (("baselines",), {"linear": {"soft": [[1], 2]}}, "baselines.linear.soft: not an array"),
    (("selection",), {"soft": {"model": "x"}}, "selection.soft.errors: missing"),
    (("calibration",), {"surfaces": {}}, "calibration.centre_of_rotation_m: missing"),
    (("data", "runs"), [["a"]], "data.runs"),
    (("arrays", "file"), "../fit.npz", "arrays.file: .*pattern"),
    (("extra",), 1, "extra: no such key"),
]


@pytest.mark.parametrize(("path", "value", "message"), NONSENSE)
def test_nonsense_with_a_right_checksum_is_refused_with_its_key(tmp_path, path, value, message):
    save(fit_of(True), tmp_path)
    content = json.loads((tmp_path / "fit.json").read_text())
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    sealed(tmp_path, content)
    with pytest.raises(DataError, match=message) as caught:
        load(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / "fit.json"))
    assert "run `slipid identify` again" in str(caught.value)


OTHER_ARRAYS = [
    ("covariance", None, "array covariance: expected finite numbers"),
    ("covariance", lambda x: x[:-1], r"array covariance of shape \(\d+, \d+\); expected"),
    ("covariance", lambda x: -x, "negative variances"),
    ("laplace", lambda x: x * np.nan, "array laplace: expected finite numbers"),
    ("laplace", lambda x: x.astype(np.float32), "array laplace: expected finite numbers"),
    ("shared/soft/coefs", lambda x: x[0], "array shared/soft/coefs of shape"),
    ("shared/soft/std", lambda x: x[:2], "array shared/soft/std of shape"),
    ("shared/soft/by_number", lambda x: x[..., 0], "array shared/soft/by_number of shape"),
    ("chain", lambda x: np.zeros(3), r"array chain of shape \(3,\)"),
]


@pytest.mark.parametrize(("name", "change", "message"), OTHER_ARRAYS)
def test_arrays_that_do_not_fit_are_refused(tmp_path, name, change, message):
    *_, file = save(fit_of(True), tmp_path)
    kept = dict(np.load(tmp_path / file))
    old = kept.pop(name, None)
    buffer = io.BytesIO()
    np.savez(buffer, **(kept if change is None else {**kept, name: change(old)}))
    (tmp_path / file).write_bytes(buffer.getvalue())
    content = json.loads((tmp_path / "fit.json").read_text())
    content["arrays"]["sha256"] = hashlib.sha256(buffer.getvalue()).hexdigest()
    sealed(tmp_path, content)
    with pytest.raises(DataError, match=message):
        load(tmp_path)


def test_a_fit_from_its_files_has_the_same_type_and_names_what_it_lacks(tmp_path):
    fit = fit_of(True)
    fit.save(tmp_path)
    again = Fit.load(tmp_path)
    assert str(again) == str(fit)
    assert again["surface.soft.creep"] == fit["surface.soft.creep"]
    with pytest.raises(KeyError, match=r"no parameter 'motor\.nonsense'; there are"):
        _ = again["motor.nonsense"]
    assert again.new_runs(fit.data) == 0
    with pytest.raises(ValueError, match="this fit was loaded from its files"):
        again.profile("surface.soft.creep", quiet=True)
