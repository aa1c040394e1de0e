"""Verdicts of ratios, flat directions with known truth, profiles of known shapes."""

from __future__ import annotations

import functools
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pint
import pytest
from scipy.stats import chi2

from slipid.fitting.optimise import optimise
from slipid.fitting.problem import Problem
from slipid.infer.verdicts import unidentified as flat_module
from slipid.infer.verdicts import wording
from slipid.infer.verdicts.estimates import RATIOS, derived, estimates
from slipid.infer.verdicts.profile import RISE, _Refits, profile, profiled
from slipid.infer.verdicts.unidentified import FLAT_INFORMATION, flat_directions, sentences
from slipid.infer.verdicts.wording import VOLTAGE, remedy
from slipid.model.robot import Validity
from slipid.search_space import Choice, Space
from tests.fitting.test_optimise import NOISE, begin
from tests.helpers.made_windows import made, robot

NOTHING = Choice("*", free=False)
TRUTH = robot(sessions=("one",))
MANY = (
    *("camera.scale", "camera.marker_yaw", "robot.*_radius", "robot.drive_offset"),
    *("robot.load_share@*", "surface.*", "motor.resistance", "motor.back_emf"),
    *("motor.coulomb_friction", "motor.viscous_friction"),
)


def space_of(*patterns: str) -> Space:
    return Space(TRUTH, [NOTHING, *(Choice(p, free=True) for p in patterns)])


def test_a_mass_ratio_is_free_but_for_the_first_load_setup_and_weak_at_most():
    space = Space(TRUTH, [NOTHING, Choice("robot.load_share@moved", free=True)])
    assert [e.path for e in space.free] == ["robot.load_share@moved"]
    space = Space(TRUTH, [])
    ratios = [e.path for e in space.free if e.quantity == "robot.mass_ratio"]
    assert ratios == ["robot.mass_ratio@moved"]
    assert space.electric[space.slices[ratios[0]]].all()
    assert "robot.mass_ratio@as_built" in space_of("robot.mass_ratio@*").slices
    narrow = np.diag(1e-4 * space.prior_std**2)
    found = {e.path: e for e in estimates(space, (), space.start, narrow, True, ())}
    assert found["robot.load_share@moved"].verdict == "identified"
    assert found["robot.mass_ratio@moved"].verdict == "weak"
    assert found["robot.mass_ratio@moved"].provenance == "measured"


# sparse flat directions --------------------------------------------------------------------------


def precision_of(p):
    return flat_module._Precision(p)


def information(size, flat, held=400.0):
    """Return information 1 along the columns of `flat`, and `held` more across them."""
    q, _ = np.linalg.qr(flat)
    return np.eye(size) + held * (np.eye(size) - q @ q.T)


def test_planted_directions_come_out_alone_and_exact():
    flat = np.zeros((9, 3))
    flat[2, 0] = 1.0
    flat[[0, 4], 1] = 0.6, -0.8
    flat[[1, 5, 8], 2] = 1.0, 1.0, -1.0
    found = flat_module._sparse(precision_of(information(9, flat)), list(range(9)), [], np.ones(9))
    assert [sorted(picked) for picked, _ in found] == [[2], [0, 4], [1, 5, 8]]
    for (picked, u), column in zip(found, flat.T, strict=True):
        cosine = u @ column[picked] / np.linalg.norm(column)
        assert abs(cosine) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_what_is_called_flat_is_and_nothing_is_left_out(seed):
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(8, 8)))
    p = q @ np.diag([1.0, 1.0, 1.3, 1.5, 2.0, 5.0, 50.0, 1e4]) @ q.T
    found = flat_module._sparse(precision_of(p), list(range(8)), [], np.ones(8))
    assert found
    pivots = []
    for picked, u in found:
        assert u @ p[np.ix_(picked, picked)] @ u < FLAT_INFORMATION
        for k in range(len(picked)):  # without any of its numbers nothing flat remains
            fewer = picked[:k] + picked[k + 1 :]
            if fewer and len(picked) > 1:
                lowest = np.linalg.eigvalsh(p[np.ix_(fewer, fewer)])[0]
                assert lowest >= flat_module._NO_EFFECT
        pivots.append(picked[int(np.argmax(np.abs(u) > 0.9 * np.abs(u).max()))])
    rest = [k for k in range(8) if k not in pivots]
    assert np.linalg.eigvalsh(p[np.ix_(rest, rest)])[0] >= FLAT_INFORMATION


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_flat_where_the_data_determine_every_direction(seed):
    space = space_of("surface.*")
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(space.size, space.size)))
    p = q @ np.diag(rng.uniform(1.6, 1e3, space.size)) @ q.T  # weakest: std 0.79 of the prior's
    cov = np.linalg.inv(p) * space.prior_std[:, None] * space.prior_std
    assert flat_directions(space, cov, True, True) == ()


