"""Floors that nobody drove on: what they are made of, and what they are good for."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.model.geometry import omni
from slipid.model.robot import build
from slipid.model.se2 import advance
from slipid.robot.deployed import LOG_CREEPS, LOG_FRICTIONS, DeployedRobot, with_unseen
from slipid.robot.estimator import Estimator, EstimatorState
from slipid.robot.filter.floor_filter import FloorFilter
from slipid.robot.filter.hypotheses import hypotheses_of
from slipid.robot.interface import Readings, Settings
from slipid.robot.record import EffectRecord
from tests.helpers.known_robot import deploy_known
from tests.helpers.small_twin import deployed

COUNT = len(LOG_CREEPS) * len(LOG_FRICTIONS)
SOFT = {"friction": 0.5, "creep": 0.6, "roller_drag": 0.95}
"""Softer than the floors of the robot as floors are, between two of the unseen ones."""
OTHER = {"friction": 0.5, "creep": 0.9, "roller_drag": 0.5}
"""Softer still, with far less drag than floors so soft have."""


def value(robot: DeployedRobot, path: str) -> float:
    number = robot.record.parameters[f"surface.{path}"].value
    assert isinstance(number, float)
    return number


def test_unseen_floors_surround_the_middle_of_the_known_floors():
    known, wider = deployed(process=1.0), deployed(process=1.0).with_unseen()
    names = wider.labels[2:]
    assert names == tuple(f"unseen_{k + 1}" for k in range(COUNT))
    assert wider.labels[:2] == known.labels
    for quantity in ("creep", "friction", "roller_drag", "scrub"):
        own = [value(known, f"{name}.{quantity}") for name in known.labels]
        made = [value(wider, f"{name}.{quantity}") for name in names]
        assert np.log(made).mean() == pytest.approx(np.log(own).mean())
    creep = [value(wider, f"{name}.creep") for name in names]
    drag = [value(wider, f"{name}.roller_drag") for name in names]
    assert np.argsort(creep, kind="stable").tolist() == np.argsort(drag, kind="stable").tolist()
    assert max(creep) / min(creep) == pytest.approx(np.exp(4.0))
    assert max(drag) / min(drag) == pytest.approx(np.exp(0.8 * 4.0))
    # their motion is surely no better known than that of a floor that was driven on
    assert (np.asarray(wider.effect[2:]) > np.asarray(wider.effect[:2]).max(axis=0)).all()
    assert {n.verdict for p, n in wider.record.parameters.items() if "unseen" in p} == {
        "not_identified"
    }


def test_currents_on_unseen_floors_are_less_certain_than_on_any_known_floor():
    wider = deployed(current=1.0).with_unseen()
    known, made = np.asarray(wider.current_std[:2]), np.asarray(wider.current_std[2:])
    assert made == pytest.approx(1.5 * known.mean())
    assert made.min() > known.max()


def test_effects_of_unseen_floors_are_unknown_and_have_a_large_std():
    made = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["firm", "soft"])
    cell = ((0.01, -0.02, 0.3), (0.0, 0.1, 0.0))
    left = ((0.01, 0.02, 0.3), (0.0, 0.1, 0.0))
    told = EffectRecord((0.1,), ((cell,), (cell,)), ((left,), (left,)))
    known = deploy_known(made, effects={made.body.loads[0]: told}).record
    spread = tuple(replace(load, spread=((0.2, 0.4, 0.1),) * 2) for load in known.loads)
    record = with_unseen(replace(known, loads=spread))
    (load,) = record.loads
    assert load.told is not None
    assert load.told.mean[:2] == told.mean
    assert load.told.left[:2] == told.left
    assert load.spread[2:] == pytest.approx(np.tile([0.2, 0.4, 0.1], (COUNT, 1)))
    assert np.asarray(load.told.mean[2:]) == pytest.approx(np.zeros((COUNT, 1, 2, 3)))
    both = np.hypot([0.1, 0.1, 0.3], [0.2, 0.4, 0.1])
    assert np.asarray(load.told.left[2:]) == pytest.approx(np.tile(both, (COUNT, 1, 2, 1)))


def test_unseen_floors_together_are_as_rare_as_a_second_floor():
    known, wider = deployed(), deployed().with_unseen()
    settings = Settings(further_floor_penalty=2.0)
    prior = np.asarray(FloorFilter(wider, settings).prior())
    ways = hypotheses_of(wider)
    before = np.asarray(FloorFilter(known, settings).prior())
    # the driven floors keep their odds
    np.testing.assert_allclose(prior[: len(before)] / prior[0], before / before[0])
    assert prior[ways.uniform[2:]].sum() == pytest.approx(np.exp(-2.0) * prior[ways.uniform[0]])


def test_unseen_floors_are_added_once():
    record = with_unseen(deployed().record)
    assert with_unseen(record) is record


def test_a_floor_with_the_name_of_an_unseen_floor_is_refused():
    made = deploy_known(build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["unseen_3"]))
    with pytest.raises(ValueError, match="floor 'unseen_3'"):
        made.with_unseen()


def test_a_robot_enters_and_leaves_unseen_floors_as_a_whole():
    wider = deployed().with_unseen()
    by_floor, ways = FloorFilter(wider, Settings()), hypotheses_of(wider)
    for start in (0, 5):
        alone = jnp.zeros((len(ways), 1)).at[ways.uniform[start]].set(1.0)
        now = np.asarray(by_floor._unseen_changed(alone, jnp.asarray(0.5)))[:, 0]
        assert now.sum() == pytest.approx(1.0)
        assert (now[ways.uniform[2:]] > 0).all()
        assert now[ways.uniform[start]] > 0.97
        # also when wheels come to other floors one by one
        all_told = np.asarray(by_floor._changed(alone, jnp.asarray(0.5)))[:, 0]
        assert (all_told[ways.uniform[2:]] > 0).all()
    # from one floor that was driven on to another it comes wheel by wheel
    alone = jnp.zeros((len(ways), 1)).at[ways.uniform[0]].set(1.0)
    assert float(by_floor._unseen_changed(alone, jnp.asarray(0.5))[ways.uniform[1], 0]) == 0.0


@cache
def strange(numbers: tuple[tuple[str, float], ...]) -> DeployedRobot:
    """The robot on a floor that it does not know."""
    made = build(omni([60.0, 180.0, 300.0], 0.125, 0.04, 16.0), ["strange"])
    surfaces = replace(made.surfaces, **{k: jnp.asarray([v]) for k, v in numbers})
    return deploy_known(eqx.tree_at(lambda r: r.surfaces, made, surfaces), highest_speed=8.0)


DT = 0.1
solve = eqx.filter_jit(FloorFilter.solve)


@eqx.filter_jit
def driven(estimator: Estimator, w: jax.Array, amps: jax.Array) -> jax.Array:
    """Pose after 4 s at wheel speeds [rad/s] and currents [A]; compiled once for robots alike."""
    nothing = Readings.nothing(3)

    def step(state: EstimatorState, k: jax.Array) -> tuple[EstimatorState, jax.Array]:
        z = replace(nothing, wheel_angle=k * DT * w, current=amps)
        state, seen = estimator.step(state, z, DT)
        return state, seen.pose

    return jax.lax.scan(step, estimator.init(), jnp.arange(41.0))[1][-1]


def end_after(
    robot: DeployedRobot, numbers: dict[str, float], way: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return true and estimated poses after 4 s on an unfamiliar floor."""
    truth, settings = strange(tuple(numbers.items())), Settings(current_is_signed=True)
    w = truth.forward @ jnp.asarray([0.2 * np.cos(way), 0.2 * np.sin(way), 0.0]) / 0.04
    xi = jnp.zeros((1, 3))
    for _ in range(4):
        xi, amps = solve(FloorFilter(truth, settings), xi, w, w)
    assert np.isfinite(amps).all()
    return np.asarray(advance(xi[0], 4.0)), np.asarray(
        driven(Estimator(robot, settings), w, amps[0])
    )


DIRECTIONS = (0.3, 1.2, 2.5)
"""Directions of travel [rad]."""


@pytest.mark.slow
@pytest.mark.parametrize(("numbers", "each", "mean"), [(SOFT, 0.7, 0.5), (OTHER, 0.95, 0.8)])
def test_an_unfamiliar_floor_is_identified_by_its_currents(numbers, each, mean):
    """The gain differs between directions, since only a few unseen floors are kept."""
    before, after = [], []
    for direction in DIRECTIONS:
        true, pose = end_after(deployed(), numbers, direction)
        _, wider = end_after(deployed().with_unseen(), numbers, direction)
        before.append(float(np.hypot(*(pose - true)[:2])))
        after.append(float(np.hypot(*(wider - true)[:2])))
    assert (np.asarray(after) < each * np.asarray(before)).all()
    assert np.mean(after) < mean * np.mean(before)
