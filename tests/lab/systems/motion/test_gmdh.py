"""Polynomial networks against plain least squares, and GMDH on simulated floors."""

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from slipid.lab.systems.motion.gmdh import (
    CANDIDATES,
    EVIDENCE_MEMORY,
    GmdhClass,
    GmdhOne,
    NetworkSet,
    first_half,
    remembered,
)
from slipid.lab.systems.motion.polynomial_network import (
    LEAST_GAIN,
    Growth,
    Layer,
    PairMoments,
    PolynomialNetwork,
    grown,
    pruned,
)
from slipid.predict.slip_model import Run, path_of
from tests.helpers.made_runs import ROBOTINO, made_run, straight

EXACT = Growth(1e-12, 20, 5)
SIZES = np.array([1.0, 1.0, 0.125])


def terms(a, b):
    return np.stack([np.ones_like(a), a, b, a * b, a**2, b**2], axis=1)


def rows(seed=0, n=80, inputs=4):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, inputs)), rng.normal(size=n), rng.uniform(0.5, 2.0, n)


def test_neurons_of_all_pairs_are_weighted_ridge_regressions():
    x, y, weight = rows()
    layer = PairMoments.of(x, y, weight).solved(0.3)
    assert layer.inputs.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    for (a, b), found in zip(layer.inputs, layer.weight, strict=True):
        root = np.sqrt(weight / weight.sum())[:, None]
        # ridge as further rows, none for the constant
        tall = np.vstack([root * terms(x[:, a], x[:, b]), np.sqrt(0.3) * np.eye(6)[1:]])
        right = np.concatenate([root[:, 0] * y, np.zeros(5)])
        assert np.allclose(found, np.linalg.lstsq(tall, right, rcond=None)[0])


def test_errors_of_neurons_are_those_of_their_outputs():
    x, y, weight = rows()
    layer = PairMoments.of(*rows(1)).solved(0.01)
    square = (layer.output(x) - y[:, None]) ** 2
    assert np.allclose(
        PairMoments.of(x, y, weight).errors(layer.weight),
        np.average(square, axis=0, weights=weight),
    )


def test_a_quadratic_of_two_inputs_is_found_exactly_in_one_layer():
    x, _, weight = rows(n=200)
    y = 0.3 - x[:, 3] + 2.0 * x[:, 1] * x[:, 3] + 0.5 * x[:, 1] ** 2 - 0.7 * x[:, 3] ** 2
    network = grown(x, y, weight, np.arange(200) < 100, EXACT)
    (layer,) = network.layers
    assert layer.inputs.tolist() == [[1, 3]]
    assert layer.weight[0] == pytest.approx([0.3, 0.0, -1.0, 2.0, 0.5, -0.7], abs=1e-8)
    assert network.numbers == 6


def test_two_quadratics_of_other_inputs_take_two_layers():
    # levels of all inputs combined, so that no term of one pair is like a term of the other
    x = np.array(list(product([-1.2, -0.5, 0.4, 1.3], repeat=4)))
    x = np.concatenate([x, x])
    y = x[:, 0] * x[:, 1] + x[:, 0] ** 2 + 0.5 * x[:, 2] - x[:, 2] * x[:, 3]
    in_a = np.arange(len(x)) < len(x) // 2
    network = grown(x, y, np.ones(len(x)), in_a, EXACT)
    assert len(network.layers) == 2
    assert sorted(map(tuple, network.layers[0].inputs.tolist())) == [(0, 1), (2, 3)]
    assert np.allclose(network.output(x), y, atol=1e-6)
    assert network.errors[0] > 0.1
    short = grown(x, y, np.ones(len(x)), in_a, replace(EXACT, layers=1))
    assert len(short.layers) == 1


def test_growth_ends_where_the_held_out_half_does_not_improve():
    x, y, weight = rows(3, n=120, inputs=6)
    y = y + x[:, 0] * x[:, 1] + np.tanh(x[:, 2])
    in_a = np.arange(120) % 2 == 0
    growth = Growth(1e-6, 4, 9)
    network = grown(x, y, weight, in_a, growth)
    errors = np.array(network.errors)
    assert 1 < len(network.layers) < 9
    assert (errors[1:] < (1 - LEAST_GAIN) * errors[:-1]).all()
    assert errors[-1] == pytest.approx(
        np.average((network.output(x) - y)[~in_a] ** 2, weights=weight[~in_a])
    )
    # the next layer of all that was kept is no better
    kept = x
    for _ in network.layers:
        half_a, half_b = (PairMoments.of(kept[h], y[h], weight[h]) for h in (in_a, ~in_a))
        layer = half_a.solved(growth.ridge)
        best = np.argsort(half_b.errors(layer.weight))[:4]
        kept = layer.only(best).output(kept)
    half_a, half_b = (PairMoments.of(kept[h], y[h], weight[h]) for h in (in_a, ~in_a))
    following = half_b.errors(half_a.solved(growth.ridge).weight).min()
    assert following >= (1 - LEAST_GAIN) * errors[-1]