def test_powers_differ_by_formula():
    a, b = "camera.scale", "robot.wheel_radius"
    both = [axis for e in numbers(a, b) for axis in wording.axes_of(e)]
    assert wording._product(both, np.array([1.0, 1.0])) == f"{a}, {b} only as {b}/{a}"
    assert wording._product(both, np.array([1.0, -1.0])) == f"{a} and {b} only as {a} * {b}"
    assert wording._product(both, np.array([-0.5, 1.0])) == f"{a} and {b} only as {a}^2 * {b}"
    assert wording._product(both, np.array([1.0, 0.5])) == f"{a} and {b} only as {a} / {b}^2"
    three = [*both, *wording.axes_of(numbers("surface.soft.creep")[0])]
    open_ = wording._product(three, np.array([1.0, -0.5, 0.8]))
    assert open_.startswith(
        f"changes without effect on the data, for any factor t: {a} times t, {b} divided by t^0.5, "
    )
    assert open_.endswith(" times t^0.8")
    assert wording._sum([a, b], np.array([1.0, -1.0])) == f"{a} and {b} only as {b} + {a}"
    assert wording._sum([a, b], np.array([1.0, 0.5])) == f"{a} and {b} only as {a} - 2 {b}"


# remedies ----------------------------------------------------------------------------------------

FLOOR = Validity(
    runs=8,
    loads=("as_built",),
    wheel_speed=(0.0, 5.0),
    torque_nm=(0.0, 0.4),
    slip=(0.0, 0.3),
    yaw_rate=(0.0, 0.5),
    headings_deg=(0.0, 60.0, 120.0, 180.0),
    speeds=(0.1, 0.2),
    turn_rates=(),
    distance=0.7,
)


def numbers(*paths):
    by = {e.path: e for e in space_of("*").all}
    return [by[path] for path in paths]


@pytest.mark.parametrize(
    ("driven", "paths", "words"),
    [
        ({"headings_deg": (30.0,)}, ["surface.soft.creep"], "in other directions than 30 deg"),
        ({"speeds": (0.1, 0.11)}, ["surface.soft.slide_viscosity"], "at other speeds"),
        ({"yaw_rate": (0.0, 0.01)}, ["surface.soft.scrub"], "in curves"),
        ({"headings_deg": (30.0,)}, ["robot.load_share@as_built"], "in other directions than 30"),
        ({}, ["robot.load_share@as_built"], "weigh each wheel"),
        ({"slip": (0.0, 0.01)}, ["surface.soft.creep"], "slip by 1.0% at most"),
        ({}, ["camera.scale", "robot.wheel_radius"], "a length in the camera's image"),
        ({}, ["camera.scale", "surface.soft.creep"], "a floor on which the wheels do not slip"),
        ({"speeds": (0.1,)}, ["motor.coulomb_friction", "motor.viscous_friction"], "other speeds"),
    ],
)
def test_a_remedy_names_what_the_runs_lack(driven, paths, words):
    assert words in remedy(numbers(*paths), True, True, {"soft": replace(FLOOR, **driven)})


def test_a_remedy_names_what_the_logs_lack():
    scale = numbers("motor.back_emf", "surface.soft.friction")
    assert remedy(scale, True, False, {}) == VOLTAGE
    assert "motor currents" in remedy(scale, False, False, {})
    assert "voltage" not in remedy(numbers("surface.soft.creep"), True, False, {"soft": FLOOR})


# directions that physics makes flat ------------------------------------------------------------


@functools.cache
def problem(voltage: bool) -> Problem:
    w = made(TRUTH, runs=48, std=NOISE, voltage=voltage)
    w = replace(w, voltage=np.zeros_like(w.voltage)) if not voltage else w
    return Problem(w, TRUTH, [NOTHING, *(Choice(p, free=True) for p in MANY)])


