"""Whole steps of generated C say what JAX says, and so does a loop closed by them."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from slipid.exports.c99.code import Code
from slipid.exports.fields import attribute_docs
from slipid.robot.interface import PERIOD, Measurement
from slipid.robot.trajectory import rectangle
from tests.helpers.c_against_jax import Batch, Source, differences, wander
from tests.helpers.compiled_c import NEEDS_COMPILER, QUICK, CompiledC, code, put, worst
from tests.robot.test_estimator import SENSED, adversary

pytestmark = NEEDS_COMPILER


@cache
def batches(row: str) -> list[Batch]:
    """Steps of 40 robots by JAX, half of whose sensors lie."""
    usual = wander(3)

    def draw(key, angle):
        one, other = jax.random.split(key)
        good, dt = usual(one, angle[:20])
        z, times, _ = adversary(other, 20, angle[20:])
        # JAX takes numbers that have no full precision for 0, C does not
        z, times = (jnp.where(jnp.abs(x) < 1e-300, 0.0, x) for x in (z, times))
        bad = jax.vmap(SENSED.unravel)(z)
        together = jax.tree.map(lambda *x: jnp.concatenate(x), good, bad)
        return together, jnp.concatenate([dt, times])

    steps = Source(code(row).loop, draw, 40, 20)
    return [steps.next() for _ in range(3)]


@pytest.mark.slow
@pytest.mark.parametrize("row", ["contact", "torque", "indiveri"])
def test_a_step_is_that_of_jax(row, tmp_path):
    compiled = CompiledC(code(row), tmp_path)
    found = [differences(compiled, batch) for batch in batches(row)]
    every = {name: np.concatenate([f[name] for f in found]) for name in found[0]}
    for name, gaps in every.items():
        # where the balance is flat, the last bits count for more
        assert np.mean(gaps > 1e-12) < 0.002, name
        assert np.max(gaps) < 1e-10, name


@pytest.mark.slow
def test_a_step_in_float_is_near_that_of_jax(tmp_path):
    compiled = CompiledC(code("contact"), tmp_path, (*QUICK, "-DSLIPID_FLOAT"))
    found = differences(compiled, batches("contact")[0])
    usual = np.arange(len(found["said.twist"])) % 40 < 20
    assert np.quantile(found["said.twist"][usual], 0.9) < 1e-5
    assert np.max(found["said.pose"][usual]) < 1e-3


@pytest.mark.slow
def test_a_robot_starts_as_in_the_library(tmp_path):
    compiled = CompiledC(code("contact"), tmp_path)
    compiled.begin((0.3, -0.2, 1.1))
    begin = code("contact").loop.init((0.3, -0.2, 1.1))
    assert max(worst(compiled.estimator, begin.estimator).values()) == 0
    assert max(worst(compiled.controller, begin.controller).values()) == 0


@pytest.mark.slow
def test_a_path_is_followed_as_in_the_library(tmp_path):
    made = code("contact")
    compiled, path, time = CompiledC(made, tmp_path), rectangle(), jnp.zeros(())
    preview = made.loop.controller.gains.preview
    rng = np.random.default_rng(0)
    for _ in range(100):
        pose = np.asarray(path.at(time))[:3] + 0.04 * rng.normal(size=3)
        compiled.estimate["pose"] = pose
        compiled.follow(PERIOD)
        time, reference = path.follow(time, jnp.asarray(pose), PERIOD, preview)
        np.testing.assert_allclose(compiled.time, time, rtol=1e-13)
        np.testing.assert_allclose(compiled.reference, reference, atol=1e-13)


@pytest.mark.slow
def test_nothing_is_measured_where_nothing_is_filled_in(tmp_path):
    compiled = CompiledC(code("contact"), tmp_path)
    put(compiled.reading, Measurement(wheel_angle=np.ones(3)).filled(3))
    compiled._call("nothing", compiled.reading)
    assert all(np.isnan(compiled.reading[name]).all() for name in compiled.reading.dtype.names)


@pytest.mark.slow
def test_a_clock_that_has_run_for_days_goes_on_in_float(tmp_path):
    """Nothing that grows with the time a robot has driven is kept."""
    compiled = CompiledC(code("contact"), tmp_path, (*QUICK, "-DSLIPID_FLOAT"))
    compiled.begin((0.0, 0.0, 0.0))
    compiled._call("nothing", compiled.reading)
    compiled.reading["wheel_speed"] = [3.0, 0.0, -3.0]
    for _ in range(20_000):
        compiled.observe(0.05)
    before = compiled.estimator
    for name in ("place_noise", "place_far", "place_still", "wheels_age"):
        assert np.max(np.abs(before[name])) < 1.0, name
    ages = before["place_history"].reshape(-1, 15)[:, 0]
    np.testing.assert_allclose(ages, 0.05 * np.arange(len(ages)), rtol=1e-4)


@pytest.mark.slow
def test_every_field_has_a_unit():
    plain = {f.name for s in code("contact").structs for f in s.fields if f.about.endswith("[1]")}
    assert plain == {
        *("floors_belief", "floors_expected", "place_toward", "begun", "slip"),
        *("drives_off", "gave_up", "limited", "pursues"),
        *("surface_probability", "stale", "immobilised", "out_of_range", "rejected"),
        *("wheels_rejected", "refused", "gyro_rejected"),
        *("place_fixes_agreeing", "place_fixes_rejected"),
    }


def test_a_docstring_says_what_each_attribute_is():
    docs = attribute_docs(Measurement)
    assert docs["gyro"] == "yaw rate [rad/s]"
    assert docs["fix_std"].startswith("std of the fix's position [m] and heading [rad]")
    assert set(docs) == set(vars(Measurement()))


@pytest.mark.slow
def test_the_loop_closes_in_c_as_it_does_in_the_library(tmp_path):
    from slipid.deploy.deploy import actuator_model_of
    from slipid.deploy.export import record_example
    from slipid.deploy.twin_run import starts, twin_floor, twin_plant

    made = code("contact")
    path = rectangle(length=0.4, width=0.2)
    generated = Code(made.robot, made.loop, path)
    compiled = CompiledC(generated, tmp_path)
    robot = made.robot
    floor = twin_floor(robot)
    start, sensors = starts(20, floor, path)[0], actuator_model_of(robot, gyro=False)
    plant = twin_plant(robot, floor, start, 0, sensors)
    kept = record_example(made.loop, path, plant, (0.0, 0.0, 0.0), "rectangle")
    compiled.begin((0.0, 0.0, 0.0))
    numbers = [f.size for f in generated.reading.fields]
    for row, command, time in zip(kept.given, kept.command, kept.time, strict=True):
        parts = np.split(row[1:], np.cumsum(numbers)[:-1])
        for field, part in zip(generated.reading.fields, parts, strict=True):
            compiled.reading[field.name] = part.reshape(field.shape)
        compiled.observe(row[0])
        compiled.follow(row[0])
        compiled.control(row[0])
        np.testing.assert_allclose(compiled.command, command, atol=1e-9)
        np.testing.assert_allclose(compiled.time, time, atol=1e-9)
    assert kept.time[-1] > path.duration - 1e-6