def test_a_pruned_network_has_the_same_output():
    rng = np.random.default_rng(5)
    sizes = [5, 7, 6, 4]
    layers = [
        Layer(rng.integers(0, before, (after, 2)), rng.normal(0.0, 0.3, (after, 6)))
        for before, after in pairwise(sizes)
    ]
    x = rng.normal(size=(9, 5))
    whole = PolynomialNetwork(layers, [])
    small = PolynomialNetwork(pruned(layers), [])
    assert np.allclose(small.output(x), whole.output(x))
    assert [len(layer.weight) for layer in small.layers[-2:]] <= [2, 1]
    assert small.numbers < whole.numbers


def test_with_an_empty_half_all_rows_do_both():
    x, y, weight = rows()
    everyone = np.ones(len(x), dtype=bool)
    network = grown(x, y, weight, everyone, Growth(1e-3, 5, 1))
    assert network.errors == grown(x, y, weight, ~everyone, Growth(1e-3, 5, 1)).errors
    assert np.isfinite(network.errors[0])


def test_halves_are_of_whole_runs_of_every_floor():
    run = np.repeat(np.arange(9), 4)
    floors = np.repeat(["gray"] * 4 + ["green"] * 4 + ["table"], 4)
    in_a = first_half(run, floors)
    share = in_a.reshape(9, 4).mean(axis=1)
    assert share[:4].sum() == 2
    assert share[4:8].sum() == 2
    assert set(share[:8]) == {0.0, 1.0}
    # a single run is cut into windows
    assert in_a[32:].tolist() == [True, False, True, False]


def test_older_evidence_fades_and_no_run_remembers_another():
    run = np.array([0, 0, 0, 1, 1])
    got = remembered(np.array([[1.0], [1.0], [1.0], [5.0], [0.0]]), run)
    expected = [
        1.0,
        1.0 + EVIDENCE_MEMORY,
        1.0 + EVIDENCE_MEMORY + EVIDENCE_MEMORY**2,
        5.0,
        5.0 * EVIDENCE_MEMORY,
    ]
    assert got[:, 0] == pytest.approx(expected)


def test_outputs_of_networks_are_clipped_to_the_training_range():
    x = np.random.default_rng(0).uniform([-1, -1, -3], [1, 1, 1], (100, 3))
    y = np.stack([x[:, 0] * x[:, 1], x[:, 2] ** 2], axis=1)
    networks = NetworkSet.grown(x, y, np.ones(100), np.arange(100) % 2 == 0, EXACT)
    assert np.allclose(networks.predict(x), y)
    far = networks.predict(np.full((1, 3), 50.0))
    # the corner where both are largest was not seen, nor squares beyond one on this side
    assert far[0] == pytest.approx([y[:, 0].max(), x[:, 2].max() ** 2], abs=1e-6)


def slipping(angle: float, floor: str, seed: int = 0, steps: int = 40) -> Run:
    """Return runs that slip by their direction on ice, with low currents, and not on gray."""
    ratio = np.array([-0.4 - 0.2 * np.cos(angle), 0.2 * np.sin(angle), 0.1])
    ratio = ratio if floor == "ice" else np.zeros(3)
    amps = 0.3 if floor == "ice" else 0.9
    noise = np.random.default_rng([seed, int(1000 * angle)]).normal(0.0, 0.1, (steps, 3))
    rolling = straight(angle, steps=steps)
    return made_run(rolling, rolling + 0.2 * ratio / SIZES, current=amps + noise, floor=floor)


ANGLES = np.linspace(0.0, 6.0, 16)
RUNS = [slipping(angle, floor) for angle in ANGLES for floor in ("gray", "ice")]


@pytest.fixture(scope="module")
def classes() -> GmdhClass:
    return GmdhClass().fit(RUNS, ROBOTINO)


def error(predicted, run: Run) -> float:
    return float(np.hypot(*(predicted.path - path_of(run.twist, run.signals.dt))[-1, :2]))