@functools.cache
def precision(voltage: bool, one_heading: bool = False) -> np.ndarray:
    this = problem(voltage)
    if one_heading:
        w = this.windows
        rate = np.abs(w.turn).max(axis=-1, keepdims=True)
        this = this.of(replace(w, turn=rate * np.array([-1.0, 0.0, 1.0])))
    typical, keep = 2 * np.log(this.noise.typical), np.ones(len(this.windows))
    return np.linalg.inv(this.laplace(this.space.start, typical, keep))


def expected_posterior(*patterns: str, voltage: bool = True, one_heading: bool = False):
    """Return a space in which only these are free, and its expected covariance."""
    space, names = space_of(*patterns), problem(voltage).space.names
    at = np.array([names.index(n) for n in space.names])
    whole, electric = precision(voltage, one_heading), problem(voltage).space.electric
    motion = np.zeros_like(whole)  # currents do not inform it
    still = np.ix_(~electric, ~electric)
    motion[still] = np.linalg.inv(np.linalg.inv(whole)[still])
    e, m = at[electric[at]], at[~electric[at]]
    ie, im = np.flatnonzero(electric[at]), np.flatnonzero(~electric[at])
    own, cross = whole[np.ix_(e, e)], whole[np.ix_(e, m)]
    p = np.zeros((len(at), len(at)))
    p[np.ix_(ie, ie)], p[np.ix_(ie, im)], p[np.ix_(im, ie)] = own, cross, cross.T
    p[np.ix_(im, im)] = motion[np.ix_(m, m)] + cross.T @ np.linalg.solve(own, cross)
    return space, np.linalg.inv(p)


@pytest.mark.slow
def test_nothing_determines_the_unit_of_length():
    """One factor may scale the robot, the floor's lengths and the picture."""
    lengths = ("camera.scale", "robot.*_radius", "surface.*.lead", "surface.*.scrub")
    space, cov = expected_posterior(*lengths)
    [found] = flat_directions(space, cov, True, True)
    assert set(found.paths) == {"camera.scale", "robot.wheel_radius", "robot.base_radius"}
    assert found.powers == pytest.approx([1.0] * 3, abs=0.05)
    assert "only as robot.base_radius/robot.wheel_radius" in found.formula
    assert "a length in the camera's image" in found.remedy
    by = {e.path: e for e in derived(space, space.start, cov, True)}
    assert by["camera.scale/robot.wheel_radius"].verdict == "identified"
    assert flat_directions(*expected_posterior("camera.scale", *lengths[2:]), True, True) == ()


@pytest.mark.slow
def test_marker_yaw_and_a_turn_of_all_drives_are_one_number():
    space, cov = expected_posterior("camera.marker_yaw", "robot.drive_offset", "surface.*.creep")
    [found] = flat_directions(space, cov, True, True)
    assert set(found.paths) == {"camera.marker_yaw", "robot.drive_offset"}
    assert len(found.paths) == 4
    assert np.abs(found.powers) == pytest.approx(1.0, abs=0.05)
    assert "the marker's angle" in found.remedy
    assert (
        flat_directions(*expected_posterior("camera.marker_yaw", "surface.*.creep"), True, True)
        == ()
    )


@pytest.mark.slow
def test_one_direction_of_travel_leaves_loads_open_and_many_do_not():
    floor = (f"surface.*.{n}" for n in ("creep", "roller_drag", "roller_creep", "lead"))
    free = ("robot.load_share@*", *floor)
    floors = {"firm": FLOOR, "soft": replace(FLOOR, loads=("as_built", "moved"))}
    one = {k: replace(v, headings_deg=(0.0,)) for k, v in floors.items()}
    assert flat_directions(*expected_posterior(*free), True, True, floors) == ()
    found = flat_directions(*expected_posterior(*free, one_heading=True), True, True, one)
    assert any("robot.load_share" in p for f in found for p in f.paths)
    assert all("in other directions than 0 deg" in f.remedy for f in found)


@pytest.mark.slow
def test_the_torque_scale_is_open_without_voltage_and_reported_once():
    free = ("motor.resistance", "motor.back_emf", "motor.*_friction", "surface.*.friction")
    found = flat_directions(*expected_posterior(*free, voltage=False), True, False)
    texts = sentences(found)
    assert f"the data have almost no information about motor.resistance: {VOLTAGE}" in texts
    [scale] = [f for f in found if "motor.back_emf" in f.paths]
    assert scale.powers == pytest.approx([1.0] * 5, abs=0.05)
    assert scale.text.endswith(
        "motor.viscous_friction/motor.back_emf, surface.*.friction/motor.back_emf: " + VOLTAGE
    )
    assert flat_directions(*expected_posterior(*free), True, True) == ()


# ratios ------------------------------------------------------------------------------------------


def test_units_of_ratios_are_those_of_their_numbers():
    units, every = pint.UnitRegistry(), space_of("*").all
    by = {name: e.declaration.unit for e in every for name in (e.quantity, e.path)}
    for (over, under), wanted in RATIOS.items():
        quotient = units.parse_units(by[over]) / units.parse_units(by[under])
        same = units.Quantity(1.0, wanted.unit) / units.Quantity(1.0, quotient)
        assert float(same.to_base_units().magnitude) == pytest.approx(1.0)
        assert same.dimensionless


@pytest.mark.slow
@pytest.mark.parametrize("voltage", [True, False])
def test_verdicts_with_currents_and_voltages(voltage):
    space, cov = expected_posterior(
        "motor.resistance", "motor.back_emf", "surface.*.friction", voltage=voltage
    )
    found = {e.path: e for e in derived(space, space.start, cov, voltage)}
    for floor in ("firm", "soft"):
        assert found[f"surface.{floor}.friction/motor.back_emf"].verdict == "identified"
    both = found["motor.resistance/motor.back_emf"]
    assert both.value == pytest.approx(5.5 / float(TRUTH.motor.back_emf))
    assert both.verdict == ("identified" if voltage else "not_identified")
    assert both.provenance == ("measured" if voltage else "borrowed")
    r, c = (space.slices[f"motor.{n}"].start for n in ("resistance", "back_emf"))
    std = np.sqrt(cov[r, r] + cov[c, c] - 2 * cov[r, c])
    assert both.std == pytest.approx(both.value * std)
    low, high = both.interval90
    assert np.log(high / low) == pytest.approx(2 * 1.6448536 * std)
    assert both.ratio == pytest.approx(std / np.hypot(space.prior_std[r], space.prior_std[c]))


def test_a_number_without_bounds_may_be_larger_than_any_exponent():
    space = space_of("surface.soft.lead")
    at = space.slices["surface.soft.lead"]
    z = np.array(space.start)
    z[at] = 1e4
    [e] = [one for one in estimates(space, (), z, np.eye(len(z)), True, ()) if one.std is not None]
    assert e.interval90 == pytest.approx((1e4 - 1.6448536, 1e4 + 1.6448536))


def test_an_unknown_number_has_finite_interval_ends():
    space = space_of("motor.resistance", "motor.back_emf")
    wide = np.diag((1e4 * space.prior_std) ** 2)
    [e] = derived(space, space.start, wide, True)
    every = estimates(space, (), space.start, wide, True, ())
    ends = [e.interval90[1], *(one.interval90[1] for one in every if one.std is not None)]
    assert len(ends) == 3
    assert np.isfinite(ends).all()


def test_no_prior_lends_the_ratio_a_verdict_without_voltage():
    space = space_of("motor.resistance", "motor.back_emf")
    tight = np.diag((1e-3 * space.prior_std) ** 2)
    for voltage, verdict in ((False, "not_identified"), (True, "identified")):
        [e] = derived(space, space.start, tight, voltage)
        assert e.verdict == verdict
    fixed = space_of("motor.resistance")  # a ratio to a known number is no news
    assert derived(fixed, fixed.start, np.eye(1), True) == ()


# profiles ----------------------------------------------------------------------------------------

FITTED = (
    Choice("motor.resistance", prior_mean=5.0, prior_std=2.0),
    Choice("motor.back_emf", free=True),
    Choice("surface.*.creep", free=True),
    Choice("surface.firm.scrub", free=True),
    Choice("motor.inductance", free=True),
)