def test_floors_are_classified_by_currents_and_slip_is_that_of_the_floor(classes):
    for floor in ("gray", "ice"):
        new = slipping(1.1, floor, seed=7).with_floor(False)
        (predicted,) = classes.predict([new.signals], ROBOTINO)
        assert predicted.floors is not None
        assert sum(predicted.floors.values()) == pytest.approx(1.0)
        assert predicted.floors[floor][-1] > 0.95
        assert predicted.floors[floor][0] < predicted.floors[floor][-1]
        assert len(predicted.floors[floor]) == 40
        assert error(predicted, new) < 0.02 * 0.8


def test_a_given_floor_is_used_if_it_was_trained_on(classes):
    new = slipping(1.1, "gray", seed=7)
    wrong = replace(new, signals=replace(new.signals, floor="ice"))
    unseen = replace(new, signals=replace(new.signals, floor="sand"))
    predicted = classes.predict([new.signals, wrong.signals, unseen.signals], ROBOTINO)
    as_on_ice = slipping(1.1, "ice", seed=7)
    assert error(predicted[1], as_on_ice) < 0.02 * 0.8
    assert error(predicted[0], new) < 0.02 * 0.8
    assert error(predicted[2], new) < 0.02 * 0.8
    # what it tells of floors is from what it hears, whatever it is told
    assert predicted[1].floors["gray"][-1] > 0.95


def test_floors_are_classified_without_later_signals(classes):
    whole = slipping(1.1, "gray", seed=7).signals
    other = slipping(1.1, "ice", seed=7).signals
    mixed = np.concatenate([whole.current[:20], other.current[20:]])
    first, second = classes.predict([whole, replace(whole, current=mixed)], ROBOTINO)
    assert np.array_equal(first.floors["ice"][:20], second.floors["ice"][:20])
    assert second.floors["ice"][-1] > 0.5 > first.floors["ice"][-1]


def test_a_floor_without_training_runs_in_this_load_is_left_out():
    loads = {"gray": "moved", "ice": "as_built"}
    runs = [replace(run, signals=replace(run.signals, load=loads[run.floor])) for run in RUNS]
    method = GmdhClass().fit(runs, ROBOTINO)
    # by its currents it is on ice
    new = slipping(1.1, "ice", seed=7).with_floor(False).signals
    moved, other = method.predict([replace(new, load="moved"), replace(new, load="new")], ROBOTINO)
    assert np.array_equal(moved.floors["gray"], np.ones(40))
    assert other.floors["ice"][-1] > 0.95


def test_a_robot_at_rest_learns_nothing_of_its_floor(classes):
    rest = made_run(np.zeros((40, 3)), current=np.full((40, 3), 0.3)).with_floor(False).signals
    (predicted,) = classes.predict([rest], ROBOTINO)
    assert np.allclose(predicted.floors["gray"], 0.5)
    assert np.abs(predicted.path).max() == 0.0


def test_a_single_floor_needs_no_classifier():
    runs = [run for run in RUNS if run.floor == "ice"]
    method = GmdhClass().fit(runs, ROBOTINO)
    new = slipping(2.2, "ice", seed=9).with_floor(False)
    (predicted,) = method.predict([new.signals], ROBOTINO)
    assert method.classifier is None
    assert error(predicted, new) < 0.02 * 0.8
    assert np.array_equal(predicted.floors["ice"], np.ones(40))
    assert 18 <= method.numbers == method.floors["ice"].numbers


def test_one_set_of_networks_does_not_ask_for_the_floor(classes):
    method = GmdhOne().fit(RUNS, ROBOTINO)
    new = slipping(1.1, "ice", seed=7)
    given, not_told = method.predict([new.signals, new.with_floor(False).signals], ROBOTINO)
    assert np.array_equal(given.path, not_told.path)
    assert given.floors is None
    assert 0 < method.numbers < classes.numbers
    encoders = path_of(new.signals.rolling(ROBOTINO), new.signals.dt)
    assert error(given, new) < 0.4 * error(replace(given, path=encoders), new)


@pytest.mark.parametrize("method", [GmdhOne(), GmdhClass()], ids=lambda method: method.name)
def test_settings_that_are_tried(method):
    assert [each.growth for each in method.candidates()] == list(CANDIDATES)
    assert method.numbers == 0
    with pytest.raises(ValueError, match="was not fitted"):
        method.predict([RUNS[0].signals], ROBOTINO)