@functools.cache
def fitted(scrub=0.002):
    truth = eqx.tree_at(lambda r: r.surfaces.scrub, TRUTH, jnp.array([scrub, 0.002]))
    w = made(truth, runs=24, std=NOISE)
    this = Problem(w, truth, [NOTHING, *FITTED])
    return this, optimise(this, start=begin(this), tolerance=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("path", ["motor.resistance", "surface.soft.creep"])
def test_a_profile_is_laplace_near_the_top_and_ends_where_the_likelihood_does(path):
    this, end = fitted()
    p = profile(this, end, path)
    assert p.settled
    assert p.ends == ("closed", "closed")
    low = np.array(p.laplace) < 0.3
    assert low.sum() >= 3
    np.testing.assert_allclose(np.array(p.posterior)[low], np.array(p.laplace)[low], atol=0.05)
    found = np.interp(p.interval90, p.value, p.likelihood)
    assert found == pytest.approx([RISE, RISE], abs=0.12)  # between points: straight, not cubic
    assert chi2.cdf(2 * RISE, 1) == pytest.approx(0.9)
    assert p.interval90[0] < p.estimate < p.interval90[1]


@pytest.mark.slow
def test_a_profile_refits_all_others():
    """Holding a number elsewhere costs less than moving it alone."""
    this, end = fitted()
    p = profile(this, end, "motor.back_emf")
    k = this.space.slices["motor.back_emf"].start
    z = end.state.z.copy()
    z[k] = np.log(p.value[-1])
    log_v, every = end.state.log_variance, np.ones(len(this.windows))
    electric = this.electric(end.state.z, log_v)

    def loss(z):
        blocks, _ = this.linear(z, electric)
        seen = this.weighed(blocks, log_v, every, end.state.effect)
        return this.loss(z, log_v, every, seen, electric)

    assert p.posterior[-1] < 0.9 * (loss(z) - loss(end.state.z))


@pytest.mark.slow
def test_a_profile_without_a_lower_end_ends_at_the_bound():
    this, end = fitted(scrub=1e-4)
    p = profile(this, end, "surface.firm.scrub")
    assert p.ends == ("at_bound", "closed")
    assert p.interval90[0] == 0.0
    assert p.interval90[1] < p.value[-1]
    assert "is at its bound: the data only show that it is below" in p.sentence


@pytest.mark.slow
def test_a_profile_goes_back_where_it_stepped_over_the_end_of_a_flat_stretch(monkeypatch):
    """A likelihood level over 1.5 prior stds and then steep needs points near the edge."""
    this, end = fitted()
    at = this.space.slices["motor.inductance"].start
    start, std = end.state.z[at], this.space.prior_std[at]

    def optimised(problem, start, **_):
        return replace(end, state=start)

    def loss(walk, state):
        return 50.0 * max((start - state.z[at]) / std - 1.5, 0.0) ** 2

    monkeypatch.setattr("slipid.infer.verdicts.profile.optimise", optimised)
    monkeypatch.setattr(_Refits, "loss", loss)
    walk = _Refits(this, end, at, lambda points, rise: None)
    z, rise = np.array(sorted(walk.side(-1.0), reverse=True)).T
    z, rise = (start - z) / std, rise - 0.5 * ((z - this.space.prior_mean[at]) / std) ** 2
    k = np.flatnonzero(rise - rise[0] > RISE)[0]
    assert rise[k] - rise[0] < 3 * RISE
    assert z[k] - z[k - 1] < 0.7
    assert z[k - 1] < 1.5 + np.sqrt(RISE / 50) < z[k]


@pytest.mark.slow
def test_a_profile_of_a_number_without_data_is_level():
    this, end = fitted()
    p = profile(this, end, "motor.inductance")
    assert p.ends == ("open", "open")
    assert p.interval90 == (None, None)
    assert max(p.likelihood) < 1e-6
    np.testing.assert_allclose(p.posterior, p.laplace, atol=1e-6)  # the prior alone
    assert "do not determine it" in p.sentence


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("motor.resistanse", "no parameter 'motor.resistanse'"),
        ("robot.mass", "robot.mass is fixed"),
        ("robot.load_share@as_built", "is a vector of 3 numbers"),
    ],
)
def test_a_profile_of_something_else_is_refused_with_the_choices(path, why):
    with pytest.raises(ValueError, match=why) as error:
        profiled(space_of("motor.resistance", "robot.load_share@*"), path)
    assert str(error.value).endswith("expected one of the free scalars motor.resistance")
